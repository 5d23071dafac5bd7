"""Explain what happened along paths: one observer keeps every event, for a path that is printed and for samples that are lost.

Where a sample is not finite it is traced again, and the first value that is not finite names the cause: stage by stage what
goes into a sample is looked at (light that was met, light that was sampled, what the path carries on), and only where one of
these is not finite it is asked which of their factors was the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from torchpt.core.tree import leaves
from torchpt.math.vectors import take
from torchpt.paths.nonfinite import SampleId
from torchpt.paths.state import Emission, PathState, VertexOutput
from torchpt.paths.walk import Observer, Population
from torchpt.paths.wave import Wave
from torchpt.physics.samplers import Randomizations
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.world import World

__all__ = [
    "CAUSES",
    "CameraRay",
    "EmitterHit",
    "Event",
    "Explainer",
    "Intersection",
    "NonFiniteCause",
    "ReadablePopulation",
    "Scattering",
    "Trace",
    "causes_of_samples",
]


class ReadablePopulation(Population, Protocol):
    """Paths whose tensors may be looked at, of an engine that keeps what its stages returned."""

    @property
    def state(self) -> PathState:
        """Return the paths as they arrive."""
        ...

    @property
    def met(self) -> Hit:
        """Return what their rays met."""
        ...

    @property
    def emissions(self) -> Sequence[tuple[Tensor, Emission]]:
        """Return the light that lanes met here by chance."""
        ...

    @property
    def outputs(self) -> Sequence[tuple[int, Tensor, VertexOutput]]:
        """Return, of the vertex before, number of the BSDF model, lanes of the wave, what its surfaces made of them."""
        ...

    @property
    def clear(self) -> Sequence[Tensor]:
        """Return how much gets through of the light that was sampled at the vertex before, model by model."""
        ...


@dataclass(frozen=True)
class CameraRay:
    """Camera rays, as they left.

    Attributes:
        lanes: ``(n,)`` int64 places in the wave, as in all events.
        state: of them.
    """

    lanes: Tensor
    state: PathState


@dataclass(frozen=True)
class Intersection:
    """Hits of rays at a vertex.

    Attributes:
        depth: of the vertex, from 1.
        lanes: ``(n,)``.
        state: with which they came; its radiance is that before the vertex.
        hit: what the search found.
    """

    depth: int
    lanes: Tensor
    state: PathState
    hit: Hit


@dataclass(frozen=True)
class EmitterHit:
    """Light that paths met by chance.

    Attributes:
        depth: of the vertex.
        lanes: ``(n,)``.
        slot: ``(n,)`` of the surface, see :class:`~torchpt.physics.shapes.geometry.Interaction`; None: it is the environment.
        light: what they met.
    """

    depth: int
    lanes: Tensor
    slot: Tensor | None
    light: Emission


@dataclass(frozen=True)
class Scattering:
    """A vertex from which paths may go on.

    Attributes:
        depth: of it.
        lanes: ``(n,)``.
        model: number of the BSDF model.
        output: what its surfaces made of the paths.
        clear: ``(n,)`` how much of the light that was sampled gets through; None where none was.
    """

    depth: int
    lanes: Tensor
    model: int
    output: VertexOutput
    clear: Tensor | None


Event = CameraRay | Intersection | EmitterHit | Scattering
#: From camera rays of a wave to the radiance that they bring, while an observer looks on.
Trace = Callable[[Wave, PathState, Observer[ReadablePopulation]], Tensor]


class Explainer(Observer[ReadablePopulation]):
    """Keeps what happens along the paths of a walk; to be used for few lanes.

    Args:
        world: the scene's tensors.

    Attributes:
        events: in order.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.events: list[Event] = []

    def keep(self, event: Event) -> None:
        """Take an event."""
        self.events.append(event)

    def began(self, state: PathState) -> None:
        """Look at camera rays."""
        self.keep(CameraRay(state.lane, state))

    def arrived(self, paths: ReadablePopulation) -> bool:
        """See :class:`Observer`."""
        state = paths.state
        self.keep(Intersection(paths.depth, state.lane, replace(state, radiance=state.radiance.clone()), paths.met))
        return False

    def gathered(self, paths: ReadablePopulation) -> None:
        """See :class:`Observer`."""
        for index, light in paths.emissions:
            prim = take(paths.met.prim, index)
            slot = None if bool((prim < 0).any()) else self.world.geometry.slot(prim)
            self.keep(EmitterHit(paths.depth, take(paths.state.lane, index), slot, light))

    def left(self, paths: ReadablePopulation) -> None:
        """See :class:`Observer`."""
        clear = iter(paths.clear)
        for model, lanes, output in paths.outputs:
            arrived = None if output.shadow is None else next(clear)
            self.keep(Scattering(paths.depth - 1, lanes, model, output, arrived))


#: Causes, and what each says.
CAUSES = {
    "camera": "a camera ray",
    "surface": "the point that was met, or its normals",
    "texture": "what textures gave the material, normal and bump maps included",
    "material": "the parameters of the material",
    "emission": "light of a surface that the path met",
    "environment": "light of the environment that the path escaped to",
    "light": "a light that was sampled: what it brings, or its density",
    "bsdf": "a value, density or weight of the material's model",
    "throughput": "what the path carries on: a product of weights, each of them finite",
    "ray": "the ray that leaves a surface",
    "preview": "what the first surface shows, of integrators that go no further",
    "sum": "the sum of light, or its product with the filter's weight, each of them finite",
    "not repeated": "nothing: traced again by tensor operations, the sample is finite",
}


@dataclass(frozen=True)
class NonFiniteCause:
    """The reason why a sample is not finite.

    Attributes:
        cause: a key of :data:`CAUSES`.
        nan: whether the first value that was not finite was NaN; else it was infinite.
        depth: of the vertex, from 1; 0: at the camera, or after the path.
        slot: of the surface there, see :class:`~torchpt.physics.shapes.geometry.Interaction`; -1: it was on none.
    """

    cause: str
    nan: bool
    depth: int
    slot: int = -1

    @property
    def name(self) -> str:
        """Return the name that samples are counted by."""
        return self.cause if self.cause == "not repeated" else f"{'nan' if self.nan else 'infinite'} {self.cause}"


def causes_of_samples(trace: Trace, wave: Wave, places: Sequence[SampleId]) -> list[NonFiniteCause]:
    """The faults of samples, each traced again by tensor operations.

    Args:
        trace: by tensor operations.
        wave: of their render.
        places: of the samples.
    """
    found: dict[SampleId, NonFiniteCause] = {}
    for streams in sorted({(place.first, place.streams) for place in places}):
        own = [place for place in places if (place.first, place.streams) == streams]
        found |= zip(own, _find_causes(trace, wave, own, Randomizations(*streams)), strict=True)
    return [found[place] for place in places]


@torch.no_grad()
def _find_causes(trace: Trace, wave: Wave, places: Sequence[SampleId], streams: Randomizations) -> list[NonFiniteCause]:
    """The same for samples of the same streams."""
    finder = _CauseFinder(wave.context.world, len(places))
    x, y, sample = (
        torch.tensor([getattr(place, name) for place in places], device=wave.centre.device)
        for name in ("x", "y", "sample")
    )
    state = wave.rays_of(x, y, sample, streams)
    finder.began(state)
    radiance = trace(wave, state, finder)
    if not finder.full:  # a path that is given up has brought nothing
        finder.look("sum", radiance, torch.arange(len(places), device=x.device), 0, None)
    rest = NonFiniteCause("not repeated", False, 0)
    return [cause or rest for cause in finder.causes]


class _CauseFinder(Explainer):
    """Finds the first value of each lane that is not finite, and keeps no events.

    Args:
        world: the scene's tensors.
        lanes: how many.

    Attributes:
        causes: by lane; None where none was found yet.
    """

    def __init__(self, world: World, lanes: int) -> None:
        super().__init__(world)
        self.causes: list[NonFiniteCause | None] = [None] * lanes

    @property
    def full(self) -> bool:
        """Return True where every lane has its fault."""
        return None not in self.causes

    def arrived(self, paths: ReadablePopulation) -> bool:
        """See :class:`Explainer`: paths that carry what is not finite may have no end, and need none here."""
        super().arrived(paths)
        return self.full

    def keep(self, event: Event) -> None:
        """See :class:`Explainer`."""
        slot = None
        depth = 0 if isinstance(event, CameraRay) else event.depth
        if isinstance(event, EmitterHit):
            slot = event.slot
        elif isinstance(event, Scattering):
            slot = event.output.at.slot
        elif isinstance(event, Intersection):
            slot = self.world.geometry.slot(event.hit.prim)
        for cause, value in _checks(event, self.world):
            self.look(cause, value, event.lanes, depth, slot)

    def look(self, cause: str, value: Tensor, lanes: Tensor, depth: int, slot: Tensor | None) -> None:
        """Blame ``value (C, n)`` or ``(n,)`` for the lanes ``(n,)`` where it is not finite, unless something was before."""
        value = value if value.dim() == 2 else value[None]
        bad = ~torch.isfinite(value).all(0)
        for n in bad.nonzero().squeeze(1).tolist():  # of KEPT lanes at most
            lane = int(lanes[n])
            if self.causes[lane] is None:
                nan = bool(torch.isnan(value[:, n]).any())
                self.causes[lane] = NonFiniteCause(cause, nan, depth, -1 if slot is None else int(slot[n]))


def _checks(event: Event, world: World) -> Iterator[tuple[str, Tensor]]:
    """Causes with values ``(C, n)`` or ``(n,)``, in the order in which the values come about."""
    if isinstance(event, CameraRay):
        yield "camera", torch.cat((event.state.o, event.state.d))
    elif isinstance(event, Intersection):
        hit = event.hit
        yield "surface", torch.where(hit.prim >= 0, torch.stack((hit.t, hit.u, hit.v)), 0.0)
    elif isinstance(event, EmitterHit):
        yield "environment" if event.slot is None else "emission", event.light.brought
    else:
        yield from _of_vertex(event, world)


def _of_vertex(event: Scattering, world: World) -> Iterator[tuple[str, Tensor]]:
    """The same at a vertex from which paths may go on."""
    output = event.output
    after, surface, at, direct, drawn = output.leaving, output.surface, output.at, output.direct, output.drawn
    goes_on = after.t_max > 0
    ray = torch.where(goes_on, torch.cat((after.o, after.d)), 0.0)
    brought = torch.zeros_like(after.throughput) if output.shadow is None else output.shadow.radiance
    own = torch.zeros_like(brought) if drawn is not None else after.radiance
    # Factors may be anything where what they make is finite: a density is infinite of a delta.
    spoiled = ~torch.isfinite(torch.cat((brought, own, after.throughput, ray))).all(0)

    def of(cause: str, value: Tensor) -> tuple[str, Tensor]:
        return cause, torch.where(spoiled, value, 0.0)

    read = "texture" if world.materials.textures[event.model] is not None else "material"
    yield of("surface", torch.cat((at.p, at.ng, at.ns)))
    if surface is not None:
        for value in leaves(surface.parameters):
            if value.dim() and value.shape[-1] == len(spoiled):
                yield of(read, value.reshape(-1, len(spoiled)))
        yield of("surface" if surface.perturbed_normal is None else "texture", torch.cat((surface.frame.n, surface.wo)))
    if direct is not None:
        unlit = torch.isfinite(brought).all(0)
        factors = [("light", direct.radiance), ("light", direct.sample.weight), ("bsdf", direct.reflected)]
        if direct.weight is not None:
            factors.append(("bsdf", direct.weight))
        for cause, value in factors:
            yield of(cause, torch.where(unlit, 0.0, value))
    yield of("light", brought)
    if drawn is None:
        yield of("preview", own)
        return
    yield of("bsdf", torch.where(torch.isfinite(after.throughput).all(0), 0.0, drawn.weight))
    yield of("throughput", after.throughput)
    yield of("ray", ray)
