"""Gradients with respect to the camera in film space: first hits stay in place, and their projections move over the film.

``gradients/__init__.py`` chooses this method where the camera is differentiated and no surface moves
(:func:`film_space_applies`); :func:`film_space_backward` is its entry.

A loss is an integral over the film, ``∫ C(p) L(p) dp``, where ``C`` is the cotangent of the pixels under their filters and
``L`` the radiance seen at ``p``. A first hit that stays on its surface while the camera moves is projected to ``p(θ)``. Its
radiance toward the camera changes only because the BSDF depends on the direction. Integration by parts gives

    d/dθ ∫ C L dp  =  ∫ (C div u + u · ∇C) L dp  +  ∫ C dL/dθ dp  +  edges,      u = dp/dθ.

The first term weights paths by the change of their film area and by the slope of the filters. A path is added to all pixels
whose filters cover it, since the slopes of neighbouring filters nearly cancel for a smooth loss. A box filter has jumps instead
of slopes: there, paths through the borders of pixels carry light from one pixel to the next. The second term is the derivative
of the BSDF. This is the material form of Zhang et al. (*Path-Space Differentiable Rendering*, 2020), in which surface points
keep their place on the primitive, with the first hit kept in place as well; the borders are the boundary of its pixel.

In the code a *primal* wave has detached parameters, and its twin *on the tape* carries their derivatives. Terms are returned as
values whose derivative is that of the loss: a factor ``1 + x - x.detach()`` is 1 and has the derivative of ``x``.

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

#: Xor mask that gives the paths of borders and splats a seed of their own, any constant.
_BORDER_SEED = 0x2545F491
#: A border has 1 / BORDER_FRACTION of a pixel's samples: of two borders a pixel, half as many paths as for the pixels.
BORDER_FRACTION = 4
#: Intervals by which the integral of a filter's profile is computed.
FILTER_STEPS = 1 << 12
#: Step of the central difference that gives the slope of a filter's profile, relative to the filter's radius.
_SLOPE_STEP = 1e-5

#: Maps samples ``(3, ...)`` to the values that are added to pixels: finite, and clamped.
SampleValue = Callable[[Tensor], Tensor]


def film_space_applies(scene: Scene, settings: Settings, wanted: Iterable[str]) -> bool:
    """Return True if gradients with respect to parameters ``wanted`` can be computed in film space.

    The camera moves and no surface does, and everything is opaque: a ray that passes surfaces has no first hit to hold.
    """
    moving = [name for name in wanted if scene.spec(name).moves is Moves.SURFACES]
    only_camera = bool(moving) and all(name.startswith("camera.") for name in moving)
    materials = [owner.material for owner in (*scene.built.parts, *scene.built.copies)]
    parts = [part for material in materials for part in material.with_inner()]
    if not only_camera or any(part.opacity != 1.0 or part.model.sheer for part in parts):
        return False
    return scene.description.camera.kind.projects and isinstance(settings.integrator, PathIntegrator)


def needs_direction_gradients(scene: Scene, wanted: Iterable[str]) -> bool:
    """Return True if directions need derivatives in film space: behind delta lobes, or for parameters of other objects."""
    owners = [*scene.built.parts, *scene.built.copies]
    has_delta = any(material.model.delta for owner in owners for material in owner.material.with_inner())
    return has_delta or attached(scene, [name for name in wanted if not name.startswith("camera.")])


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
    sample_value = partial(clamped_samples, settings)

    # Each of these returns the values of a chunk, which depend on the leaves of the tape, and the cotangents of the values.

    def interior_loss(span: Span) -> tuple[Tensor, Tensor]:
        first_pixel, pixel_count, _, _ = span
        pixels = interior(primal, wave, span, sample_value).sum(1) / spp
        return pixels, cotangent[:, first_pixel : first_pixel + pixel_count]

    def splat_loss(span: Span) -> tuple[Tensor, Tensor]:
        values = splats(primal, wave, span, spp, cotangent, sample_value)
        return values, torch.ones_like(values)

    def border_loss(vertical: bool, border_spp: int, span: Span) -> tuple[Tensor, Tensor]:
        values = borders(primal, wave, span, border_spp, cotangent, sample_value, vertical=vertical)
        return values, torch.ones_like(values)

    _, _, width, height = primal.crop
    if not primal.filter.jumps:  # every filter but the box is 0 at its radius
        chunk_by_chunk(scene_tape, settings, sums, splat_loss, cells(primal), spp)
        return
    border_spp = -(-spp // BORDER_FRACTION)
    chunk_by_chunk(scene_tape, settings, sums, interior_loss, width * height, spp)
    for vertical, number in borders_of(primal):
        chunk_by_chunk(scene_tape, settings, sums, partial(border_loss, vertical, border_spp), number, border_spp)


@dataclass(frozen=True)
class _HeldPoints:
    """First hits that stay in place while the camera moves, and their projections."""

    state: PathState  # camera rays to the points, differentiable in the camera
    x: Tensor  # (N,) position on the film in pixels, differentiable
    y: Tensor  # (N,) likewise
    stretch: Tensor  # (N,) film area of the point's surroundings, relative to that of now: value 1, differentiable


def interior(primal: Wave, wave: Wave, span: Span, sample_value: SampleValue) -> Tensor:
    """Return samples ``(3, samples, pixels)`` with the derivative of pixels under a box filter, without the border term.

    Args:
        primal: the wave with detached parameters.
        wave: the same wave on a tape.
        span: first pixel, number of pixels, first sample, number of samples.
        sample_value: see :data:`SampleValue`; how much of the film a point covers does not count for the clamp.
    """
    with torch.no_grad():
        state = primal.rays(*span)
    held = _hold_points(primal, wave, state)
    _, pixel_count, _, spp = span
    return (sample_value(_radiance(wave, held.state)) * held.stretch).view(3, spp, pixel_count)


def borders(
    primal: Wave,
    wave: Wave,
    span: Span,
    samples: int,
    cotangent: Tensor,
    sample_value: SampleValue,
    *,
    vertical: bool,
) -> Tensor:
    """Return the loss of light that moves through borders of pixels ``(3, N)``: the values are 0, their derivatives are not.

    Args:
        primal: the wave with detached parameters.
        wave: the same wave on a tape.
        span: first border, number of borders, first sample, number of samples.
        samples: number of samples of each border over all spans.
        cotangent: of the pixels ``(3, H W)``.
        sample_value: see :data:`SampleValue`.
        vertical: True: borders between neighbours in a row. False: in a column.
    """
    left, top, width, _ = primal.crop
    columns = width + 1 if vertical else width
    column, row, offset, key = _cells(primal, span, columns, samples, stream=int(vertical))
    along = offset[0]  # position on the border, 0..1
    with torch.no_grad():
        state = _rays(
            primal, column + left + (0.0 if vertical else along), row + top + (along if vertical else 0.0), key
        )
        radiance = sample_value(_radiance(primal, state))
        # What the loss gains if light moves from the pixel before the border (left or above) to the one behind it.
        before = _pixel_cotangents(cotangent, column - (1 if vertical else 0), row - (0 if vertical else 1), width)
        film_cotangent = _pixel_cotangents(cotangent, column, row, width) - before
    held = _hold_points(primal, wave, state)
    across = held.x if vertical else held.y
    return film_cotangent.to(radiance.dtype) * radiance * (across - across.detach()) / samples


def borders_of(primal: Wave) -> tuple[tuple[bool, int], ...]:
    """Return the number of vertical borders and of horizontal ones, as pairs of ``vertical`` and number."""
    _, _, width, height = primal.crop
    return (True, (width + 1) * height), (False, width * (height + 1))


def splats(primal: Wave, wave: Wave, span: Span, samples: int, cotangent: Tensor, sample_value: SampleValue) -> Tensor:
    """Return the loss of samples all over the film ``(3, N)``, for filters that are continuous at their radius.

    Each path is added to all pixels whose filters cover it, so that the slopes of neighbouring filters cancel.

    Args:
        primal: the wave with detached parameters.
        wave: the same wave on a tape.
        span: first cell, number of cells, first sample, number of samples; see :func:`cells`.
        samples: number of samples of each cell over all spans.
        cotangent: of the pixels ``(3, H W)``.
        sample_value: see :data:`SampleValue`.
    """
    left, top, width, _ = primal.crop
    beyond = _pixels_beyond(primal)
    column, row, offset, key = _cells(primal, span, width + 2 * beyond, samples, stream=0)
    column, row = column - beyond, row - beyond  # of the picture's pixels, or beyond them
    with torch.no_grad():
        state = _rays(primal, column + left + offset[0], row + top + offset[1], key)
    held = _hold_points(primal, wave, state)
    radiance = sample_value(_radiance(wave, held.state)) * held.stretch
    reach = range(-beyond, beyond + 1)
    # Filter weights of the pixels around, by their distance in columns and in rows.
    across = [_filter(primal, held.x - (column + (left + k + 0.5))) for k in reach]
    down = [_filter(primal, held.y - (row + (top + k + 0.5))) for k in reach]
    film_cotangent = torch.zeros_like(radiance)
    for i, row_weight in zip(reach, down, strict=True):
        for k, column_weight in zip(reach, across, strict=True):
            film_cotangent = film_cotangent + _pixel_cotangents(cotangent, column + k, row + i, width).to(
                film_cotangent.dtype
            ) * (column_weight * row_weight)
    return radiance * film_cotangent / samples


def cells(primal: Wave) -> int:
    """Return the number of cells of a pixel's size that the filter of any pixel covers."""
    _, _, width, height = primal.crop
    return (width + 2 * _pixels_beyond(primal)) * (height + 2 * _pixels_beyond(primal))


def _pixels_beyond(primal: Wave) -> int:
    """Return how many pixels a filter extends beyond its own."""
    return math.ceil(primal.filter.radius - 0.5)


def _filter(primal: Wave, away: Tensor) -> Tensor:
    """Return the normalized profile of the filter ``(N,)`` at distances ``away``, differentiable."""
    filter, distance = primal.filter, away.detach().cpu().double().numpy()
    ends = np.linspace(-filter.radius, filter.radius, FILTER_STEPS + 1, dtype=np.float64)
    middle = 0.5 * (ends[1:] + ends[:-1])  # of each interval
    integral, step = filter.profile(middle).mean() * 2.0 * filter.radius, _SLOPE_STEP * filter.radius
    slope = (filter.profile(distance + step) - filter.profile(distance - step)) / (2.0 * step * integral)
    value = torch.from_numpy(filter.profile(distance) / integral).to(away)
    return value + torch.from_numpy(slope).to(away) * (away - away.detach())


def _pixel_cotangents(cotangent: Tensor, column: Tensor, row: Tensor, width: int) -> Tensor:
    """Return the cotangents ``(3, N)`` of pixels of the picture by column and row; 0 outside of it. ``width``: its columns."""
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < cotangent.shape[1] // width)
    return torch.where(inside, take(cotangent, torch.where(inside, row * width + column, 0)), 0.0)


def _cells(primal: Wave, span: Span, columns: int, samples: int, stream: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return columns and rows ``(N,)`` of cells or borders, random offsets in them ``(2, N)``, and sampler keys.

    Args:
        primal: the wave with detached parameters.
        span: first cell, number of cells, first sample, number of samples.
        columns: number of cells in a row.
        samples: number of samples of each cell over all spans.
        stream: 0 or 1, for independent random numbers of horizontal and vertical borders.
    """
    first, count, first_sample, sample_count = span
    device = primal.centre.device
    cell = torch.arange(first, first + count, device=device).repeat(sample_count)
    sample = torch.arange(first_sample, first_sample + sample_count, device=device).repeat_interleave(count)
    sampler = replace(primal.sampler, seed=primal.sampler.seed ^ _BORDER_SEED, spp=samples, randomizations=1)
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
        surface = interact(world, state.o, state.d, replace(hit, prim=hit.prim.clamp_min(0)), follow_ray=True)
        p, n = torch.where(missed, 0.0, surface.p), torch.where(missed, 0.0, surface.ng)
    origin = wave.camera.origin()
    offset = torch.where(missed, state.d, p - origin)  # infinitely far points do not move with the camera
    x, y, scale = wave.camera.project(offset)
    # film area of a small piece of the surface, up to a constant factor
    area = scale * torch.where(missed, 1.0, dot(n, offset).abs())
    primal_area = area.detach()
    stretch = torch.where(primal_area > 0, area / torch.where(primal_area > 0, primal_area, 1.0), 1.0)
    towards = normalize(offset)
    o = state.o + (origin - origin.detach())
    return _HeldPoints(replace(state, o=o, d=state.d + (towards - towards.detach())), x, y, stretch)
