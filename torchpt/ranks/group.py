"""The ranks of a process group and their communication, by gloo in host memory: films are small beside their cost.

Ranks take the same steps in the same order. Before each step they exchange its name, so that an error of one rank is reported
by all, and a tensor is never read as another. Decisions that may differ (by the clock, or by the rounding of another processor)
are made by the first rank. ``rendering/split.py`` and gradients share their work through a :class:`Group`.
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

#: Seconds until a silent rank is given up. Ranks wait for the slowest one, which may have much to load.
TIMEOUT = 1800.0
#: Largest timeout in seconds that torch can count in milliseconds.
LONGEST_TIMEOUT = 1e6
#: Numbers in a message: a status, a step, and up to six of the caller's.
MESSAGE_LENGTH, _HEADER_LENGTH = 8, 2
#: Seconds between two checks for answers, at first and at most: signals are handled in between.
SHORTEST_PAUSE, LONGEST_PAUSE = 5e-5, 5e-3
#: Names of the steps at which a rank sends its last message, and a message after an error.
END, FAILED = "end", "failed"
#: Status of a rank that failed: the exit code of the command line after an error.
FAILED_STATUS = 2
#: Attribute of an error that the other ranks know of.
_KNOWN_MARK = "_torchpt_other_ranks_know"


class Group:
    """The ranks that share a render. Creating one is a collective call of all ranks of the process group.

    Args:
        process_group: an initialized group of torch.distributed, of any backend; None: all processes.
        timeout: seconds until a rank that does not answer is given up, above 0 and at most a million.

    Attributes:
        rank: rank of this process, from 0.
        size: number of ranks.
        timeout: the timeout in seconds.
        has_ended: True once communication has ended, or a rank is lost.

    Raises:
        SceneError: not a process group, or not such a number.
        RenderError: torch.distributed is not initialized, or this process is not in the group.
    """

    def __init__(self, process_group: Any = None, timeout: float = TIMEOUT) -> None:
        import torch.distributed as dist

        if isinstance(timeout, bool) or not isinstance(timeout, int | float) or not 0.0 < timeout <= LONGEST_TIMEOUT:
            raise SceneError("timeout", timeout, f"a number of seconds above 0, at most {LONGEST_TIMEOUT:.0f}")
        if not dist.is_available() or not dist.is_initialized():
            raise RenderError("ranks: there is no process group; call torch.distributed.init_process_group first")
        members = _members(dist, process_group)
        if dist.get_rank() not in members:
            raise RenderError("ranks: this process is not in the process group")
        # A new group: its messages never mix with those of the caller's group.
        try:
            own = dist.new_group(
                members,
                timeout=timedelta(seconds=timeout),
                backend="gloo",
                use_local_synchronization=len(members) < dist.get_world_size(),
            )
        except RuntimeError as error:
            raise LostRankError(f"ranks: no connection between all of them ({_first_line(error)})") from None
        assert isinstance(own, dist.ProcessGroup)
        self._dist, self._process_group = dist, own
        self._transfer: Any = None  # the latest one, see _wait
        self.rank, self.size = members.index(dist.get_rank()), len(members)
        self.timeout, self.has_ended = timeout, False

    # -- a few numbers

    def all_gather_numbers(self, what: str, *numbers: float) -> list[tuple[float, ...]]:
        """Return the numbers (integers up to 2^53, or floats) of all ranks, in the order of ranks.

        Args:
            what: name of the next step, the same on all ranks.
            numbers: numbers of this rank, at most six, as many on each.

        Raises:
            LostRankError: a rank is gone, or did not answer in time.
            OtherRankError: a rank failed.
            RenderError: ranks are at different steps.
        """
        return self._exchange_step(what, status=0, numbers=numbers)

    def end(self, code: int) -> int:
        """Send the exit code of this finished rank; return the highest code of all ranks."""
        messages = self._exchange(END, status=code, numbers=())
        self.has_ended = True
        return max(status for status, _, _ in messages)

    def _exchange_step(self, what: str, status: int, numbers: tuple[float, ...]) -> list[tuple[float, ...]]:
        """Return the numbers of every rank; raise unless all are at the same step.

        ``status``: 0, or after an error of this rank another number.
        """
        messages = self._exchange(what, status=status, numbers=numbers)
        if status:  # this rank raises its own error, whatever the others do
            return []
        own_step = zlib.crc32(what.encode())
        for rank, (other_status, step, _) in enumerate(messages):
            if step == own_step:
                continue
            # A rank that failed still takes part in the last step, END. Any other step means that ranks no longer agree.
            self.has_ended = step != zlib.crc32(FAILED.encode())
            if other_status:
                raise OtherRankError(f"ranks: rank {rank} ended with an error of its own", code=other_status)
            raise RenderError(f"ranks: rank {rank} does something else than rank {self.rank}, which is at: {what}")
        return [numbers for _, _, numbers in messages]

    def _exchange(self, what: str, status: int, numbers: tuple[float, ...]) -> list[tuple[int, int, tuple[float, ...]]]:
        """Return status, step (the CRC-32 of its name) and numbers of every rank."""
        own = torch.zeros(MESSAGE_LENGTH, dtype=torch.float64)
        own[: _HEADER_LENGTH + len(numbers)] = torch.tensor(
            [status, zlib.crc32(what.encode()), *numbers], dtype=torch.float64
        )
        received = [torch.empty_like(own) for _ in range(self.size)]
        self._wait(lambda: self._dist.all_gather(received, own, group=self._process_group, async_op=True))
        lists = [message[: _HEADER_LENGTH + len(numbers)].tolist() for message in received]
        return [(int(status), int(step), tuple(rest)) for status, step, *rest in lists]

    def broadcast_numbers(self, what: str, *numbers: float) -> tuple[float, ...]:
        """Return the numbers of the first rank; NaN is allowed."""
        return self.all_gather_numbers(what, *numbers)[0]

    def check_same(self, what: str, content: bytes) -> None:
        """Raise unless ``content`` is the same on all ranks.

        Raises:
            RenderError: it differs; raised on every rank.
        """
        if len({check for (check,) in self.all_gather_numbers(what, zlib.crc32(content))}) > 1:
            raise _mark_known(RenderError(f"ranks: {what} must be the same on every rank"))

    @contextmanager
    def together(self) -> Iterator[None]:
        """Tell the other ranks, which do the same work, of an error raised within."""
        try:
            yield
        except (LostRankError, OtherRankError):
            raise
        except Exception as error:
            if not self.has_ended and not getattr(error, _KNOWN_MARK, False):
                with suppress(LostRankError):
                    self._exchange_step(FAILED, status=FAILED_STATUS, numbers=())
                _mark_known(error)
            raise

    # -- many numbers

    def gather(self, own: Tensor) -> list[Tensor]:
        """Return the tensors ``(n,)`` of all ranks, in order; n may differ, the dtype may not.

        Raises:
            LostRankError, OtherRankError, RenderError: as :meth:`all_gather_numbers`.
        """
        sizes = [int(n) for (n,) in self.all_gather_numbers("gather", len(own))]
        sent = torch.zeros(max(sizes), dtype=own.dtype)
        sent[: len(own)] = own.cpu()
        received = [torch.empty_like(sent) for _ in sizes]
        self._wait(lambda: self._dist.all_gather(received, sent, group=self._process_group, async_op=True))
        return [values[:size].to(own.device) for values, size in zip(received, sizes, strict=True)]

    def broadcast(self, own: Tensor) -> Tensor:
        """Return the tensor ``(n,)`` of the first rank; n may differ, the dtype may not.

        Raises:
            LostRankError, OtherRankError, RenderError: as :meth:`all_gather_numbers`.
        """
        (size,) = self.broadcast_numbers("broadcast", len(own))
        return self._broadcast(own if self.rank == 0 else own.new_empty(int(size)), 0)

    def sum(self, own: Tensor) -> Tensor:
        """Return the sum of tensors of one shape, added in the order of ranks: the same bits on every rank.

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
        """Return the values of a rank."""
        sent = values.cpu().contiguous()
        self._wait(lambda: self._dist.broadcast(sent, group=self._process_group, group_src=rank, async_op=True))
        return sent.to(values.device)

    def _wait(self, begin: Callable[[], Any]) -> None:
        """Start a transfer and wait for it until the timeout, in short pauses between which Python handles signals."""
        end, pause = time.monotonic() + self.timeout, SHORTEST_PAUSE
        try:
            # Kept until the next transfer: gloo's thread needs Python to free it, which may be about to end.
            self._transfer = transfer = begin()
            while not transfer.is_completed():
                if time.monotonic() > end:
                    self.has_ended = True
                    raise self._silence_error()
                time.sleep(pause)
                pause = min(1.5 * pause, LONGEST_PAUSE)  # short transfers end soon, long ones may wait
            transfer.wait()
        except BaseException as error:
            _keep_forever(self._transfer)
            if not isinstance(error, RuntimeError):
                raise
            self.has_ended = True
            if time.monotonic() > end:  # gloo's own timeout came first
                raise self._silence_error() from None
            raise LostRankError("ranks: another rank has ended, or cannot be reached any more") from None

    def _silence_error(self) -> LostRankError:
        """Return the error for a rank that did not answer in time."""
        return LostRankError(f"ranks: another rank did not answer for {self.timeout:g} s")


@contextmanager
def together(group: Group | None, what: str, content: Callable[[], bytes]) -> Iterator[None]:
    """Raise on all ranks if ``content`` differs, and tell them of errors raised within; nothing if ``group`` is None.

    Args:
        group: the ranks.
        what: name of the content, for errors.
        content: returns the bytes that must be the same on each rank.

    Raises:
        RenderError: the content differs.
    """
    if group is None:
        yield
        return
    with group.together():
        group.check_same(what, content())
        yield


def _members(dist: Any, group: Any) -> list[int]:
    """Return the ranks of a process group; none if this process is not in it."""
    if group is dist.GroupMember.NON_GROUP_MEMBER:
        return []
    try:
        if group is None or isinstance(group, dist.ProcessGroup):
            return dist.get_process_group_ranks(group)
    except (KeyError, ValueError, RuntimeError):  # it was destroyed
        pass
    raise SceneError("process_group", group, "a process group of torch.distributed, or None")


def _keep_forever(transfer: Any) -> None:
    """Never free a pending transfer: gloo's thread would free its tensors after Python has ended, and abort."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(transfer))


def _mark_known(error: Exception) -> Exception:
    """Mark an error that all ranks know of."""
    setattr(error, _KNOWN_MARK, True)
    return error


def _first_line(error: Exception) -> str:
    """Return the first line of an error's text."""
    return str(error).strip().split("\n", 1)[0]
