"""One work list for the loops of several renders, taken by one crew of threads."""

from __future__ import annotations

import threading
from collections.abc import Hashable
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

from torchpt.engines.kernels.chunk import Worker
from torchpt.engines.kernels.schedule import PATIENCE, Block, Loop, Share
from torchpt.errors import RenderError

__all__ = ["Job", "Together"]

T = TypeVar("T")

#: Latest structures of renders whose idle workers are kept.
STRUCTURES = 4


@dataclass(eq=False)
class Job(Generic[T]):
    """A render's part of the list.

    Attributes:
        owner: of whom it is.
        loop: of the render.
        blocks: what it takes.
        left: blocks of which nothing has come in yet.
        rest: what memory did not suffice for.
    """

    owner: T
    loop: Loop
    blocks: list[Block]
    left: int = 0
    rest: list[Block] = field(default_factory=list)


class Together(Generic[T]):
    """Threads that take blocks of whatever render is next.

    Args:
        threads: how many.

    Attributes:
        pending: blocks that are in the list or being taken.
    """

    def __init__(self, threads: int) -> None:
        self.threads, self.pending = threads, 0
        self._idle: list[tuple[Hashable, list[Worker]]] = []  # with the structure of the renders that they may serve
        self._todo = SimpleQueue[tuple[Job[T], Block] | None]()
        self._done = SimpleQueue[tuple[Job[T], Share | BaseException]]()
        self._crew: list[threading.Thread] = []
        self._jobs: set[Job[T]] = set()

    def add(self, job: Job[T]) -> None:
        """Put a render's blocks at the end of the list.

        Raises:
            RenderError: there is no memory for a single thread.
        """
        job.left = len(job.blocks)
        self._jobs.add(job)
        job.loop.idle = self._idle_of(job.loop.kernels.structure)
        for block in job.blocks:
            self.pending += 1
            self._todo.put((job, block))
            if len(self._crew) < min(self.threads, self.pending):
                self._start()

    def next(self, wait: bool) -> tuple[Job[T], Share | BaseException] | None:
        """Return what a block came to, and of which render; None where nothing came, after a while where it waits."""
        try:
            job, share = self._done.get(timeout=PATIENCE) if wait else self._done.get_nowait()
        except Empty:
            return None
        self.pending -= 1
        job.left -= 1
        if isinstance(share, Share):
            job.rest += share.rest
        if job.left == 0:
            self._jobs.discard(job)
            job.loop.dismiss()
        return job, share

    def close(self) -> None:
        """End the threads; renders that are not done stop at their next kernel."""
        for job in self._jobs:
            job.loop.halt()
        for _ in self._crew:
            self._todo.put(None)
        for thread in self._crew:
            thread.join()

    def _idle_of(self, structure: Hashable) -> list[Worker]:
        """The workers that renders of a structure take over and leave."""
        known = next((one for one in self._idle if one[0] == structure), None)
        found = (structure, []) if known is None else known
        self._idle = [found, *(one for one in self._idle if one is not found)][:STRUCTURES]
        return found[1]

    def _start(self) -> None:
        thread = threading.Thread(target=self._work, name=f"torchpt_{len(self._crew)}")
        try:
            thread.start()
        except (RuntimeError, MemoryError):
            if not self._crew:
                raise RenderError("not enough memory for a thread that renders") from None
            self.threads = len(self._crew)
            return
        self._crew.append(thread)

    def _work(self) -> None:
        while (task := self._todo.get()) is not None:
            job, block = task
            try:
                self._done.put((job, job.loop.task(*block)))
            except BaseException as error:
                self._done.put((job, error))
