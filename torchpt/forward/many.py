"""Several renders at once: their samples are one work list, and what is next is made ready while threads trace.

By tensor operations, as on CUDA, pictures of several cameras and scenes share their waves.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext

import torch

from torchpt.errors import ShortageError
from torchpt.forward.crowd import Crowd, Entry, blamed
from torchpt.integrators.loop.together import Job, Together
from torchpt.integrators.plate import Plate
from torchpt.lanes.graph import Unsupported
from torchpt.math.threads import one_thread
from torchpt.native.memory import let_go
from torchpt.native.modes import undisturbed
from torchpt.shortage import ran_out

__all__ = ["Entry", "render_many"]

#: Renders a thread that are made ready in advance.
AHEAD = 2


def render_many(entries: Iterable[Entry], tasks: int) -> None:
    """Render them, each to the very bits that it has alone.

    Of renders which nothing but their number of samples ends, those that the compiled loop takes share threads and a work list,
    and those by tensor operations (on CUDA above all) share waves, where they follow each other and are
    :func:`torchpt.forward.shared.alike`. Others are rendered one after another: to a time or an error, in bounded memory.

    Args:
        entries: what is to be rendered; taken one by one.
        tasks: into how many parts the work of a render is cut, as far as that repays.

    Raises:
        Exception: what an entry's ``failed`` raises; the others are given up then.
    """
    crew, crowd = Together[Entry](torch.get_num_threads()), Crowd()
    waiting = iter(entries)
    try:
        while True:
            with _beside(crew):
                entry = next(waiting, None)
            if entry is None:
                break
            spans = _ready(entry, crew, crowd)
            if spans is None:
                _drain(crew, 0)
                crowd.add(entry)
                continue
            crowd.settle()
            with blamed(entry):
                loop = entry.run.loop
                assert loop is not None
                crew.add(Job(entry, loop, loop.blocks(spans, tasks)))
            _drain(crew, AHEAD * crew.threads * tasks)
        _drain(crew, 0)
        crowd.settle()
    finally:
        crew.close()


def _ready(entry: Entry, crew: Together[Entry], crowd: Crowd) -> list[tuple[Plate, int, int]] | None:
    """Make a render ready; its samples, where the compiled loop takes all of them at once.

    Where memory runs out, those that wait are done first.
    """

    def ready() -> list[tuple[Plate, int, int]] | None:
        with undisturbed(entry.device), _beside(crew):
            entry.run = entry.make(crew.threads)
            return entry.run.at_once()

    with blamed(entry):
        try:
            return ready()
        except Exception as error:
            if not crowd or not (isinstance(error, ShortageError) or ran_out(error)):
                raise
    crowd.settle()
    let_go()
    with blamed(entry):
        return ready()


@contextmanager
def _beside(crew: Together[Entry]) -> Iterator[None]:
    """While all cores trace, tensor operations of this thread are its own: a team would wait for a core, and spin meanwhile."""
    with one_thread() if crew.pending else nullcontext():
        yield


def _drain(crew: Together[Entry], most: int) -> None:
    """Take in what threads have done, until no more than ``most`` blocks are pending."""
    while True:
        found = crew.next(wait=crew.pending > most)
        if found is None:
            if crew.pending <= most:
                return
            continue
        job, share = found
        entry = job.owner
        with undisturbed(entry.device), blamed(entry), _beside(crew):
            if isinstance(share, Unsupported):
                entry.run.unsupported = share
                job.loop.halt()
            elif isinstance(share, BaseException):
                raise share
            else:
                entry.run.took(share)
            if job.left == 0:
                entry.done(entry.run.completed(job.rest))
                del entry.run
