"""Write textures of mesh files' materials as blocks of a scene file, without keys that have their defaults.

The readers of MTL and glTF materials use this module.
"""

from __future__ import annotations

from typing import Any

from torchpt.images import EncodedImage

__all__ = ["image_texture", "number_if_grey"]

Rgb = tuple[float, float, float]


def number_if_grey(color: Rgb) -> float | list[float]:
    """Return a colour in the form of a scene file: one number where it is grey."""
    return color[0] if color[0] == color[1] == color[2] else list(color)


def image_texture(
    path: str | EncodedImage,
    *,
    scale: float | list[float] = 1.0,
    channel: str | None = None,
    wrap: str = "repeat",
    nearest: bool = False,
    uv_transform: dict[str, Any] | None = None,
    encoded: bool = False,
) -> dict[str, Any]:
    """Return the block ``{type: image, path: ..., ...}``.

    Args:
        path: absolute, or an image in memory.
        scale: factor of the values.
        channel: the channel that a number reads; None for colours.
        wrap: ``repeat``, ``clamp`` or ``mirror``.
        nearest: True where texels are not interpolated.
        uv_transform: the block of a scene file; empty for none.
        encoded: True: colours are sRGB, of whatever number of bits.
    """
    entry: dict[str, Any] = {"type": "image", "path": path}
    if wrap != "repeat":
        entry["wrap"] = wrap
    if nearest:
        entry["filter"] = "nearest"
    if scale != 1.0:
        entry["scale"] = scale
    if channel is not None:
        entry["channel"] = channel
    if encoded:
        entry["colorspace"] = "srgb"
    if uv_transform:
        entry["uv_transform"] = uv_transform
    return entry
