"""Record look-ups in tables that require gradients.

Autograd's derivative of a look-up is a dense tensor as large as the table, for each look-up: with a large texture atlas a
backward pass would spend nearly all its time there. A recorder replaces the look-ups of a thread by ones with sparse
derivatives: :func:`torchpt.math.vectors.take` asks it first. The recorders are the sums of gradients, ``math/sums.py``.
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
    """The operators that take look-ups over."""

    def take(self, table: Tensor, index: Tensor) -> Tensor | None:
        """Return columns ``index (N,)`` of a table ``(..., M)`` that requires gradients; None if it is not recorded."""
        ...


@contextmanager
def recording_gathers(recorder: GatherRecorder | None) -> Iterator[None]:
    """Send look-ups of this thread to ``recorder`` inside the ``with``; None: to none."""
    before = gather_recorder()
    _local.recorder = recorder
    try:
        yield
    finally:
        _local.recorder = before


def gather_recorder() -> GatherRecorder | None:
    """Return the recorder of this thread; None if there is none."""
    return getattr(_local, "recorder", None)
