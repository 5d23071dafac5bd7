"""One atlas for all images of a scene, and look-ups into it that are differentiable in texels and coordinates.

An image is stored in the atlas as ``(H, W, C)``, without a copy where all images lie in one block of memory. A node defines
how it is read: channel, wrap mode, filter, transform of texture coordinates. Texel centres are at ``(i + 1/2) / size``; row 0
is ``v = 0`` (Mitsuba). All nodes that read images are rows of one table, the :class:`Atlas`, which stages look up on lanes: N
points at once, each with its own node. Nodes that read luminances, which are computed, have an atlas of their own.

Images of 8 bits a value may be *packed*, one number of 32 bits a texel; nodes that read them are a table of their own. Its
look-ups decode the bytes by a table, and give the same values.

A filtered node has a mipmap (Williams, *Pyramidal Parametrics*, 1983). Each level is another node with the same settings, and
a look-up interpolates between the two levels whose texels are about as large as the footprint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from torchpt.core.memory_block import common_block
from torchpt.core.threads import mean_all
from torchpt.images import PackedTexels, decode_table
from torchpt.math.vectors import luminance, take
from torchpt.physics.textures.base import (
    IDENTITY,
    Matrix,
    Node,
    Table,
    TexelSource,
    TexturePoint,
    transform_uv,
)

__all__ = ["WRAPS", "Atlas", "ImageNode", "Mipmaps", "atlas_of", "look_up", "slope"]

#: Wrap modes beyond the edges of an image, in the order of their codes in :class:`Atlas`.
WRAPS = ("repeat", "clamp", "mirror")
#: Coordinates are clamped to this distance from the origin in texels, where float32 has no fraction anyway.
_FARTHEST = 2.0**30


@dataclass(frozen=True)
class ImageNode(Node):
    """One use of an image.

    Attributes:
        texels: name of the parameter with the texels, or the argument of ``compute``.
        channel: see :class:`Node`.
        wrap: one of :data:`WRAPS`.
        nearest: whether to read the nearest texel; else bilinear.
        transform: rows of the affine map ``(2, 3)`` of texture coordinates.
        scale: factors of the three channels (the first for a number).
        filtered: whether footprints larger than a texel read levels of a mipmap.
        compute: function that makes the image ``(H, W, C)`` from the parameters and ``texels``; None: it is a parameter.
        packed: whether the image may be packed.
    """

    texels: str
    channel: int | None
    wrap: str
    nearest: bool
    transform: Matrix
    scale: tuple[float, float, float]
    filtered: bool = False
    compute: Callable[[Mapping[str, Tensor], str], Tensor] | None = None
    packed: bool = False

    @property
    def variant(self) -> Hashable:
        """See :attr:`Node.variant`."""
        return Atlas, self.channel == -1, self.packed

    def divided(self, unit: float) -> ImageNode:
        """See :meth:`Node.divided`."""
        x, y, z = self.scale
        return replace(self, scale=(x / unit, y / unit, z / unit))

    def image(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the image ``(H, W, C)``, linear."""
        return parameters[self.texels] if self.compute is None else self.compute(parameters, self.texels)

    def table(
        self, nodes: Sequence[Any], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> Table:
        """See :meth:`Node.table`."""
        by_image = {node.texels: node for node in reversed(nodes)}  # of equal names the first node counts
        if self.packed and isinstance(parameters, TexelSource):
            packed = {name: image for name in by_image if (image := parameters.packed(name)) is not None}
            if len(packed) == len(by_image):
                return _packed_atlas_of(nodes, packed, dtype, device)
        return atlas_of(nodes, {name: node.image(parameters) for name, node in by_image.items()}, dtype, device)

    def mean(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """See :meth:`Node.mean`; the mean of the whole image, for any transform."""
        image = self.image(parameters).detach().double()
        color = image[..., :3].mean((0, 1)) if image.shape[2] >= 3 else mean_all(image[..., 0]).expand(3)
        return color * color.new_tensor(self.scale)


@dataclass(frozen=True)
class Mipmaps:
    """The mipmaps of the M nodes that :func:`atlas_of` was given.

    Level 0 is the node itself; the levels above are further nodes, after the M given ones, from large to small.

    Attributes:
        first: ``(M,)`` int64 node of level 1, minus one: level ``k > 0`` is node ``first + k``; arbitrary without a mipmap.
        top: ``(M,)`` the coarsest level; 0 without a mipmap.
        density: ``(M,)`` number of texels in a unit square of texture coordinates.
    """

    first: Tensor
    top: Tensor
    density: Tensor


@dataclass(frozen=True)
class Atlas(Table):
    """All images, and the M nodes that read them, levels of mipmaps included.

    Attributes:
        texels: ``(T,)`` numbers of all images; of packed ones int32, the first channel in the lowest byte.
        layouts: ``(7, M)`` int64: first number, stride between texels, stride between channels (0: one serves all), width,
            height, code of the wrap mode, 1 if bilinear. Of packed images ``(9, M)``: the stride between channels is in bits,
            and the last two rows are the first channel's place in bits, and where its bytes begin in ``decode``.
        transforms: ``(9, M)``: rows of the transform of texture coordinates, then ``scale``.
        wraps: wrap modes in use; static.
        scaled: whether any node scales; static.
        transformed: whether any node transforms texture coordinates; static.
        mipmaps: None if no node is filtered.
        decode: ``(512,)`` what bytes stand for, see :func:`torchpt.images.decode_table`; None: images are not packed.
    """

    texels: Tensor
    layouts: Tensor
    transforms: Tensor
    wraps: tuple[str, ...]
    scaled: bool
    transformed: bool
    mipmaps: Mipmaps | None = None
    decode: Tensor | None = None

    @property
    def count(self) -> int:
        """Number of nodes, levels of mipmaps included."""
        return self.layouts.shape[1]

    @property
    def filtered(self) -> bool:
        """See :attr:`Table.filtered`."""
        return self.mipmaps is not None

    def look_up(self, nodes: Tensor, point: TexturePoint, *, coloured: bool) -> Tensor:
        """See :meth:`Table.look_up`."""
        assert point.uv is not None
        return look_up(self, nodes, point.uv, coloured=coloured, footprint=point.footprint)

    def slope(self, nodes: Tensor, point: TexturePoint) -> tuple[Tensor, Tensor]:
        """See :meth:`Table.slope`."""
        assert point.uv is not None
        return slope(self, nodes, point.uv, footprint=point.footprint)


def atlas_of(nodes: Sequence[ImageNode], images: dict[str, Tensor], dtype: torch.dtype, device: torch.device) -> Atlas:
    """Build the atlas of ``nodes``, in their order; differentiable in the images.

    Args:
        nodes: the nodes that the atlas serves.
        images: ``(H, W, C)`` by name, linear; C is 1 (grey), 2 (grey, alpha), 3 (RGB) or 4 (RGB, alpha).
        dtype: dtype of the world.
        device: device of the atlas.
    """
    # Nodes that read the same channels of an image share its levels (H, W, 1 or 3).
    levels_of: dict[tuple[str, int | None], list[Tensor]] = {}
    filtered = {(node.texels, node.channel) for node in nodes if node.filtered}
    for source in dict.fromkeys((node.texels, node.channel) for node in nodes):
        levels = levels_of[source] = [_channels(images[source[0]], source[1])]
        while source in filtered and max(levels[-1].shape[:2]) > 1:
            levels.append(_halved(_halved(levels[-1], dim=0), dim=1))
    texels, places = _stored([level for levels in levels_of.values() for level in levels], dtype, device)
    rest = iter(places)
    layouts_of = {source: [next(rest) for _ in levels] for source, levels in levels_of.items()}
    layouts, coarser = [], []  # coarser: layouts of the levels above 0 of each node
    for node in nodes:
        modes = _modes(node)
        finest, *others = layouts_of[node.texels, node.channel]
        layouts.append([*finest, *modes])
        coarser.append([[*level, *modes] for level in others] if node.filtered else [])
    transforms = [_transform_and_scale(node) for node in nodes]
    mipmaps = None
    if filtered:
        counts = torch.tensor([len(levels) for levels in coarser], dtype=torch.int64)
        mipmaps = Mipmaps(
            first=(len(nodes) - 1 + torch.cumsum(counts, 0) - counts).to(device),
            top=counts.to(device=device, dtype=dtype),
            density=torch.tensor(
                [_density(node, *layout[3:5]) for layout, node in zip(layouts, nodes, strict=True)],
                dtype=dtype,
                device=device,
            ),
        )
        layouts += [layout for levels in coarser for layout in levels]
        transforms += [row for row, levels in zip(list(transforms), coarser, strict=True) for _ in levels]
    return Atlas(
        texels=texels,
        layouts=torch.tensor(layouts, dtype=torch.int64, device=device).T.contiguous(),
        transforms=torch.tensor(transforms, dtype=dtype, device=device).T.contiguous(),
        mipmaps=mipmaps,
        **_static(nodes),
    )


def _packed_atlas_of(
    nodes: Sequence[ImageNode], images: Mapping[str, PackedTexels], dtype: torch.dtype, device: torch.device
) -> Atlas:
    """Build the atlas of nodes whose images are packed, all in the same memory; arguments as for :func:`atlas_of`."""
    layouts = []
    for node in nodes:
        packed, channel = images[node.texels], node.channel or 0
        height, width, channels = packed.image.shape
        step = 8 if node.channel is None and channels >= 3 else 0
        alpha = channels in (2, 4) and node.channel == channels - 1
        place = [8 * channel, 256 if packed.image.encoded and not alpha else 0]
        layouts.append([packed.first, 1, step, width, height, *_modes(node), *place])
    return Atlas(
        texels=images[nodes[0].texels].words.to(device),
        layouts=torch.tensor(layouts, dtype=torch.int64, device=device).T.contiguous(),
        transforms=torch.tensor(list(map(_transform_and_scale, nodes)), dtype=dtype, device=device).T.contiguous(),
        decode=decode_table().to(device=device, dtype=dtype),
        **_static(nodes),
    )


def _modes(node: ImageNode) -> list[int]:
    """Return the code of the wrap mode, and 1 if bilinear."""
    return [WRAPS.index(node.wrap), 0 if node.nearest else 1]


def _transform_and_scale(node: ImageNode) -> list[float]:
    """Return a row of :attr:`Atlas.transforms`."""
    return [*node.transform[0], *node.transform[1], *node.scale]


def _static(nodes: Sequence[ImageNode]) -> dict[str, Any]:
    """Return the static attributes of :class:`Atlas`."""
    return {
        "wraps": tuple(wrap for wrap in WRAPS if any(node.wrap == wrap for node in nodes)),
        "scaled": any(node.scale != (1.0, 1.0, 1.0) for node in nodes),
        "transformed": any(node.transform != IDENTITY for node in nodes),
    }


def _stored(levels: Sequence[Tensor], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, list[list[int]]]:
    """Return all numbers of levels ``(H, W, 1 or 3)``, and of each the first five rows of :attr:`Atlas.layouts`."""
    block = common_block(levels)
    even = all(level.stride(0) == level.shape[1] * level.stride(1) for level in levels)  # a row follows the one above
    if block is not None and even and (block.dtype, block.device) == (dtype, device):
        return block, [
            _layout(level, int(level.storage_offset()), level.stride(1), level.stride(2)) for level in levels
        ]
    sizes = [level.numel() for level in levels]
    layouts = [
        _layout(level, end - level.numel(), level.shape[2], 1)
        for level, end in zip(levels, accumulate(sizes), strict=True)
    ]
    if torch.is_grad_enabled() and any(level.requires_grad for level in levels):
        return torch.cat([level.reshape(-1).to(device=device, dtype=dtype) for level in levels]), layouts
    numbers = torch.empty(sum(sizes), dtype=dtype, device=device)
    for copied, level in zip(numbers.split(sizes), levels, strict=True):
        copied.view(level.shape).copy_(level)  # images are large: no copies on the way
    return numbers, layouts


def _layout(level: Tensor, first: int, texel_stride: int, channel_stride: int) -> list[int]:
    """Return the first five rows of :attr:`Atlas.layouts` for a level ``(H, W, 1 or 3)``."""
    height, width, channels = level.shape
    return [first, texel_stride, channel_stride if channels == 3 else 0, width, height]


def _density(node: ImageNode, width: int, height: int) -> float:
    """Return the number of texels in a unit square of texture coordinates, for an image of this size."""
    (a, b, _), (c, d, _) = node.transform
    return abs(a * d - b * c) * width * height


def _halved(image: Tensor, dim: int) -> Tensor:
    """Downsample an image ``(H, W, C)`` by 2 along ``dim`` (rounded down) with a box filter, exact for odd sizes too.

    For ``2 m + 1`` texels, output ``i`` covers ``i (2 + 1/m) .. (i + 1) (2 + 1/m)``: fractions of three texels.
    """
    n = image.shape[dim]
    m = n // 2
    if m == 0:
        return image
    # Texels 2 i, 2 i + 1 and, for odd sizes, 2 i + 2.
    even = torch.arange(0, 2 * m, 2, device=image.device)
    left, right = (image.narrow(dim, k, 2 * m - 1).index_select(dim, even) for k in range(2))
    if n % 2 == 0:
        return 0.5 * (left + right)
    last = image.narrow(dim, 2, 2 * m - 1).index_select(dim, even)
    i = torch.arange(m, dtype=image.dtype, device=image.device)
    i = i.view([m if k == dim else 1 for k in range(image.dim())])
    return (left * (m - i) + right * m + last * (i + 1)) / n


def _channels(image: Tensor, channel: int | None) -> Tensor:
    """Return the channels ``(H, W, 1 or 3)`` of an image that a node with this channel reads."""
    coloured = image.shape[2] >= 3
    if channel is None:
        return image[..., : 3 if coloured else 1]
    if channel >= 0 or not coloured:
        return image[..., max(channel, 0), None]
    return luminance(image.movedim(-1, 0))[..., None]


@dataclass(frozen=True)
class _Corners:
    """The four texels around each point, the position between them, and what of the node a look-up needs."""

    low: tuple[Tensor, Tensor]  # left and right texel of the row with the smaller v, (3, N) or (N,) each
    high: tuple[Tensor, Tensor]  # those of the next row
    x: Tensor  # (N,) 0 at the left texel to 1 at the right one; 0 for nearest
    y: Tensor
    width: Tensor  # (N,) of the image, in texels
    height: Tensor
    blend: Tensor  # (N,) 1 for bilinear, 0 for nearest
    transforms: Tensor  # (9, N), see Atlas


def look_up(atlas: Atlas, node: Tensor, uv: Tensor, coloured: bool, footprint: Tensor | None = None) -> Tensor:
    """Return values of nodes ``(N,)`` at texture coordinates ``(2, N)``: ``(3, N)`` if ``coloured``, else ``(N,)``.

    ``footprint``: areas ``(N,)`` in texture coordinates over which filtered nodes average; None: no filtering.
    """
    if footprint is None or atlas.mipmaps is None:
        return _look_up_level(atlas, node, uv, coloured=coloured)
    fine, coarse, fraction = _levels(atlas.mipmaps, node, footprint)
    value_fine = _look_up_level(atlas, fine, uv, coloured=coloured)
    value_coarse = _look_up_level(atlas, coarse, uv, coloured=coloured)
    return value_fine + (value_coarse - value_fine) * fraction


def _look_up_level(atlas: Atlas, node: Tensor, uv: Tensor, *, coloured: bool) -> Tensor:
    """Return the values of nodes without filtering: interpolated between four texels, or the nearest one."""
    c = _corners(atlas, node, uv, coloured=coloured)
    low = c.low[0] + (c.low[1] - c.low[0]) * c.x
    high = c.high[0] + (c.high[1] - c.high[0]) * c.x
    value = low + (high - low) * c.y
    if atlas.scaled:
        value = value * (c.transforms[6:9] if coloured else c.transforms[6])
    return value


def slope(atlas: Atlas, node: Tensor, uv: Tensor, footprint: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return derivatives ``(N,)`` of number-valued nodes by ``u`` and ``v``; ``footprint`` as for :func:`look_up`."""
    if footprint is None or atlas.mipmaps is None:
        return _slope(atlas, node, uv)
    fine, coarse, fraction = _levels(atlas.mipmaps, node, footprint)
    (fine_u, fine_v), (coarse_u, coarse_v) = _slope(atlas, fine, uv), _slope(atlas, coarse, uv)
    return fine_u + (coarse_u - fine_u) * fraction, fine_v + (coarse_v - fine_v) * fraction


def _slope(atlas: Atlas, node: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Return derivatives ``(N,)`` of number-valued nodes by ``u`` and ``v``, without filtering; 0 for nearest."""
    c = _corners(atlas, node, uv, coloured=False)
    low, high = c.low[1] - c.low[0], c.high[1] - c.high[0]
    along_u = (low + (high - low) * c.y) * (c.width * c.blend)
    left, right = c.high[0] - c.low[0], c.high[1] - c.low[1]
    along_v = (left + (right - left) * c.x) * (c.height * c.blend)
    if atlas.scaled:
        along_u, along_v = along_u * c.transforms[6], along_v * c.transforms[6]
    if not atlas.transformed:
        return along_u, along_v
    # Chain rule: these were by transformed coordinates; rows of the transform are m0 m1 m2 and m3 m4 m5.
    return (
        along_u * c.transforms[0] + along_v * c.transforms[3],
        along_u * c.transforms[1] + along_v * c.transforms[4],
    )


def _levels(mipmaps: Mipmaps, node: Tensor, footprint: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the two mipmap levels for footprints, as nodes, and the fraction between them: 0 up to one texel."""
    texels = take(mipmaps.density, node) * footprint
    top = take(mipmaps.top, node)
    # Half the logarithm of an area is that of its side. No mipmap has levels beyond 2^60 texels.
    level = torch.minimum(texels.clamp(1.0, _FARTHEST * _FARTHEST).log() * (0.5 / math.log(2.0)), top)
    below = level.detach().floor()
    above = torch.minimum(below + 1.0, top)
    first = take(mipmaps.first, node)
    fine, coarse = (torch.where(k > 0, first + k.to(torch.int64), node) for k in (below, above))
    return fine, coarse, level - below


def _corners(atlas: Atlas, node: Tensor, uv: Tensor, *, coloured: bool) -> _Corners:
    """Read the four texels around points ``uv (2, N)``, three channels of each if ``coloured``."""
    layout, transforms = take(atlas.layouts, node), take(atlas.transforms, node)
    first, texel_stride, channel_stride, width, height, wrap, linear = (layout[k] for k in range(7))
    u, v = transform_uv(transforms, uv) if atlas.transformed else (uv[0], uv[1])
    blend = linear.to(uv.dtype)
    columns, rows = width.to(uv.dtype), height.to(uv.dtype)
    # In texels: from the first texel's centre for bilinear, from its edge for nearest.
    x = (u * columns - 0.5 * blend).clamp(-_FARTHEST, _FARTHEST)
    y = (v * rows - 0.5 * blend).clamp(-_FARTHEST, _FARTHEST)
    i, j = x.detach().floor(), y.detach().floor()
    x, y = (x - i) * blend, (y - j) * blend
    i, j = i.to(torch.int64), j.to(torch.int64)
    left, right = (_wrapped(atlas.wraps, k, width, wrap) * texel_stride for k in (i, i + 1))
    row = width * texel_stride
    top, bottom = (first + _wrapped(atlas.wraps, k, height, wrap) * row for k in (j, j + 1))
    places = (row + column for row in (top, bottom) for column in (left, right))
    # All channels of all lanes by one look-up, (3 N,).
    steps = torch.arange(3, device=node.device)[:, None] * channel_stride if coloured else None
    if atlas.decode is not None:
        a, b, c, d = (_decoded(atlas, take(atlas.texels, place), layout[7], layout[8], steps) for place in places)
    elif steps is None:
        a, b, c, d = (take(atlas.texels, place) for place in places)
    else:
        a, b, c, d = (take(atlas.texels, (steps + place).reshape(-1)).view(3, -1) for place in places)
    return _Corners(low=(a, b), high=(c, d), x=x, y=y, width=columns, height=rows, blend=blend, transforms=transforms)


def _decoded(atlas: Atlas, word: Tensor, place: Tensor, start: Tensor, steps: Tensor | None) -> Tensor:
    """Return the values of packed texels ``(N,)``, or three channels of each.

    Args:
        atlas: with ``decode``.
        word: the texels.
        place: ``(N,)`` the first channel's, in bits.
        start: ``(N,)`` where its bytes begin in ``decode``.
        steps: ``(3, N)`` between channels, in bits; None: one channel.
    """
    assert atlas.decode is not None
    if steps is None:
        return take(atlas.decode, ((word >> place) & 255) + start)
    return take(atlas.decode, (((word >> (place + steps)) & 255) + start).reshape(-1)).view(3, -1)


def _wrapped(wraps: tuple[str, ...], index: Tensor, size: Tensor, code: Tensor) -> Tensor:
    """Map indices ``(N,)`` of rows or columns into ``0..size - 1`` by the wrap mode, whose ``code (N,)`` indexes :data:`WRAPS`.

    ``wraps``: the modes that occur; others are not computed.
    """
    wrapped: Tensor | None = None
    for wrap in wraps:
        if wrap == "repeat":
            by_mode = torch.remainder(index, size)
        elif wrap == "clamp":
            by_mode = torch.minimum(index.clamp_min(0), size - 1)
        else:
            position = torch.remainder(index, 2 * size)  # in the image and its mirror image after it
            by_mode = torch.minimum(position, 2 * size - 1 - position)
        wrapped = by_mode if wrapped is None else torch.where(code == WRAPS.index(wrap), by_mode, wrapped)
    assert wrapped is not None
    return wrapped
