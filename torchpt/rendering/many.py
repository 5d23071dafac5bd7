"""Several renders at once: their samples are one work list, and what is next is made ready while threads trace."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial

import torch

from torchpt.compiler.graph import Unsupported
from torchpt.core.threads import TaskQueue, one_thread, without_autocast
from torchpt.engines.engine import Block, TaskResult
from torchpt.rendering.result import Rendering
from torchpt.rendering.run import Run

__all__ = ["QueuedRender", "render_many"]

#: Renders a thread that are made ready in advance.
PREFETCH = 2


@dataclass
class QueuedRender:
    """A render of several.

    Attributes:
        device: where it is rendered.
        make: makes it ready for a number of threads; called when it is soon to begin.
        done: told of the rendering.
        failed: told of an error instead, which it may raise as another one.
        run: once it is ready.
        left: tasks of it that are not done.
        rest: blocks that memory did not suffice for.
    """

    device: torch.device
    make: Callable[[int], Run]
    done: Callable[[Rendering], None]
    failed: Callable[[BaseException], None]
    run: Run = field(init=False)
    left: int = field(init=False, default=0)
    rest: list[Block] = field(init=False, default_factory=list)


def render_many(entries: Iterable[QueuedRender], tasks: int) -> None:
    """Render them, each to the very bits that it has alone.

    Renders that the compiled loop takes, and that nothing but their number of samples ends, share threads and a work list.
    Others are rendered one after another: by tensor operations (as on CUDA), to a time or an error, in bounded memory.

    Args:
        entries: what is to be rendered; taken one by one.
        tasks: into how many parts the work of a render is cut, as far as that repays.

    Raises:
        Exception: what an entry's ``failed`` raises; the others are given up then.
    """
    queue = TaskQueue[QueuedRender, TaskResult](torch.get_num_threads())
    waiting, begun = iter(entries), dict[int, QueuedRender]()
    try:
        while True:
            with _single_threaded(queue):
                entry = next(waiting, None)
            if entry is None:
                break
            with without_autocast(entry.device), _errors_to(entry), _single_threaded(queue):
                entry.run = entry.make(queue.threads)
                spans = entry.run.all_spans()
            if spans is None:
                _collect(queue, begun, 0)
                with without_autocast(entry.device), _errors_to(entry):
                    entry.done(entry.run.sample_all(None))
                del entry.run
                continue
            with _errors_to(entry):
                engine = entry.run.tasks
                assert engine is not None
                begun[id(entry)] = entry
                blocks = engine.blocks(spans, tasks)
                entry.left = len(blocks)
                for block in blocks:
                    queue.add(entry, partial(engine.task, block))
            _collect(queue, begun, PREFETCH * queue.threads * tasks)
        _collect(queue, begun, 0)
    finally:
        for entry in begun.values():  # those that are not done stop at their next kernel
            if entry.run.tasks is not None:
                entry.run.tasks.halt()
        queue.close()


@contextmanager
def _single_threaded(queue: TaskQueue[QueuedRender, TaskResult]) -> Iterator[None]:
    """While all cores trace, tensor operations of this thread are its own: a team would wait for a core, and spin meanwhile."""
    with one_thread() if queue.pending else nullcontext():
        yield


@contextmanager
def _errors_to(entry: QueuedRender) -> Iterator[None]:
    """Tell an entry of the errors within."""
    try:
        yield
    except Exception as error:
        entry.failed(error)
        raise


def _collect(queue: TaskQueue[QueuedRender, TaskResult], begun: dict[int, QueuedRender], most: int) -> None:
    """Take in what threads have done, until no more than ``most`` blocks are pending."""
    while True:
        found = queue.next(wait=queue.pending > most)
        if found is None:
            if queue.pending <= most:
                return
            continue
        entry, share = found
        entry.left -= 1
        with without_autocast(entry.device), _errors_to(entry), _single_threaded(queue):
            if isinstance(share, Unsupported):
                entry.run.unsupported = share
                assert entry.run.tasks is not None
                entry.run.tasks.halt()
            elif isinstance(share, BaseException):
                raise share
            else:
                entry.rest += share.rest
                entry.run.task_finished(share)
            if entry.left == 0:
                del begun[id(entry)]
                entry.done(entry.run.finish(entry.rest))
                del entry.run
