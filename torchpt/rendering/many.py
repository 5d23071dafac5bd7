"""Render several pictures on one thread pool; the next ones are prepared while its threads trace.

``torchpt.render_batch`` calls :func:`render_many`. A task renders one block, some pixels of a picture, on any thread of the
pool; results come back to the calling thread, which adds them to their render.
"""

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

#: Renders for each thread whose tasks may wait in the queue: enough that threads do not wait for the next render.
PREFETCH = 2


@dataclass
class QueuedRender:
    """One render of a batch.

    Attributes:
        device: of the scene.
        make: prepares the render for a number of threads; called shortly before it begins.
        on_done: called with the rendering.
        on_error: called with an error instead, and may raise another one.
        tasks: the number of tasks that each pixel set is cut into, at most.
        run: the prepared render.
        tasks_left: number of its tasks that are not finished.
        unfinished: blocks put back when memory ran out.
    """

    device: torch.device
    make: Callable[[int], Run]
    on_done: Callable[[Rendering], None]
    on_error: Callable[[BaseException], None]
    tasks: int
    run: Run = field(init=False)
    tasks_left: int = field(init=False, default=0)
    unfinished: list[Block] = field(init=False, default_factory=list)


def render_many(entries: Iterable[QueuedRender]) -> None:
    """Render all entries; each picture has the bits that it has alone.

    Compiled renders that only ``spp`` ends share the threads and one queue of tasks. Others are rendered one after another:
    those by tensor operations (as on CUDA), with a time limit or target error, or in bounded memory.

    Args:
        entries: the renders, taken one by one.

    Raises:
        Exception: the error that an entry's ``on_error`` raises; all other renders are cancelled.
    """
    queue = TaskQueue[QueuedRender, TaskResult](torch.get_num_threads())
    waiting, started = iter(entries), dict[int, QueuedRender]()  # started: by id, while tasks are unfinished
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
                _collect(queue, started, most=0)
                with without_autocast(entry.device), _errors_to(entry):
                    entry.on_done(entry.run.sample_all(None))
                del entry.run
                continue
            with _errors_to(entry):
                engine = entry.run.tasks
                assert engine is not None
                started[id(entry)] = entry
                blocks = engine.blocks(spans, entry.tasks)
                entry.tasks_left = len(blocks)
                for block in blocks:
                    queue.add(entry, partial(engine.task, block))
            _collect(queue, started, most=PREFETCH * queue.threads * entry.tasks)
        _collect(queue, started, most=0)
    finally:
        for entry in started.values():  # unfinished renders stop at their next kernel
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
    """Pass errors raised within to the entry's ``on_error``."""
    try:
        yield
    except Exception as error:
        entry.on_error(error)
        raise


def _collect(queue: TaskQueue[QueuedRender, TaskResult], started: dict[int, QueuedRender], *, most: int) -> None:
    """Collect results of the pool until at most ``most`` tasks are pending."""
    while True:
        found = queue.next(wait=queue.pending > most)
        if found is None:
            if queue.pending <= most:
                return
            continue
        entry, result = found
        entry.tasks_left -= 1
        with without_autocast(entry.device), _errors_to(entry), _single_threaded(queue):
            if isinstance(result, Unsupported):
                entry.run.unsupported = result
                assert entry.run.tasks is not None
                entry.run.tasks.halt()
            elif isinstance(result, BaseException):
                raise result
            else:
                entry.unfinished += result.unfinished  # blocks for which memory ran out
                entry.run.task_finished(result)
            if entry.tasks_left == 0:
                del started[id(entry)]
                entry.on_done(entry.run.finish(entry.unfinished))
                del entry.run
