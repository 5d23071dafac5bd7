"""The one loop over the vertices of paths: the order of events along a path, whoever runs them.

Forward renders, first surfaces, layers, the first half of a replay and a path that is printed all come through :func:`walk`.
A *population* is some thousand paths at one vertex. The walk never looks into it but for its depth: an engine made it, and only
that engine can read it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from torchpt.paths.integrators.base import Limits

__all__ = ["KEPT", "Counts", "Engine", "Observer", "Population", "find", "walk"]

#: Vertices, one after the other, that an engine keeps at once for the way back.
KEPT = 16


class Population(Protocol):
    """Paths at one vertex."""

    @property
    def depth(self) -> int:
        """Return the number of the vertex, from 1: the first that a camera ray meets."""
        ...


P = TypeVar("P", bound=Population)
Q = TypeVar("Q", bound=Population, contravariant=True)


@dataclass(slots=True)
class Counts:
    """Numbers of lanes of a population by what they met, known to the host: one transfer a vertex.

    Attributes:
        scatter: lanes by BSDF model.
        emissive: lanes that met an emitter; they are counted by their models too.
        missed: lanes that met nothing, where that means something.
    """

    scatter: Sequence[int]
    emissive: int
    missed: int


class Engine(Protocol[P]):
    """An engine runs the events of paths. Verbs take whole populations; none returns a tensor to the walk."""

    def intersect(self, paths: P) -> bool:
        """Find the nearest hits; return whether any ray is still on its way. Nothing to do where hits are known already."""
        ...

    def transmit(self, paths: P) -> bool:
        """Take one step through what lets rays pass: opacity, null, media; return whether any ray is still on its way."""
        ...

    def sort(self, paths: P) -> Counts:
        """List lanes by what they met."""
        ...

    def emit(self, paths: P) -> None:
        """Add the light of emitters that were hit, weighted by MIS."""

    def escape(self, paths: P) -> None:
        """Add the light of the environment, and end the paths that met nothing."""

    def scatter(self, paths: P, roulette: float) -> P:
        """Sample lights and BSDFs, play roulette, and return the paths that go on.

        ``roulette``: the most that it lets paths survive with; 0: it does not play.
        """
        ...

    def occlude(self, paths: P) -> None:
        """Resolve pending light: add what gets through."""

    def terminate(self, paths: P, truncated: bool) -> None:
        """End all paths that remain; ``truncated``: they are counted as cut short."""


class Observer(Generic[Q]):
    """An observer looks on: replays keep populations, layers read the first surface, a debugger prints one path.

    The first two may return True, which ends the walk there.
    """

    def arrived(self, paths: Q) -> bool:
        """Look at paths that have their hits but are not sorted yet."""
        return False

    def sorted(self, paths: Q, counts: Counts) -> bool:
        """Look at paths that are about to gather light and to scatter."""
        return False

    def gathered(self, paths: Q) -> None:
        """Look at paths that have the light that they met by chance."""

    def left(self, paths: Q) -> None:
        """Look at paths behind a vertex, once the light that was sampled there is resolved."""


def find(engine: Engine[P], paths: P) -> None:
    """Find what the rays of a population meet, behind what lets them pass."""
    if engine.intersect(paths):
        while engine.transmit(paths):
            pass


def walk(
    engine: Engine[P], paths: P, limits: Limits, observer: Observer[P] | None = None, until: int | None = None
) -> None:
    """Take a population from its vertex to the ends of all its paths.

    Args:
        engine: runs the events.
        paths: of that engine.
        limits: where paths end.
        observer: looks on, and may end the walk.
        until: vertex at which the walk is to stop, before rays to it are searched for; None: it goes on to the ends.
    """
    last, endless = limits.last, limits.endless
    if last < paths.depth:
        engine.terminate(paths, truncated=False)
        return
    while paths.depth != until:
        find(engine, paths)
        if observer is not None and observer.arrived(paths):
            return
        counts = engine.sort(paths)
        if observer is not None and observer.sorted(paths, counts):
            return
        if counts.emissive:
            engine.emit(paths)
        if counts.missed:
            engine.escape(paths)
        if observer is not None:
            observer.gathered(paths)
        if paths.depth >= last:
            engine.terminate(paths, truncated=endless)
            return
        if not any(counts.scatter):
            return
        paths = engine.scatter(paths, limits.roulette(paths.depth))
        engine.occlude(paths)
        if observer is not None:
            observer.left(paths)
        if limits.first_surface:
            engine.terminate(paths, truncated=False)
            return
