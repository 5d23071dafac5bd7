"""How many threads there are, and that their number does not matter."""

from __future__ import annotations

import functools

import torch

__all__ = ["settle", "thread_count"]

#: What torch hands over to MKL's vector mathematics.
_FUNCTIONS = "acos asin atan cos erf erfc erfinv exp log log10 log2 sin sqrt tan tanh trunc".split()


def thread_count(threads: int | None) -> int:
    """Threads to use: the caller's wish, else torch's own number."""
    return max(1, int(threads)) if threads else max(1, torch.get_num_threads())


@functools.cache
def settle() -> None:
    """Calls the vector functions once, before several threads do.

    MKL finds out at its first call which code suits the processor. Two threads that find it out together may compute half a
    tensor by less exact code: then the same render gave other bits now and then.
    """
    for dtype in (torch.float32, torch.float64):
        half = torch.full((1,), 0.5, dtype=dtype)
        for name in _FUNCTIONS:
            getattr(torch, name)(half)
