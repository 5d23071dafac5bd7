"""The ranks of a process group. All they say goes over gloo, from the host's memory: films are small beside what they cost.

Ranks do the same things in the same order. Before each thing they tell each other by a few numbers what it is, so that one that
failed is no riddle to the others, and what would be read wrongly is never sent. Where a decision may differ (by the clock, or
by the rounding of another kind of processor) the first rank takes it for all.
"""

from __future__ import annotations

import ctypes
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import LostRankError, OtherRankError, RenderError, SceneError

__all__ = ["TIMEOUT", "Group", "together"]

#: Seconds after which a rank that says nothing is given up. Ranks wait for the slowest one, which may have much to load.
TIMEOUT = 1800.0
#: The most of them that torch counts in milliseconds.
LONGEST = 1e6
#: Numbers that a rank says at once.
WORDS = 8
#: Seconds between two looks whether the others have answered, at first and at most: signals are heard in between.
SOON, LATE = 5e-5, 5e-3
#: What ranks say last, and what they say where they fail.
END, FAILED = "end", "failed"
#: Name of the mark on an error that the others know of.
_TOLD = "_torchpt_other_ranks_know"


class Group:
    """The ranks that share a render. To make one is a collective call: every rank of the process group must make it.

    Args:
        process_group: of torch.distributed, which must be initialized, by whatever backend; None: all processes.
        timeout: seconds after which a rank that does not answer is given up, above 0 and at most a million.

    Attributes:
        rank: of this process, from 0.
        size: how many there are.
        timeout: as given.
        over: whether ranks have parted: one is gone.

    Raises:
        SceneError: something else than a process group, or than such a number.
        RenderError: there is no process group, or this process is not in it.
    """

    def __init__(self, process_group: Any = None, timeout: float = TIMEOUT) -> None:
        import torch.distributed as dist

        if isinstance(timeout, bool) or not isinstance(timeout, int | float) or not 0.0 < timeout <= LONGEST:
            raise SceneError("timeout", timeout, f"a number of seconds above 0, at most {LONGEST:.0f}")
        if not dist.is_available() or not dist.is_initialized():
            raise RenderError("ranks: there is no process group; call torch.distributed.init_process_group first")
        members = _members(dist, process_group)
        if dist.get_rank() not in members:
            raise RenderError("ranks: this process is not in the process group")
        # One of its own: what others send over theirs is never mixed up with it.
        try:
            own = dist.new_group(
                members,
                timedelta(seconds=timeout),
                "gloo",
                use_local_synchronization=len(members) < dist.get_world_size(),
            )
        except RuntimeError as error:
            raise LostRankError(f"ranks: no connection between all of them ({_first_line(error)})") from None
        assert isinstance(own, dist.ProcessGroup)
        self._dist, self._process_group = dist, own
        self._work: Any = None
        self.rank, self.size, self.timeout, self.over = members.index(dist.get_rank()), len(members), timeout, False

    # -- a few numbers

    def all_gather_numbers(self, what: str, *numbers: float) -> list[tuple[float, ...]]:
        """What all ranks say: the numbers (whole ones up to 2^53) of each, in the order of ranks.

        Args:
            what: comes next.
            numbers: of this rank, at most six, as many on each.

        Raises:
            LostRankError: one is gone, or did not answer in time.
            OtherRankError: one failed.
            RenderError: ranks do different things.
        """
        return self._exchange_step(what, 0, numbers)

    def end(self, code: int) -> int:
        """Say that this rank is done, with an exit code; returns the highest one of all that are."""
        every = self._exchange(END, code, ())
        self.over = True
        return max(status for status, _, _ in every)

    def _exchange_step(self, what: str, status: int, numbers: tuple[float, ...]) -> list[tuple[float, ...]]:
        every = self._exchange(what, status, numbers)
        if status:
            return []
        number = zlib.crc32(what.encode())
        for rank, (code, at, _) in enumerate(every):
            if at == number:
                continue
            self.over = at != zlib.crc32(FAILED.encode())
            if code:
                raise OtherRankError(f"ranks: rank {rank} ended with an error of its own", code)
            raise RenderError(f"ranks: rank {rank} does something else than rank {self.rank}, which is at: {what}")
        return [said for _, _, said in every]

    def _exchange(self, what: str, status: int, numbers: tuple[float, ...]) -> list[tuple[int, int, tuple[float, ...]]]:
        """Status, what comes next, and numbers of every rank."""
        own = torch.zeros(WORDS, dtype=torch.float64)
        own[: 2 + len(numbers)] = torch.tensor([status, zlib.crc32(what.encode()), *numbers], dtype=torch.float64)
        every = [torch.empty_like(own) for _ in range(self.size)]
        self._wait(lambda: self._dist.all_gather(every, own, group=self._process_group, async_op=True))
        return [(int(said[0]), int(said[1]), tuple(said[2 : 2 + len(numbers)].tolist())) for said in every]

    def broadcast_numbers(self, what: str, *numbers: float) -> tuple[float, ...]:
        """Numbers as the first rank has them; NaN goes through."""
        return self.all_gather_numbers(what, *numbers)[0]

    def check_same(self, what: str, content: bytes) -> None:
        """Make sure that all ranks have the same.

        Raises:
            RenderError: they do not; on every rank.
        """
        if len({check for (check,) in self.all_gather_numbers(what, zlib.crc32(content))}) > 1:
            raise _mark_known(RenderError(f"ranks: {what} must be the same on every rank"))

    @contextmanager
    def together(self) -> Iterator[None]:
        """Context in which an error of this rank is told to the others, which are at the same work."""
        try:
            yield
        except (LostRankError, OtherRankError):
            raise
        except Exception as error:
            if not self.over and not getattr(error, _TOLD, False):
                with suppress(LostRankError):
                    self._exchange_step(FAILED, 2, ())
                _mark_known(error)
            raise

    # -- many numbers

    def gather(self, own: Tensor) -> list[Tensor]:
        """The tensors ``(n,)`` of all ranks, in their order; n may differ, the dtype may not.

        Raises:
            LostRankError, OtherRankError, RenderError: as :meth:`all_gather_numbers`.
        """
        sizes = [int(n) for (n,) in self.all_gather_numbers("gather", len(own))]
        sent = torch.zeros(max(sizes), dtype=own.dtype)
        sent[: len(own)] = own.cpu()
        every = [torch.empty_like(sent) for _ in sizes]
        self._wait(lambda: self._dist.all_gather(every, sent, group=self._process_group, async_op=True))
        return [values[:size].to(own.device) for values, size in zip(every, sizes, strict=True)]

    def first(self, own: Tensor) -> Tensor:
        """The tensor ``(n,)`` of the first rank; n may differ, the dtype may not.

        Raises:
            LostRankError, OtherRankError, RenderError: as :meth:`all_gather_numbers`.
        """
        (size,) = self.broadcast_numbers("first", len(own))
        return self._broadcast(own if self.rank == 0 else own.new_empty(int(size)), 0)

    def sum(self, own: Tensor) -> Tensor:
        """The sum of a tensor of the same shape over ranks, added in their order: the same bits on every rank.

        Raises:
            LostRankError, OtherRankError, RenderError: as :meth:`all_gather_numbers`.
        """
        self.all_gather_numbers("sum", own.numel())
        total = torch.zeros_like(own)
        for rank in range(self.size):
            total += self._broadcast(own if rank == self.rank else torch.empty_like(own), rank)
        return total

    def barrier(self) -> None:
        """Wait for all ranks.

        Raises:
            LostRankError, OtherRankError, RenderError: as :meth:`all_gather_numbers`.
        """
        self.all_gather_numbers("barrier")

    def _broadcast(self, values: Tensor, rank: int) -> Tensor:
        """The values that a rank has."""
        sent = values.cpu().contiguous()
        self._wait(lambda: self._dist.broadcast(sent, group=self._process_group, group_src=rank, async_op=True))
        return sent.to(values.device)

    def _wait(self, begin: Any) -> None:
        """Wait for what is sent, but not for ever, and with an ear for signals."""
        end, pause = time.monotonic() + self.timeout, SOON
        try:
            # Kept until the next: what gloo's thread lets go last it needs Python for, which may be about to end.
            self._work = work = begin()
            while not work.is_completed():
                if time.monotonic() > end:
                    self.over = True
                    raise self._silent()
                time.sleep(pause)
                pause = min(1.5 * pause, LATE)
            work.wait()
        except BaseException as error:
            _leak(self._work)
            if not isinstance(error, RuntimeError):
                raise
            self.over = True
            if time.monotonic() > end:  # gloo noticed first
                raise self._silent() from None
            raise LostRankError("ranks: another rank has ended, or cannot be reached any more") from None

    def _silent(self) -> LostRankError:
        return LostRankError(f"ranks: another rank did not answer for {self.timeout:g} s")


@contextmanager
def together(group: Group | None, what: str, content: Callable[[], bytes]) -> Iterator[None]:
    """Context in which ranks do one thing; nothing where ``group`` is None.

    Args:
        group: the ranks.
        what: must be the same on each.
        content: gives its bytes.

    Raises:
        RenderError: it is not the same.
    """
    if group is None:
        yield
        return
    with group.together():
        group.check_same(what, content())
        yield


def _members(dist: Any, group: Any) -> list[int]:
    """The ranks of a process group of torch.distributed; none of one that this process is not in."""
    if group is dist.GroupMember.NON_GROUP_MEMBER:
        return []
    try:
        if group is None or isinstance(group, dist.ProcessGroup):
            return dist.get_process_group_ranks(group)
    except (KeyError, ValueError, RuntimeError):  # it was destroyed
        pass
    raise SceneError("process_group", group, "a process group of torch.distributed, or None")


def _leak(work: Any) -> None:
    """Keep what is still under way beyond the end of Python: gloo's thread would free its tensors then, and abort."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(work))


def _mark_known(error: Exception) -> Exception:
    """Mark an error of which all ranks know."""
    setattr(error, _TOLD, True)
    return error


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n", 1)[0]
