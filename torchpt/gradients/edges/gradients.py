"""The gradients that moving edges add: what ``render`` asks for after the interior of the picture is differentiated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Protocol

import torch
from torch import Tensor

from torchpt.core.autograd import gradients_of
from torchpt.core.threads import limited_threads
from torchpt.gradients.edges.bodies import Bodies, bodies_of
from torchpt.gradients.edges.cuts import Cuts, cuts_of
from torchpt.gradients.edges.film import Worth
from torchpt.gradients.edges.horizons import Horizons, horizons_of
from torchpt.gradients.edges.meshes import marked_primitives
from torchpt.gradients.edges.occluders import occluders_of
from torchpt.gradients.edges.primary import Look, primary_of
from torchpt.gradients.edges.receivers import MovingFrame
from torchpt.gradients.edges.segments import Segments, SegmentSampler, smooth_of
from torchpt.gradients.edges.shadows import Shadows, sources_of
from torchpt.gradients.edges.traced import Traced, traced_of
from torchpt.gradients.parameters import near_of, scene_reach
from torchpt.math.guiding import EdgeGuide, rounds
from torchpt.math.vectors import take
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.ranks import Group, share
from torchpt.scene import Scene
from torchpt.scene.settings import Settings
from torchpt.spec import Moves

__all__ = ["Boundary", "add_gradients", "boundary_of", "concerns", "samples_for"]

#: Samples of a chunk, whose sums are added in order: the same ones whatever the memory. They take about 4 kB each, which is
#: less in all than any render needs.
SAMPLES = 1 << 15

#: Samples of a backward pass's paths for one of each estimator of edges, which takes longer and varies less; and where there
#: are so many paths that what guides samples knows more.
_PER_EDGE_SAMPLE, _PER_EDGE_SAMPLE_OF_MANY, _MANY = 8, 16, 1 << 19
#: The same where vertices move each by itself: what guides samples learns less of so many directions.
_PER_EDGE_SAMPLE_OF_VERTICES = 4
#: The same of meshes of so many: the variance of their gradients is that of the faces' normals, which turn the more the smaller
#: a face is, and edges bring a tenth to a five-hundredth of it.
_PER_EDGE_SAMPLE_OF_MESHES, _MESH = 32, 64


class Samples(Protocol):
    """Samples of edges."""

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``, whose derivative is theirs."""
        ...


def concerns(scene: Scene, names: Iterable[str]) -> bool:
    """Return True where any of the parameters moves edges."""
    return any(scene.spec(name).moves in (Moves.SURFACES, Moves.SHADOWS) for name in names)


def samples_for(scene: Scene, names: Iterable[str], spp: int, pixels: int) -> float:
    """Return how many samples a pixel each estimator takes beside ``spp`` of the backward pass, by what is differentiated."""
    moving = [name for name in names if concerns(scene, (name,))]
    vertices = [scene.raw_params[name].numel() // 3 for name in moving if name.endswith(".vertices")]
    if not vertices:
        return spp / (_PER_EDGE_SAMPLE_OF_MANY if spp * pixels >= _MANY else _PER_EDGE_SAMPLE)
    meshes = len(vertices) == len(moving) and min(vertices) >= _MESH
    return spp / (_PER_EDGE_SAMPLE_OF_MESHES if meshes else _PER_EDGE_SAMPLE_OF_VERTICES)


def moving_primitives(scene: Scene, names: Iterable[str]) -> Tensor:
    """Return a mask ``(P,)`` of the primitives, by ids of the search, that any of the parameters moves."""
    names = [name for name in names if scene.spec(name).moves is Moves.SURFACES]

    def move(name: str) -> bool:
        return any(wanted.startswith(f"{name}.") for wanted in names)

    return marked_primitives(scene, lambda part: move(part.name), lambda copy, marked: move(copy.name) or marked)


@dataclass(frozen=True)
class Boundary:
    """The edges of a backward pass.

    Attributes:
        scene: whose edges.
        settings: of the backward pass, its seed included.
        params: all that replace the scene's, detached.
        leaves: those that move edges, as leaves of a tape.
        moving: what moves, on that tape.
        still: the same detached.
        traced: what sees.
        worth: of places on the film.
        pixels: of the picture.
        ranks: those that share the samples; None: there is but one process.
        guide: what is kept of earlier backward passes; None: nothing.
    """

    scene: Scene
    settings: Settings
    params: Mapping[str, Tensor]
    leaves: Mapping[str, Tensor]
    moving: Mapping[str, Tensor]
    still: Bodies
    traced: Traced
    worth: Worth
    pixels: int
    ranks: Group | None = None
    guide: EdgeGuide | None = None

    @property
    def _camera_moves(self) -> bool:
        return any(name.startswith("camera.") for name in self.moving)

    @cached_property
    def _cuts(self) -> Cuts | None:
        """Return the curves where surfaces cut."""
        with torch.no_grad():
            return cuts_of(self.scene, self.still, self.scene.merged(self.params))

    def gradients(self, samples: Iterable[Samples], wanted: Iterable[str]) -> list[Tensor | None]:
        """Return what samples add to the gradients of ``wanted``; None for those that move no edges."""
        sums = {name: torch.zeros_like(t) for name, t in self.moving.items()}
        tensors = self.still.tensors()
        for found in samples:
            with torch.enable_grad():
                own = {name: tensors[name].clone().requires_grad_() for name in sums}
                value = found.sum(self.still.having({**tensors, **own}))
            if not value.requires_grad:
                continue
            for name, grad in zip(own, torch.autograd.grad(value, list(own.values()), allow_unused=True), strict=True):
                if grad is not None:
                    sums[name] += grad
        if self.ranks is not None:
            sums = {name: self.ranks.sum(total) for name, total in sums.items()}
        outputs, inputs = list(self.moving.values()), list(self.leaves.values())
        grads = gradients_of(outputs, inputs, list(sums.values()))
        by_name = dict(zip(self.leaves, grads, strict=True))
        return [by_name.get(name) for name in wanted]

    def primary(self, spp: float, look: Look, held: bool = False) -> Iterator[Samples]:
        """Yield samples of the edges that the camera sees, chunk by chunk; ``look``: what rays beside them see.

        ``held``: they count as they move over what is seen beside them.
        """
        total = math.ceil(spp * self.pixels)
        if self.moving.keys() <= {"lights"}:  # none of which is seen
            return
        with torch.no_grad():
            # Elsewhere a curve that stands still may have what moves behind it, but the film has it where it was.
            moves = None if self._camera_moves else moving_primitives(self.scene, self.leaves)
            poses = self.scene.merged(self.params)
            bounds = self.worth.bounds()
            primary = primary_of(self.scene, self.still, poses, self.traced, bounds, self._cuts, moves)
        if primary is None:
            return
        for first, count in self._chunks(total):
            yield primary.samples(first, count, total, self.worth, look, held)

    def shadows(self, spp: float, holds_first: bool = False) -> Iterator[Samples]:
        """Yield samples of the edges of shadows of lights, of edges in reflected light, and of horizons.

        ``holds_first``: the interior holds in place what the camera sees.
        """
        total = math.ceil(spp * self.pixels)
        for estimator in self._estimators(holds_first):
            memory = (
                None
                if self.guide is None
                else self.guide.memory(type(estimator).__name__, self.traced.wave.centre.device)
            )
            for turn in rounds(total, memory):
                if turn.memory is not None:  # every rank draws it, as all learn from it
                    found = estimator.samples(turn, 0, turn.count)
                    if found is not None and (self.ranks is None or self.ranks.rank == 0):
                        yield found
                    continue
                for first, count in self._chunks(turn.count):
                    found = estimator.samples(turn, first, count)
                    if found is not None:
                        yield found

    def _estimators(self, holds_first: bool) -> Iterator[Shadows | Segments | Horizons]:
        still, integrator = self.still, self.traced.wave.integrator
        depth = integrator.limits.max_depth
        if not isinstance(integrator, PathIntegrator) or 0 <= depth < 2:
            return
        world = self.traced.wave.context.world
        with torch.no_grad():
            reach = float(scene_reach(self.scene, world.geometry))
            sources = sources_of(still, world, reach, met=integrator.strategy in ("bsdf", "uniform"))
            if sources is None:
                return
            moves = moving_primitives(self.scene, self.leaves)
            lights_move = "lights" in self.moving or bool(take(moves, sources.prim[: sources.surfaces]).any())
            poses = self.scene.merged(self.params)
            occluders = occluders_of(self.scene, still, poses, moves, self._cuts, lights_move=lights_move)
            near = near_of(self.scene, world.geometry, self.leaves)
            frame = MovingFrame(still, self.traced, self.worth, near, moves, holds_first, self._camera_moves)
            reflects = bool(self.moving.keys() - {"lights"})
            smooth = smooth_of(self.scene, still) if reflects else None
            horizons = horizons_of(self.scene, frame, depth) if reflects else None
        if occluders is not None:
            yield Shadows(frame, occluders, sources, depth, lights_move)
            if reflects and not 0 <= depth < 3:
                yield Segments(frame, SegmentSampler(occluders, smooth), depth)
        if horizons is not None:
            yield horizons

    def _chunks(self, total: int) -> Iterator[tuple[int, int]]:
        """Yield the first samples of chunks and their numbers."""
        for _, first in share(range(0, total, SAMPLES), self.ranks):
            yield first, min(SAMPLES, total - first)


def boundary_of(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    wanted: Iterable[str],
    dtype: torch.dtype,
    cotangent: Tensor,
    ranks: Group | None = None,
    guide: EdgeGuide | None = None,
) -> Boundary | None:
    """Return what a backward pass knows of edges; None where none of the parameters moves any.

    Args:
        scene: whose.
        settings: of the backward pass, its seed included.
        params: all that replace the scene's.
        wanted: names of those that are differentiated.
        dtype: of the lanes.
        cotangent: ``(C, H, W)`` of what is differentiated.
        ranks: those that share the samples.
        guide: what is kept of earlier backward passes.

    Raises:
        SceneError: settings that this scene cannot be rendered with.
    """
    plain = {name: value.detach() for name, value in params.items()}
    with torch.enable_grad():
        leaves = {name: plain[name].clone().requires_grad_() for name in wanted if concerns(scene, (name,))}
        bodies = bodies_of(scene, settings.film, {**plain, **leaves})
    tensors = bodies.tensors()
    moving = {name: t for name, t in tensors.items() if t.requires_grad}
    still = bodies.having({name: t.detach() for name, t in tensors.items()})
    if not moving or still.camera.film_of(still.camera.origin()) is None:
        return None
    with torch.no_grad():
        traced = traced_of(scene, settings, plain, dtype)
        worth = Worth(cotangent, traced.wave.filter, traced.wave.crop)
    pixels = cotangent.shape[1] * cotangent.shape[2]
    return Boundary(scene, settings, plain, leaves, moving, still, traced, worth, pixels, ranks, guide)


def add_gradients(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    cotangent: Tensor,
    samples: float,
    held: bool = False,
    ranks: Group | None = None,
    guide: EdgeGuide | None = None,
) -> list[Tensor | None]:
    """Return what moving edges add to the gradients of ``wanted``; None for those that move none.

    Args:
        scene: whose.
        settings: of the backward pass, its seed included.
        params: all that replace the scene's.
        wanted: names of those that are differentiated.
        dtype: of the lanes.
        cotangent: ``(H, W, 3)`` of the picture.
        samples: of each estimator, a pixel of the picture.
        held: whether the interior holds in place what the camera sees (:mod:`torchpt.gradients.camera`): edges count as they
            move over that.
        ranks: those that share the samples, which are the same on each.
        guide: what is kept of earlier backward passes.

    Raises:
        SceneError: settings that this scene cannot be rendered with.
    """
    if guide is not None:
        settings = replace(settings, render=settings.render.but(seed=guide.next_seed(settings.render.seed)))
    with limited_threads(settings.render.threads):
        cotangent = cotangent.permute(2, 0, 1)
        every = boundary_of(scene, settings, params, wanted, dtype, cotangent, ranks, guide)
        if every is None:
            return [None] * len(wanted)
        if not held:
            return every.gradients(chain(every.primary(samples, every.traced.radiance), every.shadows(samples)), wanted)
        found = every.gradients(every.primary(samples, every.traced.radiance, held=True), wanted)
        # What the camera sees is held: only lights move shadows.
        lights = [name for name in wanted if not name.startswith("camera.")]
        thrown = boundary_of(scene, settings, params, lights, dtype, cotangent, ranks, guide)
        if thrown is None:
            return found
        more = thrown.gradients(thrown.shadows(samples, holds_first=True), wanted)
        return [b if a is None else a if b is None else a + b for a, b in zip(found, more, strict=True)]
