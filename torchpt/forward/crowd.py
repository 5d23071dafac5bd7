"""Renders of one scene by several cameras, as waves of tensor operations that they share: a lane carries its camera's ray.

Small pictures by themselves fill no wave, and on CUDA a wave costs its launches, however few lanes it has.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from torchpt.forward.piece import Work, take
from torchpt.forward.result import Rendering
from torchpt.forward.run import Run
from torchpt.forward.schedule import LANES
from torchpt.integrators.loop.schedule import Share
from torchpt.native.memory import let_go
from torchpt.native.modes import undisturbed
from torchpt.shortage import ran_out

__all__ = ["Crowd", "Entry", "blamed"]


@dataclass
class Entry:
    """A render of several.

    Attributes:
        device: where it is rendered.
        make: makes it ready for a number of threads; called when it is soon to begin.
        done: told of the rendering.
        failed: told of an error instead, which it may raise as another one.
        run: once it is ready.
    """

    device: torch.device
    make: Callable[[int], Run]
    done: Callable[[Rendering], None]
    failed: Callable[[BaseException], None]
    run: Run = field(init=False)


@contextmanager
def blamed(entry: Entry) -> Iterator[None]:
    """Errors within are told to an entry."""
    try:
        yield
    except Exception as error:
        entry.failed(error)
        raise


class Crowd:
    """Renders by tensor operations that wait until they fill a wave, or until one comes that cannot share it."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Entry, Work]] = []

    def add(self, entry: Entry) -> None:
        """Let a render wait, or do it by itself; those that waited before may be done first."""
        work = _whole(entry.run)
        held = sum(other.lanes for _, other in self._waiting)
        most = LANES.get(entry.device.type, LANES["cpu"])
        if self._waiting and (
            work is None or held + work.lanes > most or not _alike(entry.run, self._waiting[0][0].run)
        ):
            self.settle()
        if work is None:
            _alone(entry)
        else:
            self._waiting.append((entry, work))

    def settle(self) -> None:
        """Do what waits."""
        waiting, self._waiting = self._waiting, []
        if len(waiting) < 2 or not _together(waiting):
            for entry, _ in waiting:
                _alone(entry)


def _whole(run: Run) -> Work | None:
    """All samples of a render; None where its waves are its own: it has kernels, has no fixed end, or memory is bounded."""
    if run.loop is not None or not run.only_counts():
        return None
    return Work(run.wave, run.picture, run.light, (0, run.width * run.height, 0, run.settings.render.spp))


def _alike(a: Run, b: Run) -> bool:
    """Whether one wave can take the samples of both: they differ in their cameras and seeds alone.

    Textures that average over footprints want to know of one camera.
    """
    shared = (
        a.wave.stages.world is b.wave.stages.world and a.wave.accel is b.wave.accel and a.wave.filter is b.wave.filter
    )
    same = a.wave.stages.plan == b.wave.stages.plan and a.integrator == b.integrator and list(a.seen) == list(b.seen)
    return shared and same and a.wave.stages.pixel is None


def _alone(entry: Entry) -> None:
    with undisturbed(entry.device), blamed(entry):
        entry.done(entry.run.go(None))
    del entry.run


def _together(waiting: list[tuple[Entry, Work]]) -> bool:
    """Renders by one wave; returns whether there was memory for it."""
    first, begun = waiting[0][0], time.perf_counter()
    with undisturbed(first.device), blamed(first):
        try:
            pieces = take([work for _, work in waiting])
        except Exception as error:
            if not ran_out(error):
                raise
            pieces = []
    if not pieces:
        let_go()
        return False
    for (entry, work), piece in zip(waiting, pieces, strict=True):
        run = entry.run
        run.begun, run.left = begun, work.lanes
        with undisturbed(entry.device), blamed(entry):
            piece.write()
            run.took(Share(piece.tally, work.lanes, piece.lost))
            entry.done(run.completed([]))
        del entry.run
    return True
