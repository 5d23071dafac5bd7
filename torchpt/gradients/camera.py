"""Gradients with respect to the camera in film space: first hits stay in place, and their projections move over the film.

A loss is an integral over the film, ``∫ C(p) L(p) dp``, where ``C`` is the cotangent of the pixels under their filters and
``L`` the radiance seen at ``p``. A first hit that stays on its surface while the camera moves is projected to ``p(θ)``. Its
radiance toward the camera changes only because the BSDF depends on the direction. Integration by parts gives

    d/dθ ∫ C L dp  =  ∫ (C div u + u · ∇C) L dp  +  ∫ C dL/dθ dp  +  edges,      u = dp/dθ.

The first term weights paths by the change of their film area and by the slope of the filters. A path is added to all pixels
whose filters cover it, since the slopes of neighbouring filters nearly cancel for a smooth loss. A box filter has jumps instead
of slopes: there, paths through the borders of pixels carry light from one pixel to the next. The second term is the derivative
of the BSDF. This is the material form of Zhang et al. (*Path-Space Differentiable Rendering*, 2020) with the first hit held
too; the borders are the boundary of its pixel.

Nothing behind the first hit is differentiated. If the first hit slid along its surface while later vertices stay, the geometry
term of two points at distance r would have a derivative of order 1/r: near the corners of a room it is not absolutely
integrable, and the visibility between all points changes. Here edges are only silhouettes on the film. With the radiance ``L``
behind and the motion of both sides, their term is ``∮ C L (u_near - u_behind) · n``: zero where the camera rotates or its field
of view changes, which moves both sides alike, and zero at creases. :mod:`torchpt.gradients.edges` computes it.
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

#: Xor mask that gives these paths a seed of their own.
_OTHER = 0x2545F491

#: Maps samples ``(3, ...)`` to their values in pixels: finite, and clamped.
Count = Callable[[Tensor], Tensor]


def film_space_applies(scene: Scene, settings: Settings, wanted: Iterable[str]) -> bool:
    """Return True if gradients with respect to parameters ``wanted`` can be computed in film space.

    The camera moves and no surface does, and everything is opaque: a ray that passes surfaces has no first hit to hold.
    """
    moving = [name for name in wanted if scene.spec(name).moves is Moves.SURFACES]
    of_camera = bool(moving) and all(name.startswith("camera.") for name in moving)
    if not of_camera or any(owner.material.opacity != 1.0 for owner in (*scene.built.parts, *scene.built.copies)):
        return False
    return scene.description.camera.kind.projects and isinstance(settings.integrator, PathIntegrator)


def needs_direction_gradients(scene: Scene, wanted: Iterable[str]) -> bool:
    """Return True if directions need derivatives in film space: behind delta lobes, or for parameters of other objects."""
    owners = [*scene.built.parts, *scene.built.copies]
    bent = any(material.model.delta for owner in owners for material in owner.material.all())
    return bent or attached(scene, [name for name in wanted if not name.startswith("camera.")])


def film_space_backward(scene_tape: SceneTape, settings: Settings, cotangent: Tensor, sums: GradientSums) -> None:
    """Add the gradients of a render to ``sums``, in film space, a chunk at a time.

    Args:
        scene_tape: the wave and its leaves.
        settings: of the backward pass.
        cotangent: of the pixels ``(3, H W)``.
        sums: gradient sums to add to.

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
    """First hits that stay in place while the camera moves, and their projections."""

    state: PathState  # camera rays to the points, differentiable in the camera
    x: Tensor  # (N,) position on the film in pixels, differentiable
    y: Tensor  # (N,) likewise
    stretch: Tensor  # (N,) relative film area: 1, differentiable


def interior(primal: Wave, wave: Wave, span: Span) -> Tensor:
    """Return radiance ``(3, samples, pixels)`` with the derivative of pixels under a box filter, without the border term.

    Args:
        primal: the wave with detached parameters.
        wave: the same wave on a tape.
        span: arguments of :func:`torchpt.engines.engine.radiance`.
    """
    with torch.no_grad():
        state = primal.rays(*span)
    seen = _hold_points(primal, wave, state)
    return (_radiance(wave, seen.state) * seen.stretch).view(3, span[3], span[1])


def borders(
    primal: Wave, wave: Wave, vertical: bool, span: Span, samples: int, cotangent: Tensor, count: Count
) -> Tensor:
    """Return the loss of light that moves through borders of pixels ``(3, N)``: the values are 0, their derivatives are not.

    Args:
        primal: the wave with detached parameters.
        wave: the same wave on a tape.
        vertical: True: borders between neighbours in a row. False: in a column.
        span: first border, number of borders, first sample, number of samples.
        samples: number of samples of each border over all spans.
        cotangent: of the pixels ``(3, H W)``.
        count: see :data:`Count`.
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
    """Return the number of vertical borders and of horizontal ones, as pairs of ``vertical`` and number."""
    _, _, width, height = primal.crop
    return (True, (width + 1) * height), (False, width * (height + 1))


def splats(primal: Wave, wave: Wave, span: Span, samples: int, cotangent: Tensor, count: Count) -> Tensor:
    """Return the loss of samples all over the film ``(3, N)``, for filters that are continuous at their radius.

    Each path is added to all pixels whose filters cover it, so that the slopes of neighbouring filters cancel.

    Args:
        primal: the wave with detached parameters.
        wave: the same wave on a tape.
        span: first cell, number of cells, first sample, number of samples; see :func:`cells`.
        samples: number of samples of each cell over all spans.
        cotangent: of the pixels ``(3, H W)``.
        count: see :data:`Count`.
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
    """Return the number of cells of a pixel's size that the filter of any pixel covers."""
    _, _, width, height = primal.crop
    return (width + 2 * _beyond(primal)) * (height + 2 * _beyond(primal))


def _beyond(primal: Wave) -> int:
    """Return how many pixels a filter extends beyond its own."""
    return math.ceil(primal.filter.radius - 0.5)


def _filter(primal: Wave, away: Tensor) -> Tensor:
    """Return the normalized profile of the filter ``(N,)`` at distances ``away``, differentiable."""
    filter, place = primal.filter, away.detach().cpu().double().numpy()
    ends = np.linspace(-filter.radius, filter.radius, (1 << 12) + 1, dtype=np.float64)
    middle = 0.5 * (ends[1:] + ends[:-1])
    whole, step = filter.profile(middle).mean() * 2.0 * filter.radius, 1e-5 * filter.radius
    slope = (filter.profile(place + step) - filter.profile(place - step)) / (2.0 * step * whole)
    value = torch.from_numpy(filter.profile(place) / whole).to(away)
    return value + torch.from_numpy(slope).to(away) * (away - away.detach())


def _of_pixel(cotangent: Tensor, column: Tensor, row: Tensor, width: int) -> Tensor:
    """Return the cotangents ``(3, N)`` of pixels; 0 outside the picture."""
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < cotangent.shape[1] // width)
    return torch.where(inside, take(cotangent, torch.where(inside, row * width + column, 0)), 0.0)


def _cells(primal: Wave, span: Span, columns: int, samples: int, stream: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return columns and rows ``(N,)`` of cells or borders, random offsets in them ``(2, N)``, and sampler keys."""
    first, count, start, several = span
    device = primal.centre.device
    cell = torch.arange(first, first + count, device=device).repeat(several)
    sample = torch.arange(start, start + several, device=device).repeat_interleave(count)
    sampler = replace(primal.sampler, seed=primal.sampler.seed ^ _OTHER, spp=samples, randomizations=1)
    key = sampler.key(2 * cell + stream, sample)
    offset = Draws(sampler.points, key, salts(0, device)).two(Dimension.PIXEL).to(primal.context.plan.dtype)
    return cell % columns, cell // columns, offset, key


def _rays(primal: Wave, x: Tensor, y: Tensor, key: Tensor) -> PathState:
    """Return camera rays through positions ``x, y`` of the film."""
    dtype = primal.context.plan.dtype
    o, d = primal.camera.rays(x.to(dtype), y.to(dtype), None)
    return camera_state(o.expand_as(d), d, key)


def _radiance(wave: Wave, state: PathState) -> Tensor:
    """Return the radiance ``(3, N)`` along camera rays."""
    return trace(wave, state)


def _hold_points(primal: Wave, wave: Wave, state: PathState) -> _HeldPoints:
    """Return the first hits of camera rays with detached parameters, projected by the camera on the tape."""
    world = primal.context.world
    with torch.no_grad():
        hit = hits(primal, state)
        missed = hit.prim < 0
        at = interact(world, state.o, state.d, replace(hit, prim=hit.prim.clamp_min(0)), True)
        p, n = torch.where(missed, 0.0, at.p), torch.where(missed, 0.0, at.ng)
    origin = wave.camera.origin()
    offset = torch.where(missed, state.d, p - origin)  # infinitely far points do not move with the camera
    x, y, scale = wave.camera.project(offset)
    area = scale * torch.where(missed, 1.0, dot(n, offset).abs())
    value = area.detach()
    stretch = torch.where(value > 0, area / torch.where(value > 0, value, 1.0), 1.0)
    towards = normalize(offset)
    o = state.o + (origin - origin.detach())
    return _HeldPoints(replace(state, o=o, d=state.d + (towards - towards.detach())), x, y, stretch)
