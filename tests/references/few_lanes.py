"""Renders by waves and chunks of a few lanes, as they are where memory is short."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from torchpt.engines.kernels import threads as loop
from torchpt.scene.memory_estimate import LANES

__all__ = ["few_lanes"]


@contextmanager
def few_lanes(lanes: int | None) -> Iterator[None]:
    """Context in which a wave of tensor operations, or a chunk of the compiled loop, has so many lanes at most."""
    with pytest.MonkeyPatch.context() as patched:
        if lanes is not None:
            for device in LANES:
                patched.setitem(LANES, device, lanes)
            patched.setattr(loop, "LANES", min(lanes, loop.LANES))
        yield
