"""The ranks that torchrun (or whoever sets RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT) started, for the command line."""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from datetime import timedelta

from torchpt.errors import LostRankError, RenderError
from torchpt.ranks.group import TIMEOUT, Group

__all__ = ["Started"]

#: Seconds between two looks whether all ranks are there.
PAUSE = 0.02
#: What must be set.
NAMES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


class Started:
    """A process that was started as one of several.

    Args:
        check: called while the others are waited for; what it raises ends the wait.
        timeout: seconds for that, and for every answer later.

    Attributes:
        group: the ranks.

    Raises:
        RenderError: the environment lacks something, or not all ranks came.
    """

    def __init__(self, check: Callable[[], None], timeout: float = TIMEOUT) -> None:
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # else it warns of every connection that ends
        import torch
        import torch.distributed as dist

        missing = [name for name in NAMES if not os.environ.get(name)]
        if missing:
            raise RenderError(f"WORLD_SIZE is {os.environ['WORLD_SIZE']}, but {', '.join(missing)} are not set; use torchrun")
        if not dist.is_available() or not dist.is_gloo_available():
            raise RenderError("this build of PyTorch has no gloo, by which ranks talk to each other")
        try:
            store, rank, size = next(iter(dist.rendezvous("env://", timeout=timedelta(seconds=timeout))))
            # torchrun keeps its store where it starts all ranks again, with the addresses of those that are gone.
            self._store = dist.PrefixStore(f"torchpt/{os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)
            self._wait(size, check, timeout)
            dist.init_process_group(
                "gloo", store=self._store, rank=rank, world_size=size, timeout=timedelta(seconds=timeout)
            )
        except (RuntimeError, ValueError) as error:
            raise LostRankError(f"ranks: not all of them came ({str(error).strip().splitlines()[0]})") from None
        self.group = Group(timeout=timeout)
        local = os.environ.get("LOCAL_RANK", "")
        if torch.cuda.is_available() and local.isdigit():  # `auto` and `cuda` are one GPU for each rank of a machine
            torch.cuda.set_device(int(local) % torch.cuda.device_count())

    def _wait(self, size: int, check: Callable[[], None], timeout: float) -> None:
        """Wait until all are there, with an ear for signals: what waits inside of torch has none."""
        end = time.monotonic() + timeout
        self._store.add("here", 1)
        while (here := self._store.add("here", 0)) < size:
            check()
            if time.monotonic() > end:
                raise LostRankError(f"ranks: {here} of {size} came within {timeout:g} s")
            time.sleep(PAUSE)

    def first_to_say(self, line: str) -> bool:
        """Whether no other rank said this line before; true where nobody can be asked any more."""
        with suppress(RuntimeError):
            return self._store.add(f"said/{zlib.crc32(line.encode())}", 1) == 1
        return True

    def leave(self) -> None:
        """Close connections, where all ranks are there to do so."""
        import torch.distributed as dist

        dist.destroy_process_group()
