"""Many pictures by one call: ``inputs`` reads what is given, ``batch`` orders the pictures and puts them together."""

from __future__ import annotations

from torchpt.rendering.batches.batch import Renderings, render_batch

__all__ = ["Renderings", "render_batch"]
