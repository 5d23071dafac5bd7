"""Quadrics under affine maps: points, normals, tangents, uv, area and sampling, in object space.

A subclass of :class:`Quadric` defines the surface in object space, in the file of its shape. A primitive maps it by
``p = p0 + x e1 + y e2 + z e3``; normals are mapped by the cofactor matrix, which needs no inverse and keeps them outward under
mirroring maps. The functions below take lanes of all quadrics of a scene together.

``q`` is a point in object space. ``u, v`` are those of a hit, as the search returns them; texture coordinates are those of
:func:`surface_uv`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import affine, azimuth, cross, dot, normalize
from torchpt.math.vectors import rows as columns
from torchpt.physics.shapes.geometry import Quadrics, QuadricTable
from torchpt.physics.world import World

__all__ = [
    "Form",
    "Quadric",
    "areas",
    "bitangent",
    "direction",
    "follow_ray",
    "normal",
    "octahedral",
    "outward",
    "place",
    "polar",
    "quadrics_of",
    "resolvable_slope",
    "ring",
    "rows",
    "sample",
    "surface_uv",
    "table_of",
    "tangent",
]  # fmt: skip

#: Samples along each axis for the mean area of mapped quadrics; it decides how often a light is chosen, not what it emits.
_GRID = 16


@dataclass(frozen=True)
class Form:
    """The equation ``x^2 + y^2 + bend w^2 + 2 half w = level`` with ``w = z - shift``, for ``low <= z <= high``.

    Attributes:
        bend: coefficient of ``w^2``.
        level: right side of the equation.
        shift: offset of z.
        low: least z.
        high: greatest z.
        around: whether ``u, v`` of hits are octahedral coordinates of the direction from the origin, needed where the surface
            closes smoothly at an end; else the position on the ring and the height.
        half: half the coefficient of ``w``.
    """

    bend: float
    level: float
    shift: float = 0.0
    low: float = 0.0
    high: float = 1.0
    around: bool = False
    half: float = 0.0


class Quadric:
    """A surface of revolution about z in object space, within ``[-1, 1]^3``.

    Attributes:
        name: name of the surface.
        form: equation of the surface.
        area: area in object space, by which emitters are sampled.
    """

    name: ClassVar[str] = ""
    form: ClassVar[Form]
    area: ClassVar[float]

    @classmethod
    def place(cls, u: Tensor, v: Tensor) -> Tensor:
        """Return points ``(3, N)`` by ``u, v (N,)`` of hits (:func:`torchpt.search.leaf.quadric`), without gradients."""
        raise NotImplementedError

    @classmethod
    def normal(cls, q: Tensor) -> Tensor:
        """Return outward normals ``(3, N)`` at points of the surface, not of unit length; along the axis where undefined."""
        raise NotImplementedError

    @classmethod
    def climb(cls, q: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``dr/dv`` and ``dz/dv (N,)`` at points: r is the distance from the axis, here ``radius (N,)``."""
        return torch.zeros_like(radius), torch.ones_like(radius)

    @classmethod
    def v(cls, q: Tensor, radius: Tensor) -> Tensor:
        """Return the texture coordinate ``v (N,)`` at points with distance ``radius (N,)`` from the axis."""
        return q[2]

    @classmethod
    def sample(cls, u: Tensor) -> Tensor:
        """Sample points ``(3, N)`` uniformly by area, from ``u (2, N)`` in [0, 1)."""
        raise NotImplementedError

    @classmethod
    def box(cls, e1: Tensor, e2: Tensor, e3: Tensor) -> tuple[Tensor, Tensor]:
        """Return the corners ``(3, Q)`` of the bounding box under the map by ``e1, e2, e3 (3, Q)``, relative to ``p0``."""
        raise NotImplementedError


def ring(u: Tensor) -> Tensor:
    """Return points ``(3, N)`` of the unit circle in the xy plane, by their position ``u`` in [-2, 2].

    ``u`` is the position along the square ``|x| + |y| = 1``, each side of which counts 1: 0 at +x, 1 at +y, 2 and -2 at -x, -1
    at -y. Unlike an angle it needs no trigonometry. The point of the square is projected to the circle.
    """
    across, sign = u.abs(), torch.copysign(torch.ones_like(u), u)
    return normalize(torch.stack((1.0 - across, sign * torch.minimum(across, 2.0 - across), torch.zeros_like(u))))


def octahedral(u: Tensor, v: Tensor) -> Tensor:
    """Return unit directions ``(3, N)`` by octahedral coordinates ``u, v (N,)`` in [-1, 1]."""
    z = 1.0 - u.abs() - v.abs()
    x = torch.where(z < 0, torch.copysign(1.0 - v.abs(), u), u)
    y = torch.where(z < 0, torch.copysign(1.0 - u.abs(), v), v)
    return normalize(torch.stack((x, y, z)))


def polar(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return distance from the axis ``(N,)`` and azimuth over 2 pi ``(N,)``, with finite derivatives on the axis."""
    square = torch.addcmul(x * x, y, y)
    off_axis = square > 0
    # The inner ``where`` keeps the infinite derivative of the root at 0 out of the backward pass.
    radius = torch.where(off_axis, torch.where(off_axis, square, 1.0).sqrt(), 0.0)
    return radius, azimuth(x, y) * (0.5 / math.pi)


# -- when a world is built


def quadrics_of(kinds: Sequence[type[Quadric]], turned: Sequence[bool], frames: Tensor, dtype: torch.dtype) -> Quadrics:
    """Return the quadrics for stages; normals are computed in float64.

    Args:
        kinds: surface of each quadric.
        turned: whether to flip the normals of each quadric.
        frames: ``(12, Q)`` float64, ``p0 e1 e2 e3``.
        dtype: dtype of the world.
    """
    p0, e1, e2, e3 = frames[0:3], frames[3:6], frames[6:9], frames[9:12]
    cofactors = [cross(e2, e3), cross(e3, e1), cross(e1, e2)]  # columns of the cofactor matrix
    front = torch.tensor([-1.0 if turn else 1.0 for turn in turned], dtype=p0.dtype, device=p0.device)
    front = front * torch.sign(dot(e1, cofactors[0]).detach())  # the sign of the determinant: mirroring maps
    scale = torch.stack(cofactors).detach().abs().amax((0, 1))
    n1, n2, n3 = ((n * (front / scale)).to(dtype) for n in cofactors)
    coordinate_bound = (p0.abs() + e1.abs() + e2.abs() + e3.abs()).detach().to(dtype)
    present = tuple(sorted(set(kinds), key=lambda kind: kind.name))
    code = None
    if len(present) > 1:
        code = torch.tensor([present.index(kind) for kind in kinds], dtype=torch.int64, device=p0.device)
    return Quadrics(kinds=present, code=code, e3=e3.to(dtype), n1=n1, n2=n2, n3=n3, coordinate_bound=coordinate_bound)


def table_of(table: Quadrics, frames: Tensor) -> QuadricTable:
    """Return the quadrics for the search, from frames ``(12, Q)``."""
    frames = frames.detach()
    forms = torch.tensor([astuple(kind.form) for kind in table.kinds], dtype=torch.float64, device=frames.device).T
    p0, e1, e2, e3 = frames[0:3], frames[3:6], frames[6:9], frames[9:12]
    low, high = zip(*(kind.box(e1, e2, e3) for kind in table.kinds), strict=True)
    form = forms.expand(-1, frames.shape[1]) if table.code is None else forms[:, table.code]
    return QuadricTable(
        frame=frames,
        form=form,
        low=_select_by_kind(table, low) + p0,
        high=_select_by_kind(table, high) + p0,
    )


def areas(table: Quadrics, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return two areas of each quadric, ``(Q,)`` float64.

    The first is the area in object space times ``|det|``, differentiable. Emitters are sampled uniformly in object space, and
    :func:`torchpt.physics.lights.surfaces.quadric.world_area` turns this area into one over the density by area in the world.
    The second is the area in the world, detached, for the power of emitters. Ellipsoids have no closed form, so it is the area
    in object space times a numerical mean, over a 16 x 16 grid of samples, of the factor by which the map scales area.
    """
    e1, e2, e3 = frames[3:6], frames[6:9], frames[9:12]
    object_area = torch.tensor([kind.area for kind in table.kinds], dtype=torch.float64, device=e1.device)
    object_area = object_area.expand(e1.shape[1]) if table.code is None else object_area[table.code]
    det = dot(e1, cross(e2, e3)).abs()
    cofactors = [n.detach() for n in (cross(e2, e3), cross(e3, e1), cross(e1, e2))]
    grid = (torch.arange(_GRID, dtype=torch.float64, device=e1.device) + 0.5) / _GRID
    samples = torch.cartesian_prod(grid, grid)
    total = torch.zeros_like(object_area)
    for u in samples:
        n = normal(table, sample(table, u[:, None].expand(2, len(object_area))))
        mapped = affine(cofactors[0] * n[0], cofactors[1], n[1], cofactors[2], n[2])
        total += (dot(mapped, mapped) / dot(n, n)).sqrt()
    return object_area * det, object_area * total / len(samples)


# -- on lanes


def rows(world: World, prim: Tensor) -> Quadrics:
    """Return the columns ``(., N)`` of primitives ``prim (N,)``; arbitrary ones where a primitive is no quadric."""
    assert world.geometry.quadrics is not None
    index = (prim - world.geometry.ends[3]).clamp_min(
        0
    )  # quadrics are the last of five kinds: they begin where spheres end
    return columns(world.geometry.quadrics, index)


def _select_by_kind(table: Quadrics, values: Iterable[Tensor]) -> Tensor:
    """Select in each lane the value of its surface; ``values`` are in the order of ``table.kinds``."""
    selected, *others = values
    for number, value in enumerate(others, 1):
        assert table.code is not None
        selected = torch.where(table.code == number, value, selected)
    return selected


def place(table: Quadrics, u: Tensor, v: Tensor) -> Tensor:
    """Return points ``(3, N)`` in object space by ``u, v (N,)`` of hits."""
    return _select_by_kind(table, (kind.place(u, v) for kind in table.kinds))


def normal(table: Quadrics, q: Tensor) -> Tensor:
    """Return outward normals ``(3, N)`` in object space, with the lengths of :meth:`Quadric.normal`."""
    return _select_by_kind(table, (kind.normal(q) for kind in table.kinds))


def direction(table: Quadrics, n: Tensor) -> Tensor:
    """Transform normals ``(3, N)`` from object space to the world, toward the front, not of unit length."""
    return affine(table.n1 * n[0], table.n2, n[1], table.n3, n[2])


def outward(table: Quadrics, q: Tensor) -> Tensor:
    """Return unit normals ``(3, N)`` in the world at points ``q`` of object space, on the front.

    The front is the outside, or the inside of quadrics whose normals are flipped.
    """
    return normalize(direction(table, normal(table, q)))


def tangent(e1: Tensor, e2: Tensor, q: Tensor) -> Tensor:
    """Return derivatives ``(3, N)`` of the point in the world by ``u``, the azimuth over 2 pi."""
    return (e2 * q[0] - e1 * q[1]) * (2.0 * math.pi)


def bitangent(table: Quadrics, e1: Tensor, e2: Tensor, q: Tensor) -> Tensor:
    """Return derivatives ``(3, N)`` of the point in the world by the texture coordinate ``v``."""
    square = (q[0] * q[0] + q[1] * q[1]).detach()
    radius = torch.where(square > 0, square, 1.0).sqrt()
    x, y = q[0] / radius, q[1] / radius
    dr_dv, dz_dv = (
        _select_by_kind(table, part) for part in zip(*(kind.climb(q, radius) for kind in table.kinds), strict=True)
    )
    return affine(e1 * (dr_dv * x), e2, dr_dv * y, table.e3, dz_dv)


def surface_uv(table: Quadrics, q: Tensor) -> Tensor:
    """Return texture coordinates ``(2, N)``: the azimuth about z over 2 pi, and :meth:`Quadric.v`."""
    radius, azimuth_u = polar(q[0], q[1])
    return torch.stack((azimuth_u, _select_by_kind(table, (kind.v(q, radius) for kind in table.kinds))))


def follow_ray(table: Quadrics, p0: Tensor, e1: Tensor, o: Tensor, d: Tensor, t: Tensor, q: Tensor) -> Tensor:
    """Return the points ``q (3, N)`` with the derivative of the intersection of ``o + t d``, in all arguments but ``t``.

    One Newton step on the surface's equation, with a detached slope. In float64 the value is its result too, more accurate than
    the float32 of the search; else the value stays ``q``, whose rounding does not depend on the distance of the origin.
    """
    det = dot(e1, table.n1)
    inverse = 1.0 / torch.where(det == 0, 1.0, det)

    def to_object(x: Tensor) -> Tensor:
        return torch.stack((dot(table.n1, x), dot(table.n2, x), dot(table.n3, x))) * inverse

    origin, e = to_object(o - p0), to_object(d)  # the ray in object space
    at = origin + e * t.detach()
    value = _select_by_kind(table, (_residual(kind.form, at) for kind in table.kinds))
    slope = _select_by_kind(table, (_slope(kind.form, at, e) for kind in table.kinds)).detach()
    steepest = _select_by_kind(table, (_steepness(kind.form, at) for kind in table.kinds)).detach() * _length(e)
    moved = at - e.detach() * (value / resolvable_slope(slope, steepest, _length(origin)))
    return moved if q.dtype == torch.float64 else q + (moved - moved.detach())


def _residual(form: Form, q: Tensor) -> Tensor:
    """Return left minus right side ``(N,)`` of a surface's equation at points ``(3, N)``."""
    value = q[0] * q[0] + q[1] * q[1]
    if form.bend or form.half:
        w = q[2] - form.shift if form.shift else q[2]
        value = value + form.bend * w * w if form.bend else value
        value = value + (2.0 * form.half) * w if form.half else value
    return value - form.level


def _slope(form: Form, q: Tensor, e: Tensor) -> Tensor:
    """Return the derivative ``(N,)`` of :func:`_residual` along ``e (3, N)``."""
    half = q[0] * e[0] + q[1] * e[1]
    if form.bend or form.half:
        w = q[2] - form.shift if form.shift else q[2]
        half = half + form.bend * w * e[2] if form.bend else half
        half = half + form.half * e[2] if form.half else half
    return 2.0 * half


def _steepness(form: Form, q: Tensor) -> Tensor:
    """Return the length ``(N,)`` of the gradient of :func:`_residual`."""
    square = q[0] * q[0] + q[1] * q[1]
    if form.bend or form.half:
        w = q[2] - form.shift if form.shift else q[2]
        along = form.bend * w + form.half
        square = square + along * along
    return 2.0 * square.sqrt()


def _length(x: Tensor) -> Tensor:
    """Return the lengths ``(N,)`` of vectors ``(3, N)``, without derivatives."""
    x = x.detach()
    return dot(x, x).sqrt()


def resolvable_slope(slope: Tensor, steepest: Tensor, distance: Tensor) -> Tensor:
    """Return the slopes ``(N,)`` of a surface's equation along rays, raised to the least size that rounding can tell from 0.

    At the limb of a round body a hit is off by the root of a rounding error, and one over such a slope is noise without bounds.
    What is lost is about half the cosine from which on slopes count: .05 % of a derivative, seen from ten radii away.

    Args:
        slope: the slopes, without derivatives.
        steepest: slopes of rays along the normal ``(N,)``.
        distance: of the origins of the rays from the body's centre, in its radii ``(N,)``.
    """
    least = steepest * (torch.finfo(slope.dtype).eps * (1.0 + distance)).sqrt()
    slope = torch.where(slope.abs() < least, torch.copysign(least, slope), slope)
    return torch.where(slope == 0, 1.0, slope)


def sample(table: Quadrics, u: Tensor) -> Tensor:
    """Sample points ``(3, N)`` uniformly by area in object space, from ``u (2, N)`` in [0, 1)."""
    return _select_by_kind(table, (kind.sample(u) for kind in table.kinds))
