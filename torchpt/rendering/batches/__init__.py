"""Render scenes by cameras in one call: ``inputs`` reads and checks arguments, ``batch`` renders and stacks the pictures."""

from __future__ import annotations

from torchpt.rendering.batches.batch import Renderings, render_batch

__all__ = ["Renderings", "render_batch"]
