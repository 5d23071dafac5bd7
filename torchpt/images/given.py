"""Pictures that a scene states itself, as arrays or nested lists."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchpt.images.decode import MAX_PIXELS
from torchpt.images.texels import Texels
from torchpt.spec import Refused

__all__ = ["TEXELS", "check_source", "texels_of"]

#: What is accepted.
TEXELS = "texels (H, W, C), channels last, or (H, W), C from 1 to 4: finite numbers, or 8 bits a value (uint8)"


def texels_of(value: Any) -> Texels:
    """Numbers as a picture ``(H, W, C)``: row 0 at the top, linear; those of 8 or 16 bits are scaled to 0..1 as a file's.

    Raises:
        Refused: another shape, numbers that are not finite in float32, or too many of them.
    """
    if not isinstance(value, np.ndarray | list | tuple):
        raise Refused(TEXELS)
    try:
        array = np.asarray(value)
    except (OverflowError, TypeError, ValueError, RuntimeError):
        raise Refused(TEXELS, "rows of different lengths") from None
    if array.dtype.kind not in "iuf" or array.ndim not in (2, 3):
        raise Refused(TEXELS, f"{array.dtype} of shape {array.shape}")
    array = array if array.ndim == 3 else array[..., None]
    if not array.size or array.shape[2] > 4 or array.shape[0] * array.shape[1] > MAX_PIXELS:
        raise Refused(TEXELS, f"shape {array.shape}")
    with np.errstate(over="ignore"):
        values = np.array(array, np.float32, order="C")
    bad = np.flatnonzero(~np.isfinite(values).all(axis=(1, 2)))
    if len(bad):
        raise Refused(TEXELS, f"a value that is not finite (row {bad[0]})")
    if array.dtype in (np.uint8, np.uint16):
        values /= np.float32(np.iinfo(array.dtype).max)
    return Texels(values, array.dtype == np.uint8)


def check_source(values: Mapping[str, Any]) -> None:
    """A picture comes from the file ``path`` or from the numbers ``data``.

    Raises:
        Refused: it comes from neither, or from both.
    """
    if values["path"] is None and values["data"] is None:
        raise Refused("a file path or data (one of them is required)", None, ("path",))
    if values["path"] is not None and values["data"] is not None:
        raise Refused("either path or data, not both", "texels", ("data",))
