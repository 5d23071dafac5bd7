"""Who is told of look-ups in tables under a tape.

Autograd's own derivative of a look-up is as large as the table, and made anew for each: of an atlas of many texels nearly all
of a backward pass would be spent there. So whoever differentiates may take the look-ups of a thread over.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from torch import Tensor

__all__ = ["GatherRecorder", "gather_recorder", "recording_gathers"]

_local = threading.local()


class GatherRecorder(Protocol):
    """Takes look-ups over."""

    def take(self, table: Tensor, index: Tensor) -> Tensor | None:
        """Columns ``index (N,)`` of a table ``(..., M)`` that requires gradients; None: not one of its own."""
        ...


@contextmanager
def recording_gathers(gathers: GatherRecorder | None) -> Iterator[None]:
    """Look-ups of this thread go to ``gathers`` meanwhile."""
    before = gather_recorder()
    _local.gathers = gathers
    try:
        yield
    finally:
        _local.gathers = before


def gather_recorder() -> GatherRecorder | None:
    """Who takes the look-ups of this thread over."""
    return getattr(_local, "gathers", None)
