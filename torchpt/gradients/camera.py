"""Gradients by the camera: what it sees stays in place, and the picture moves over it.

A loss is an integral over the film, ``∫ C(p) L(p) dp``: ``C`` are the cotangents of pixels, each under its filter, ``L`` the
radiance that is seen at ``p``. A point that is held on its surface while the camera moves is seen at ``p(θ)``, and sends as
much light to it as before, but for what its material makes of another direction. So, by parts,

    d/dθ ∫ C L dp  =  ∫ (C div u + u · ∇C) L dp  +  ∫ C dL/dθ dp  +  edges,      u = dp/dθ.

The first term weighs paths by how their film area changes, and by the slopes of filters. Filters are seen together: a path
counts in all pixels in which its place lies, as a gradient of a smooth loss has little of the slope of one filter. A box has
jumps in place of slopes, and there paths through the borders of pixels carry light from one to the next. The second term is the
material's part. It is the material form of Zhang et al. (*Path-Space Differentiable Rendering*, 2020) with the first point
held too, and the borders are the boundary of its pixel.

No derivative is taken of what happens behind the first point. Where that slides along its surface while later points stay,
the geometry term of two points at distance r has a derivative of the order of 1/r: near the corners of a room its absolute
value has no mean, and the visibility between all points changes. Here edges are only those where nearer things hide others.
With the radiance ``L`` behind and the motions of both sides they are ``∮ C L (u_near - u_behind) · n``: nothing where the
camera turns or its angle of view changes, which moves both alike, and nothing at creases. :mod:`torchpt.gradients.edges` takes
that term.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchpt.core.memory import Span
from torchpt.engines.engine import hits, trace
from torchpt.gradients.parameters import SceneTape, attached
from torchpt.gradients.tape import chunk_by_chunk, clamped_samples
from torchpt.math.sums import GradientSums
from torchpt.math.vectors import dot, normalize, take
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.paths.state import PathState
from torchpt.paths.wave import Wave, camera_state
from torchpt.physics.samplers import Dimension, Draws, salts
from torchpt.physics.shapes import interact
from torchpt.scene import Scene
from torchpt.scene.settings import Settings
from torchpt.spec import Moves

__all__ = ["film_space_applies", "film_space_backward", "needs_direction_gradients"]

#: Makes the seed of paths through borders another one.
_OTHER = 0x2545F491

#: How samples ``(3, ...)`` count in pixels.
Count = Callable[[Tensor], Tensor]


def film_space_applies(scene: Scene, settings: Settings, wanted: Iterable[str]) -> bool:
    """Return True where gradients by the parameters ``wanted`` are taken in this form.

    The camera moves, no surface does, and every ray ends at the first one: what lets some rays pass has no place to be held at.
    """
    moving = [name for name in wanted if scene.spec(name).moves is Moves.SURFACES]
    of_camera = bool(moving) and all(name.startswith("camera.") for name in moving)
    if not of_camera or any(owner.material.opacity != 1.0 for owner in (*scene.built.parts, *scene.built.copies)):
        return False
    return scene.description.camera.kind.projects and isinstance(settings.integrator, PathIntegrator)


def needs_direction_gradients(scene: Scene, wanted: Iterable[str]) -> bool:
    """Return True where directions follow surfaces in it: those behind mirrors and glass, or where others ask for it."""
    owners = [*scene.built.parts, *scene.built.copies]
    bent = any(material.model.delta for owner in owners for material in owner.material.all())
    return bent or attached(scene, [name for name in wanted if not name.startswith("camera.")])


def film_space_backward(scene_tape: SceneTape, settings: Settings, cotangent: Tensor, sums: GradientSums) -> None:
    """Reverse mode in this form, a chunk at a time.

    Args:
        scene_tape: what waves read.
        settings: of the backward pass.
        cotangent: derivatives by the pixels ``(3, H W)``.
        sums: what is added to.

    Raises:
        RenderError: not even the tape of a single lane fits in memory.
    """
    primal, wave, spp = scene_tape.wave, scene_tape.taped, settings.render.spp
    count = partial(clamped_samples, settings)

    def inner(span: Span) -> tuple[Tensor, Tensor]:
        return count(interior(primal, wave, span)).sum(1) / spp, cotangent[:, span[0] : span[0] + span[1]]

    def splat(span: Span) -> tuple[Tensor, Tensor]:
        values = splats(primal, wave, span, spp, cotangent, count)
        return values, torch.ones_like(values)

    def border(vertical: bool, each: int, span: Span) -> tuple[Tensor, Tensor]:
        values = borders(primal, wave, vertical, span, each, cotangent, count)
        return values, torch.ones_like(values)

    _, _, width, height = primal.crop
    if not primal.filter.jumps:
        chunk_by_chunk(scene_tape, settings, sums, splat, cells(primal), spp)
        return
    each = -(-spp // 4)
    chunk_by_chunk(scene_tape, settings, sums, inner, width * height, spp)
    for vertical, number in borders_of(primal):
        chunk_by_chunk(scene_tape, settings, sums, partial(border, vertical, each), number, each)


@dataclass(frozen=True)
class _HeldPoints:
    """Surfaces that are seen at places of the film, held where they are."""

    state: PathState  # camera rays that follow the camera to the points
    x: Tensor  # (N,) where on the film, in pixels, differentiable
    y: Tensor  # (N,) likewise
    stretch: Tensor  # (N,) of value 1: film area, differentiable


def interior(primal: Wave, wave: Wave, span: Span) -> Tensor:
    """Radiance ``(3, samples, pixels)`` whose derivative is that of pixels under a box, but for their borders.

    Args:
        primal: a wave of detached parameters.
        wave: the same under a tape.
        span: as of :func:`torchpt.engines.engine.radiance`.
    """
    with torch.no_grad():
        state = primal.rays(*span)
    seen = _hold_points(primal, wave, state)
    return (_radiance(wave, seen.state) * seen.stretch).view(3, span[3], span[1])


def borders(
    primal: Wave, wave: Wave, vertical: bool, span: Span, samples: int, cotangent: Tensor, count: Count
) -> Tensor:
    """Return what moves through borders of pixels is worth, ``(3, N)``: values are 0, derivatives are not.

    Args:
        primal: a wave of detached parameters.
        wave: the same under a tape.
        vertical: borders between neighbours in a row; else in a column.
        span: first border, how many, first sample, how many of them.
        samples: of each border, in all.
        cotangent: derivatives by the pixels ``(3, H W)``.
        count: how samples count in pixels.
    """
    x0, y0, width, _ = primal.crop
    columns = width + 1 if vertical else width
    column, row, offset, key = _cells(primal, span, columns, samples, int(vertical))
    along = offset[0]
    with torch.no_grad():
        state = _rays(primal, column + x0 + (0.0 if vertical else along), row + y0 + (along if vertical else 0.0), key)
        radiance = count(_radiance(primal, state))
        before = _of_pixel(cotangent, column - (1 if vertical else 0), row - (0 if vertical else 1), width)
        film_cotangent = _of_pixel(cotangent, column, row, width) - before
    seen = _hold_points(primal, wave, state)
    at = seen.x if vertical else seen.y
    return film_cotangent.to(radiance.dtype) * radiance * (at - at.detach()) / samples


def borders_of(primal: Wave) -> tuple[tuple[bool, int], ...]:
    """Upright borders and others: whether they are, and how many."""
    _, _, width, height = primal.crop
    return (True, (width + 1) * height), (False, width * (height + 1))


def splats(primal: Wave, wave: Wave, span: Span, samples: int, cotangent: Tensor, count: Count) -> Tensor:
    """Return what places all over the film are worth ``(3, N)``, for filters that end without a jump.

    Each path counts in all pixels that see its place: what the derivatives of neighbouring filters have in common cancels.

    Args:
        primal: a wave of detached parameters.
        wave: the same under a tape.
        span: first cell, how many, first sample, how many of them; cells are those of :func:`cells`.
        samples: of each cell, in all.
        cotangent: derivatives by the pixels ``(3, H W)``.
        count: how samples count in pixels.
    """
    x0, y0, width, _ = primal.crop
    beyond = _beyond(primal)
    column, row, offset, key = _cells(primal, span, width + 2 * beyond, samples, 0)
    column, row = column - beyond, row - beyond
    with torch.no_grad():
        state = _rays(primal, column + x0 + offset[0], row + y0 + offset[1], key)
    seen = _hold_points(primal, wave, state)
    radiance = count(_radiance(wave, seen.state) * seen.stretch)
    reach = range(-beyond, beyond + 1)
    across = [_filter(primal, seen.x - (column + (x0 + k + 0.5))) for k in reach]
    down = [_filter(primal, seen.y - (row + (y0 + k + 0.5))) for k in reach]
    film_cotangent = torch.zeros_like(radiance)
    for i, along in zip(reach, down, strict=True):
        for k, weight in zip(reach, across, strict=True):
            film_cotangent = film_cotangent + _of_pixel(cotangent, column + k, row + i, width).to(
                film_cotangent.dtype
            ) * (weight * along)
    return radiance * film_cotangent / samples


def cells(primal: Wave) -> int:
    """Return how many cells of a pixel's size there are that any pixel sees."""
    _, _, width, height = primal.crop
    return (width + 2 * _beyond(primal)) * (height + 2 * _beyond(primal))


def _beyond(primal: Wave) -> int:
    """Return how many pixels a filter reaches beyond its own."""
    return math.ceil(primal.filter.radius - 0.5)


def _filter(primal: Wave, away: Tensor) -> Tensor:
    """The filter's profile ``(N,)`` at distances, of integral 1, differentiable."""
    filter, place = primal.filter, away.detach().cpu().double().numpy()
    ends = np.linspace(-filter.radius, filter.radius, (1 << 12) + 1, dtype=np.float64)
    middle = 0.5 * (ends[1:] + ends[:-1])
    whole, step = filter.profile(middle).mean() * 2.0 * filter.radius, 1e-5 * filter.radius
    slope = (filter.profile(place + step) - filter.profile(place - step)) / (2.0 * step * whole)
    value = torch.from_numpy(filter.profile(place) / whole).to(away)
    return value + torch.from_numpy(slope).to(away) * (away - away.detach())


def _of_pixel(cotangent: Tensor, column: Tensor, row: Tensor, width: int) -> Tensor:
    """Return what is asked ``(3, N)`` of pixels; nothing beyond the picture."""
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < cotangent.shape[1] // width)
    return torch.where(inside, take(cotangent, torch.where(inside, row * width + column, 0)), 0.0)


def _cells(primal: Wave, span: Span, columns: int, samples: int, stream: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Columns and rows ``(N,)`` of cells or borders, places within them ``(2, N)`` and keys of paths of their own."""
    first, count, start, several = span
    device = primal.centre.device
    cell = torch.arange(first, first + count, device=device).repeat(several)
    sample = torch.arange(start, start + several, device=device).repeat_interleave(count)
    sampler = replace(primal.sampler, seed=primal.sampler.seed ^ _OTHER, spp=samples, randomizations=1)
    key = sampler.key(2 * cell + stream, sample)
    offset = Draws(sampler.points, key, salts(0, device)).two(Dimension.PIXEL).to(primal.context.plan.dtype)
    return cell % columns, cell // columns, offset, key


def _rays(primal: Wave, x: Tensor, y: Tensor, key: Tensor) -> PathState:
    """Camera rays through places of the film."""
    dtype = primal.context.plan.dtype
    o, d = primal.camera.rays(x.to(dtype), y.to(dtype), None)
    return camera_state(o.expand_as(d), d, key)


def _radiance(wave: Wave, state: PathState) -> Tensor:
    """Radiance ``(3, N)`` that camera rays bring."""
    return trace(wave, state)


def _hold_points(primal: Wave, wave: Wave, state: PathState) -> _HeldPoints:
    """Return what camera rays of detached parameters meet, as a camera under a tape sees it."""
    world = primal.context.world
    with torch.no_grad():
        hit = hits(primal, state)
        missed = hit.prim < 0
        at = interact(world, state.o, state.d, replace(hit, prim=hit.prim.clamp_min(0)), True)
        p, n = torch.where(missed, 0.0, at.p), torch.where(missed, 0.0, at.ng)
    origin = wave.camera.origin()
    offset = torch.where(missed, state.d, p - origin)  # what is infinitely far moves with no step of the camera
    x, y, scale = wave.camera.project(offset)
    area = scale * torch.where(missed, 1.0, dot(n, offset).abs())
    value = area.detach()
    stretch = torch.where(value > 0, area / torch.where(value > 0, value, 1.0), 1.0)
    towards = normalize(offset)
    o = state.o + (origin - origin.detach())
    return _HeldPoints(replace(state, o=o, d=state.d + (towards - towards.detach())), x, y, stretch)
