"""Maps convolved with a lobe about each direction: diffuse irradiance, and radiance prefiltered by GGX."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchpt.core.errors import SceneError
from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import azimuth
from torchpt.physics.ibl.equirect import checked, directions, solid_angles
from torchpt.physics.ibl.points import hammersley
from torchpt.physics.ibl.pyramid import Pyramid, resampled

__all__ = ["METHODS", "irradiance_map", "prefiltered", "roughnesses"]

METHODS = ("grid", "importance")
#: Step of the regular grid in both angles.
STEP = 0.025
#: Samples read at once, so that memory does not grow with the maps.
LANES = 1 << 19
#: How many points of light stand for the brightest texels.
SUNS = 1024
#: Largest lattice of points for a texel as wide as a lobe, or wider.
LATTICE = 8
#: Texels across the width of a lobe that it can tell apart: more are averaged first.
FINE = 8


@dataclass(frozen=True)
class Lobe:
    """Weighted directions about +z, and the density that they stand for."""

    d: Tensor  # (3, S) float64, unit
    weight: Tensor  # (S,), of sum 1
    spacing: Tensor  # (S,) angle from a direction to its neighbours
    density: Callable[[Tensor], Tensor]  # of the cosine with +z, in solid angle
    width: float  # the angle over which the density falls: as -1/width^2 is its second derivative at the peak, over the peak


def irradiance_map(map: Tensor, height: int = 32, width: int = 64, method: str = "importance") -> Tensor:
    """``E(n) / pi`` of a map: what a white diffuse surface sends back, by its normal.

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
    lobe = _regular() if method == "grid" else _cosine(1024)
    return _Convolution(checked(map))(height, width, lobe)


def prefiltered(
    map: Tensor, levels: int = 6, sizes: Sequence[tuple[int, int]] | None = None, samples: int = 1024
) -> list[Tensor]:
    """The map seen in rough mirrors, ``sum L (n l) / sum (n l)`` over directions ``l`` mirrored about GGX normals.

    One map for each of ``levels`` roughnesses from 0 to 1, ``alpha = roughness^2``, with ``n = v = r`` (Karis, *Real Shading in
    Unreal Engine 4*, 2013). Directions are Hammersley's points; each reads a level of a pyramid by the solid angle that
    it stands for (Colbert and Krivanek, GPU Gems 3, chapter 20), so that no sun falls between them.

    Args:
        map: radiance ``(H, W, 3)``.
        levels: how many; the first is the map itself.
        sizes: ``(rows, columns)`` of the levels after the first; by default as many columns as the map for the
            second, from 16 to 256, halved down to 64.
        samples: directions for each texel.

    Returns:
        ``levels`` tensors ``(H_l, W_l, 3)``, differentiable in the map.
    """
    for key, value, least in (("levels", levels, 2), ("samples", samples, 1)):
        if not isinstance(value, int) or value < least:
            raise SceneError(key, value, f"an integer, at least {least}")
    checked(map)
    if sizes is None:
        most = max(min(256, map.shape[1]), 16)
        widths = [max(most >> k, min(64, most)) for k in range(levels - 1)]
        sizes = [(width // 2, width) for width in widths]
    if len(sizes) != levels - 1:
        raise SceneError("sizes", list(sizes), f"{levels - 1} pairs (rows, columns), one a level after the first")
    convolved, maps = _Convolution(map), [map]
    for roughness, (height, width) in zip(roughnesses(levels)[1:], sizes, strict=True):
        maps.append(convolved(height, width, _facets(roughness * roughness, samples)))
    return maps


def roughnesses(levels: int) -> list[float]:
    """The roughness of each level of a chain."""
    return [k / (levels - 1) for k in range(levels)]


def _regular() -> Lobe:
    rings, spokes = math.ceil(0.5 * math.pi / STEP), math.ceil(2.0 * math.pi / STEP)
    theta = (torch.arange(rings, dtype=torch.float64) + 0.5) * (0.5 * math.pi / rings)
    phi = (torch.arange(spokes, dtype=torch.float64) + 0.5) * (2.0 * math.pi / spokes)
    theta, phi = theta.repeat_interleave(spokes), phi.repeat(rings)
    d = torch.stack((theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()))
    weight = theta.cos() * theta.sin() * (math.pi / len(theta))
    return Lobe(d, weight, torch.full_like(weight, STEP), _lambert, 1.0)


def _centred(n: int) -> Tensor:
    return hammersley(n) + 0.5 / n


def _lambert(cos: Tensor) -> Tensor:
    return cos.clamp_min(0.0) * (1.0 / math.pi)


def _cosine(n: int) -> Lobe:
    d = cosine_hemisphere(_centred(n))
    return Lobe(d, torch.full_like(d[2], 1.0 / n), (math.pi / (n * d[2])).sqrt(), _lambert, 1.0)


def _facets(alpha: float, n: int) -> Lobe:
    """Mirror directions of ``n`` for normals with density ``D cos``; those below the horizon are left out."""
    a2 = alpha * alpha

    def distribution(cos: Tensor, scale: float = 1.0) -> Tensor:
        """D of the normal halfway to a direction with this cosine: ``a2 / (pi (sin^2 + a2 cos^2)^2)`` of the half angle."""
        bracket = 0.5 * (1.0 + a2) - 0.5 * (1.0 - a2) * cos
        return (scale * a2 / math.pi) / bracket.square()

    u = _centred(n)
    cos2 = (1.0 - u[1]) / (1.0 + (a2 - 1.0) * u[1])
    z = 2.0 * cos2 - 1.0
    r = 2.0 * (cos2 * (1.0 - cos2)).sqrt()
    phi = (2.0 * math.pi) * u[0]
    above = z > 0
    d = torch.stack((r * phi.cos(), r * phi.sin(), z))[:, above]
    total = float(d[2].sum())  # over n: the integral of D / 4 times the cosine
    scale = 0.25 * n / total
    spacing = (4.0 / (n * distribution(d[2]))).sqrt()
    return Lobe(d, d[2] / total, spacing, lambda cos: distribution(cos, scale).mul_(cos.clamp_min(0.0)), alpha)


@dataclass(frozen=True)
class _Convolve:
    """How a result of ``height x width`` is made of the texels of a pyramid and of suns, by a lobe."""

    pyramid: Pyramid
    suns: Tensor  # (3, K) float64 directions, on the host
    height: int
    width: int
    lobe: Lobe

    def taps(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Indices and weights ``(n, 4 S)`` of texels for consecutive texels of the result, row by row."""
        columns = max(1, min(self.width, LANES // len(self.lobe.weight)))
        for row in range(self.height):
            place = self._places(math.pi * row / (self.height - 1))
            for start in range(0, self.width, columns):
                yield self._taps(place, torch.arange(start, min(start + columns, self.width), device=place[0].device))

    def _places(self, theta: float) -> tuple[Tensor, ...]:
        """Where the lobe about a direction at longitude 0 reads: column, columns there are, first texel, two weights."""
        p, lobe, texels = self.pyramid, self.lobe, self.pyramid.texels
        sine, cosine = math.sin(theta), math.cos(theta)
        x, y, z = lobe.d
        up, away = z * cosine - y * sine, z * sine + y * cosine
        across = torch.addcmul(x * x, away, away).sqrt()
        u, v = azimuth(away, x) * (0.5 / math.pi), azimuth(up, across) * (1.0 / math.pi)
        # Levels whose texels are as large as what a direction stands for.
        tall = lobe.spacing * ((p.heights[0] - 1) / math.pi)
        wide = lobe.spacing * (p.widths[0] / (2.0 * math.pi)) / across.clamp_min(1e-12)
        a, b = (
            torch.log2(size).round().clamp(0, last).to(torch.int64)
            for size, last in ((tall, len(p.heights) - 1), (wide, len(p.widths) - 1))
        )
        height, width = torch.tensor(p.heights)[a], torch.tensor(p.widths)[b]
        row = v * (height - 1)
        i = torch.minimum(row.floor(), (height - 2).double())
        share = row - i
        first = p.first[a, b] + i.to(torch.int64) * width
        dtypes = (texels.dtype, torch.int32, torch.int32, texels.dtype, texels.dtype)
        place = (u * width, width, first, lobe.weight * (1.0 - share), lobe.weight * share)
        return tuple(t.to(texels.device, dtype) for t, dtype in zip(place, dtypes, strict=True))

    def _taps(self, place: tuple[Tensor, ...], column: Tensor) -> tuple[Tensor, Tensor]:
        x, width, first, low, high = place
        turn = (column[:, None] + 0.5) / self.width
        x = torch.addcmul(x - 0.5, turn.to(x.dtype), width.to(x.dtype))
        j = x.floor()
        share = x - j
        left = j.to(torch.int32)
        left = torch.where(left < 0, left + width, torch.where(left >= width, left - width, left))
        right = left + 1
        right = torch.where(right == width, 0, right)
        left, right = left + first, right + first
        a, b = low * share, high * share
        return torch.cat((left, right, left + width, right + width), 1), torch.cat((low - a, a, high - b, b), 1)

    def sun_weights(self) -> Iterator[Tensor]:
        """Densities ``(n, K)`` of the suns for consecutive texels of the result."""
        n = directions(self.height, self.width).reshape(3, -1)
        for start in range(0, n.shape[1], max(1, LANES // self.suns.shape[1])):
            cos = n[:, start : start + max(1, LANES // self.suns.shape[1])].T @ self.suns
            yield self.lobe.density(cos).to(self.pyramid.texels.device, self.pyramid.texels.dtype)


class _Gather(torch.autograd.Function):
    """Weighted sums of texels and suns. Weights are made anew for the backward pass rather than kept."""

    @staticmethod
    def forward(ctx: Any, texels: Tensor, light: Tensor, rule: _Convolve) -> Tensor:
        ctx.rule = rule
        sums = torch.cat(
            [
                torch.nn.functional.embedding_bag(index, texels, mode="sum", per_sample_weights=weight)
                for index, weight in rule.taps()
            ]
        )
        sums += torch.cat([sight @ light for sight in rule.sun_weights()])
        return sums.view(rule.height, rule.width, 3)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]: the decorator hides names
        ctx: Any, *cotangents: Tensor
    ) -> tuple[Tensor, Tensor, None]:
        rule: _Convolve = ctx.rule
        flat = cotangents[0].reshape(-1, 3)
        # A channel at a time: several times faster than rows of three on a CPU.
        texels, first = rule.pyramid.texels.new_zeros(3, len(rule.pyramid.texels)), 0
        for index, weight in rule.taps():
            place, share = index.reshape(-1).to(torch.int64), flat[first : first + len(index)]
            for channel in range(3):
                texels[channel].scatter_add_(0, place, (weight * share[:, channel, None]).reshape(-1))
            first += len(index)
        light, first = flat.new_zeros(rule.suns.shape[1], 3), 0
        for sight in rule.sun_weights():
            light += sight.T @ flat[first : first + len(sight)]
            first += len(sight)
        return texels.T, light, None


class _Convolution:
    """A map ready to be convolved with any lobe.

    Its brightest texels are taken out and shine on each texel of the result by the lobe's density itself: a sun between two
    of a thousand directions would be missed, and one that a coarse level of the pyramid spreads out is not where it was.
    """

    def __init__(self, map: Tensor) -> None:
        self.map = map
        self.parts: dict[tuple[int, int], tuple[Pyramid, Tensor, Tensor]] = {}

    def __call__(self, height: int, width: int, lobe: Lobe) -> Tensor:
        """The result ``(height, width, 3)``."""
        for key, value, least in (("height", height, 2), ("width", width, 1)):
            if not isinstance(value, int) or value < least:
                raise SceneError(key, value, f"an integer, at least {least}")
        pyramid, suns, light = self._ready(lobe.width)
        out = _Gather.apply(pyramid.texels, light, _Convolve(pyramid, suns, height, width, lobe))
        assert isinstance(out, Tensor)
        return out

    def _ready(self, width: float) -> tuple[Pyramid, Tensor, Tensor]:
        """The map for lobes as wide as this: no finer than they can tell, the rest and the suns."""
        most = math.ceil(FINE * math.pi / width)
        rows, columns = min(self.map.shape[0] - 1, most) + 1, min(self.map.shape[1], 2 * most)
        # A texel is a point to a lobe five times as wide, else a lattice of points; still wider ones are read as they are.
        points = math.ceil(5.0 * math.pi / (rows - 1) / width)
        points = points if points <= LATTICE else 0
        if (rows, points) not in self.parts:
            rest, suns, light = _extract_suns(resampled(self.map, rows, columns), points)
            self.parts[rows, points] = Pyramid.of(rest), suns, light
        return self.parts[rows, points]


def _extract_suns(map: Tensor, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """A map without what its brightest texels have above the others, and that as suns.

    Args:
        map: ``(H, W, 3)``.
        points: each texel's hat becomes ``(2 points - 1)^2`` suns; 0: none at all.

    Returns:
        The rest ``(H, W, 3)``, directions of suns ``(3, K)`` float64 on the host, and their light ``(K, 3)``, radiance by solid
        angle.
    """
    height, width, _ = map.shape
    each = max(2 * points - 1, 0) ** 2
    count = min(max(SUNS // each, 16), height * width) if points else 0
    flat = map.reshape(-1, 3)
    brightest = torch.topk(flat.detach().amax(1), count) if count else None
    if brightest is None:
        return map, torch.zeros(3, 1, dtype=torch.float64), map.new_zeros(1, 3)
    excess = (flat[brightest.indices] - brightest.values[-1]).clamp_min(0.0)
    rest = flat.index_add(0, brightest.indices, -excess).view_as(map)
    # The lattice of each hat: offsets in texels, and shares of its solid angle.
    offset = torch.arange(1 - points, points, dtype=torch.float64) / points
    hat = 1.0 - offset.abs()
    row, column = brightest.indices.cpu() // width, brightest.indices.cpu() % width
    theta = (row[:, None] + offset) * (math.pi / (height - 1))
    phi = (column[:, None] + 0.5 + offset) * (2.0 * math.pi / width)
    tall = hat * theta.sin().clamp_min(0.0)
    tall = torch.where(tall.sum(1, keepdim=True) > 1e-9, tall, hat)
    share = (tall / tall.sum(1, keepdim=True))[:, :, None] * (hat / hat.sum())
    mass = share * solid_angles(height, width)[row][:, None, None]
    sine, cosine = theta.sin()[:, :, None], theta.cos()[:, :, None]
    d = torch.stack((sine * phi.sin()[:, None], cosine.expand_as(mass), -sine * phi.cos()[:, None]))
    light = mass.reshape(count, -1, 1).to(map) * excess[:, None]
    return rest, d.reshape(3, -1), light.reshape(-1, 3)
