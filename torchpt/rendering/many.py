"""Render several pictures on one thread pool; the next ones are prepared while its threads trace."""

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

#: Renders for each thread that are prepared in advance.
PREFETCH = 2


@dataclass
class QueuedRender:
    """One render of a batch.

    Attributes:
        device: of the scene.
        make: prepares the render for a number of threads; called shortly before it begins.
        done: is called with the rendering.
        failed: is called with an error instead, and may raise another one.
        run: the prepared render.
        left: number of its tasks that are not finished.
        rest: blocks put back when memory ran out.
    """

    device: torch.device
    make: Callable[[int], Run]
    done: Callable[[Rendering], None]
    failed: Callable[[BaseException], None]
    run: Run = field(init=False)
    left: int = field(init=False, default=0)
    rest: list[Block] = field(init=False, default_factory=list)


def render_many(entries: Iterable[QueuedRender], tasks: int) -> None:
    """Render all entries; each picture has the bits that it has alone.

    Compiled renders that only ``spp`` ends share the threads and one queue of tasks. Others are rendered one after another:
    those by tensor operations (as on CUDA), with a time limit or target error, or in bounded memory.

    Args:
        entries: the renders, taken one by one.
        tasks: the number of tasks that a render is cut into, at most.

    Raises:
        Exception: the error that an entry's ``failed`` raises; all other renders are cancelled.
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
        for entry in begun.values():  # unfinished renders stop at their next kernel
            if entry.run.tasks is not None:
                entry.run.tasks.halt()
        queue.close()


@contextmanager
def _single_threaded(queue: TaskQueue[QueuedRender, TaskResult]) -> Iterator[None]:
    """Let tensor operations use one thread while the pool traces: torch's team would wait for busy cores, and spin."""
    with one_thread() if queue.pending else nullcontext():
        yield


@contextmanager
def _errors_to(entry: QueuedRender) -> Iterator[None]:
    """Pass errors raised within to the entry's ``failed``."""
    try:
        yield
    except Exception as error:
        entry.failed(error)
        raise


def _collect(queue: TaskQueue[QueuedRender, TaskResult], begun: dict[int, QueuedRender], most: int) -> None:
    """Collect results of the pool until at most ``most`` tasks are pending."""
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
