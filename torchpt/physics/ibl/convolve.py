"""Convolution of environment maps: diffuse irradiance, and radiance prefiltered by GGX.

A texel of the result is the mean of the map over a lobe about the texel's direction. A lobe is a set of weighted sample
directions; each reads a level of a pyramid (a downsampled map) whose texels are as large as the spacing of samples. The
brightest texels would still be missed or spread out: they are cut out of the map as *suns*, directional lights, which are
convolved exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchpt.core.errors import SceneError
from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import azimuth
from torchpt.physics.ibl.equirect import check_map, directions, solid_angles
from torchpt.physics.ibl.points import hammersley
from torchpt.physics.ibl.pyramid import Pyramid, downsample

__all__ = ["METHODS", "irradiance_map", "prefiltered", "roughnesses"]

METHODS = ("grid", "importance")
#: Step of the regular grid in both angles, in radians.
GRID_STEP = 0.025
#: Number of samples read at once, which bounds memory: some 2 MB for each number of a sample.
SAMPLES_AT_ONCE = 1 << 19
#: Number of suns.
MAX_SUNS = 1024
#: A texel that is wide compared to the lobe becomes a lattice of suns; most of them from its centre to its neighbour's.
MAX_LATTICE = 8
#: Number of texels across the width of a lobe; finer maps are downsampled first.
TEXELS_PER_LOBE = 8


@dataclass(frozen=True)
class Lobe:
    """Weighted sample directions about +z, and the density that they represent."""

    d: Tensor  # (3, S) float64, unit
    weight: Tensor  # (S,), of sum 1
    spacing: Tensor  # (S,) angle between neighbouring directions
    density: Callable[[Tensor], Tensor]  # function of the cosine with +z, per steradian
    width: float  # angular width: the second derivative of the density at the peak is -1/width^2 times the peak


def irradiance_map(map: Tensor, height: int = 32, width: int = 64, method: str = "importance") -> Tensor:
    """Return ``E(n) / pi`` of a map: the radiance of a white diffuse surface by its normal.

    Args:
        map: radiance ``(H, W, 3)``, see :mod:`torchpt.physics.ibl.equirect`.
        height: rows of the result.
        width: columns of the result.
        method: ``importance``, 1024 directions by the cosine; or ``grid``, ``pi sum L cos sin / N`` over steps of 0.025 rad
            in both angles.

    Returns:
        ``(height, width, 3)``, differentiable in the map.
    """
    if method not in METHODS:
        raise SceneError("method", method, " or ".join(METHODS))
    lobe = _grid_lobe() if method == "grid" else _cosine_lobe(1024)
    return _PreparedMap(check_map(map)).convolved(height, width, lobe)


def prefiltered(
    map: Tensor, levels: int = 6, sizes: Sequence[tuple[int, int]] | None = None, samples: int = 1024
) -> list[Tensor]:
    """Prefilter a map for rough mirrors: ``sum L (n l) / sum (n l)`` over directions ``l`` mirrored about GGX normals.

    There is one map for each of ``levels`` roughnesses from 0 to 1, ``alpha = roughness^2``, with ``n = v = r`` (Karis, *Real
    Shading in Unreal Engine 4*, 2013). Directions are Hammersley's points; each reads a level of a pyramid by the solid angle
    of the sample (Colbert and Krivanek, GPU Gems 3, chapter 20), so that small bright lights are not missed.

    Args:
        map: radiance ``(H, W, 3)``.
        levels: number of levels; the first is the map itself.
        sizes: ``(rows, columns)`` of the levels after the first; by default the second has as many columns as the map, from 16
            to 256, and each further one half of them, down to 64.
        samples: number of directions for each texel.

    Returns:
        ``levels`` tensors ``(H_l, W_l, 3)``, differentiable in the map.
    """
    for key, value, minimum in (("levels", levels, 2), ("samples", samples, 1)):
        if not isinstance(value, int) or value < minimum:
            raise SceneError(key, value, f"an integer, at least {minimum}")
    check_map(map)
    if sizes is None:
        widest = max(min(256, map.shape[1]), 16)
        widths = [max(widest >> k, min(64, widest)) for k in range(levels - 1)]
        sizes = [(width // 2, width) for width in widths]
    if len(sizes) != levels - 1:
        raise SceneError("sizes", list(sizes), f"{levels - 1} pairs (rows, columns), one a level after the first")
    prepared, maps = _PreparedMap(map), [map]
    for roughness, (height, width) in zip(roughnesses(levels)[1:], sizes, strict=True):
        maps.append(prepared.convolved(height, width, _ggx_lobe(roughness * roughness, samples)))
    return maps


def roughnesses(levels: int) -> list[float]:
    """Return the roughness of each level of a prefiltered map."""
    return [k / (levels - 1) for k in range(levels)]


def _grid_lobe() -> Lobe:
    """Return the cosine lobe on a regular grid of both angles over the hemisphere."""
    rings, spokes = math.ceil(0.5 * math.pi / GRID_STEP), math.ceil(2.0 * math.pi / GRID_STEP)
    theta = (torch.arange(rings, dtype=torch.float64) + 0.5) * (0.5 * math.pi / rings)
    phi = (torch.arange(spokes, dtype=torch.float64) + 0.5) * (2.0 * math.pi / spokes)
    theta, phi = theta.repeat_interleave(spokes), phi.repeat(rings)
    d = torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()))
    weight = theta.cos() * theta.sin() * (math.pi / len(theta))
    spacing = torch.full_like(weight, GRID_STEP)
    return Lobe(d, weight, spacing, density=_cosine_density, width=1.0)


def _centred_points(n: int) -> Tensor:
    """Return Hammersley's points ``(2, n)``, moved so that they lie symmetrically in the unit square, none at 0."""
    return hammersley(n) + 0.5 / n


def _cosine_density(cos: Tensor) -> Tensor:
    """Return the density of a cosine-weighted direction, per steradian, by its cosine with +z."""
    return cos.clamp_min(0.0) * (1.0 / math.pi)


def _cosine_lobe(n: int) -> Lobe:
    """Return the cosine lobe by ``n`` directions of that density."""
    d = cosine_hemisphere(_centred_points(n))
    # The side of a square of the solid angle that one sample stands for, 1 / (n density).
    spacing = (math.pi / (n * d[2])).sqrt()
    return Lobe(d, torch.full_like(d[2], 1.0 / n), spacing, density=_cosine_density, width=1.0)


def _ggx_lobe(alpha: float, n: int) -> Lobe:
    """Return mirror directions for ``n`` normals of density ``D cos``, without those below the horizon.

    For ``n = v = r`` (all +z) a direction weighs by its cosine, and its density is ``D / 4``.
    """
    a2 = alpha * alpha

    def distribution(cos: Tensor, scale: float = 1.0) -> Tensor:
        """Return D of the half vector of +z and a direction with this cosine: ``a2 / (pi (sin^2 + a2 cos^2)^2)``."""
        bracket = 0.5 * (1.0 + a2) - 0.5 * (1.0 - a2) * cos
        return (scale * a2 / math.pi) / bracket.square()

    u = _centred_points(n)
    # Squared cosine of the normal, and from it the direction, at twice the angle.
    cos2 = (1.0 - u[1]) / (1.0 + (a2 - 1.0) * u[1])
    z = 2.0 * cos2 - 1.0
    r = 2.0 * (cos2 * (1.0 - cos2)).sqrt()
    phi = (2.0 * math.pi) * u[0]
    above = z > 0
    d = torch.stack((r * phi.cos(), r * phi.sin(), z))[:, above]
    total = float(d[2].sum())  # over n: the integral of D / 4 times the cosine
    scale = 0.25 * n / total
    spacing = (4.0 / (n * distribution(d[2]))).sqrt()
    return Lobe(
        d,
        d[2] / total,
        spacing,
        density=lambda cos: distribution(cos, scale).mul_(cos.clamp_min(0.0)),
        width=alpha,
    )


@dataclass(frozen=True)
class _LobeSums:
    """The sums that convolve a pyramid and suns with a lobe of S samples, to a map of ``height x width``."""

    pyramid: Pyramid
    suns: Tensor  # (3, K) float64 directions, on the CPU
    height: int
    width: int
    lobe: Lobe

    def texel_weights(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield indices and weights ``(n, 4 S)`` of texels for n consecutive texels of the result, row by row."""
        columns = max(1, min(self.width, SAMPLES_AT_ONCE // len(self.lobe.weight)))
        for row in range(self.height):
            samples = self._row_samples(math.pi * row / (self.height - 1))
            for start in range(0, self.width, columns):
                column = torch.arange(start, min(start + columns, self.width), device=samples.column.device)
                yield self._around(samples, column)

    def _row_samples(self, theta: float) -> _RowSamples:
        """Return what the samples of a lobe at angle ``theta`` from +y and longitude 0 read."""
        pyramid, lobe, texels = self.pyramid, self.lobe, self.pyramid.texels
        sine, cosine = math.sin(theta), math.cos(theta)
        x, y, z = lobe.d
        # The lobe's +z turned by theta away from +y, toward longitude 0.
        up, away = z * cosine - y * sine, z * sine + y * cosine
        sin_polar = torch.addcmul(x * x, away, away).sqrt()
        u, v = azimuth(away, x) * (0.5 / math.pi), azimuth(up, sin_polar) * (1.0 / math.pi)
        # Levels whose texels are as large as the spacing of samples: their sizes in texels of level 0.
        rows_spaced = lobe.spacing * ((pyramid.heights[0] - 1) / math.pi)
        columns_spaced = lobe.spacing * (pyramid.widths[0] / (2.0 * math.pi)) / sin_polar.clamp_min(1e-12)
        a, b = (
            torch.log2(size).round().clamp(0, last).to(torch.int64)
            for size, last in ((rows_spaced, len(pyramid.heights) - 1), (columns_spaced, len(pyramid.widths) - 1))
        )
        height, width = torch.tensor(pyramid.heights)[a], torch.tensor(pyramid.widths)[b]
        row = v * (height - 1)
        i = torch.minimum(row.floor(), (height - 2).double())
        fraction = row - i
        first = pyramid.first[a, b] + i.to(torch.int64) * width
        device, dtype = texels.device, texels.dtype
        return _RowSamples(
            column=(u * width).to(device, dtype),
            width=width.to(device, torch.int32),
            first=first.to(device, torch.int32),
            upper=(lobe.weight * (1.0 - fraction)).to(device, dtype),
            lower=(lobe.weight * fraction).to(device, dtype),
        )

    def _around(self, samples: _RowSamples, column: Tensor) -> tuple[Tensor, Tensor]:
        """Return indices and weights ``(n, 4 S)`` for lobes at columns ``(n,)`` of the result: the samples turned about +y."""
        width = samples.width
        turn = (column[:, None] + 0.5) / self.width  # a fraction of a full turn
        x = torch.addcmul(samples.column - 0.5, turn.to(samples.column.dtype), width.to(samples.column.dtype))
        j = x.floor()
        fraction = x - j
        left = j.to(torch.int32)
        left = torch.where(left < 0, left + width, torch.where(left >= width, left - width, left))
        right = left + 1
        right = torch.where(right == width, 0, right)
        left, right = left + samples.first, right + samples.first
        upper_right, lower_right = samples.upper * fraction, samples.lower * fraction
        return (
            torch.cat((left, right, left + width, right + width), 1),
            torch.cat((samples.upper - upper_right, upper_right, samples.lower - lower_right, lower_right), 1),
        )

    def sun_weights(self) -> Iterator[Tensor]:
        """Yield the densities ``(n, K)`` of the K suns for n consecutive texels of the result."""
        n = directions(self.height, self.width).reshape(3, -1)
        count = max(1, SAMPLES_AT_ONCE // self.suns.shape[1])
        for start in range(0, n.shape[1], count):
            cos = n[:, start : start + count].T @ self.suns
            yield self.lobe.density(cos).to(self.pyramid.texels.device, self.pyramid.texels.dtype)


class _RowSamples(NamedTuple):
    """Texels of the pyramid that S samples of a lobe at longitude 0 read, each ``(S,)``."""

    column: Tensor  # fractional, in columns of the sample's level, from the left edge
    width: Tensor  # int32 number of columns of that level
    first: Tensor  # int32 first texel of the upper one of two rows
    upper: Tensor  # weight of the sample times that of the upper row
    lower: Tensor  # the same of the row below


class _Gather(torch.autograd.Function):
    """Weighted sums of texels ``(T, 3)`` and of the light of suns ``(K, 3)``: the convolved map.

    The backward pass recomputes the weights instead of keeping them.
    """

    @staticmethod
    def forward(ctx: Any, texels: Tensor, light: Tensor, lobe_sums: _LobeSums) -> Tensor:
        ctx.lobe_sums = lobe_sums
        sums = torch.cat(
            [
                torch.nn.functional.embedding_bag(index, texels, mode="sum", per_sample_weights=weight)
                for index, weight in lobe_sums.texel_weights()
            ]
        )
        sums += torch.cat([weight @ light for weight in lobe_sums.sun_weights()])
        return sums.view(lobe_sums.height, lobe_sums.width, 3)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]: the decorator hides names
        ctx: Any, *cotangents: Tensor
    ) -> tuple[Tensor, Tensor, None]:
        lobe_sums: _LobeSums = ctx.lobe_sums
        flat = cotangents[0].reshape(-1, 3)  # of the result's texels
        # Cotangents of texels and of light. A channel at a time: several times faster than rows of three on a CPU.
        texels, first = lobe_sums.pyramid.texels.new_zeros(3, len(lobe_sums.pyramid.texels)), 0
        for index, weight in lobe_sums.texel_weights():
            texel, cotangent = index.reshape(-1).to(torch.int64), flat[first : first + len(index)]
            for channel in range(3):
                texels[channel].scatter_add_(0, texel, (weight * cotangent[:, channel, None]).reshape(-1))
            first += len(index)
        light, first = flat.new_zeros(lobe_sums.suns.shape[1], 3), 0
        for weight in lobe_sums.sun_weights():
            light += weight.T @ flat[first : first + len(weight)]
            first += len(weight)
        return texels.T, light, None


class _PreparedMap:
    """A map prepared for convolution with any lobe.

    The excess of the brightest texels is removed and becomes suns, which are convolved exactly by the lobe's density: a sun
    between sample directions would be missed, and a coarse level of the pyramid would spread it out.
    """

    def __init__(self, map: Tensor) -> None:
        self.map = map
        # By rows and lattice, which depend on the width of the lobe: see _prepared.
        self.forms: dict[tuple[int, int], tuple[Pyramid, Tensor, Tensor]] = {}

    def convolved(self, height: int, width: int, lobe: Lobe) -> Tensor:
        """Return the convolution with a lobe, as a map ``(height, width, 3)``."""
        for key, value, minimum in (("height", height, 2), ("width", width, 1)):
            if not isinstance(value, int) or value < minimum:
                raise SceneError(key, value, f"an integer, at least {minimum}")
        pyramid, suns, light = self._prepared(lobe.width)
        out = _Gather.apply(pyramid.texels, light, _LobeSums(pyramid, suns, height, width, lobe))
        assert isinstance(out, Tensor)
        return out

    def _prepared(self, width: float) -> tuple[Pyramid, Tensor, Tensor]:
        """Return pyramid, suns and their light for lobes of this width, at the resolution that they need."""
        intervals = math.ceil(TEXELS_PER_LOBE * math.pi / width)  # from pole to pole
        rows, columns = min(self.map.shape[0] - 1, intervals) + 1, min(self.map.shape[1], 2 * intervals)
        # A texel counts as a point for a lobe five times as wide, else as a lattice of points; wider ones stay in the map.
        points = math.ceil(5.0 * math.pi / (rows - 1) / width)
        points = points if points <= MAX_LATTICE else 0
        if (rows, points) not in self.forms:
            remainder, suns, light = _extract_suns(downsample(self.map, rows, columns), points)
            self.forms[rows, points] = Pyramid.of(remainder), suns, light
        return self.forms[rows, points]


def _extract_suns(map: Tensor, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """Split off the excess radiance of the brightest texels as suns.

    Args:
        map: ``(H, W, 3)``.
        points: the hat function of each texel becomes ``(2 points - 1)^2`` suns; 0: no suns.

    Returns:
        The remaining map ``(H, W, 3)``, directions of suns ``(3, K)`` float64 on the CPU, and their light ``(K, 3)``: radiance
        times solid angle.
    """
    height, width, _ = map.shape
    suns_per_texel = max(2 * points - 1, 0) ** 2
    count = min(max(MAX_SUNS // suns_per_texel, 16), height * width) if points else 0  # of texels, at least 16
    flat = map.reshape(-1, 3)
    brightest = torch.topk(flat.detach().amax(1), count) if count else None
    if brightest is None:
        return map, torch.zeros(3, 1, dtype=torch.float64), map.new_zeros(1, 3)
    # Radiance above that of the dimmest texel among them.
    excess = (flat[brightest.indices] - brightest.values[-1]).clamp_min(0.0)
    remainder = flat.index_add(0, brightest.indices, -excess).view_as(map)
    # The lattice of each hat: offsets in texels, and fractions of its solid angle, rows weighted by the sine of theta.
    offset = torch.arange(1 - points, points, dtype=torch.float64) / points
    hat = 1.0 - offset.abs()
    row, column = brightest.indices.cpu() // width, brightest.indices.cpu() % width
    theta = (row[:, None] + offset) * (math.pi / (height - 1))
    phi = (column[:, None] + 0.5 + offset) * (2.0 * math.pi / width)
    row_weight = hat * theta.sin().clamp_min(0.0)
    row_weight = torch.where(row_weight.sum(1, keepdim=True) > 1e-9, row_weight, hat)  # a single point at a pole
    fraction = (row_weight / row_weight.sum(1, keepdim=True))[:, :, None] * (hat / hat.sum())
    solid_angle = fraction * solid_angles(height, width)[row][:, None, None]
    sine, cosine = theta.sin()[:, :, None], theta.cos()[:, :, None]
    d = torch.stack((sine * phi.sin()[:, None], cosine.expand_as(solid_angle), -sine * phi.cos()[:, None]))
    light = solid_angle.reshape(count, -1, 1).to(map) * excess[:, None]
    return remainder, d.reshape(3, -1), light.reshape(-1, 3)
