"""Where samples stopped being finite: they are traced again, and the first value that is not finite names the cause.

A watch looks at what goes into a sample, stage by stage: light that was met, light that was sampled, and what the path carries
on. Only where one of these is not finite it asks which of their factors was the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.core.tree import leaves
from torchpt.integrators.first_surface import FirstSurface
from torchpt.integrators.lost import Place
from torchpt.integrators.plan import Plan
from torchpt.integrators.stage_runner import Stages
from torchpt.integrators.wave import Wave
from torchpt.paths.recorder import Bounced, Left, Legible, Met, Record, Recorder, Shone
from torchpt.paths.walk import Observer
from torchpt.records import Hit, PathState, Shadow, World
from torchpt.samplers import Streams

__all__ = ["CAUSES", "Fault", "faults_of"]

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
class Fault:
    """Why a sample is not finite.

    Attributes:
        cause: a key of :data:`CAUSES`.
        nan: whether the first value that was not finite was NaN; else it was infinite.
        depth: of the vertex, from 1; 0: at the camera, or after the path.
        slot: of the surface there, see :class:`~torchpt.records.Interaction`; -1: it was on none.
    """

    cause: str
    nan: bool
    depth: int
    slot: int = -1

    @property
    def name(self) -> str:
        """What samples are counted by."""
        return self.cause if self.cause == "not repeated" else f"{'nan' if self.nan else 'infinite'} {self.cause}"


#: From camera rays of a wave to the radiance that they bring, while somebody looks on.
Trace = Callable[[Wave, PathState, Observer[Legible]], Tensor]


def faults_of(trace: Trace, wave: Wave, places: Sequence[Place]) -> list[Fault]:
    """The faults of samples, each traced again by tensor operations.

    Args:
        trace: by tensor operations.
        wave: of their render.
        places: of the samples.
    """
    found: dict[Place, Fault] = {}
    for streams in sorted({(place.first, place.streams) for place in places}):
        own = [place for place in places if (place.first, place.streams) == streams]
        found |= zip(own, _again(trace, wave, own, Streams(*streams)), strict=True)
    return [found[place] for place in places]


@torch.no_grad()
def _again(trace: Trace, wave: Wave, places: Sequence[Place], streams: Streams) -> list[Fault]:
    """The same for samples of the same streams."""
    watch = Watch(wave.stages, len(places))
    first = None if wave.first is None else _Watched(wave.first, watch)
    again = replace(wave, stages=watch, first=first)
    x, y, sample = (
        torch.tensor([getattr(place, name) for place in places], device=wave.centre.device)
        for name in ("x", "y", "sample")
    )
    radiance = trace(again, again.rays_of(x, y, sample, streams), watch)
    if not watch.full:  # a path that is given up has brought nothing
        watch.look("sum", radiance, torch.arange(len(places), device=x.device), 0, None)
    rest = Fault("not repeated", False, 0)
    return [fault or rest for fault in watch.faults]


class Watch(Recorder):
    """Stages that find the first value of each lane that is not finite, and keep no records.

    Args:
        stages: see :class:`Recorder`.
        lanes: how many.

    Attributes:
        faults: by lane; None where none was found yet.
    """

    def __init__(self, stages: Stages, lanes: int) -> None:
        super().__init__(stages)
        self.faults: list[Fault | None] = [None] * lanes

    @property
    def full(self) -> bool:
        """Whether every lane has its fault."""
        return None not in self.faults

    def arrived(self, paths: Legible) -> bool:
        """See :class:`Recorder`: paths that carry what is not finite may have no end, and need none here."""
        super().arrived(paths)
        return self.full

    def keep(self, record: Record) -> None:
        """See :class:`Recorder`."""
        slot = None
        depth = 0 if isinstance(record, Left) else record.depth
        if isinstance(record, Shone):
            slot = record.slot
        elif isinstance(record, Bounced):
            slot = record.at.slot
        elif isinstance(record, Met):
            slot = self.world.geometry.slot(record.hit.prim)
        for cause, value in checks(record, self.world):
            self.look(cause, value, record.lanes, depth, slot)

    def look(self, cause: str, value: Tensor, lanes: Tensor, depth: int, slot: Tensor | None) -> None:
        """Blame ``value (C, n)`` or ``(n,)`` for the lanes ``(n,)`` where it is not finite, unless something was before."""
        value = value if value.dim() == 2 else value[None]
        bad = ~torch.isfinite(value).all(0)
        for n in bad.nonzero().squeeze(1).tolist():  # of KEPT lanes at most
            lane = int(lanes[n])
            if self.faults[lane] is None:
                nan = bool(torch.isnan(value[:, n]).any())
                self.faults[lane] = Fault(cause, nan, depth, -1 if slot is None else int(slot[n]))


def checks(record: Record, world: World) -> Iterator[tuple[str, Tensor]]:
    """Causes with values ``(C, n)`` or ``(n,)``, in the order in which the values come about."""
    if isinstance(record, Left):
        yield "camera", torch.cat((record.state.o, record.state.d))
    elif isinstance(record, Met):
        hit = record.hit
        yield "surface", torch.where(hit.prim >= 0, torch.stack((hit.t, hit.u, hit.v)), 0.0)
    elif isinstance(record, Shone):
        yield "environment" if record.slot is None else "emission", record.brought
    else:
        yield from _of_vertex(record, world)


def _of_vertex(record: Bounced, world: World) -> Iterator[tuple[str, Tensor]]:
    """The same at a vertex from which paths may go on."""
    lit, drawn, surface, after = record.lit, record.drawn, record.surface, record.after
    goes_on = after.t_max > 0
    ray = torch.where(goes_on, torch.cat((after.o, after.d)), 0.0)
    brought = torch.zeros_like(after.throughput) if lit is None else lit.brought
    # Factors may be anything where what they make is finite: a density is infinite of a delta.
    spoiled = ~torch.isfinite(torch.cat((brought, after.throughput, ray))).all(0)

    def of(cause: str, value: Tensor) -> tuple[str, Tensor]:
        return cause, torch.where(spoiled, value, 0.0)

    read = "texture" if world.materials.textures[record.model] is not None else "material"
    yield of("surface", torch.cat((record.at.p, record.at.ng, record.at.ns)))
    for value in leaves(surface.parameters):
        if value.dim() and value.shape[-1] == len(spoiled):
            yield of(read, value.reshape(-1, len(spoiled)))
    frame = surface.frame
    yield of("surface" if surface.relief is None else "texture", torch.cat((frame.n, surface.wo)))
    if lit is not None:
        unlit = torch.isfinite(lit.brought).all(0)
        factors = (("light", lit.radiance), ("light", lit.sample.weight), ("bsdf", lit.reflected), ("bsdf", lit.weight))
        for cause, value in factors:
            yield of(cause, torch.where(unlit, 0.0, value))
        yield of("light", lit.brought)
    yield of("bsdf", torch.where(torch.isfinite(after.throughput).all(0), 0.0, drawn.weight))
    yield of("throughput", after.throughput)
    yield of("ray", ray)


class _Watched(FirstSurface):
    """What happens at first surfaces, under a watch.

    Args:
        first: what happens.
        watch: told of it.
    """

    def __init__(self, first: FirstSurface, watch: Watch) -> None:
        self._first, self._watch = first, watch

    def shade(
        self,
        plan: Plan,
        world: World,
        model: int,
        state: PathState,
        hit: Hit,
        salts: Tensor,
        pixel: Tensor | None,
        slide: bool,
    ) -> tuple[Tensor, Shadow | None]:
        """See :class:`FirstSurface`."""
        radiance, shadow = self._first.shade(plan, world, model, state, hit, salts, pixel, slide)
        slot = world.geometry.slot(hit.prim)
        if shadow is not None:
            self._watch.look("light", shadow.radiance, state.lane, 1, slot)
        self._watch.look("preview", radiance, state.lane, 1, slot)
        return radiance, shadow
