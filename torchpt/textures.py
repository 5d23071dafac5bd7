"""One atlas for all images of a scene, and look-ups into it that are differentiable in texels and coordinates.

An image lies in the atlas as planes of floats, one a channel. A *node* is one way of reading it: which plane, how it
repeats, how texture coordinates are transformed. Texel centres are at ``(i + 1/2) / size``; row 0 is ``v = 0`` (Mitsuba).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.math.vectors import take

__all__ = ["WRAPS", "Atlas", "Look", "Node", "Pick", "Veils", "atlas_of", "look_up", "slope"]

#: How an image goes on beyond its edges, in the order of the codes in :class:`Atlas`.
WRAPS = ("repeat", "clamp", "mirror")
#: Texels from the origin beyond which a coordinate says nothing any more.
_FAR = 2.0**30


@dataclass(frozen=True)
class Node:
    """One way of reading an image; static.

    Attributes:
        texels: which of the images.
        channel: None for a colour, else the channel read as a number: its index, or -1 for luminance.
        wrap: one of :data:`WRAPS`.
        nearest: take the nearest texel; else bilinear.
        transform: rows of the affine map ``(2, 3)`` of texture coordinates.
        scale: factors of the three channels (of a number: the first).
    """

    texels: str
    channel: int | None
    wrap: str
    nearest: bool
    transform: tuple[tuple[float, float, float], tuple[float, float, float]]
    scale: tuple[float, float, float]


@dataclass(frozen=True)
class Atlas:
    """All planes, and the nodes that read them.

    Attributes:
        texels: ``(T,)``.
        places: ``(6, M)`` int64: first texel, texels from one channel to the next, width, height, wrap, 1 where bilinear.
        maps: ``(9, M)``: transform of the coordinates by rows, scale.
        wraps: the ways of wrapping in use; static.
        scaled: whether any node scales; static.
        moved: whether any node transforms its coordinates; static.
    """

    texels: Tensor
    places: Tensor
    maps: Tensor
    wraps: tuple[str, ...]
    scaled: bool
    moved: bool


@dataclass(frozen=True)
class Pick:
    """Which texture a material reads, for the rows of one model.

    Attributes:
        nodes: ``(R,)`` int64 into the atlas; None: the colours of vertices.
        channel: static; None: a colour. Of vertex colours as in :class:`Node`, of nodes any number.
    """

    nodes: Tensor | None
    channel: int | None


@dataclass(frozen=True)
class Look:
    """What the materials of one model read from textures.

    Attributes:
        readings: :class:`Pick` by parameter, nested as the parameters are.
        normal: nodes of normals in the surface's own frame ``(R,)``, or None.
        bump: nodes of heights ``(R,)``, or None.
    """

    readings: dict[str, Any]
    normal: Tensor | None
    bump: Tensor | None


@dataclass(frozen=True)
class Veils:
    """Textures of opacity, by primitive and copy: ``bias + factor * value``, and where that counts as 0 or 1.

    Attributes:
        nodes: ``(P + I,)`` int64, -1 where there is none.
        bias: ``(P + I,)``.
        factor: ``(P + I,)``.
        cutoff: ``(P + I,)``, -1 where there is none; None where there is none at all.
    """

    nodes: Tensor
    bias: Tensor
    factor: Tensor
    cutoff: Tensor | None


_SAME = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def atlas_of(nodes: Sequence[Node], images: dict[str, Tensor], dtype: torch.dtype, device: torch.device) -> Atlas:
    """The atlas of ``nodes``, in their order; differentiable in the images.

    Args:
        nodes: what is read.
        images: ``(H, W, C)`` by name, linear; C is 1 (grey), 2 (grey, alpha), 3 or 4 (RGB, alpha).
        dtype: of the lanes.
        device: where it lies.
    """
    planes: list[Tensor] = []
    blocks: dict[tuple[str, int | None], tuple[int, int]] = {}
    places, maps, end = [], [], 0
    for node in nodes:
        image = images[node.texels]
        height, width, _ = image.shape
        block = (node.texels, node.channel)
        if block not in blocks:
            found = _planes(image, node.channel)
            blocks[block] = (end, width * height if len(found) == 3 else 0)
            planes.append(found.reshape(-1).to(device=device, dtype=dtype))
            end += found.numel()
        first, stride = blocks[block]
        places.append([first, stride, width, height, WRAPS.index(node.wrap), 0 if node.nearest else 1])
        maps.append([*node.transform[0], *node.transform[1], *node.scale])
    return Atlas(
        torch.cat(planes),
        torch.tensor(places, dtype=torch.int64, device=device).T.contiguous(),
        torch.tensor(maps, dtype=dtype, device=device).T.contiguous(),
        tuple(wrap for wrap in WRAPS if any(node.wrap == wrap for node in nodes)),
        any(node.scale != (1.0, 1.0, 1.0) for node in nodes),
        any(node.transform != _SAME for node in nodes),
    )


def _planes(image: Tensor, channel: int | None) -> Tensor:
    """The planes ``(1 or 3, H, W)`` that a node reads."""
    coloured = image.shape[2] >= 3
    if channel is None:
        return image[..., :3].permute(2, 0, 1) if coloured else image[..., :1].permute(2, 0, 1)
    if channel >= 0:
        return image[..., channel][None]
    if not coloured:
        return image[..., 0][None]
    return (0.212671 * image[..., 0] + 0.715160 * image[..., 1] + 0.072169 * image[..., 2])[None]


@dataclass(frozen=True)
class _Corners:
    """The four texels about a point: ``(C, N)`` each, and where the point lies between them."""

    low: tuple[Tensor, Tensor]
    high: tuple[Tensor, Tensor]
    x: Tensor
    y: Tensor
    width: Tensor
    height: Tensor
    maps: Tensor


def look_up(atlas: Atlas, node: Tensor, uv: Tensor, coloured: bool) -> Tensor:
    """Values of nodes ``(N,)`` at texture coordinates ``(2, N)``: ``(3, N)`` where ``coloured``, else ``(N,)``."""
    c = _corners(atlas, node, uv, coloured)
    low = c.low[0] + (c.low[1] - c.low[0]) * c.x
    high = c.high[0] + (c.high[1] - c.high[0]) * c.x
    value = low + (high - low) * c.y
    if atlas.scaled:
        value = value * (c.maps[6:9] if coloured else c.maps[6])
    return value


def slope(atlas: Atlas, node: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives ``(N,)`` of number-valued nodes with respect to ``u`` and ``v``."""
    c = _corners(atlas, node, uv, False)
    low, high = c.low[1] - c.low[0], c.high[1] - c.high[0]
    across = (low + (high - low) * c.y) * c.width
    left, right = c.high[0] - c.low[0], c.high[1] - c.low[1]
    along = (left + (right - left) * c.x) * c.height
    if atlas.scaled:
        across, along = across * c.maps[6], along * c.maps[6]
    if not atlas.moved:
        return across, along
    return across * c.maps[0] + along * c.maps[3], across * c.maps[1] + along * c.maps[4]


def _corners(atlas: Atlas, node: Tensor, uv: Tensor, coloured: bool) -> _Corners:
    place, maps = take(atlas.places, node), take(atlas.maps, node)
    first, stride, width, height, wrap, linear = (place[k] for k in range(6))
    u, v = uv[0], uv[1]
    if atlas.moved:
        u, v = (
            torch.addcmul(torch.addcmul(maps[2], u, maps[0]), v, maps[1]),
            torch.addcmul(torch.addcmul(maps[5], u, maps[3]), v, maps[4]),
        )
    blend = linear.to(uv.dtype)
    wide, tall = width.to(uv.dtype), height.to(uv.dtype)
    x = (u * wide - 0.5 * blend).clamp(-_FAR, _FAR)
    y = (v * tall - 0.5 * blend).clamp(-_FAR, _FAR)
    i, j = x.detach().floor(), y.detach().floor()
    x, y = (x - i) * blend, (y - j) * blend
    i, j = i.to(torch.int64), j.to(torch.int64)
    left, right = (_wrapped(atlas.wraps, k, width, wrap) for k in (i, i + 1))
    top, bottom = (first + _wrapped(atlas.wraps, k, height, wrap) * width for k in (j, j + 1))
    if not coloured:
        a, b, c, d = (take(atlas.texels, row + column) for row in (top, bottom) for column in (left, right))
    else:
        steps = torch.arange(3, device=stride.device)[:, None] * stride
        a, b, c, d = (
            take(atlas.texels, (steps + (row + column)).reshape(-1)).view(3, -1)
            for row in (top, bottom)
            for column in (left, right)
        )
    return _Corners((a, b), (c, d), x, y, wide, tall, maps)


def _wrapped(wraps: tuple[str, ...], index: Tensor, size: Tensor, code: Tensor) -> Tensor:
    """Indices folded into ``0..size - 1``."""
    found: Tensor | None = None
    for wrap in wraps:
        if wrap == "repeat":
            here = torch.remainder(index, size)
        elif wrap == "clamp":
            here = torch.minimum(index.clamp_min(0), size - 1)
        else:
            turned = torch.remainder(index, 2 * size)
            here = torch.minimum(turned, 2 * size - 1 - turned)
        found = here if found is None else torch.where(code == WRAPS.index(wrap), here, found)
    assert found is not None
    return found
