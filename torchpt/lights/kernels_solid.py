"""Directions on planar lights, uniform by solid angle, as CPU kernels (numba); :mod:`torchpt.lights.solid_angle` says how.

All arithmetic is float64, and the loops are free of library calls, so that they become vector code: one lane takes some
tens of nanoseconds. No operation is reordered or contracted: a lane's bits owe nothing to its place.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchpt.lights.solid_angle import LEAST, MOST, OPPOSITE, OTHER, RECTANGLE, TRIANGLE
from torchpt.math.angles import SERIES
from torchpt.native.jit import jit, launch
from torchpt.native.threads import thread_count

__all__ = ["BLOCK", "angles", "sample"]

#: Lanes a thread takes at once. The loops over them have this constant trip count, and a flat work table with constant
#: offsets needs no alias checks: both are what makes them vector code.
BLOCK = 128
_AX, _AY, _AZ, _EX, _EY, _EZ, _FX, _FY, _FZ, _U, _V, _ANGLE = range(0, 12 * BLOCK, BLOCK)
_TINY = 1e-300
_NO_ROW = np.empty(0, np.int64)
_NO_DRAW = {torch.float32: np.empty((2, 0), np.float32), torch.float64: np.empty((2, 0), np.float64)}
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7 = SERIES


@jit(forceinline=True)
def _azimuth(x: Any, y: Any) -> Any:
    """The angle from +x to ``(x, y)`` in ``[0, 2 pi)``, as :func:`torchpt.math.angles.azimuth`."""
    a, b = abs(x), abs(y)
    steep = b > a
    low, high = (a, b) if steep else (b, a)
    upper = low > (math.sqrt(2.0) - 1.0) * high
    over = low - high if upper else low
    under = low + high if upper else high
    ratio = over / (under if under > 0.0 else 1.0)
    s = ratio * ratio
    angle = ratio * (((((((_S7 * s + _S6) * s + _S5) * s + _S4) * s + _S3) * s + _S2) * s + _S1) * s + _S0)
    angle = angle + (0.25 * math.pi if upper else 0.0)
    angle = 0.5 * math.pi - angle if steep else angle
    angle = math.pi - angle if x < 0.0 else angle
    return 2.0 * math.pi - angle if y < 0.0 else angle


@jit(forceinline=True)
def _cos_sin(angle: Any) -> Any:
    """Cosine and sine of an angle in ``[0, pi]``: Taylor's series about the middle, to rounding."""
    y = angle - 0.5 * math.pi
    s = y * y
    c = 1.0 - s * (1.0 / 342.0)
    c = 1.0 - s * (1.0 / 272.0) * c
    c = 1.0 - s * (1.0 / 210.0) * c
    c = 1.0 - s * (1.0 / 156.0) * c
    c = 1.0 - s * (1.0 / 110.0) * c
    c = 1.0 - s * (1.0 / 72.0) * c
    c = 1.0 - s * (1.0 / 42.0) * c
    c = 1.0 - s * (1.0 / 20.0) * c
    c = 1.0 - s * (1.0 / 6.0) * c
    d = 1.0 - s * (1.0 / 380.0)
    d = 1.0 - s * (1.0 / 306.0) * d
    d = 1.0 - s * (1.0 / 240.0) * d
    d = 1.0 - s * (1.0 / 182.0) * d
    d = 1.0 - s * (1.0 / 132.0) * d
    d = 1.0 - s * (1.0 / 90.0) * d
    d = 1.0 - s * (1.0 / 56.0) * d
    d = 1.0 - s * (1.0 / 30.0) * d
    d = 1.0 - s * (1.0 / 12.0) * d
    d = 1.0 - s * (1.0 / 2.0) * d
    return -(y * c), d


@jit(forceinline=True)
def _dot(ax: Any, ay: Any, az: Any, bx: Any, by: Any, bz: Any) -> Any:
    return ax * bx + ay * by + az * bz


@jit(forceinline=True)
def _reciprocal(x: Any) -> Any:
    return 1.0 / (x if x > _TINY else _TINY)


@jit(forceinline=True)
def _corner(ax: Any, ay: Any, az: Any) -> Any:
    """One over the length."""
    return _reciprocal(math.sqrt(_dot(ax, ay, az, ax, ay, az)))


@jit(forceinline=True)
def _excess(volume: Any, ab: Any, bc: Any, ca: Any) -> Any:
    """Half the solid angle of three unit vectors (van Oosterom and Strackee, 1983); NaN where it is rounding only."""
    half = _azimuth(1.0 + ab + bc + ca, volume)
    half = half if half <= math.pi else 0.0
    return half if 1.0 + min(min(ab, bc), ca) >= OPPOSITE else math.nan


@jit(forceinline=True)
def _within(angle: Any) -> Any:
    return angle if (angle >= LEAST) & (angle <= MOST) else 0.0


@jit(forceinline=True)
def _arc(half: Any, volume: Any, ab: Any, bc: Any, ca: Any, u: Any, v: Any) -> Any:
    """Weights of the unit vectors A, B, C in a direction of their triangle: Arvo's map, without its angles."""
    c, s = _cos_sin(half * u)
    # C' on the arc from A to C cuts off the share u: along x A + y C, reflected.
    x, y = volume * c - (bc + ca) * s, (1.0 + ab) * s
    k = 2.0 * (x + y * ca) * _reciprocal(x * x + y * y + 2.0 * x * y * ca)
    p, q = k * x - 1.0, k * y
    # On the arc from B to C', with 1 - cos linear in v.
    far = p * ab + q * bc
    near = 1.0 - v * (1.0 - far)
    t = math.sqrt(abs(v * (1.0 + near) * _reciprocal(1.0 + far)))
    return t * p, near - t * far, t * q


@jit(forceinline=True)
def _share(a: Any, b: Any, c: Any, ia: Any, ib: Any, ic: Any) -> Any:
    """Barycentric shares of A and C in the plane, from weights of unit vectors and one over their lengths."""
    a, b, c = max(a, 0.0) * ia, max(b, 0.0) * ib, max(c, 0.0) * ic
    scale = _reciprocal(a + b + c)
    return a * scale, c * scale


@jit(forceinline=True)
def _angle_of_triangle(w: Any, i: int) -> Any:
    """Half the solid angle; the corners' cosines ``AB BC CA`` and one over the distances of ``A B C``, and the volume.

    B, the hub of the map, is the corner ``p0``; A is the end of ``e1``, C that of ``e2``.
    """
    bx, by, bz = w[_AX + i], w[_AY + i], w[_AZ + i]
    ex, ey, ez, fx, fy, fz = w[_EX + i], w[_EY + i], w[_EZ + i], w[_FX + i], w[_FY + i], w[_FZ + i]
    ax, ay, az, cx, cy, cz = bx + ex, by + ey, bz + ez, bx + fx, by + fy, bz + fz
    ia, ib, ic = _corner(ax, ay, az), _corner(bx, by, bz), _corner(cx, cy, cz)
    volume = abs(_dot(bx, by, bz, ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx)) * (ia * ib) * ic
    ab = _dot(ax, ay, az, bx, by, bz) * ia * ib
    bc = _dot(bx, by, bz, cx, cy, cz) * ib * ic
    ca = _dot(cx, cy, cz, ax, ay, az) * ic * ia
    return _excess(volume, ab, bc, ca), ab, bc, ca, ia, ib, ic, volume


@jit()
def _triangle_angles(w: Any) -> None:
    for i in range(BLOCK):
        half, _, _, _, _, _, _, _ = _angle_of_triangle(w, i)
        w[_ANGLE + i] = _within(2.0 * half)


@jit()
def _triangle(w: Any) -> None:
    for i in range(BLOCK):
        half, ab, bc, ca, ia, ib, ic, volume = _angle_of_triangle(w, i)
        u, v = w[_U + i], w[_V + i]
        p, hub, q = _arc(half, volume, ab, bc, ca, u, v)
        p, q = _share(p, hub, q, ia, ib, ic)
        w[_U + i], w[_V + i], w[_ANGLE + i] = p, q, _within(2.0 * half)


@jit(forceinline=True)
def _angle_of_rectangle(w: Any, i: int) -> Any:
    """The solid angle; the frame's ``x0 x1 y0 y1 z``, and the cosine and sine of the share left of ``x0``."""
    ax, ay, az = w[_AX + i], w[_AY + i], w[_AZ + i]
    ex, ey, ez, fx, fy, fz = w[_EX + i], w[_EY + i], w[_EZ + i], w[_FX + i], w[_FY + i], w[_FZ + i]
    ee, ff = _dot(ex, ey, ez, ex, ey, ez), _dot(fx, fy, fz, fx, fy, fz)
    wide, high = math.sqrt(ee), math.sqrt(ff)
    ie, jf = _reciprocal(wide), _reciprocal(high)
    x0, y0 = _dot(ax, ay, az, ex, ey, ez) * ie, _dot(ax, ay, az, fx, fy, fz) * jf
    z = abs(_dot(ax, ay, az, ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx)) * ie * jf
    x1, y1 = x0 + wide, y0 + high
    # The unit of length: eight of them are multiplied below.
    unit = _reciprocal(max(max(max(abs(x0), abs(x1)), max(abs(y0), abs(y1))), z))
    x0, x1, y0, y1, z = x0 * unit, x1 * unit, y0 * unit, y1 * unit, z * unit
    zz = z * z
    # tan F(x, y) = x y / (z r): the corners' complex numbers turn by F, products of them by sums.
    r00, r01 = z * math.sqrt(x0 * x0 + y0 * y0 + zz), z * math.sqrt(x0 * x0 + y1 * y1 + zz)
    r10, r11 = z * math.sqrt(x1 * x1 + y0 * y0 + zz), z * math.sqrt(x1 * x1 + y1 * y1 + zz)
    i00, i01, i10, i11 = x0 * y0, x0 * y1, x1 * y0, x1 * y1
    c0, s0 = r01 * r00 + i01 * i00, i01 * r00 - r01 * i00
    c1, s1 = r11 * r10 + i11 * i10, i11 * r10 - r11 * i10
    angle = _azimuth(c1 * c0 + s1 * s0, s1 * c0 - c1 * s0)
    return angle, x0, x1, y0, y1, z, c0, s0


@jit()
def _rectangle_angles(w: Any) -> None:
    for i in range(BLOCK):
        angle, _, _, _, _, _, _, _ = _angle_of_rectangle(w, i)
        w[_ANGLE + i] = _within(angle)


@jit()
def _rectangle(w: Any) -> None:
    for i in range(BLOCK):
        angle, x0, x1, y0, y1, z, c0, s0 = _angle_of_rectangle(w, i)
        u, v = w[_U + i], w[_V + i]
        zz = z * z
        h = math.sqrt((y0 * y0 + zz) * (y1 * y1 + zz))
        scale = _reciprocal((x0 * x0 + zz) * h)
        c0, s0 = c0 * scale, s0 * scale
        # The share left of x is T = F(x, y1) - F(x, y0) = T0 + u S.
        c, s = _cos_sin(0.5 * angle * u)
        c, s = c * c - s * s, 2.0 * s * c
        c, s = c * c0 - s * s0, s * c0 + c * s0
        p = h * c - y0 * y1
        x = z * h * s * _reciprocal(math.sqrt(max((p - zz) * (p + zz), 0.0)))
        x = min(max(x, x0), x1)
        dd = x * x + zz
        h0, h1 = y0 * _reciprocal(math.sqrt(dd + y0 * y0)), y1 * _reciprocal(math.sqrt(dd + y1 * y1))
        g = h0 + v * (h1 - h0)
        y = g * math.sqrt(dd) * _reciprocal(math.sqrt(max((1.0 - g) * (1.0 + g), 0.0)))
        y = min(max(y, y0), y1)
        w[_U + i], w[_V + i] = (x - x0) * _reciprocal(x1 - x0), (y - y0) * _reciprocal(y1 - y0)
        w[_ANGLE + i] = _within(angle)


@jit(forceinline=True)
def _angles_of_skew(w: Any, i: int) -> Any:
    """The halves' half solid angles, and what :func:`_arc` and :func:`_share` need of both: they share the hub ``p0``."""
    px, py, pz = w[_AX + i], w[_AY + i], w[_AZ + i]
    ex, ey, ez, fx, fy, fz = w[_EX + i], w[_EY + i], w[_EZ + i], w[_FX + i], w[_FY + i], w[_FZ + i]
    ax, ay, az, cx, cy, cz = px + ex, py + ey, pz + ez, px + fx, py + fy, pz + fz
    bx, by, bz = ax + fx, ay + fy, az + fz
    ip, ia, ib, ic = _corner(px, py, pz), _corner(ax, ay, az), _corner(bx, by, bz), _corner(cx, cy, cz)
    volume = abs(_dot(px, py, pz, ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx)) * ip
    pa = _dot(px, py, pz, ax, ay, az) * ip * ia
    pb = _dot(px, py, pz, bx, by, bz) * ip * ib
    pc = _dot(px, py, pz, cx, cy, cz) * ip * ic
    ab = _dot(ax, ay, az, bx, by, bz) * ia * ib
    bc = _dot(bx, by, bz, cx, cy, cz) * ib * ic
    first, second = volume * ia * ib, volume * ib * ic
    return _excess(first, pa, pb, ab), _excess(second, pb, pc, bc), pa, pb, pc, ab, bc, ip, ia, ib, ic, first, second


@jit()
def _skew_angles(w: Any) -> None:
    for i in range(BLOCK):
        a, b, _, _, _, _, _, _, _, _, _, _, _ = _angles_of_skew(w, i)
        w[_ANGLE + i] = _within(2.0 * (a + b))


@jit()
def _skew(w: Any) -> None:
    for i in range(BLOCK):
        ha, hb, pa, pb, pc, ab, bc, ip, ia, ib, ic, first, second = _angles_of_skew(w, i)
        u, v = w[_U + i], w[_V + i]
        at = u * (ha + hb)
        left = at < ha
        half = ha if left else hb
        inner = (at if left else at - ha) * _reciprocal(half)
        inner = min(inner, 1.0)
        p, hub, q = _arc(
            half, first if left else second, pa if left else pb, pb if left else pc, ab if left else bc, inner, v
        )
        p, q = _share(p, hub, q, ia if left else ib, ip, ib if left else ic)
        # Of the first half A and C are the ends of e1 and of e1 + e2, of the second those of e1 + e2 and of e2.
        w[_U + i], w[_V + i] = (p + q, q) if left else (p, p + q)
        w[_ANGLE + i] = _within(2.0 * (ha + hb))


@jit(forceinline=True)
def _near(table: Any, k: int, x: Any, y: Any, z: Any) -> bool:
    a, b, c = table[k, 2] - x, table[k, 3] - y, table[k, 4] - z
    return a * a + b * b + c * c < table[k, 1]


@jit()
def _load(table: Any, row: Any, x: Any, lane: Any, n: int, w: Any) -> None:
    """Gathers lanes into the work table."""
    for i in range(n):
        j = lane[i]
        k = row[j] if len(row) > 0 else 0
        w[_AX + i] = table[k, 5] - x[0, j]
        w[_AY + i] = table[k, 6] - x[1, j]
        w[_AZ + i] = table[k, 7] - x[2, j]
        w[_EX + i], w[_EY + i], w[_EZ + i] = table[k, 8], table[k, 9], table[k, 10]
        w[_FX + i], w[_FY + i], w[_FZ + i] = table[k, 11], table[k, 12], table[k, 13]


@jit()
def _sort(block: int, table: Any, row: Any, x: Any, lanes: Any, counts: Any) -> None:
    """Lists a block's lanes by shape, those near their light."""
    counts[:] = 0
    for j in range(block * BLOCK, min((block + 1) * BLOCK, x.shape[1])):
        k = row[j] if len(row) > 0 else 0
        if _near(table, k, x[0, j], x[1, j], x[2, j]):
            shape = np.int64(table[k, 0])
            lanes[shape, counts[shape]] = j
            counts[shape] += 1


@jit()
def _range(begin: int, end: int, table: Any, row: Any, x: Any, u: Any, uv: Any, angle: Any) -> None:
    w, lanes, counts = np.zeros(_ANGLE + BLOCK), np.empty((OTHER, BLOCK), np.int64), np.empty(OTHER, np.int64)
    drawn = u.shape[1] > 0
    for block in range(begin, end):
        if drawn:
            # By area: of triangles Heitz, A Low-Distortion Map Between Triangle and Square, 2019.
            for j in range(block * BLOCK, min((block + 1) * BLOCK, x.shape[1])):
                k = row[j] if len(row) > 0 else 0
                low = min(u[0, j], u[1, j]) * u.dtype.type(0.5 if table[k, 0] == TRIANGLE else 0.0)
                uv[0, j], uv[1, j] = u[0, j] - low, u[1, j] - low
        _sort(block, table, row, x, lanes, counts)
        for shape in range(OTHER):
            n, lane = counts[shape], lanes[shape]
            if n == 0:
                continue
            _load(table, row, x, lane, n, w)
            if drawn:
                for i in range(n):
                    w[_U + i], w[_V + i] = u[0, lane[i]], u[1, lane[i]]
                if shape == TRIANGLE:
                    _triangle(w)
                elif shape == RECTANGLE:
                    _rectangle(w)
                else:
                    _skew(w)
                for i in range(n):
                    if w[_ANGLE + i] > 0.0:
                        uv[0, lane[i]], uv[1, lane[i]] = w[_U + i], w[_V + i]
            elif shape == TRIANGLE:
                _triangle_angles(w)
            elif shape == RECTANGLE:
                _rectangle_angles(w)
            else:
                _skew_angles(w)
            for i in range(n):
                angle[lane[i]] = w[_ANGLE + i]


@jit()
def _serial(first: int, last: int, table: Any, row: Any, x: Any, u: Any, uv: Any, angle: Any) -> None:
    _range(first, last, table, row, x, u, uv, angle)


@jit(parallel=True)
def _parallel(chunks: int, items: int, table: Any, row: Any, x: Any, u: Any, uv: Any, angle: Any) -> None:
    for chunk in nb.prange(chunks):
        _range(items * chunk // chunks, items * (chunk + 1) // chunks, table, row, x, u, uv, angle)


def _run(table: Tensor, row: Tensor | None, x: Tensor, u: Any, uv: Any, angle: Tensor) -> None:
    n = x.shape[1]
    if n:
        index = _NO_ROW if row is None else row.contiguous().numpy()
        arguments = (table.contiguous().numpy(), index, x.detach().contiguous().numpy(), u, uv, angle.numpy())
        launch(_serial, _parallel, -(-n // BLOCK), thread_count(None), 32, arguments)


def sample(table: Tensor, row: Tensor | None, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`torchpt.lights.solid_angle.sample`, on the CPU."""
    u = u.detach().contiguous()
    uv, angle = torch.empty_like(u), torch.zeros_like(x[0], memory_format=torch.contiguous_format)
    _run(table, row, x, u.numpy(), uv.numpy(), angle)
    return uv, angle


def angles(table: Tensor, row: Tensor | None, x: Tensor) -> Tensor:
    """As :func:`torchpt.lights.solid_angle.angles`, on the CPU."""
    angle, nothing = torch.zeros_like(x[0], memory_format=torch.contiguous_format), _NO_DRAW[x.dtype]
    _run(table, row, x, nothing, nothing, angle)
    return angle
