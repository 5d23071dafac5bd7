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
camera turns or its angle of view changes, which moves both alike, and nothing at creases. :mod:`torchpt.edges` takes that term.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchpt.adjoint.assembly import Assembly
from torchpt.adjoint.attachment import attached
from torchpt.adjoint.sums import Sums
from torchpt.adjoint.tape import TAPE, tape_per_lane
from torchpt.forward.schedule import Span, budget_of
from torchpt.forward.waves import Waves
from torchpt.integrators.path import PathIntegrator
from torchpt.integrators.search import Search
from torchpt.integrators.wave import Wave
from torchpt.math.gathers import gathered_by
from torchpt.math.vectors import dot, normalize
from torchpt.records import PathState
from torchpt.samplers import Dimension, Draws, salts
from torchpt.scene import Scene
from torchpt.settings import Settings
from torchpt.shapes import interact
from torchpt.spec import Moves

__all__ = ["by_film", "follows", "suits"]

#: Makes the seed of paths through borders another one.
_OTHER = 0x2545F491


def suits(scene: Scene, settings: Settings, wanted: Iterable[str]) -> bool:
    """Whether gradients by the parameters ``wanted`` are taken in this form: the camera moves, and no surface does."""
    moving = [name for name in wanted if scene.spec(name).moves is Moves.SURFACES]
    of_camera = bool(moving) and all(name.startswith("camera.") for name in moving)
    return of_camera and scene.description.camera.kind.projects and isinstance(settings.integrator, PathIntegrator)


def follows(scene: Scene, wanted: Iterable[str]) -> bool:
    """Whether directions follow surfaces in it: where mirrors and glass send on the camera's ray, or the others ask for it."""
    owners = [*scene.built.parts, *scene.built.copies]
    bent = any(material.model.delta for owner in owners for material in owner.material.all())
    return bent or attached(scene, [name for name in wanted if not name.startswith("camera.")])


def by_film(assembly: Assembly, settings: Settings, asked: Tensor, sums: Sums) -> None:
    """Reverse mode in this form, a chunk at a time.

    Args:
        assembly: what waves read.
        settings: of the backward pass.
        asked: derivatives by the pixels ``(3, H W)``.
        sums: what is added to.

    Raises:
        RenderError: not even the tape of a single lane fits in memory.
    """
    still, wave, spp = assembly.wave, assembly.taped, settings.render.spp

    def kept(values: Tensor) -> Tensor:
        values = torch.where(torch.isfinite(values.detach()).all(0), values, 0.0)
        clamp = settings.integrator.clamp
        if clamp is None:
            return values
        return values * (clamp / values.detach().abs().amax(0).clamp_min(clamp)).clamp_max(1.0)

    def inner(span: Span) -> tuple[Tensor, Tensor]:
        values = kept(interior(still, wave, span)).sum(1) / spp
        return values, asked[:, span[0] : span[0] + span[1]]

    def splat(span: Span) -> tuple[Tensor, Tensor]:
        values, places = splats(still, wave, span, spp)
        return places.picture(kept(values)), asked

    def border(upright: bool, each: int, span: Span) -> tuple[Tensor, Tensor]:
        return borders(still, wave, upright, span, each, kept), asked

    def add(part: Callable[[Span], tuple[Tensor, Tensor]], span: Span) -> None:
        found = assembly.sums()
        with torch.enable_grad(), gathered_by(found):
            values, cotangent = part(span)
        if values.requires_grad:
            leaves = [*assembly.leaves, *assembly.held]
            for number, gradient in enumerate(
                torch.autograd.grad(values, leaves, cotangent.to(values.dtype), allow_unused=True)
            ):
                if gradient is not None:
                    found.add(number, gradient)
        sums.join(found)

    # What is done with spans of what, how many of it, and samples of each: pixels, cells of the film, borders of pixels.
    _, _, width, height = still.crop
    parts: list[tuple[Callable[[Span], tuple[Tensor, Tensor]], int, int]]
    if still.filter.jumps:
        each = -(-spp // 4)
        parts = [(inner, width * height, spp)]
        parts += [(partial(border, upright, each), count, each) for upright, count in borders_of(still)]
    else:
        parts = [(splat, cells(still), spp)]
    for part, count, samples in parts:
        budget = budget_of(settings, wave.centre.device, tape_per_lane(settings))
        budget.most = min(budget.most, max(TAPE // tape_per_lane(settings), 1))
        assembly.through(Waves(budget, "the tape of a single lane"), partial(add, part), count, samples)


@dataclass(frozen=True)
class _Seen:
    """What is seen at places of the film, held where it is."""

    state: PathState  # camera rays that follow the camera to the points
    x: Tensor  # (N,) where on the film, in pixels, differentiable
    y: Tensor
    stretch: Tensor  # (N,) of value 1: film area, differentiable


def interior(still: Wave, wave: Wave, span: Span) -> Tensor:
    """Radiance ``(3, samples, pixels)`` whose derivative is that of pixels under a box, but for their borders.

    Args:
        still: a wave of detached parameters.
        wave: the same under a tape.
        span: as of :meth:`Wave.radiance`.
    """
    with torch.no_grad():
        state = still.rays(*span)
    seen = _held(still, wave, state)
    return (_brought(wave, seen.state) * seen.stretch).view(3, span[3], span[1])


def borders(
    still: Wave, wave: Wave, upright: bool, span: Span, samples: int, kept: Callable[[Tensor], Tensor]
) -> Tensor:
    """What moves through borders of pixels, ``(3, pixels)`` of the whole picture: values are 0, derivatives are not.

    Args:
        still: a wave of detached parameters.
        wave: the same under a tape.
        upright: borders between neighbours in a row; else in a column.
        span: first border, how many, first sample, how many of them.
        samples: of each border, in all.
        kept: what of radiance counts.
    """
    x0, y0, width, height = still.crop
    columns = width + 1 if upright else width
    column, row, offset, key = _cells(still, span, columns, samples, int(upright))
    along = offset[0]
    with torch.no_grad():
        state = _rays(still, column + x0 + (0.0 if upright else along), row + y0 + (along if upright else 0.0), key)
        brought = _brought(still, state)
    seen = _held(still, wave, state)
    at = seen.x if upright else seen.y
    moved = kept(brought) * (at - at.detach()) / samples
    picture = torch.zeros(3, width * height, dtype=moved.dtype, device=moved.device)
    for back, value in ((0, moved), (1, -moved)):
        picture = _added(picture, value, column - (back if upright else 0), row - (0 if upright else back), width)
    return picture


def borders_of(still: Wave) -> tuple[tuple[bool, int], ...]:
    """Upright borders and others: whether they are, and how many."""
    _, _, width, height = still.crop
    return (True, (width + 1) * height), (False, width * (height + 1))


def splats(still: Wave, wave: Wave, span: Span, samples: int) -> tuple[Tensor, Splat]:
    """Radiance ``(3, N)`` of places all over the film, and how it comes to pixels, for filters that end without a jump.

    Each path counts in all pixels that see its place: what the derivatives of neighbouring filters have in common cancels.

    Args:
        still: a wave of detached parameters.
        wave: the same under a tape.
        span: first cell, how many, first sample, how many of them; cells are those of :func:`cells`.
        samples: of each cell, in all.
    """
    x0, y0, width, _ = still.crop
    beyond = _beyond(still)
    column, row, offset, key = _cells(still, span, width + 2 * beyond, samples, 0)
    with torch.no_grad():
        state = _rays(still, column + (x0 - beyond) + offset[0], row + (y0 - beyond) + offset[1], key)
    seen = _held(still, wave, state)
    return _brought(wave, seen.state) * seen.stretch, Splat(
        still, seen.x, seen.y, column - beyond, row - beyond, samples
    )


def cells(still: Wave) -> int:
    """How many cells of a pixel's size there are that any pixel sees."""
    _, _, width, height = still.crop
    return (width + 2 * _beyond(still)) * (height + 2 * _beyond(still))


def _beyond(still: Wave) -> int:
    """How many pixels a filter reaches beyond its own."""
    return math.ceil(still.filter.radius - 0.5)


@dataclass(frozen=True)
class Splat:
    """Places of the film, and the pixels in which they lie."""

    still: Wave
    x: Tensor
    y: Tensor
    column: Tensor
    row: Tensor
    samples: int

    def picture(self, radiance: Tensor) -> Tensor:
        """Radiance ``(3, N)`` as ``(3, pixels)`` under the filter, differentiable in the places too."""
        x0, y0, width, height = self.still.crop
        reach = range(-_beyond(self.still), _beyond(self.still) + 1)
        across = [self._filter(self.x - (self.column + (x0 + k + 0.5))) for k in reach]
        down = [self._filter(self.y - (self.row + (y0 + k + 0.5))) for k in reach]
        picture = torch.zeros(3, width * height, dtype=radiance.dtype, device=radiance.device)
        for i, along in zip(reach, down, strict=True):
            for k, weight in zip(reach, across, strict=True):
                value = radiance * (weight * along) / self.samples
                picture = _added(picture, value, self.column + k, self.row + i, width)
        return picture

    def _filter(self, away: Tensor) -> Tensor:
        """The filter's profile ``(N,)`` at distances, of integral 1."""
        filter, place = self.still.filter, away.detach().cpu().double().numpy()
        ends = np.linspace(-filter.radius, filter.radius, (1 << 12) + 1, dtype=np.float64)
        middle = 0.5 * (ends[1:] + ends[:-1])
        whole, step = filter.profile(middle).mean() * 2.0 * filter.radius, 1e-5 * filter.radius
        slope = (filter.profile(place + step) - filter.profile(place - step)) / (2.0 * step * whole)
        value = torch.from_numpy(filter.profile(place) / whole).to(away)
        return value + torch.from_numpy(slope).to(away) * (away - away.detach())


def _cells(still: Wave, span: Span, columns: int, samples: int, stream: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Columns and rows ``(N,)`` of cells or borders, places within them ``(2, N)`` and keys of paths of their own."""
    first, count, start, several = span
    device = still.centre.device
    cell = torch.arange(first, first + count, device=device).repeat(several)
    sample = torch.arange(start, start + several, device=device).repeat_interleave(count)
    sampler = replace(still.sampler, seed=still.sampler.seed ^ _OTHER, spp=samples, randomizations=1)
    key = sampler.key(2 * cell + stream, sample)
    offset = Draws(sampler.points, key, salts(0, device)).two(Dimension.PIXEL).to(still.stages.plan.dtype)
    return cell % columns, cell // columns, offset, key


def _rays(still: Wave, x: Tensor, y: Tensor, key: Tensor) -> PathState:
    """Camera rays through places of the film."""
    dtype = still.stages.plan.dtype
    o, d = still.camera.rays(x.to(dtype), y.to(dtype), None)
    n = d.shape[1]
    forever = torch.full((n,), math.inf, dtype=dtype, device=d.device)
    lane = torch.arange(n, device=d.device)
    nothing = torch.zeros_like(d)
    return PathState(o.expand(3, n).clone(), d, forever, torch.ones_like(d), nothing, forever.clone(), lane, key)


def _added(picture: Tensor, value: Tensor, column: Tensor, row: Tensor, width: int) -> Tensor:
    """A picture ``(3, pixels)`` with values ``(3, N)`` at pixels, those beyond it left out."""
    height = picture.shape[1] // width
    inside = torch.nonzero((column >= 0) & (column < width) & (row >= 0) & (row < height)).squeeze(1)
    return picture.index_add(1, (row * width + column)[inside], value[:, inside])


def _brought(wave: Wave, state: PathState) -> Tensor:
    """Radiance ``(3, N)`` that camera rays bring."""
    return wave.integrator.radiance(wave.stages, wave.accel, state, wave.first)[0]


def _held(still: Wave, wave: Wave, state: PathState) -> _Seen:
    """What camera rays of detached parameters meet, as a camera under a tape sees it."""
    world, plan = still.stages.world, still.stages.plan
    with torch.no_grad():
        hit = Search(still.accel, world, plan.sampler, plan.dtype).nearest(state, 1)
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
    return _Seen(replace(state, o=o, d=state.d + (towards - towards.detach())), x, y, stretch)
