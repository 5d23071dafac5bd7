"""How many threads there are."""

from __future__ import annotations

import torch

__all__ = ["thread_count"]


def thread_count(threads: int | None) -> int:
    """Threads to use: the caller's wish, else torch's own number."""
    return max(1, int(threads)) if threads else max(1, torch.get_num_threads())
