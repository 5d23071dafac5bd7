"""Render scenes by cameras in one call: ``inputs`` reads and checks arguments, ``batch`` renders and stacks the pictures."""

from __future__ import annotations

from torchpt.rendering.batches.batch import (
    Picture,
    Renderings,
    render_batch,
    render_pictures,
    request_of,
    task_counts,
)
from torchpt.rendering.batches.inputs import naming_errors

__all__ = [
    "Picture",
    "Renderings",
    "naming_errors",
    "render_batch",
    "render_pictures",
    "request_of",
    "task_counts",
]
