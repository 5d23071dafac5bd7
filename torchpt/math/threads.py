"""Operations whose last bits torch makes depend on how many threads share the work, done so that they do not.

On a CPU torch cuts a tensor of more than 32,768 elements into a part for each thread. The last elements of a part fill no
vector, and where another function computes those than computes vectors (``atan2``, ``pow``) they round differently. A sum over
all elements becomes a sum of the threads' own. What is here gives on any number of threads what one thread alone computes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

__all__ = ["in_pieces", "mean_all", "one_thread", "sum_all"]

#: Elements that one thread computes alone: fewer than torch divides, and a whole number of the vectors of any CPU.
PIECE = 1 << 14


def in_pieces(function: Callable[..., Tensor], *given: Tensor) -> Tensor:
    """``function`` of each element of tensors of one shape."""
    first = given[0]
    if first.device.type != "cpu" or first.numel() <= PIECE:
        return function(*given)
    pieces = [function(*piece) for piece in zip(*(x.reshape(-1).split(PIECE) for x in given), strict=True)]
    return torch.cat(pieces).view(first.shape)


def sum_all(x: Tensor) -> Tensor:
    """The sum ``()`` of all elements."""
    # Of two sums at once each is one thread's.
    return x.expand(2, *x.shape).sum(tuple(range(1, x.dim() + 1)))[0]


def mean_all(x: Tensor) -> Tensor:
    """The mean ``()`` of all elements."""
    return x.expand(2, *x.shape).mean(tuple(range(1, x.dim() + 1)))[0]


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use a single thread for a while, where what it sums cannot be reached."""
    before = torch.get_num_threads()
    if before > 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if before > 1:
            torch.set_num_threads(before)
