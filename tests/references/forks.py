"""Ranks as forked children of the test process: they start at once, with all modules imported and kernels compiled."""

from __future__ import annotations

import multiprocessing
import os
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torchpt
from torchpt.cli.main import run
from torchpt.rendering import checkpoint
from torchpt.rendering import run as running

# torch asks DNS for the name of the other side of each connection, to show it in messages: no test waits for such answers.
os.environ.setdefault("RES_OPTIONS", "attempts:0")
os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # nor sees that there are none

#: Seconds after which a child is killed.
PATIENCE = 100.0
_context = multiprocessing.get_context("fork")


def in_ranks(size: int, work: Callable[[Any], Any], folder: Path, timeout: float = 60.0) -> list[Any]:
    """Run ``work(group)`` on each of ``size`` ranks; return the results (plain values and arrays) or exceptions."""
    place = f"file://{folder}/store_{size}_{len(list(folder.iterdir()))}"

    def child(rank: int, pipe: Connection) -> None:
        import torch.distributed as dist

        try:
            dist.init_process_group("gloo", init_method=place, rank=rank, world_size=size)
            found = work(torchpt.ranks.Group(timeout=timeout))
        except Exception as error:
            found = error
        try:
            pipe.send(found)
        finally:
            os._exit(0)  # what a test has open belongs to its parent

    pipes, children = [], []
    for rank in range(size):
        here, there = _context.Pipe(False)
        children.append(_context.Process(target=child, args=(rank, there)))
        children[-1].start()
        there.close()
        pipes.append(here)
    found = []
    for pipe, process in zip(pipes, children, strict=True):
        try:
            found.append(pipe.recv() if pipe.poll(PATIENCE) else TimeoutError("a rank does not end"))
        except EOFError:
            found.append(None)  # the child was killed
        if process.is_alive():
            process.join(5.0)
        if process.is_alive():
            process.kill()
            process.join()
    return found


@dataclass
class Command:
    """A command line that runs on several ranks.

    Attributes:
        children: processes, by rank.
        errors: file of their stderr.
        output: file of their stdout.
        store: store through which they find each other.
    """

    children: list[Any]
    errors: Path
    output: Path
    store: Any

    def codes(self) -> list[int | None]:
        """Wait for all ranks and return their exit codes; ranks that do not end are killed."""
        for process in self.children:
            process.join(PATIENCE)
            if process.is_alive():
                process.kill()
                process.join()
        return [process.exitcode for process in self.children]

    def lines(self) -> list[str]:
        """Return the lines on stderr, without messages of torch itself."""
        every = self.errors.read_text().splitlines()
        return [line for line in every if not re.match(r"\[Gloo\] |\[W\d+ .* \[c10d\] ", line)]


def command(
    size: int, words: list[str], folder: Path, every: float = 5.0, env: Mapping[str, str] | None = None
) -> Command:
    """Start ``torchpt`` with these words in a folder, by ranks; ``every``: seconds between two checkpoints."""
    import torch.distributed as dist

    number = len(list(folder.iterdir()))
    errors, output = folder / f"stderr_{number}", folder / f"stdout_{number}"
    # As with torchrun, no rank owns the store.
    store = dist.TCPStore("127.0.0.1", 0, None, True, wait_for_workers=False)  # pyright: ignore[reportPrivateImportUsage]

    def child(rank: int) -> None:
        try:
            os.chdir(folder)
            for number, path in ((2, errors), (1, output)):
                opened = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
                os.dup2(opened, number)
            sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False, buffering=1)
            os.environ.update(RANK=str(rank), WORLD_SIZE=str(size), LOCAL_RANK=str(rank), MASTER_ADDR="127.0.0.1")
            os.environ.update(MASTER_PORT=str(store.port), TORCHELASTIC_USE_AGENT_STORE="True")
            os.environ.update(env or {})
            checkpoint.EVERY = running.EVERY = every
            checkpoint.PATIENCE = 1.0
            sys.argv = ["torchpt", *words]
            run()
        except SystemExit as end:
            sys.stdout.flush()
            os._exit(end.code if isinstance(end.code, int) else 1)
        except BaseException:
            traceback.print_exc()
            os._exit(99)
        os._exit(0)

    children = [_context.Process(target=child, args=(rank,)) for rank in range(size)]
    for process in children:
        process.start()
    return Command(children, errors, output, store)
