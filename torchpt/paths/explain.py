"""Record the events along paths, to print a path or to find the cause of a sample that is not finite.

Both are observers of the walk over vertices (:mod:`torchpt.paths.walk`), of a few lanes that are traced by tensor operations.

A sample that is not finite is traced again. At each vertex the contributions of emission and light sampling, the throughput and
the next ray are checked; where one of them is not finite, the first of its factors that is not finite names the cause.
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
from torchpt.paths.state import Emission, PathState, Shadow, VertexOutput
from torchpt.paths.store import VertexStore
from torchpt.paths.walk import Observer, Population
from torchpt.paths.wave import Wave
from torchpt.physics.film.splats import LARGEST
from torchpt.physics.samplers import Randomizations
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.world import World

__all__ = [
    "CAUSES",
    "CameraRay",
    "Connection",
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
    """A population whose tensors an observer may read: its engine keeps the outputs of stages."""

    @property
    def state(self) -> PathState:
        """Return the paths as they arrive at the vertex."""
        ...

    @property
    def hits(self) -> Hit:
        """Return the hits of their rays."""
        ...

    @property
    def emissions(self) -> Sequence[tuple[Tensor, Emission]]:
        """Return lanes and emission of the emitters and the environment that were hit at this vertex."""
        ...

    @property
    def outputs(self) -> Sequence[tuple[int, Tensor, VertexOutput]]:
        """Return, for each BSDF model that the vertex before was on: index of the model, lanes in the wave, stage outputs."""
        ...

    @property
    def transmittance(self) -> Sequence[Tensor]:
        """Return the transmittance ``(n,)`` of the shadow rays of the vertex before: of each output that has some, in order."""
        ...

    @property
    def connections(self) -> Sequence[tuple[Tensor, Shadow, Tensor]]:
        """Return, for connections of the vertex before: lanes in the wave, shadow rays and their transmittance ``(n,)``."""
        ...


@dataclass(frozen=True)
class CameraRay:
    """Start of paths at the camera.

    Attributes:
        lanes: ``(n,)`` int64 indices of the samples in the wave, as in all events.
        state: the camera rays.
    """

    lanes: Tensor
    state: PathState


@dataclass(frozen=True)
class Intersection:
    """Hits of rays at a vertex.

    Attributes:
        depth: number of the vertex, from 1.
        lanes: ``(n,)``.
        state: the paths as they arrive; their radiance is that before the vertex.
        hit: the nearest hits.
    """

    depth: int
    lanes: Tensor
    state: PathState
    hit: Hit


@dataclass(frozen=True)
class EmitterHit:
    """Emission that was added where paths hit an emitter, or nothing.

    Attributes:
        depth: number of the vertex.
        lanes: ``(n,)``.
        slot: ``(n,)`` index of the emitter among all primitives, then instances; None: the environment.
        light: the emission and its MIS weight.
    """

    depth: int
    lanes: Tensor
    slot: Tensor | None
    light: Emission


@dataclass(frozen=True)
class Scattering:
    """Light sample and BSDF sample at a vertex.

    Attributes:
        depth: number of the vertex.
        lanes: ``(n,)``.
        model: index of the BSDF model.
        output: outputs of the stage.
        transmittance: ``(n,)`` of the shadow rays; None where no light was sampled.
    """

    depth: int
    lanes: Tensor
    model: int
    output: VertexOutput
    transmittance: Tensor | None


@dataclass(frozen=True)
class Connection:
    """Connections of a vertex with vertices of light paths.

    Attributes:
        depth: number of the vertex.
        lanes: ``(n,)``.
        light: the rays to the other ends, and the light that goes through them.
        transmittance: ``(n,)`` of these rays.
    """

    depth: int
    lanes: Tensor
    light: Shadow
    transmittance: Tensor


Event = CameraRay | Intersection | EmitterHit | Scattering | Connection
#: Traces rays of a wave with an observer and the store of its light paths, and returns their radiance ``(3, N)``.
Trace = Callable[[Wave, PathState, Observer[ReadablePopulation], VertexStore | None], Tensor]


class Explainer(Observer[ReadablePopulation]):
    """Records all events along the paths of a walk; for few lanes.

    Args:
        world: the scene's tensors.

    Attributes:
        events: the events in order.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.events: list[Event] = []

    def record(self, event: Event) -> None:
        """Record an event."""
        self.events.append(event)

    def on_start(self, state: PathState) -> None:
        """Record camera rays."""
        self.record(CameraRay(lanes=state.lane, state=state))

    def on_hits(self, paths: ReadablePopulation) -> bool:
        """Record the hits; return False, so that the walk goes on."""
        state = paths.state
        # Cloned, since engines add to the radiance in place.
        state = replace(state, radiance=state.radiance.clone())
        self.record(Intersection(depth=paths.depth, lanes=state.lane, state=state, hit=paths.hits))
        return False

    def on_emission(self, paths: ReadablePopulation) -> None:
        """Record the emission that was added, of emitters or of the environment."""
        for index, light in paths.emissions:
            prim = take(paths.hits.prim, index)  # -1: no hit, so the environment
            slot = None if bool((prim < 0).any()) else self.world.geometry.slot(prim)
            self.record(EmitterHit(depth=paths.depth, lanes=take(paths.state.lane, index), slot=slot, light=light))

    def on_scattered(self, paths: ReadablePopulation) -> None:
        """Record samples and connections of the vertex that the paths leave; ``paths`` are at the next one already."""
        transmittances = iter(paths.transmittance)
        for model, lanes, output in paths.outputs:
            transmittance = None if output.shadow is None else next(transmittances)
            self.record(
                Scattering(depth=paths.depth - 1, lanes=lanes, model=model, output=output, transmittance=transmittance)
            )
        for lanes, light, transmittance in paths.connections:
            self.record(Connection(depth=paths.depth - 1, lanes=lanes, light=light, transmittance=transmittance))


#: Names of causes, and their descriptions.
CAUSES = {
    "camera": "a camera ray",
    "surface": "a hit point or its normals",
    "texture": "a value of a texture, normal and bump maps included",
    "material": "a parameter of a material",
    "emission": "the contribution of an emitter that a path hit",
    "environment": "the contribution of the environment to a path that hit nothing",
    "light": "a light sample: its radiance, weight or contribution",
    "splat": "a splat: the light that a surface sends to the camera; from 2^55 on it counts as infinite",
    "connection": "the light that goes through the connection of a camera path with a light path",
    "bsdf": "a value, pdf or weight of a BSDF",
    "throughput": "the throughput of a path: a product of weights, each of them finite",
    "ray": "the ray that leaves a surface",
    "preview": "the shading of the first surface, of integrators that stop there",
    "sum": "the sum of contributions, or its product with the filter weight, each of them finite",
    "merge": "a photon of its light path, or the light of a merge: neither is looked at again",
    "not repeated": "none: traced again by tensor operations, the sample is finite",
}
#: Causes of samples that are finite as they are traced again.
_NOT_SEEN = ("merge", "not repeated")


@dataclass(frozen=True)
class NonFiniteCause:
    """The cause of a sample that is not finite.

    Attributes:
        cause: a key of :data:`CAUSES`.
        nan: True: the first value that was not finite was NaN. False: infinite.
        depth: number of the vertex, from 1; 0: at the camera, or after the path.
        slot: index of the surface there among all primitives, then instances; -1: no surface.
    """

    cause: str
    nan: bool
    depth: int
    slot: int = -1

    @property
    def name(self) -> str:
        """Return the name under which samples are counted."""
        return self.cause if self.cause in _NOT_SEEN else f"{'nan' if self.nan else 'infinite'} {self.cause}"


def causes_of_samples(trace: Trace, wave: Wave, samples: Sequence[SampleId]) -> list[NonFiniteCause]:
    """Return the cause of each sample that is not finite, by tracing it again with tensor operations.

    Args:
        trace: traces rays with tensor operations.
        wave: of the render.
        samples: the samples, in any order.
    """
    found: dict[SampleId, NonFiniteCause] = {}

    def group_of(sample: SampleId) -> tuple[int, int, int]:
        """Return what samples share that are traced as one wave: randomizations, which error probes have others of; radius."""
        number = sample.sample if wave.integrator.merging_counts else 0
        return sample.first_randomization, sample.randomizations, number

    for first, count, number in sorted(set(map(group_of, samples))):
        group = [sample for sample in samples if group_of(sample) == (first, count, number)]
        causes = _find_causes(trace, wave.at_sample(number), group, Randomizations(first=first, count=count))
        found |= zip(group, causes, strict=True)
    return [found[sample] for sample in samples]


@torch.no_grad()
def _find_causes(
    trace: Trace, wave: Wave, samples: Sequence[SampleId], randomizations: Randomizations
) -> list[NonFiniteCause]:
    """Return the causes for samples that belong to the same randomizations."""
    finder = _CauseFinder(wave.context.world, len(samples))
    x, y, index = (
        torch.tensor([getattr(sample, name) for sample in samples], device=wave.centre.device)
        for name in ("x", "y", "sample")
    )
    store = VertexStore(len(samples)) if wave.integrator.connects else None
    for walked in (wave.light_paths, wave):  # what spoils a light path spoils connections with it too
        if walked is None or finder.found_all:
            continue
        state = walked.rays_of(x, y, index, randomizations)
        finder.on_start(state)
        radiance = trace(walked, state, finder, store)
        if not finder.found_all:  # a walk that was ended early returns no radiance
            finder.check("sum", radiance, torch.arange(len(samples), device=x.device), depth=0, slot=None)
    other = NonFiniteCause("merge" if wave.integrator.merges else "not repeated", nan=False, depth=0)
    return [cause or other for cause in finder.causes]


class _CauseFinder(Explainer):
    """Finds the first value of each lane that is not finite, and records no events.

    Args:
        world: the scene's tensors.
        lanes: number of lanes.

    Attributes:
        causes: cause of each lane; None: not found yet.
    """

    def __init__(self, world: World, lanes: int) -> None:
        super().__init__(world)
        self.causes: list[NonFiniteCause | None] = [None] * lanes

    @property
    def found_all(self) -> bool:
        """Return True once the cause of every lane is known."""
        return None not in self.causes

    def on_hits(self, paths: ReadablePopulation) -> bool:
        """Check the hits; return True once all causes are known, as a path with NaN might go on for ever."""
        super().on_hits(paths)
        return self.found_all

    def record(self, event: Event) -> None:
        """Check an event for values that are not finite."""
        slot = None
        depth = 0 if isinstance(event, CameraRay) else event.depth
        if isinstance(event, EmitterHit):
            slot = event.slot
        elif isinstance(event, Scattering):
            slot = event.output.at.slot
        elif isinstance(event, Intersection):
            slot = self.world.geometry.slot(event.hit.prim)
        for cause, value in _checks(event, self.world):
            self.check(cause, value, event.lanes, depth, slot)

    def check(self, cause: str, value: Tensor, lanes: Tensor, depth: int, slot: Tensor | None) -> None:
        """Record ``cause`` for the lanes ``(n,)`` where ``value (C, n)`` or ``(n,)`` is the first that is not finite.

        ``slot (n,)``: index of the surface there; None: no surface.
        """
        value = value if value.dim() == 2 else value[None]
        bad = ~torch.isfinite(value).all(0)
        for i in bad.nonzero().squeeze(1).tolist():  # of nonfinite.KEPT lanes at most
            lane = int(lanes[i])
            if self.causes[lane] is None:
                nan = bool(torch.isnan(value[:, i]).any())
                surface = -1 if slot is None else int(slot[i])
                self.causes[lane] = NonFiniteCause(cause, nan=nan, depth=depth, slot=surface)


def _checks(event: Event, world: World) -> Iterator[tuple[str, Tensor]]:
    """Yield causes with values ``(C, n)`` or ``(n,)``, in the order in which the stages compute them."""
    if isinstance(event, CameraRay):
        yield "camera", torch.cat((event.state.o, event.state.d))
    elif isinstance(event, Intersection):
        hit = event.hit
        yield "surface", torch.where(hit.prim >= 0, torch.stack((hit.t, hit.u, hit.v)), 0.0)
    elif isinstance(event, EmitterHit):
        contribution = event.light.brought
        yield "environment" if event.slot is None else "emission", contribution
    elif isinstance(event, Connection):
        yield "connection", event.light.radiance
    else:
        yield from _checks_of_vertex(event, world)


def _checks_of_vertex(event: Scattering, world: World) -> Iterator[tuple[str, Tensor]]:
    """Yield causes and values of a vertex at which paths scatter."""
    output = event.output
    leaving, surface, at, direct, drawn = output.leaving, output.surface, output.at, output.direct, output.drawn
    goes_on = leaving.t_max > 0  # (n,), False where the path ended
    ray = torch.where(goes_on, torch.cat((leaving.o, leaving.d)), 0.0)
    light = torch.zeros_like(leaving.throughput) if output.shadow is None else output.shadow.radiance
    # Without a BSDF sample the integrator stops here, and its stage added the shading of the first surface to the radiance.
    preview = torch.zeros_like(light) if drawn is not None else leaving.radiance
    # Factors are checked only in lanes with a product that is not finite: some factors are infinite where the product is
    # finite, such as the pdf of a delta lobe.
    spoiled = ~torch.isfinite(torch.cat((light, preview, leaving.throughput, ray))).all(0)

    def where_spoiled(cause: str, value: Tensor) -> tuple[str, Tensor]:
        return cause, torch.where(spoiled, value, 0.0)

    source = "texture" if world.materials.textures[event.model] is not None else "material"
    yield where_spoiled("surface", torch.cat((at.p, at.ng, at.ns)))
    if surface is not None:
        for value in leaves(surface.parameters):
            if value.dim() and value.shape[-1] == len(spoiled):  # others are tables, not values by lane
                yield where_spoiled(source, value.reshape(-1, len(spoiled)))
        cause = "surface" if surface.perturbed_normal is None else "texture"
        yield where_spoiled(cause, torch.cat((surface.frame.n, surface.wo)))
    if direct is not None:
        finite = torch.isfinite(light).all(0)
        factors = [("light", direct.radiance), ("light", direct.sample.weight), ("bsdf", direct.reflected)]
        if direct.weight is not None:
            factors.append(("bsdf", direct.weight))
        for cause, value in factors:
            yield where_spoiled(cause, torch.where(finite, 0.0, value))
    yield where_spoiled("light", light)
    if output.splat is not None:
        sent = output.splat.light.radiance
        yield "splat", torch.where(sent.abs() >= LARGEST, torch.inf, sent)
    if drawn is None:
        yield where_spoiled("preview", preview)
        return
    yield where_spoiled("bsdf", torch.where(torch.isfinite(leaving.throughput).all(0), 0.0, drawn.weight))
    yield where_spoiled("throughput", leaving.throughput)
    yield where_spoiled("ray", ray)
