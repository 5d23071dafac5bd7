"""Force waves and chunks of a few lanes, as when memory is short."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from torchpt.engines.kernels import threads as loop
from torchpt.scene.memory_estimate import LANES

__all__ = ["few_lanes"]


@contextmanager
def few_lanes(lanes: int | None) -> Iterator[None]:
    """Limit waves of tensor operations and chunks of the compiled loop to a few lanes inside the context."""
    with pytest.MonkeyPatch.context() as patched:
        if lanes is not None:
            for device in LANES:
                patched.setitem(LANES, device, lanes)
            patched.setattr(loop, "LANES", min(lanes, loop.LANES))
        yield
