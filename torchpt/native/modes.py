"""Modes of torch that a caller may be in, and that renders do not heed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["lasting", "undisturbed"]


@contextmanager
def lasting() -> Iterator[None]:
    """What is made here can be used outside of ``torch.inference_mode`` too: tensors made in that mode could not."""
    if torch.is_inference_mode_enabled():
        with torch.inference_mode(False), torch.no_grad():  # the former alone would turn gradients on
            yield
    else:
        yield


@contextmanager
def undisturbed(device: torch.device) -> Iterator[None]:
    """No gradients, no ``torch.autocast`` (which would round products to half precision), and what is made lasts."""
    with lasting(), torch.no_grad(), torch.autocast(device.type, enabled=False):
        yield
