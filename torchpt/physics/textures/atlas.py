"""One atlas for all images of a scene, and look-ups into it that are differentiable in texels and coordinates.

An image lies in the atlas as planes of floats, one a channel. A node says how it is read: which plane, how it
repeats, how texture coordinates are transformed. Texel centres are at ``(i + 1/2) / size``; row 0 is ``v = 0`` (Mitsuba).

A node that filters has its image in smaller and smaller sizes too (Williams, *Pyramidal Parametrics*, 1983). Each is a further
node that reads as the first one does, and a look-up lies between the two whose texels are about as large as the footprint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.core.threads import mean_all
from torchpt.math.vectors import luminance, take
from torchpt.physics.textures.base import SAME, Matrix, Node, Table, TexturePoint, transform_uv

__all__ = ["WRAPS", "Atlas", "ImageNode", "Mipmaps", "atlas_of", "look_up", "slope"]

#: How an image goes on beyond its edges, in the order of the codes in :class:`Atlas`.
WRAPS = ("repeat", "clamp", "mirror")
#: Texels from the origin beyond which a coordinate says nothing any more.
_FAR = 2.0**30


@dataclass(frozen=True)
class ImageNode(Node):
    """One way of reading an image.

    Attributes:
        texels: which of the images: the parameter that holds it, or of which ``made`` makes it.
        channel: see :class:`Node`.
        wrap: one of :data:`WRAPS`.
        nearest: take the nearest texel; else bilinear.
        transform: rows of the affine map ``(2, 3)`` of texture coordinates.
        scale: factors of the three channels (of a number: the first).
        filtered: whether footprints larger than a texel read the image in smaller sizes.
        made: makes the image ``(H, W, C)`` of the parameters and ``texels``; None: it is a parameter.
    """

    texels: str
    channel: int | None
    wrap: str
    nearest: bool
    transform: Matrix
    scale: tuple[float, float, float]
    filtered: bool = False
    made: Callable[[Mapping[str, Tensor], str], Tensor] | None = None

    @property
    def variant(self) -> Hashable:
        """See :class:`Node`."""
        return Atlas

    def divided(self, unit: float) -> ImageNode:
        """See :class:`Node`."""
        x, y, z = self.scale
        return replace(self, scale=(x / unit, y / unit, z / unit))

    def image(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """What it reads ``(H, W, C)``, linear."""
        return parameters[self.texels] if self.made is None else self.made(parameters, self.texels)

    def table(
        self, nodes: Sequence[Any], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> Table:
        """See :class:`Node`."""
        first = {node.texels: node for node in reversed(nodes)}
        return atlas_of(nodes, {name: node.image(parameters) for name, node in first.items()}, dtype, device)

    def mean(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Of the whole image, however it is read; see :class:`Node`."""
        image = self.image(parameters).detach().double()
        color = image[..., :3].mean((0, 1)) if image.shape[2] >= 3 else mean_all(image[..., 0]).expand(3)
        return color * color.new_tensor(self.scale)


@dataclass(frozen=True)
class Mipmaps:
    """Which nodes read an image in smaller sizes; those sizes are nodes after the given ones, from large to small.

    Attributes:
        first: ``(M,)`` int64 node of the first smaller size less one; any number where there is none.
        top: ``(M,)`` how many smaller sizes there are.
        density: ``(M,)`` texels in a unit square of texture coordinates.
    """

    first: Tensor
    top: Tensor
    density: Tensor


@dataclass(frozen=True)
class Atlas(Table):
    """All planes, and the nodes that read them.

    Attributes:
        texels: ``(T,)``.
        places: ``(6, M)`` int64: first texel, texels from one channel to the next, width, height, wrap, 1 where bilinear.
        maps: ``(9, M)``: transform of the coordinates by rows, scale.
        wraps: the ways of wrapping in use; static.
        scaled: whether any node scales; static.
        transform_uv: whether any node transforms its coordinates; static.
        pyramids: of nodes that filter; None where none does.
    """

    texels: Tensor
    places: Tensor
    maps: Tensor
    wraps: tuple[str, ...]
    scaled: bool
    transform_uv: bool
    pyramids: Mipmaps | None = None

    @property
    def count(self) -> int:
        """Nodes, smaller sizes included."""
        return self.places.shape[1]

    @property
    def filtered(self) -> bool:
        """See :class:`Table`."""
        return self.pyramids is not None

    def look_up(self, nodes: Tensor, point: TexturePoint, coloured: bool) -> Tensor:
        """See :class:`Table`."""
        assert point.uv is not None
        return look_up(self, nodes, point.uv, coloured, point.footprint)

    def slope(self, nodes: Tensor, point: TexturePoint) -> tuple[Tensor, Tensor]:
        """See :class:`Table`."""
        assert point.uv is not None
        return slope(self, nodes, point.uv, point.footprint)


def atlas_of(nodes: Sequence[ImageNode], images: dict[str, Tensor], dtype: torch.dtype, device: torch.device) -> Atlas:
    """The atlas of ``nodes``, in their order; differentiable in the images.

    Args:
        nodes: what is read.
        images: ``(H, W, C)`` by name, linear; C is 1 (grey), 2 (grey, alpha), 3 or 4 (RGB, alpha).
        dtype: of the lanes.
        device: where it lies.
    """
    planes: list[Tensor] = []
    blocks: dict[tuple[str, int | None], list[list[int]]] = {}  # first texel, stride, width, height of each size
    places, maps, smaller, end = [], [], [], 0
    filtered = {(node.texels, node.channel) for node in nodes if node.filtered}
    for node in nodes:
        block = (node.texels, node.channel)
        if block not in blocks:
            sizes = [_planes(images[node.texels], node.channel)]
            while block in filtered and max(sizes[-1].shape[1:]) > 1:
                sizes.append(_halved(_halved(sizes[-1], 1), 2))
            blocks[block] = []
            for size in sizes:
                count, height, width = size.shape
                blocks[block].append([end, width * height if count == 3 else 0, width, height])
                planes.append(size.reshape(-1).to(device=device, dtype=dtype))
                end += size.numel()
        ways = [WRAPS.index(node.wrap), 0 if node.nearest else 1]
        places.append([*blocks[block][0], *ways])
        maps.append([*node.transform[0], *node.transform[1], *node.scale])
        smaller.append([[*size, *ways] for size in blocks[block][1:]] if node.filtered else [])
    pyramids = None
    if filtered:
        counts = torch.tensor([len(sizes) for sizes in smaller], dtype=torch.int64)
        pyramids = Mipmaps(
            (len(nodes) - 1 + torch.cumsum(counts, 0) - counts).to(device),
            counts.to(device=device, dtype=dtype),
            torch.tensor(
                [_density(p, node) for p, node in zip(places, nodes, strict=True)], dtype=dtype, device=device
            ),
        )
        places += [place for sizes in smaller for place in sizes]
        maps += [row for row, sizes in zip(list(maps), smaller, strict=True) for _ in sizes]
    return Atlas(
        torch.cat(planes),
        torch.tensor(places, dtype=torch.int64, device=device).T.contiguous(),
        torch.tensor(maps, dtype=dtype, device=device).T.contiguous(),
        tuple(wrap for wrap in WRAPS if any(node.wrap == wrap for node in nodes)),
        any(node.scale != (1.0, 1.0, 1.0) for node in nodes),
        any(node.transform != SAME for node in nodes),
        pyramids,
    )


def _density(place: Sequence[int], node: ImageNode) -> float:
    """Texels in a unit square of texture coordinates."""
    (a, b, _), (c, d, _) = node.transform
    return abs(a * d - b * c) * place[2] * place[3]


def _halved(planes: Tensor, dim: int) -> Tensor:
    """Planes half as large along ``dim`` (rounded down): means over boxes, exact for odd sizes too.

    Of ``2 m + 1`` texels, new one ``i`` covers ``i (2 + 1/m) .. (i + 1) (2 + 1/m)``: parts of three.
    """
    n = planes.shape[dim]
    m = n // 2
    if m == 0:
        return planes
    left, right = (planes.narrow(dim, k, 2 * m - 1).index_select(dim, _evens(planes, m)) for k in range(2))
    if n % 2 == 0:
        return 0.5 * (left + right)
    last = planes.narrow(dim, 2, 2 * m - 1).index_select(dim, _evens(planes, m))
    share = torch.arange(m, dtype=planes.dtype, device=planes.device)
    share = share.view([m if k == dim else 1 for k in range(planes.dim())])
    return (left * (m - share) + right * m + last * (share + 1)) / n


def _evens(planes: Tensor, m: int) -> Tensor:
    return torch.arange(0, 2 * m, 2, device=planes.device)


def _planes(image: Tensor, channel: int | None) -> Tensor:
    """The planes ``(1 or 3, H, W)`` that a node reads."""
    coloured = image.shape[2] >= 3
    if channel is None:
        return image[..., :3].permute(2, 0, 1) if coloured else image[..., :1].permute(2, 0, 1)
    if channel >= 0:
        return image[..., channel][None]
    if not coloured:
        return image[..., 0][None]
    return luminance(image.movedim(-1, 0))[None]


@dataclass(frozen=True)
class _Corners:
    """The four texels about a point: ``(C, N)`` each, and where the point lies between them."""

    low: tuple[Tensor, Tensor]
    high: tuple[Tensor, Tensor]
    x: Tensor
    y: Tensor
    width: Tensor
    height: Tensor
    blend: Tensor  # 1, or 0 where the nearest texel is taken
    maps: Tensor


def look_up(atlas: Atlas, node: Tensor, uv: Tensor, coloured: bool, footprint: Tensor | None = None) -> Tensor:
    """Values of nodes ``(N,)`` at texture coordinates ``(2, N)``: ``(3, N)`` where ``coloured``, else ``(N,)``.

    ``footprint``: areas ``(N,)`` in texture coordinates that nodes which filter average over; None: they read single points.
    """
    if footprint is None or atlas.pyramids is None:
        return _point(atlas, node, uv, coloured)
    low, high, share = _sizes(atlas.pyramids, node, footprint)
    a, b = _point(atlas, low, uv, coloured), _point(atlas, high, uv, coloured)
    return a + (b - a) * share


def _point(atlas: Atlas, node: Tensor, uv: Tensor, coloured: bool) -> Tensor:
    c = _corners(atlas, node, uv, coloured)
    low = c.low[0] + (c.low[1] - c.low[0]) * c.x
    high = c.high[0] + (c.high[1] - c.high[0]) * c.x
    value = low + (high - low) * c.y
    if atlas.scaled:
        value = value * (c.maps[6:9] if coloured else c.maps[6])
    return value


def slope(atlas: Atlas, node: Tensor, uv: Tensor, footprint: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Derivatives ``(N,)`` of number-valued nodes with respect to ``u`` and ``v``; ``footprint`` as of :func:`look_up`."""
    if footprint is None or atlas.pyramids is None:
        return _slope(atlas, node, uv)
    low, high, share = _sizes(atlas.pyramids, node, footprint)
    a, b = _slope(atlas, low, uv), _slope(atlas, high, uv)
    return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share


def _slope(atlas: Atlas, node: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    c = _corners(atlas, node, uv, False)
    low, high = c.low[1] - c.low[0], c.high[1] - c.high[0]
    across = (low + (high - low) * c.y) * (c.width * c.blend)
    left, right = c.high[0] - c.low[0], c.high[1] - c.low[1]
    along = (left + (right - left) * c.x) * (c.height * c.blend)
    if atlas.scaled:
        across, along = across * c.maps[6], along * c.maps[6]
    if not atlas.transform_uv:
        return across, along
    return across * c.maps[0] + along * c.maps[3], across * c.maps[1] + along * c.maps[4]


def _sizes(pyramids: Mipmaps, node: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The two sizes of images between which footprints lie, as nodes, and how far between them: 0 up to one texel."""
    texels = take(pyramids.density, node) * footprint
    top = take(pyramids.top, node)
    # Half the logarithm of an area is that of its side. Beyond 2^60 texels no image has further sizes.
    level = torch.minimum(texels.clamp(1.0, _FAR * _FAR).log() * (0.5 / math.log(2.0)), top)
    under = level.detach().floor()
    over = torch.minimum(under + 1.0, top)
    first = take(pyramids.first, node)
    low, high = (torch.where(k > 0, first + k.to(torch.int64), node) for k in (under, over))
    return low, high, level - under


def _corners(atlas: Atlas, node: Tensor, uv: Tensor, coloured: bool) -> _Corners:
    place, maps = take(atlas.places, node), take(atlas.maps, node)
    first, stride, width, height, wrap, linear = (place[k] for k in range(6))
    u, v = transform_uv(maps, uv) if atlas.transform_uv else (uv[0], uv[1])
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
    return _Corners((a, b), (c, d), x, y, wide, tall, blend, maps)


def _wrapped(wraps: tuple[str, ...], index: Tensor, size: Tensor, code: Tensor) -> Tensor:
    """Indices folded into ``0..size - 1``."""
    folded: Tensor | None = None
    for wrap in wraps:
        if wrap == "repeat":
            here = torch.remainder(index, size)
        elif wrap == "clamp":
            here = torch.minimum(index.clamp_min(0), size - 1)
        else:
            turned = torch.remainder(index, 2 * size)
            here = torch.minimum(turned, 2 * size - 1 - turned)
        folded = here if folded is None else torch.where(code == WRAPS.index(wrap), here, folded)
    assert folded is not None
    return folded
