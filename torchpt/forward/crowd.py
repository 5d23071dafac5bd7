"""Renders that share waves of tensor operations: a lane carries its camera's ray, and which scene it is in.

Small pictures by themselves fill no wave, and on CUDA a wave costs its launches, however few lanes it has.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from torchpt.forward.piece import Piece, Work, take
from torchpt.forward.result import Rendering
from torchpt.forward.run import Run
from torchpt.forward.schedule import LANES
from torchpt.forward.shared import ROOM, alike, common, room_of
from torchpt.forward.waves import say_once
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
        last: whether none of the same scene comes after it: where no other scene may share its waves, none is waited for.
        run: once it is ready.
    """

    device: torch.device
    make: Callable[[int], Run]
    done: Callable[[Rendering], None]
    failed: Callable[[BaseException], None]
    last: bool
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
        self._waiting: list[Entry] = []
        self._lanes = 0  # of those
        self._worlds: dict[int, int] = {}  # theirs by id, and how many bytes each takes
        self._common: Hashable | None = None  # what their scenes have in common
        self._most: int | None = None  # where memory did not suffice for the usual number

    def __bool__(self) -> bool:
        """Whether any waits."""
        return bool(self._waiting)

    def add(self, entry: Entry) -> None:
        """Let a render wait, or do it by itself; those that waited before may be done first."""
        lanes, wave = _lanes(entry.run), entry.run.wave
        most = self._most or LANES.get(entry.device.type, LANES["cpu"])
        if lanes is None or 2 * lanes > most:
            self.settle()
            _alone(entry)
            return
        world = id(wave.stages.world)
        with undisturbed(entry.device), blamed(entry):
            room = self._worlds.get(world) or room_of(wave)
            joins = self._joins(entry, lanes, most, room)
        if not joins:
            self.settle()
            with undisturbed(entry.device), blamed(entry):
                self._common = common(wave, room)
        self._waiting.append(entry)
        self._worlds[world] = room
        self._lanes += lanes
        if entry.last and self._common is None:
            self.settle()

    def _joins(self, entry: Entry, lanes: int, most: int, room: int) -> bool:
        """Whether a render of so many lanes, whose world takes ``room``, can share a wave with those that wait."""
        if not self._waiting or self._lanes + lanes > most:
            return False
        first, run = self._waiting[0].run, entry.run
        if list(first.seen) != list(run.seen) or not alike(first.wave, run.wave):
            return False
        if id(run.wave.stages.world) in self._worlds:
            return True
        if self._common is None or sum(self._worlds.values()) + room > ROOM:
            return False
        return common(run.wave, room) == self._common

    def settle(self) -> None:
        """Do what waits."""
        waiting, self._waiting, self._lanes, self._worlds = self._waiting, [], 0, {}
        self._together(waiting)

    def _together(self, entries: list[Entry]) -> None:
        """Renders by one wave, or where memory is too short by several; the list is empty then."""
        if len(entries) < 2:
            while entries:
                _alone(entries.pop())
            return
        begun, works = time.perf_counter(), [_work(entry.run) for entry in entries]
        short, wrong = False, ""
        with undisturbed(entries[0].device):
            try:
                pieces = take(works)
            except Exception as error:  # alone each of them meets it again, under its own name
                pieces, short, wrong = [], ran_out(error), f"{type(error).__name__} {error}"
        if short:
            let_go()
            lanes = sum(work.lanes for work in works)
            self._most = max(lanes // 2, 1)
            del works
            half = len(entries) // 2
            first, entries[:half] = entries[:half], []
            self._together(first)
            self._together(entries)
            return
        while entries:
            entry = entries.pop(0)
            work = works.pop(0)
            if pieces:
                _done(entry, work.lanes, pieces.pop(0), begun)
            else:
                _alone(entry)
        if wrong:  # and none of them met it
            say_once(f"torchpt: pictures that could share a wave were rendered one by one: {wrong}")


def _done(entry: Entry, lanes: int, piece: Piece, begun: float) -> None:
    """Tell of a render, of which all samples are there."""
    run = entry.run
    run.begun, run.left = begun, lanes
    with undisturbed(entry.device), blamed(entry):
        piece.write()
        run.took(Share(piece.tally, lanes, piece.lost))
        entry.done(run.completed([]))
    del entry.run


def _lanes(run: Run) -> int | None:
    """How many samples a render has; None where its waves are its own: it has kernels, no fixed end, or bounded memory."""
    if run.loop is not None or not run.only_counts():
        return None
    return _work(run).lanes


def _work(run: Run) -> Work:
    """All samples of a render."""
    return Work(run.wave, run.picture, run.light, (0, run.width * run.height, 0, run.settings.render.spp))


def _alone(entry: Entry) -> None:
    with undisturbed(entry.device), blamed(entry):
        entry.done(entry.run.go(None))
    del entry.run
