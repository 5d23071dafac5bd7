"""The loop over the vertices of paths: the order of stages along a path, the same for every engine.

Forward renders, first-surface previews, layers, the forward half of path replay and printed paths all run :func:`walk`. A
*population* is some thousand paths at one vertex, each in a *lane* of its own. The walk reads the depth of a population and
nothing else: only the engine that made it knows where its paths lie in memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from torchpt.paths.integrators.base import Limits

__all__ = ["KEPT", "Counts", "Engine", "Observer", "Population", "find_hits", "walk"]

#: Consecutive vertices that an engine keeps at once for a backward pass: as many as the default ``max_depth``, so paths of
#: default length are never traced again.
KEPT = 16


class Population(Protocol):
    """Paths at one vertex."""

    @property
    def depth(self) -> int:
        """Return the number of the vertex: 1 is the first hit of the camera ray."""
        ...


#: The populations of one engine; ``Q``: those that an observer reads.
P = TypeVar("P", bound=Population)
Q = TypeVar("Q", bound=Population, contravariant=True)


@dataclass(slots=True)
class Counts:
    """Numbers of lanes of a population by the kind of their hit, on the host: one transfer a vertex.

    Attributes:
        scatter: lanes on each BSDF model.
        emissive: lanes that hit an emitter; ``scatter`` counts them too.
        missed: lanes that hit nothing, if the scene has an environment.
    """

    scatter: Sequence[int]
    emissive: int
    missed: int


class Engine(Protocol[P]):
    """The stages of a vertex on whole populations. No method returns a tensor to the walk."""

    def intersect(self, paths: P) -> bool:
        """Find the nearest hits, unless they are known; return True if :meth:`transmit` has to be called."""
        ...

    def transmit(self, paths: P) -> bool:
        """Take one step through opacity, ``null`` or media; return True while any ray is still in transit."""
        ...

    def sort(self, paths: P) -> Counts:
        """List lanes by the kind of their hit: BSDF model, emitter, none."""
        ...

    def emit(self, paths: P) -> None:
        """Add the light of emitters that were hit, weighted by MIS."""

    def escape(self, paths: P) -> None:
        """Add the light of the environment, and end the paths that hit nothing."""

    def scatter(self, paths: P, roulette: float) -> P:
        """Sample lights and BSDFs, play roulette, and return the paths that go on.

        ``roulette``: upper bound of the survival probability; 0: no roulette at this vertex.
        """
        ...

    def occlude(self, paths: P) -> None:
        """Trace the pending shadow rays, and add their contributions times transmittance."""

    def terminate(self, paths: P, *, truncated: bool) -> None:
        """End all paths that remain; ``truncated``: count them as truncated, since no limit of the user's ended them."""


class Observer(Generic[Q]):
    """Callbacks of the walk: path replay keeps populations, layers read the first surface, a debugger prints one path.

    :meth:`on_hits` and :meth:`on_sorted` may return True, which ends the walk.
    """

    def on_hits(self, paths: Q) -> bool:
        """Read paths that have their hits but are not sorted yet."""
        return False

    def on_sorted(self, paths: Q, counts: Counts) -> bool:
        """Read sorted paths, before emission is added and they scatter."""
        return False

    def on_emission(self, paths: Q) -> None:
        """Read paths after the emission of their hits, or of the environment, was added."""

    def on_scattered(self, paths: Q) -> None:
        """Read the paths that go on from a vertex, after its shadow rays were traced; their depth is that of the next one."""


def find_hits(engine: Engine[P], paths: P) -> None:
    """Find the hits of a population's rays, behind all surfaces and media that they pass."""
    if engine.intersect(paths):
        while engine.transmit(paths):
            pass


def walk(
    engine: Engine[P], paths: P, limits: Limits, observer: Observer[P] | None = None, until: int | None = None
) -> None:
    """Take a population from its vertex to the ends of all its paths.

    Args:
        engine: runs the stages.
        paths: a population of that engine.
        limits: greatest depth (``last``; ``endless`` where the user set none), and where roulette begins.
        observer: gets the callbacks, and may end the walk.
        until: vertex at which the walk stops, before the rays to it are searched; None: it goes on until all paths ended.
    """
    last, endless = limits.last, limits.endless
    if last < paths.depth:  # ``max_depth`` 0
        engine.terminate(paths, truncated=False)
        return
    while paths.depth != until:
        find_hits(engine, paths)
        if observer is not None and observer.on_hits(paths):
            return
        counts = engine.sort(paths)
        if observer is not None and observer.on_sorted(paths, counts):
            return
        if counts.emissive:
            engine.emit(paths)
        if counts.missed:
            engine.escape(paths)
        if observer is not None:
            observer.on_emission(paths)
        if paths.depth >= last:
            engine.terminate(paths, truncated=endless)
            return
        if not any(counts.scatter):
            return
        paths = engine.scatter(paths, limits.roulette(paths.depth))
        engine.occlude(paths)
        if observer is not None:
            observer.on_scattered(paths)
        if limits.first_surface:
            engine.terminate(paths, truncated=False)
            return
