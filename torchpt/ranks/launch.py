"""Ranks that torchrun (or anything that sets RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT) started, for the command line."""

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

#: Seconds between two checks for signals.
SIGNAL_PAUSE = 0.02
#: Environment variables that must be set.
REQUIRED_VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


class LaunchedProcess:
    """A process that was started as one of several ranks.

    Args:
        timeout: seconds until a missing or silent rank is given up.

    Attributes:
        group: the ranks, after :meth:`connect`.

    Raises:
        RenderError: a variable of the environment is missing, or PyTorch was built without gloo.
    """

    group: Group

    def __init__(self, timeout: float = TIMEOUT) -> None:
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # torch warns of every connection that ends
        import torch.distributed as dist

        missing = [name for name in REQUIRED_VARIABLES if not os.environ.get(name)]
        if missing:
            size, names = os.environ.get("WORLD_SIZE", ""), ", ".join(missing)
            found = f"WORLD_SIZE is {size}, but there" if size else "there"
            raise RenderError(f"{found} is no {names}: start it by torchrun")
        if not dist.is_available() or not dist.is_gloo_available():
            raise RenderError("this build of PyTorch has no gloo, by which ranks talk to each other")
        self._timeout = timeout
        self._store: Any = None

    def connect(self, check: Callable[[], None]) -> None:
        """Connect to the other ranks.

        Args:
            check: is called while ranks are missing; an exception of it ends the wait.

        Raises:
            LostRankError: ranks are missing.
        """
        failed: list[Exception] = []

        def connect_or_fail() -> None:
            try:
                self._connect()
            except TorchptError as error:
                failed.append(error)
            except (RuntimeError, ValueError) as error:
                reason = str(error).strip().split("\n", 1)[0]
                failed.append(LostRankError(f"ranks: not all of them came ({reason})"))

        # In a thread: a call that waits inside torch handles no signals.
        thread = threading.Thread(target=connect_or_fail, name="torchpt_ranks", daemon=True)
        thread.start()
        while thread.is_alive():
            check()
            thread.join(SIGNAL_PAUSE)
        if failed:
            raise failed[0]

    def _connect(self) -> None:
        import torch
        import torch.distributed as dist
        from torch.distributed.distributed_c10d import PrefixStore
        from torch.distributed.rendezvous import rendezvous

        timeout = timedelta(seconds=self._timeout)
        store, rank, size = next(iter(rendezvous("env://", timeout=timeout)))
        # torchrun keeps its store when it restarts all ranks, with the addresses of the old ones.
        own_store: Any = PrefixStore(f"torchpt/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)
        self._store = own_store.clone()  # a second connection: a waiting call blocks its own
        with _output_to_errors():
            dist.init_process_group("gloo", store=own_store, rank=rank, world_size=size, timeout=timeout)
            self.group = Group(timeout=self._timeout)
        local_rank = os.environ.get("LOCAL_RANK", "")
        # `auto` and `cuda` mean one GPU for each rank of a machine.
        if torch.cuda.is_available() and local_rank.isdigit():
            torch.cuda.set_device(int(local_rank) % torch.cuda.device_count())

    def is_first_to_say(self, line: str) -> bool:
        """Return True if no other rank said this line before, or none can be asked.

        The store counts how often each line was said, by its CRC-32.
        """
        with suppress(RuntimeError):
            return self._store is None or self._store.add(f"said/{zlib.crc32(line.encode())}", 1) == 1
        return True

    def disconnect(self) -> None:
        """Close the connections; all ranks must call it."""
        import torch.distributed as dist

        dist.destroy_process_group()


@contextmanager
def _output_to_errors() -> Iterator[None]:
    """Redirect stdout to stderr within: gloo of older torch (2.8 to 2.10) prints there while it connects."""
    try:
        stdout_copy = os.dup(1)
    except OSError:  # stdout is closed
        yield
        return
    try:
        with suppress(OSError):
            os.dup2(2, 1)  # file descriptors: 1 is stdout, 2 stderr
        yield
    finally:
        os.dup2(stdout_copy, 1)
        os.close(stdout_copy)
