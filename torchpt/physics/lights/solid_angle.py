"""Sample triangles and parallelograms uniformly by solid angle, as seen from each reference point.

Triangles: Arvo, *Stratified Sampling of Spherical Triangles*, 1995. The map is written with vectors instead of angles: a
subtriangle of the fraction ``u`` of the area ends where the reflection of a corner falls (van Oosterom and Strackee's
``tan(E / 2)``, *The Solid Angle of a Plane Triangle*, 1983, solved for the corner), so that nothing cancels in slivers, and
the point comes out as its own barycentric coordinates, inside the triangle whatever the rounding.
Rectangles: Urena, Fajardo, King, *An Area-Preserving Parametrization for Spherical Rectangles*, 2013. A parallelogram that
is no rectangle is two triangles, which share a corner and hence one continuous map.

Below the solid angle :data:`LEAST` a light is sampled by area, which is then as good; above :data:`MOST` the reference point
lies in the light up to rounding. :func:`angles` makes the switch, so :func:`sample` and the pdf of a direction from BSDF
sampling agree on it. Computed in float64, since the solid angle of a near or edge-on light cancels.

Nothing here is differentiable. Engines may replace :func:`sample` and :func:`angles` by kernels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchpt.core.dispatch import dispatched
from torchpt.math.sampling import uniform_triangle
from torchpt.math.vectors import azimuth, cross, dot

__all__ = [
    "LEAST",
    "MOST",
    "NEAR",
    "OPPOSITE",
    "OTHER",
    "RECTANGLE",
    "SKEW",
    "TRIANGLE",
    "angles",
    "inverse_pdf",
    "sample",
    "shapes_of",
    "table_of",
]

#: Shape codes: triangle, rectangle, parallelogram that is no rectangle, anything else.
TRIANGLE, RECTANGLE, SKEW, OTHER = 0, 1, 2, 3
#: Range of solid angles, in steradians, outside of which lights are sampled by area.
LEAST, MOST = 3e-4, 2.0 * math.pi - 1e-5
#: One plus the cosine between two corners of a triangle below which float64 loses the angle: seen from a millionth of an
#: edge's length away, its ends lie in opposite directions. Then the triangle is sampled by area.
OPPOSITE = 1e-12
#: Distance from the centre of a light, over its radius, beyond which it is sampled by area: there that has as little noise.
NEAR = 2.0
#: Cosine between the edges up to which a parallelogram is a rectangle: rounding of its corners in float32.
SQUARE = 1e-6


def table_of(codes: Sequence[int], p0: Tensor, e1: Tensor, e2: Tensor, near: float = NEAR) -> Tensor | None:
    """Return the table of lights for :func:`sample` and :func:`angles`.

    Args:
        codes: shape codes of the rows: :data:`TRIANGLE`, :data:`RECTANGLE` (which may be sheared) or :data:`OTHER`.
        p0: first corners ``(3, K)``.
        e1: edges from ``p0`` ``(3, K)``.
        e2: the other edges from ``p0`` ``(3, K)``.
        near: replaces :data:`NEAR`.

    Returns:
        ``(K, 14)`` float64: shape code, squared distance from the centre beyond which it is sampled by area, centre, ``p0``,
        ``e1``, ``e2``. None if all codes are :data:`OTHER`.
    """
    if set(codes) <= {OTHER}:
        return None
    p, a, b = (x.detach().double() for x in (p0, e1, e2))
    code = torch.tensor(codes, device=p.device)
    skew = dot(a, b).abs() > SQUARE * (dot(a, a) * dot(b, b)).sqrt()
    code = torch.where(skew & (code == RECTANGLE), SKEW, code)
    centre = (a + b) * torch.where(code == TRIANGLE, 1.0 / 3.0, 0.5).double()  # relative to p0
    corners = [torch.zeros_like(a), a, b, torch.where(code == TRIANGLE, b, a + b)]
    square = torch.stack([dot(corner - centre, corner - centre) for corner in corners]).amax(0)
    square_limit = torch.where(code == OTHER, 0.0, square * near**2)
    return torch.cat((code.double()[None], square_limit[None], p + centre, p, a, b)).T.contiguous()


def shapes_of(table: Tensor | None) -> tuple[int, ...]:
    """Return the codes other than :data:`OTHER` that occur in a table."""
    if table is None:
        return ()
    return tuple(code for code in (TRIANGLE, RECTANGLE, SKEW) if bool((table[:, 0] == code).any()))


@dispatched
@torch.no_grad()
def sample(
    table: Tensor, row: Tensor | None, x: Tensor, u: Tensor, shapes: Sequence[int] = (TRIANGLE, RECTANGLE, SKEW)
) -> tuple[Tensor, Tensor]:
    """Sample points on lights as seen from ``x``; not differentiable.

    Args:
        table: from :func:`table_of`.
        row: row of each lane ``(N,)`` int64; None for a table of one row.
        x: reference points ``(3, N)``.
        u: ``(2, N)`` in [0, 1).
        shapes: codes in the table, from :func:`shapes_of`. Other shapes are not computed.

    Returns:
        ``(u, v)`` of the points on their primitives ``(2, N)``, ``u`` itself for other shapes, and solid angles ``(N,)`` as
        from :func:`angles`: 0 where the point was sampled by area.
    """
    shape, near, a, e, f = _lane_lights(table, row, x)
    w = u.double()
    uv, angle = _sample_shapes(shapes, shape, a, e, f, w)
    angle = torch.where(near, angle, 0.0)
    by_area = torch.where(shape == TRIANGLE, uniform_triangle(w), w) if TRIANGLE in shapes else w
    return torch.where(angle > 0, uv, by_area).to(u.dtype), angle.to(x.dtype)


@dispatched
@torch.no_grad()
def angles(table: Tensor, row: Tensor | None, x: Tensor, shapes: Sequence[int] = (TRIANGLE, RECTANGLE, SKEW)) -> Tensor:
    """Return solid angles ``(N,)`` of lights as seen from ``x``, 0 where :func:`sample` samples by area.

    The angle is the same from behind: the caller has to check which side emits.
    """
    shape, near, a, e, f = _lane_lights(table, row, x)
    _, angle = _sample_shapes(shapes, shape, a, e, f, torch.zeros_like(a[:2]))
    return torch.where(near, angle, 0.0).to(x.dtype)


def inverse_pdf(angle: Tensor, by_area: Tensor) -> Tensor:
    """Return ``1 / pdf`` in steradians ``(N,)`` of points from :func:`sample`, 0 behind the emitter.

    Args:
        angle: from :func:`sample` or :func:`angles`.
        by_area: ``area cos / r^2``, 0 behind the emitter. Its relative derivative becomes that of the result, as the point
            stays fixed on the light and the integrand over the area is differentiated.
    """
    if not by_area.requires_grad:
        return torch.where(angle > 0, angle * torch.sign(by_area), by_area)
    value = by_area.detach()
    seen = value > 0
    solid = angle * torch.where(seen, by_area / torch.where(seen, value, 1.0), 0.0)
    return torch.where(angle > 0, solid, by_area)


def _lane_lights(table: Tensor, row: Tensor | None, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return for each lane, in float64: shape code, mask of near lights, first corner relative to ``x``, both edges.

    The callers name the last three ``a e f``, ``(3, N)`` each.
    """
    # Columns of the table: 0 shape code, 1 squared distance limit, 2:5 centre, 5:8 p0, 8:11 e1, 11:14 e2.
    lanes = (table if row is None else table[row]).T.expand(14, x.shape[1])
    away = lanes[2:5] - x.double()
    near = (lanes[0] != OTHER) & (dot(away, away) < lanes[1])
    return lanes[0], near, lanes[5:8] - x.double(), lanes[8:11], lanes[11:14]


def _sample_shapes(
    shapes: Sequence[int], shape: Tensor, a: Tensor, e: Tensor, f: Tensor, u: Tensor
) -> tuple[Tensor, Tensor]:
    """Return points ``(2, N)`` and solid angles ``(N,)``, each lane by the formulas of its shape."""
    samplers = {TRIANGLE: _triangle, RECTANGLE: _rectangle, SKEW: _skew}
    if not shapes:
        return torch.zeros_like(a[:2]), torch.zeros_like(a[0])
    uv, angle = samplers[shapes[-1]](a, e, f, u)
    for code in shapes[-2::-1]:
        other_uv, other_angle = samplers[code](a, e, f, u)
        uv, angle = torch.where(shape == code, other_uv, uv), torch.where(shape == code, other_angle, angle)
    return uv, angle


def _reciprocal(a: Tensor) -> Tensor:
    """Return ``1 / a`` of ``a >= 0``, finite at 0."""
    return a.clamp_min(1e-300).reciprocal()


def _zero_out_of_range(angle: Tensor) -> Tensor:
    """Return solid angles, 0 outside of :data:`LEAST` to :data:`MOST`: those lights are sampled by area."""
    return torch.where((angle >= LEAST) & (angle <= MOST), angle, 0.0)


def _unit(a: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit vectors and one over the lengths."""
    inverse = _reciprocal(dot(a, a).sqrt())
    return a * inverse, inverse


def _excess(volume: Tensor, ab: Tensor, bc: Tensor, ca: Tensor) -> Tensor:
    """Return half the solid angle of the triangle of unit vectors A, B, C; NaN where it is lost to rounding.

    ``volume`` is ``|A . (B x C)|``; ``ab bc ca`` are the dot products ``A . B``, ``B . C``, ``C . A``. ``(N,)`` each.
    """
    half = azimuth(1.0 + ab + bc + ca, volume)
    reliable = 1.0 + torch.minimum(torch.minimum(ab, bc), ca) >= OPPOSITE
    return torch.where(reliable, torch.where(half <= math.pi, half, 0.0), math.nan)


def _arc(
    half: Tensor, volume: Tensor, ab: Tensor, bc: Tensor, ca: Tensor, u: Tensor, v: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a sampled direction of the spherical triangle A, B, C as weights of these unit vectors, ``(N,)`` each.

    ``half`` is :func:`_excess`, the next four are its arguments, and ``u``, ``v`` are in [0, 1).
    """
    c, s = torch.cos(half * u), torch.sin(half * u)
    # C' on the arc from A to C cuts off the fraction u of the area: along x A + y C, reflected.
    x, y = volume * c - (bc + ca) * s, (1.0 + ab) * s
    k = 2.0 * (x + y * ca) * _reciprocal(x * x + y * y + 2.0 * x * y * ca)
    p, q = k * x - 1.0, k * y
    # On the arc from B to C', with 1 - cos linear in v.
    far = p * ab + q * bc
    near = 1.0 - v * (1.0 - far)
    t = (v * (1.0 + near) * _reciprocal(1.0 + far)).abs().sqrt()
    return t * p, near - t * far, t * q


def _barycentric(weights: tuple[Tensor, Tensor, Tensor], ia: Tensor, ib: Tensor, ic: Tensor) -> tuple[Tensor, Tensor]:
    """Return the barycentric coordinates of A and C in the plane, from weights of unit vectors and inverse lengths."""
    a, b, c = (w.clamp_min(0.0) * i for w, i in zip(weights, (ia, ib, ic), strict=True))
    scale = _reciprocal(a + b + c)
    return a * scale, c * scale


def _triangle(hub: Tensor, e: Tensor, f: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Sample the triangle with a corner at ``hub`` and edges ``e``, ``f`` from it, as seen from the origin.

    In names, ``a b c`` are unit vectors to the corners, ``ia ib ic`` one over the distances.
    """
    (a, ia), (b, ib), (c, ic) = _unit(hub + e), _unit(hub), _unit(hub + f)
    volume = dot(hub, cross(e, f)).abs() * (ia * ib) * ic
    ab, bc, ca = dot(a, b), dot(b, c), dot(c, a)
    half = _excess(volume, ab, bc, ca)
    p, q = _barycentric(_arc(half, volume, ab, bc, ca, u[0], u[1]), ia, ib, ic)
    return torch.stack((p, q)), _zero_out_of_range(2.0 * half)


def _skew(hub: Tensor, e: Tensor, f: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Sample a parallelogram as two triangles that share the corner ``hub``: names as in :func:`_triangle`."""
    (o, io), (a, ia), (b, ib), (c, ic) = _unit(hub), _unit(hub + e), _unit(hub + e + f), _unit(hub + f)
    volume = dot(hub, cross(e, f)).abs() * io
    oa, ob, oc, ab, bc = dot(o, a), dot(o, b), dot(o, c), dot(a, b), dot(b, c)
    first, second = volume * ia * ib, volume * ib * ic
    one, two = _excess(first, oa, ob, ab), _excess(second, ob, oc, bc)
    at = u[0] * (one + two)
    in_first = at < one

    def pick(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(in_first, x, y)

    half = pick(one, two)
    inner = (pick(at, at - one) * _reciprocal(half)).clamp_max(1.0)
    weights = _arc(half, pick(first, second), pick(oa, ob), pick(ob, oc), pick(ab, bc), inner, u[1])
    p, q = _barycentric(weights, pick(ia, ib), io, pick(ib, ic))
    # A and C end at e and e + f in the first triangle, at e + f and f in the second.
    return torch.stack((pick(p + q, p), pick(q, p + q))), _zero_out_of_range(2.0 * (one + two))


def _rectangle(a: Tensor, e: Tensor, f: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Sample the rectangle with corner ``a`` and edges ``e``, ``f``, as seen from the origin; notation of Urena et al.

    Coordinates along the edges run from ``x0, y0`` to ``x1, y1``, and ``z`` is the distance of the plane.
    """
    wide, high = dot(e, e).sqrt(), dot(f, f).sqrt()
    ie, jf = _reciprocal(wide), _reciprocal(high)
    x0, y0, z = dot(a, e) * ie, dot(a, f) * jf, dot(a, cross(e, f)).abs() * ie * jf
    x1, y1 = x0 + wide, y0 + high
    # Normalize lengths, as eight of them are multiplied below.
    extent = torch.maximum(torch.maximum(x0.abs(), x1.abs()), torch.maximum(y0.abs(), y1.abs()))
    unit = _reciprocal(torch.maximum(extent, z))
    x0, x1, y0, y1, z = (w * unit for w in (x0, x1, y0, y1, z))
    zz = z * z

    def corner(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return a complex number whose argument is the solid angle of the quadrant to ``(x, y)``: tan F = x y / (z r)."""
        return z * (x * x + y * y + zz).sqrt(), x * y

    def less(p: tuple[Tensor, Tensor], q: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Return a complex number whose argument is that of ``p`` less that of ``q``: ``p`` times the conjugate of ``q``."""
        return p[0] * q[0] + p[1] * q[1], p[1] * q[0] - p[0] * q[1]

    begin, end = less(corner(x0, y1), corner(x0, y0)), less(corner(x1, y1), corner(x1, y0))
    angle = azimuth(*less(end, begin))
    h = ((y0 * y0 + zz) * (y1 * y1 + zz)).sqrt()
    scale = _reciprocal((x0 * x0 + zz) * h)
    # The solid angle left of x is T = F(x, y1) - F(x, y0) = T0 + u S.
    c, s = torch.cos(angle * u[0]), torch.sin(angle * u[0])
    cos_t, sin_t = (c * begin[0] - s * begin[1]) * scale, (s * begin[0] + c * begin[1]) * scale
    p = h * cos_t - y0 * y1
    x = z * h * sin_t * _reciprocal(((p - zz) * (p + zz)).clamp_min(0.0).sqrt())
    x = torch.minimum(torch.maximum(x, x0), x1)
    dd = x * x + zz
    h0, h1 = y0 * _reciprocal((dd + y0 * y0).sqrt()), y1 * _reciprocal((dd + y1 * y1).sqrt())
    g = h0 + u[1] * (h1 - h0)
    y = g * dd.sqrt() * _reciprocal(((1.0 - g) * (1.0 + g)).clamp_min(0.0).sqrt())
    y = torch.minimum(torch.maximum(y, y0), y1)
    return torch.stack(((x - x0) * _reciprocal(x1 - x0), (y - y0) * _reciprocal(y1 - y0))), _zero_out_of_range(angle)
