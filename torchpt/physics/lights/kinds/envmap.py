"""Environment maps: images of all directions, sampled by luminance.

Coordinates are Mitsuba's: in the map's own space ``u = atan2(x, -z) / 2 pi`` (wrapped) and ``v = theta / pi`` with
``theta = acos(y)``. Texel ``(i, j)`` of H x W lies at ``u = (j + 1/2) / W``, ``v = i / (H - 1)``: the first and the last row
are the poles. Between texels the look-up is bilinear in ``(u, v)``.

**The density** is bilinear too, cell by cell, with the luminance of the same four texels; but down a cell it is linear in
``cos(theta)``, which goes from one row to the next almost as ``theta`` does. In ``(u, cos(theta))`` equal areas are equal solid
angles, so the density in solid angle *is* the bilinear value over a constant: no ``sin(theta)`` anywhere, finite at the poles,
and positive wherever the look-up is. A cell's weight is the mean of its corners times its exact solid angle.

**MIS compensation** (Karlík, Šik, Vévoda, Skřivan, Křivánek, *MIS Compensation: Optimizing Sampling Techniques in Multiple
Importance Sampling*, 2019, section 5): combined with BSDF sampling, a sharper density of the map has less variance, as BSDF
sampling finds the dim directions. The mean luminance over the sphere is subtracted, and directions below it are never sampled.
That is unbiased only if BSDF sampling covers those directions: only the strategy ``mis`` uses it; ``light`` samples by the
luminance itself. Near-constant maps are not compensated, as little but their noise would remain: maps with less than a tenth
of their light above the mean, spread over more than a tenth of the sphere (measured as ``(int f)^2 / int f^2`` of the part
above the mean; a small lamp before an even sky is worth the compensation however faint).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from torchpt.core.threads import sum_all
from torchpt.images.texels import ACCEPTED_TEXELS, check_source, read_texels, texels_from_array, texels_to_radiance
from torchpt.math.sampling import Distribution2D, invert_linear
from torchpt.math.vectors import azimuth, dot, luminance, safe_reciprocal, take
from torchpt.physics.ibl.equirect import Cell, angles
from torchpt.physics.lights.base import Environment, EnvironmentImage, Row, Setting, bright
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.spec import Choice, Custom, Moves, Path, Pose, Scalar, Spec, Texels

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["EVEN", "EnvironmentMap", "Envmap", "Grid", "build", "environment", "pdf", "radiance", "sample"]

#: A map is near-constant if less than this fraction of its light is above the mean, over more than this fraction of the sphere.
EVEN = 0.1
#: Rows of cells that are integrated at once.
_ROWS = 64


@dataclass(frozen=True)
class Grid:
    """A density over the cells of a map, proportional to ``max(luminance - floor, 0)`` at the texels.

    Attributes:
        cells: distribution of the cells.
        floor: ``()`` subtracted luminance; -1 for a black map, for a uniform density.
        factor: ``()`` factor from the interpolated difference to the density per steradian.
    """

    cells: Distribution2D
    floor: Tensor
    factor: Tensor


@dataclass(frozen=True)
class EnvironmentMap:
    """A map of H x W texels; H is at least 2.

    Attributes:
        texels: ``(3, H W)`` linear RGB.
        height: H, static; stages read ``size``.
        width: W.
        size: ``(2,)`` int64 H and W.
        turn: ``(3, 3)`` orthogonal, from the world to the map's own space.
        scale: ``()`` factor of the texels.
        halves: ``(2, H)`` ``sin^2(theta / 2)`` and ``cos^2(theta / 2)`` of the rows: differences of the first are accurate at
            the north pole, of the second at the south pole.
        steps: ``(H - 1,)`` one over the differences of ``halves[0]``.
        mean: ``()`` mean luminance over the sphere, without ``scale``; detached.
        plain: density by luminance, for light sampling alone; None where only the other one is asked for.
        compensated: density for MIS; None if it is ``plain``.
    """

    texels: Tensor
    height: int
    width: int
    size: Tensor
    turn: Tensor
    scale: Tensor
    halves: Tensor
    steps: Tensor
    mean: Tensor
    plain: Grid | None
    compensated: Grid | None

    def grid(self, mis: bool) -> Grid:
        """Return the density for MIS with BSDF sampling, or for light sampling alone."""
        grid = self.compensated if mis and self.compensated is not None else self.plain
        assert grid is not None, "a world of strategy mis has no density for light sampling alone"
        return grid


def build(
    texels: Tensor, turn: Tensor, scale: Tensor, compensation: bool | None = None, alone: bool = True
) -> EnvironmentMap:
    """Build a map for look-ups and sampling; radiance is differentiable in all three tensors, densities are not.

    Args:
        texels: ``(H, W, 3)`` linear RGB in the world's dtype; a single row is repeated at every height.
        turn: ``(3, 3)`` orthogonal, from the world to the map's own space.
        scale: ``()`` factor of the texels.
        compensation: whether to apply MIS compensation; None: unless the map is near-constant.
        alone: whether there is a density for light sampling alone, where that is not the one for MIS.
    """
    if texels.shape[0] == 1:
        texels = texels.expand(2, -1, -1)
    height, width, _ = texels.shape
    planes = texels.permute(2, 0, 1).reshape(3, -1)
    angle = torch.linspace(
        0.0, 0.5 * math.pi, height, dtype=torch.float64, device=texels.device
    )  # theta / 2 of the rows
    sine, cosine = torch.sin(angle), torch.cos(angle)
    # cos(pi / 2) is not quite 0 in floating point.
    sine[0] = cosine[-1] = 0.0
    halves = torch.stack((sine * sine, cosine * cosine))
    top = halves[0].diff()  # near the south pole the other one keeps its digits
    heights = torch.where(halves[0, 1:] < 0.5, top, -halves[1].diff())
    with torch.no_grad():
        cells = _Cells(texels, heights)
        zero = heights.new_zeros((), dtype=texels.dtype)
        mean = cells.mean()
        black = not bool(mean > 0)
        compensated = plain = None
        if not black and compensation is not False:
            floor = mean.to(texels.dtype)
            above, squares = cells.sums(floor)
            if bool(above > 0) and (compensation or _uneven(above, squares, mean)):
                compensated = cells.grid(floor, above)
        if alone or compensated is None:
            # With a floor of -1 every texel of a black map has the value 1: a uniform density.
            plain = cells.grid(zero - 1.0, heights.sum()) if black else cells.grid(zero, mean)
    return EnvironmentMap(
        texels=planes,
        height=height,
        width=width,
        size=torch.tensor((height, width), dtype=torch.int64, device=texels.device),
        turn=turn,
        scale=scale,
        halves=halves.to(texels.dtype),
        steps=(1.0 / heights).to(texels.dtype),
        mean=mean.to(texels.dtype),
        plain=plain,
        compensated=compensated,
    )


@dataclass(frozen=True)
class _Cells:
    """The cells of a map, which are computed some rows at a time: a map may be large.

    Attributes:
        texels: ``(H, W, 3)``.
        heights: differences of ``(1 - cos(theta)) / 2`` between the rows ``(H - 1,)`` float64.
    """

    texels: Tensor
    heights: Tensor

    def weights(self, floor: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield heights ``(n,)`` of rows of cells, and integrals over these cells ``(n, W)`` float64; the sphere has measure 1.

        The integrand interpolates ``max(luminance - floor, 0)`` at the texels; luminances are at least 0.
        """
        for first in range(0, len(self.heights), _ROWS):
            heights = self.heights[first : first + _ROWS]
            light = luminance(self.texels[first : first + len(heights) + 1].movedim(-1, 0)).clamp_min_(0.0)
            v = light.sub_(floor).clamp_min_(0.0).double()
            v = v.roll(-1, 1).add_(v)
            yield heights, (v[:-1] + v[1:]).mul_((heights * (0.25 / v.shape[1]))[:, None])

    def mean(self) -> Tensor:
        """Return the mean luminance ``()`` over the sphere, the sum of :meth:`weights` without a floor."""
        # A texel is a corner of two cells of the row above, and of two of the row below.
        shares = 0.5 * torch.nn.functional.pad(self.heights, (1, 1)).unfold(0, 2, 1).sum(1)
        light = [luminance(rows.movedim(-1, 0)).clamp_min_(0.0).double().mean(1) for rows in self.texels.split(_ROWS)]
        return sum_all(torch.cat(light) * shares)

    def sums(self, floor: Tensor) -> tuple[Tensor, Tensor]:
        """Return the integrals ``()`` of :meth:`weights`' integrand over the sphere, and of its square."""
        sums, squares = [], []
        for heights, weights in self.weights(floor):
            sums.append(sum_all(weights))
            of_rows = torch.linalg.vector_norm(weights, dim=1).square()
            squares.append(sum_all(of_rows * (weights.shape[1] / heights)))
        return torch.stack(sums).sum(), torch.stack(squares).sum()

    def grid(self, floor: Tensor, total: Tensor) -> Grid:
        """Return the density by :meth:`weights`, whose sum is ``total``."""
        rows = (weights for _, weights in self.weights(floor))
        cells = Distribution2D.of(rows, len(self.heights), self.texels.shape[1], self.texels.device)
        return Grid(cells=cells, floor=floor, factor=(1.0 / (4.0 * math.pi * total)).to(floor.dtype))


def _uneven(above: Tensor, squares: Tensor, mean: Tensor) -> bool:
    """Return False for a near-constant map, see :data:`EVEN`.

    ``above``, ``squares``: integrals of the luminance above the mean, and of its square.
    """
    return bool((above > EVEN * mean) | (above * above < EVEN * squares))


def _cell_of(map: EnvironmentMap, d: Tensor) -> Cell:
    """Return the cells in which unit directions ``(3, N)`` of the world lie."""
    local = [dot(map.turn[k][:, None], d) for k in range(3)]
    around, down = angles(local, min_sin2=torch.finfo(d.dtype).tiny)
    tall, wide = map.size[0].to(d.dtype), map.size[1].to(d.dtype)
    y = down * ((tall - 1.0) * (1.0 / math.pi))
    x = around * (wide * (0.5 / math.pi)) - 0.5
    at = Cell.of(x, y, map.size[0], map.size[1])
    return at._replace(y=at.y.clamp_max(1.0))


#: Colours ``(3, N)`` of a cell's texels: two of the upper row, two of the lower one.
_Corners = tuple[Tensor, Tensor, Tensor, Tensor]


def _corners(map: EnvironmentMap, at: Cell) -> _Corners:
    """Return the colours of the four texels around points in cells ``at``."""
    a, b, c, d = (take(map.texels, texel) for texel in at.texels(map.size[1]))
    return a, b, c, d


def _mix(corners: tuple[Tensor, Tensor, Tensor, Tensor], x: Tensor, y: Tensor) -> Tensor:
    """Interpolate the values at the corners bilinearly, at fractions ``x, y (N,)`` of the cell."""
    a, b, c, d = corners
    top, bottom = a + (b - a) * x, c + (d - c) * x
    return top + (bottom - top) * y


def _values(grid: Grid, corners: _Corners) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the values ``(N,)`` at the corners that the density interpolates."""
    a, b, c, d = ((luminance(colour.detach()).clamp_min(0.0) - grid.floor).clamp_min(0.0) for colour in corners)
    return a, b, c, d


def _density(map: EnvironmentMap, grid: Grid, at: Cell, corners: _Corners) -> Tensor:
    """Return the density ``(N,)`` per steradian of points in cells ``at``, whose texels have the colours ``corners``."""
    step = math.pi / (map.size[0] - 1).to(at.y.dtype)
    y = at.y.detach()
    # The fraction of the cell's cos(theta): a difference of cosines, written as a product to avoid cancellation.
    down = torch.sin((0.5 * step) * y) * torch.sin(step * (at.row + 0.5 * y)) * take(map.steps, at.row)
    return _mix(_values(grid, corners), at.x.detach(), down.clamp_max(1.0)) * grid.factor


def radiance(map: EnvironmentMap, d: Tensor) -> Tensor:
    """Return radiance ``(3, N)`` from unit directions ``d (3, N)``."""
    at = _cell_of(map, d)
    return _mix(_corners(map, at), at.x, at.y) * map.scale


def pdf(map: EnvironmentMap, d: Tensor, mis: bool) -> Tensor:
    """Return the pdf ``(N,)`` of unit directions ``d (3, N)`` under :func:`sample`, per steradian; detached."""
    at = _cell_of(map, d.detach())
    return _density(map, map.grid(mis), at, _corners(map, at))


def environment(map: EnvironmentMap, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
    """Return :func:`radiance` and :func:`pdf`, with one look-up."""
    at = _cell_of(map, d)
    corners = _corners(map, at)
    return _mix(corners, at.x, at.y) * map.scale, _density(map, map.grid(mis), at, corners)


def sample(map: EnvironmentMap, u: Tensor, mis: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Sample directions by luminance.

    Args:
        map: the map.
        u: ``(2, N)`` in ``[0, 1)``.
        mis: whether the samples are combined with BSDF sampling by MIS; else the density is positive wherever the map is.

    Returns:
        Unit directions ``(3, N)`` and their pdf ``(N,)`` per steradian, both detached, and the radiance ``(3, N)`` from these
        directions. A pdf of 0 means that sampling failed.
    """
    grid = map.grid(mis)
    row, column, rest = grid.cells.sample(u)  # `rest (2, N)`: `u` remapped to [0, 1) within the cell
    corners = _corners(map, Cell(row=row, column=column, x=rest[0], y=rest[1]))
    with torch.no_grad():
        a, b, c, d = _values(grid, corners)
        # Within the cell the density is bilinear in the column and in `down`, the fraction of the cell's cos(theta).
        down = invert_linear(rest[1], a + b, c + d)
        x = invert_linear(rest[0], a + (c - a) * down, b + (d - b) * down)
        density = _mix((a, b, c, d), x, down) * grid.factor
        above, below = take(map.halves, row), take(map.halves, row + 1)
        half = above + (below - above) * down  # sin^2 and cos^2 of theta / 2
        tall, wide = map.size[0].to(u.dtype), map.size[1].to(u.dtype)
        phi = (x + (column + 0.5)) * (2.0 * math.pi / wide)
        radius = 2.0 * (half[0] * half[1]).sqrt()
        local = (radius * torch.sin(phi), half[1] - half[0], radius * -torch.cos(phi))
        # The inverse of an orthogonal matrix is its transpose.
        turn = map.turn
        wi = torch.stack([local[0] * turn[0, k] + local[1] * turn[1, k] + local[2] * turn[2, k] for k in range(3)])
        # The fraction of the cell in theta, in which the look-up is bilinear; `azimuth` gives theta, the angle from +y, whose
        # cosine is local[1] and whose sine is `radius`.
        y = (azimuth(local[1], radius) * ((tall - 1.0) * (1.0 / math.pi)) - row).clamp(0.0, 1.0)
    if map.turn.requires_grad:
        return wi, density, radiance(map, wi)  # differentiable in the rotation
    return wi, density, _mix(corners, x, y) * map.scale


class Envmap(Environment):
    """An environment given by an image of all directions."""

    name = "envmap"
    parameters: ClassVar = {
        "path": Path(None, doc="image file; of several paths the first that exists"),
        "data": Custom(
            None,
            reader=texels_from_array,
            words=ACCEPTED_TEXELS,
            doc="array, tensor or rows of numbers in place of a file, the top row first; linear, except uint8: `colorspace`",
        ),
        "colorspace": Choice(
            "auto",
            names=("auto", "srgb", "linear"),
            doc="encoding of images of whole numbers; auto: sRGB for those of 8 bits a value, else linear",
        ),
        "scale": Scalar(1.0, doc="factor of the radiance"),
        "transform": Pose(
            None,
            angles=True,  # has to keep angles
            moves=Moves.NOTHING,
            doc="rotation, may mirror; translation and scale have no effect",
        ),
    }

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :meth:`Light.check`; refuse other than one source of texels."""
        check_source(values)

    @classmethod
    def files(
        cls, values: Mapping[str, Any], find: Callable[[str], FilePath]
    ) -> dict[str, tuple[NDArray[np.float32], Spec]]:
        """See :meth:`Light.files`."""
        spec = Texels(doc="radiance `(H, W, 3)`, before `scale`")
        space = values["colorspace"]
        if values["data"] is not None:
            return {"texels": (texels_to_radiance(values["data"], "data", "data", space), spec)}
        file = find("path")
        return {"texels": (texels_to_radiance(read_texels(file), str(file), "path", space), spec)}

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """See :meth:`Light.row`; :attr:`Row.environment` is an :class:`EnvironmentMap`."""
        texels, scale = (scene.given(key).to(scene.dtype) for key in ("texels", "scale"))
        linear = scene["to_world"][:3, :3]  # the tensor of the key `transform`
        turn = torch.linalg.inv(linear) * torch.linalg.det(linear).abs() ** (1.0 / 3.0)
        around = build(texels, turn.to(scene.dtype), scale, alone=scene.alone)
        color = (around.mean * around.scale.detach()).expand(3)
        # From each direction through a disk as wide as the scene, whose radius is `reach`; `bright` is the detached luminance.
        power = 4.0 * math.pi**2 * scene.reach**2 * bright(color)
        return Row(radiance=color, power=power, environment=around)

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """See :meth:`Light.sample`."""
        wi, density, light = sample(at.environment, u, mis)
        weight = torch.where(density > 0, safe_reciprocal(density), 0.0)
        # `distant` is set by the light table, for the rows of all kinds at once.
        return LightSample(wi=wi, target=wi, distant=None, radiance=light, pdf=density, weight=weight)

    @classmethod
    def radiance_pdf(cls, around: EnvironmentMap, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
        """See :meth:`Environment.radiance_pdf`."""
        return environment(around, d, mis)

    @classmethod
    def environment_image(cls, around: EnvironmentMap) -> EnvironmentImage:
        """See :meth:`Environment.environment_image`."""
        texels = (around.texels * around.scale).T.reshape(around.height, around.width, 3)
        return EnvironmentImage(texels=texels, turn=around.turn)

    @classmethod
    def info(cls, around: EnvironmentMap) -> dict[str, Any]:
        """See :meth:`Environment.info`."""
        return {"texels": [around.width, around.height], "mis_compensation": around.compensated is not None}
