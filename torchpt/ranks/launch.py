"""The ranks that torchrun (or whoever sets RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT) started, for the command line."""

from __future__ import annotations

import os
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

from torchpt.core.errors import LostRankError, RenderError, TorchptError
from torchpt.ranks.group import TIMEOUT, Group

__all__ = ["LaunchedProcess"]

#: Seconds between two looks whether a signal has come.
PAUSE = 0.02
#: What must be set.
NAMES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


class LaunchedProcess:
    """A process that was started as one of several.

    Args:
        timeout: seconds for all to come, and for every answer later.

    Attributes:
        group: the ranks, once they have met.

    Raises:
        RenderError: the environment lacks something, or this build of PyTorch does.
    """

    group: Group

    def __init__(self, timeout: float = TIMEOUT) -> None:
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # else it warns of every connection that ends
        import torch.distributed as dist

        missing = [name for name in NAMES if not os.environ.get(name)]
        if missing:
            size, names = os.environ["WORLD_SIZE"], ", ".join(missing)
            raise RenderError(f"WORLD_SIZE is {size}, but there is no {names}: start it by torchrun")
        if not dist.is_available() or not dist.is_gloo_available():
            raise RenderError("this build of PyTorch has no gloo, by which ranks talk to each other")
        self._timeout = timeout
        self._store: Any = None

    def connect(self, check: Callable[[], None]) -> None:
        """Wait for the other ranks.

        Args:
            check: called while they are waited for; what it raises ends the wait.

        Raises:
            LostRankError: not all came.
        """
        failed: list[Exception] = []

        def work() -> None:
            try:
                self._connect()
            except TorchptError as error:
                failed.append(error)
            except (RuntimeError, ValueError) as error:
                said = str(error).strip().split("\n", 1)[0]
                failed.append(LostRankError(f"ranks: not all of them came ({said})"))

        # In a thread: what waits inside of torch hears no signals.
        thread = threading.Thread(target=work, name="torchpt_ranks", daemon=True)
        thread.start()
        while thread.is_alive():
            check()
            thread.join(PAUSE)
        if failed:
            raise failed[0]

    def _connect(self) -> None:
        import torch
        import torch.distributed as dist
        from torch.distributed.distributed_c10d import PrefixStore
        from torch.distributed.rendezvous import rendezvous

        timeout = timedelta(seconds=self._timeout)
        store, rank, size = next(iter(rendezvous("env://", timeout=timeout)))
        # torchrun keeps its store where it starts all ranks again, with the addresses of those that are gone.
        own: Any = PrefixStore(f"torchpt/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)
        self._store = own.clone()  # a connection of its own: who waits by one keeps it for himself
        with _output_to_errors():
            dist.init_process_group("gloo", store=own, rank=rank, world_size=size, timeout=timeout)
            self.group = Group(timeout=self._timeout)
        local = os.environ.get("LOCAL_RANK", "")
        if torch.cuda.is_available() and local.isdigit():  # `auto` and `cuda` are one GPU for each rank of a machine
            torch.cuda.set_device(int(local) % torch.cuda.device_count())

    def first_to_say(self, line: str) -> bool:
        """Whether no other rank said this line before; true where nobody can be asked."""
        with suppress(RuntimeError):
            return self._store is None or self._store.add(f"said/{zlib.crc32(line.encode())}", 1) == 1
        return True

    def disconnect(self) -> None:
        """Close connections, where all ranks are there to do so."""
        import torch.distributed as dist

        dist.destroy_process_group()


@contextmanager
def _output_to_errors() -> Iterator[None]:
    """While gloo connects: that of older torch (2.8 to 2.10) tells stdout of it, where others read what a render came to."""
    try:
        kept = os.dup(1)
    except OSError:  # it is closed
        yield
        return
    try:
        with suppress(OSError):
            os.dup2(2, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
