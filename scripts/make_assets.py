"""Make the meshes in `scenes/`: `python scripts/make_assets.py` writes them again, byte for byte.

- `standin.ply` replaces the Stanford bunny: a smooth closed figure (an icosphere pushed out along its own
  directions: body, head, two ears, tail, feet) with the bunny's bounding box, pose and no vertex normals.
- `statue.ply`: a draped figure on a plinth that holds up a sphere, of height 1 from y = 0, facing +z; closed.
- `cup.ply`: a cup with a handle, of height 1 from y = 0; two closed pieces.
- `pot.ply` replaces the Utah teapot: of its size and pose (z up, spout toward +x); four closed pieces.
- `curved_wall.ply`: an upright sheet along an arc of radius 1 about the y axis, of height 1, facing the axis.
- `toy_duck.glb`: a bath duck with a painted texture, facing +x, with the bounding box of Khronos' sample duck; closed.
"""

from __future__ import annotations

import argparse
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SCENES = Path(__file__).resolve().parents[1] / "scenes"
BUNNY_BOX = ((-0.0946899, 0.0329874, -0.0618736), (0.0610091, 0.187321, 0.0587997))

# direction of a lobe, how far it reaches, how narrow it is
LOBES = (
    ((-0.55, 0.75, 0.05), 0.75, 9.0),  # head
    ((-0.30, 1.00, 0.16), 0.95, 60.0),  # ears
    ((-0.30, 1.00, -0.16), 0.95, 60.0),
    ((1.00, -0.30, 0.00), 0.30, 30.0),  # tail
    ((-0.80, -0.75, 0.35), 0.35, 25.0),  # feet
    ((-0.80, -0.75, -0.35), 0.35, 25.0),
    ((0.45, -0.80, 0.45), 0.30, 12.0),
    ((0.45, -0.80, -0.45), 0.30, 12.0),
)


def icosphere(levels: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return unit directions ``(V, 3)`` and triangles ``(20 * 4^levels, 3)``, counter-clockwise from outside."""
    golden = (1.0 + 5.0**0.5) / 2.0
    corners = [(0.0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    points = np.array(corners + [(y, z, x) for x, y, z in corners] + [(z, x, y) for x, y, z in corners])
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    faces = np.array([t for t in triples if all(_near(points[t[a]], points[t[a - 1]]) for a in range(3))])
    inward = np.einsum("ij,ij->i", _cross(points, faces), points[faces[:, 0]]) < 0
    faces[inward] = faces[inward][:, ::-1]
    points /= np.linalg.norm(points, axis=1)[:, None]
    for _ in range(levels):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = points[unique].sum(axis=1)
        middle /= np.linalg.norm(middle, axis=1)[:, None]
        ab, bc, ca = (index.reshape(-1, 3) + len(points)).T
        points = np.concatenate([points, middle])
        a, b, c = faces.T
        faces = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1).reshape(-1, 3)
    return points, faces


def _near(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    return bool(np.linalg.norm(a - b) < 2.1)  # the edge of the icosahedron is 2


def _cross(points: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    a, b, c = points[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def standin() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return vertices ``(10242, 3)`` and triangles ``(20480, 3)`` of the stand-in."""
    directions, faces = icosphere(5)
    radius = np.ones(len(directions))
    for axis, reach, narrow in LOBES:
        axis = np.array(axis) / np.linalg.norm(axis)
        radius += reach * np.exp(narrow * (directions @ axis - 1.0))
    points = directions * radius[:, None] * (1.0, 0.95, 0.8)
    floor = -0.85  # a soft plane to stand on
    points[:, 1] = floor + np.logaddexp(0.0, 12.0 * (points[:, 1] - floor)) / 12.0
    low, high = points.min(axis=0), points.max(axis=0)
    box_low, box_high = np.array(BUNNY_BOX)
    return (box_low + (points - low) / (high - low) * (box_high - box_low)).astype("<f4"), faces.astype("<i4")


def surface_nets(
    field: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    step: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Where ``field((..., 3))`` is zero, closed where it is positive on the border; normals toward the positive side.

    One vertex for each cell that the surface crosses, at the mean of the crossings of its edges (Gibson, *Constrained
    Elastic Surface Nets*, 1998), then moved onto the surface by Newton's steps.

    Args:
        field: negative inside.
        low: corner of the grid.
        high: the opposite one.
        step: size of a cell.
    """
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    value = field(grid)
    cells = [n - 1 for n in value.shape]
    total, count, quads = np.zeros((*cells, 3)), np.zeros(cells), []
    index = np.arange(count.size).reshape(cells)
    for axis in range(3):
        start, end = (np.take(value, range(k, k + cells[axis]), axis) for k in (0, 1))
        crossed = (start < 0) != (end < 0)
        point = np.take(grid, range(cells[axis]), axis)
        point[..., axis] += step * np.where(crossed, start / np.where(crossed, start - end, 1.0), 0.0)
        edges = np.argwhere(crossed)
        edges = edges[[all(0 < e[a] < cells[a] for a in range(3) if a != axis) for e in edges]]
        ring = []  # the four cells about an edge, counter-clockwise as seen from its end
        for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)):
            offset = [0, 0, 0]
            offset[(axis + 1) % 3], offset[(axis + 2) % 3] = i, j
            part = tuple(slice(o, o + n) for o, n in zip(offset, cells, strict=True))
            total += np.where(crossed[part][..., None], point[part], 0.0)
            count += crossed[part]
            ring.append(index[tuple((edges - offset).T)])
        quad = np.stack(ring, axis=1)
        quads.append(np.where((start[tuple(edges.T)] < 0)[:, None], quad, quad[:, ::-1]))
    used = count.reshape(-1) > 0
    points = total.reshape(-1, 3)[used] / count.reshape(-1)[used][:, None]
    quad = (np.cumsum(used) - 1)[np.concatenate(quads)]
    for _ in range(4):
        points -= np.clip(_newton(field, points, 1e-3 * step), -0.25 * step, 0.25 * step)
    a, b, c, d = (points[quad[:, k]] for k in range(4))
    short = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1)  # cut along the shorter diagonal
    first = np.where(short[:, None], quad[:, [0, 1, 2]], quad[:, [1, 2, 3]])
    second = np.where(short[:, None], quad[:, [0, 2, 3]], quad[:, [1, 3, 0]])
    return points, np.concatenate([first, second])


def _newton(
    field: Callable[[NDArray[np.float64]], NDArray[np.float64]], points: NDArray[np.float64], step: float
) -> NDArray[np.float64]:
    """Return the Newton correction to subtract from points ``(V, 3)`` near the zero of a field, along its gradient."""
    gradient = np.stack([field(points + e) - field(points - e) for e in step * np.eye(3)], axis=-1) / (2.0 * step)
    return field(points)[:, None] * gradient / np.maximum((gradient**2).sum(axis=-1, keepdims=True), 1e-6)


def curve(keys: tuple[tuple[float, float], ...], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a smooth curve through ``(x, y)`` keys: Catmull-Rom cubics, constant beyond the ends."""
    at, value = np.array(keys).T
    slope = np.gradient(value, at)
    k = np.clip(np.searchsorted(at, x) - 1, 0, len(at) - 2)
    width = at[k + 1] - at[k]
    t = np.clip((x - at[k]) / width, 0.0, 1.0)
    left = value[k] * (1 + 2 * t) + width * slope[k] * t
    right = value[k + 1] * (3 - 2 * t) - width * slope[k + 1] * (1 - t)
    return (1 - t) ** 2 * left + t**2 * right


def _join(a: NDArray[np.float64], b: NDArray[np.float64], soft: float) -> NDArray[np.float64]:
    """Return the union of two fields with a fillet of about ``soft``."""
    return np.minimum(a, b) - np.maximum(soft - np.abs(a - b), 0.0) ** 2 / (4.0 * soft)


def _ball(p: NDArray[np.float64], centre: tuple[float, ...], radii: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the approximate distance from an ellipsoid."""
    return (np.linalg.norm((p - centre) / radii, axis=-1) - 1.0) * min(radii)


def _limb(
    p: NDArray[np.float64], a: tuple[float, ...], b: tuple[float, ...], thick: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the distance from a rod of changing thickness."""
    start, along = np.array(a), np.array(b) - np.array(a)
    t = np.clip((p - start) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(p - start - t[..., None] * along, axis=-1) - (thick[0] + (thick[1] - thick[0]) * t)


# Height against half width, half depth, sideways and forward sway of the robe, and depth of its folds.
WIDTH = (
    (0.07, 0.125), (0.2, 0.112), (0.38, 0.1), (0.5, 0.098), (0.6, 0.072), (0.7, 0.082), (0.77, 0.088), (0.81, 0.05),
    (0.84, 0.02),
)  # fmt: skip
DEPTH = (
    (0.07, 0.115), (0.2, 0.098), (0.38, 0.082), (0.5, 0.075), (0.6, 0.056), (0.7, 0.064), (0.77, 0.05), (0.81, 0.035),
    (0.84, 0.02),
)  # fmt: skip
SWAY = ((0.07, -0.005), (0.3, 0.0), (0.5, 0.022), (0.64, 0.006), (0.8, -0.008))
LEAN = ((0.07, 0.01), (0.34, 0.016), (0.5, 0.0), (0.7, 0.008), (0.82, -0.006))
FOLD = ((0.07, 0.13), (0.25, 0.11), (0.45, 0.06), (0.56, 0.035), (0.6, 0.03), (0.66, 0.045), (0.8, 0.03))
# Rods of the limbs: both ends and both thicknesses.
LEG = (
    ((-0.035, 0.47, 0.03), (-0.042, 0.29, 0.075), (0.05, 0.042)),
    ((-0.042, 0.29, 0.075), (-0.05, 0.1, 0.06), (0.042, 0.05)),
)
SHOULDERS = (
    ((-0.08, 0.795, -0.004), (0.0, 0.815, -0.008), (0.032, 0.036)),
    ((0.0, 0.815, -0.008), (0.078, 0.81, -0.004), (0.036, 0.032)),
)
HANGING = (
    ((-0.105, 0.785, -0.004), (-0.15, 0.665, -0.02), (0.03, 0.023)),
    ((-0.15, 0.665, -0.02), (-0.108, 0.56, 0.045), (0.023, 0.016)),
)
LIFTED = (
    ((0.1, 0.805, -0.002), (0.175, 0.845, 0.02), (0.03, 0.024)),
    ((0.175, 0.845, 0.02), (0.185, 0.935, 0.035), (0.024, 0.015)),
)


def figure(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate the statue's field at ``(..., 3)``: a robed figure with one arm raised, height 1 with plinth and sphere."""
    body = _join(_robe(p), _rods(p, SHOULDERS, 0.02), 0.035)
    # One arm hangs and gathers the robe at the hip, the other lifts a sphere.
    body = _join(
        body, _join(_rods(p, HANGING, 0.015), _ball(p, (-0.1, 0.545, 0.052), (0.022, 0.026, 0.02)), 0.015), 0.018
    )
    body = _join(
        body, _join(_rods(p, LIFTED, 0.015), _ball(p, (0.185, 0.947, 0.037), (0.024, 0.014, 0.022)), 0.012), 0.02
    )
    body = _join(body, _ball(p, (0.185, 0.972, 0.037), (0.028, 0.028, 0.028)), 0.004)
    body = _join(body, _limb(p, (-0.004, 0.815, -0.008), (0.002, 0.875, 0.002), (0.03, 0.024)), 0.022)
    body = _join(body, _head(p), 0.012)
    drum = _disc(p, 0.145, 0.035, 0.03)  # the plinth and its moulding
    return _join(_join(body, drum, 0.012), _disc(p, 0.16, 0.0125, 0.0075), 0.004)


def _rods(
    p: NDArray[np.float64],
    rods: tuple[tuple[tuple[float, ...], tuple[float, ...], tuple[float, float]], ...],
    soft: float,
) -> NDArray[np.float64]:
    """Return the field of two rods that meet."""
    return _join(_limb(p, *rods[0]), _limb(p, *rods[1]), soft)


def _disc(p: NDArray[np.float64], radius: float, height: float, half: float) -> NDArray[np.float64]:
    """Return the field of an upright drum about the y axis with rounded edges."""
    flat = np.hypot(p[..., 0], p[..., 2])
    return np.hypot(np.maximum(flat - radius, 0.0), np.maximum(np.abs(p[..., 1] - height) - half, 0.0)) - 0.005


def _robe(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the field of the robe: cloth about a swaying column of elliptical section, with slanting folds."""
    x, y, z = np.moveaxis(p, -1, 0)
    wide, deep = curve(WIDTH, y), curve(DEPTH, y)
    side, front = (x - curve(SWAY, y)) / wide, (z - curve(LEAN, y)) / deep
    thin = np.minimum(wide, deep)
    angle, reach = np.arctan2(front, side), np.hypot(side, front)
    drift = 1.5 * np.sin(3.0 * y + 1.0) + 0.5 * np.sin(angle * 2.0 + 9.0 * y)
    fold = np.tanh(1.6 * (np.sin(11.0 * angle + 3.0 * drift) + 0.5 * np.sin(19.0 * angle - 4.0 * drift + 1.0)) + 0.5)
    robe = (reach / (1.0 + curve(FOLD, y) * fold) - 1.0) * thin
    robe = np.maximum(robe, np.maximum(y - 0.85, 0.03 - y))
    for rod in LEG:  # the near leg bends: its knee and shin push the cloth out
        robe = _join(robe, _limb(p, *rod), 0.05)
    # A girdle, and the overfold of cloth that hangs from it.
    girdle = np.sqrt(0.004 * (reach - 1.02) ** 2 + (y - 0.6 - 0.01 * np.sin(angle)) ** 2) - 0.008
    robe = _join(robe, girdle, 0.012)
    hem = 0.50 + 0.018 * np.sin(2.0 * angle + 0.6) + 0.008 * np.sin(11.0 * angle)
    band = np.abs(y - 0.5 * (hem + 0.6)) - 0.5 * (0.6 - hem)
    robe = _join(robe, np.maximum((reach / (1.1 + 0.05 * fold) - 1.0) * thin, band), 0.018)
    radii = (0.035, 0.035, 0.033)
    return _join(
        robe, _join(_ball(p, (-0.042, 0.735, 0.048), radii), _ball(p, (0.034, 0.74, 0.048), radii), 0.03), 0.04
    )


def _head(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the field of skull, jaw, nose, brow, mouth, and hair in a knot, turned toward the sphere."""
    x, y, z = np.moveaxis(p - (0.004, 0.925, 0.008), -1, 0)
    cos, sin = np.cos(0.45), np.sin(0.45)
    head = np.stack([cos * x - sin * z, y, sin * x + cos * z], axis=-1)
    skull = _ball(head, (0.0, 0.012, -0.004), (0.039, 0.043, 0.047))
    skull = _join(skull, _ball(head, (0.0, -0.025, 0.014), (0.027, 0.032, 0.029)), 0.02)
    skull = _join(skull, _limb(head, (0.0, 0.004, 0.042), (0.0, -0.014, 0.051), (0.004, 0.006)), 0.008)
    skull = _join(skull, _limb(head, (-0.02, 0.009, 0.037), (0.02, 0.009, 0.037), (0.005, 0.005)), 0.01)
    skull = _join(skull, _ball(head, (0.0, -0.033, 0.04), (0.011, 0.004, 0.006)), 0.006)
    wave = 0.0035 * np.sin(70.0 * y + 30.0 * np.abs(head[..., 0]))
    hair = _ball(head, (0.0, 0.014, -0.01), (0.046, 0.048, 0.052)) + wave
    hair = np.maximum(hair, 0.55 * head[..., 2] - y + 0.002)
    hair = _join(hair, _ball(head, (0.0, 0.0, -0.062), (0.024, 0.022, 0.022)) + wave, 0.012)
    return _join(skull, hair, 0.006)


def statue() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return vertices and triangles of the statue."""
    points, faces = surface_nets(figure, np.array([-0.21, -0.02, -0.18]), np.array([0.24, 1.02, 0.18]), 0.0074)
    points[:, 1] -= points[:, 1].min()
    return (points / points[:, 1].max()).astype("<f4"), faces.astype("<i4")


def _grid(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the triangles of a grid of vertices; seen from outside, rows go to the right of columns."""
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def lathe(outline: NDArray[np.float64], segments: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a closed solid of revolution about y; ``outline (K, 2)`` (radius, height) is counter-clockwise."""
    angle = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)[:, None]
    radius, height = outline[1:-1].T
    rings = np.stack([radius * np.sin(angle), height + 0.0 * angle, radius * np.cos(angle)], axis=-1)
    inner = len(outline) - 2
    index = np.arange(segments * inner).reshape(segments, inner)
    index = np.concatenate([index, index[:1]])
    south, north = segments * inner, segments * inner + 1
    a, b = index[:-1], index[1:]
    caps = [np.stack([np.full(segments, south), b[:, 0], a[:, 0]], -1)]
    caps += [np.stack([np.full(segments, north), a[:, -1], b[:, -1]], -1)]
    poles = [(0.0, outline[0, 1], 0.0), (0.0, outline[-1, 1], 0.0)]
    return np.concatenate([rings.reshape(-1, 3), poles]), np.concatenate([_grid(index), *caps])


def cup() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return a cup of height 1 (a solid of revolution) and its handle."""
    outline = np.array(
        [(0.0, 0.0), (0.24, 0.0), (0.3, 0.004), (0.325, 0.03), (0.37, 0.09), (0.42, 0.2), (0.445, 0.35), (0.455, 0.6),
         (0.465, 0.9), (0.472, 0.98), (0.46, 1.0), (0.445, 0.985), (0.435, 0.9), (0.425, 0.6), (0.415, 0.36),
         (0.39, 0.22), (0.34, 0.12), (0.27, 0.07), (0.15, 0.055), (0.0, 0.05)]
    )  # fmt: skip
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    at = np.sort(np.concatenate([np.linspace(0.0, length[-1], 80), length[1:-1]]))
    fine = [curve(tuple(zip(length.tolist(), column.tolist(), strict=True)), at) for column in outline.T]
    points, faces = lathe(np.stack(fine, axis=-1), 96)
    bend = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)[:, None]
    around = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    reach = 0.46 + (0.24 + 0.05 * np.cos(around)) * np.cos(bend)
    height = 0.54 + (0.27 + 0.05 * np.cos(around)) * np.sin(bend)
    depth = 0.07 * np.sin(around) + 0.0 * bend
    radius = np.hypot(reach, depth)
    reach *= np.maximum(radius, 0.44) / radius  # the half of the ring that is not outside stays within the wall
    index = np.pad(np.arange(64 * 24).reshape(64, 24), ((0, 1), (0, 1)), mode="wrap")
    ring = np.stack([reach, height, depth], axis=-1).reshape(-1, 3)
    both = np.concatenate([faces, _grid(index)[:, ::-1] + len(points)])
    return np.concatenate([points, ring]).astype("<f4"), both.astype("<i4")


def _tube(path: NDArray[np.float64], radius: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a closed tube about ``path (K, 2)`` in the plane of x and z, of ``radius (K,)``."""
    along = np.gradient(path, axis=0)
    side = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=1, keepdims=True)
    around = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    out = radius[:, None] * np.cos(around)
    rings = np.stack(
        [path[:, :1] + side[:, :1] * out, radius[:, None] * np.sin(around), path[:, 1:] + side[:, 1:] * out], axis=-1
    )
    inner = len(path)
    index = np.pad(np.arange(inner * 20).reshape(inner, 20), ((0, 0), (0, 1)), mode="wrap")
    ring = np.arange(20)
    first, last = ring, ring + (inner - 1) * 20
    caps = [
        np.stack([np.full(20, inner * 20), first, np.roll(first, -1)], -1),
        np.stack([np.full(20, inner * 20 + 1), np.roll(last, -1), last], -1),
    ]
    ends = [(path[0, 0], 0.0, path[0, 1]), (path[-1, 0], 0.0, path[-1, 1])]
    return np.concatenate([rings.reshape(-1, 3), ends]), np.concatenate([_grid(index), *caps])


def pot() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return a teapot: body and lid are solids of revolution, with a spout and a handle."""
    body = ((0.0, 0.0), (1.3, 0.0), (1.5, 0.06), (1.75, 0.3), (1.95, 0.7), (2.0, 1.05), (1.93, 1.5), (1.75, 2.0),
            (1.55, 2.35), (1.45, 2.45), (1.38, 2.4), (0.0, 2.4))  # fmt: skip
    lid = ((0.0, 2.38), (1.3, 2.38), (1.32, 2.44), (1.1, 2.55), (0.6, 2.66), (0.2, 2.74), (0.17, 2.82), (0.3, 2.94),
           (0.34, 3.02), (0.25, 3.12), (0.0, 3.15))  # fmt: skip
    spout = ((1.6, 0.8), (2.1, 0.9), (2.45, 1.25), (2.65, 1.75), (2.9, 2.15), (3.2, 2.4))
    handle = ((-1.75, 2.05), (-2.2, 2.1), (-2.65, 2.0), (-2.82, 1.65), (-2.6, 1.2), (-2.2, 0.85), (-1.85, 0.7))
    pieces = []
    for outline in (body, lid):
        points, faces = lathe(_smoothed(outline, 40), 64)
        pieces.append((points[:, [2, 0, 1]], faces))
    way = _smoothed(spout, 24)
    pieces.append(_tube(way, np.linspace(0.5, 0.2, len(way))))
    way = _smoothed(handle, 32)
    pieces.append(_tube(way, np.full(len(way), 0.18)))
    starts = np.cumsum([0, *(len(points) for points, _ in pieces)])
    joined = np.concatenate([faces + start for (_, faces), start in zip(pieces, starts[:-1], strict=True)])
    return np.concatenate([points for points, _ in pieces]).astype("<f4"), joined.astype("<i4")


def _smoothed(keys: tuple[tuple[float, float], ...], number: int) -> NDArray[np.float64]:
    """Return points ``(about number, 2)`` of a curve through ``keys``, which are among them."""
    given = np.array(keys)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(given, axis=0), axis=1))])
    at = np.unique(np.concatenate([np.linspace(0.0, length[-1], number), length]))
    columns = [curve(tuple(zip(length.tolist(), column.tolist(), strict=True)), at) for column in given.T]
    return np.stack([columns[0], columns[1].clip(min=given[:, 1].min())], axis=-1)


def curved_wall() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return a sheet of height 1 along 150 degrees of the unit circle about y, its middle toward -z, facing the axis."""
    angle = np.radians(np.linspace(-75.0, 75.0, 193))[:, None]
    height = np.linspace(0.0, 1.0, 9)
    points = np.stack([np.sin(angle) + 0.0 * height, height + 0.0 * angle, -np.cos(angle) + 0.0 * height], axis=-1)
    return points.reshape(-1, 3).astype("<f4"), _grid(np.arange(193 * 9).reshape(193, 9)).astype("<i4")


DUCK_BOX = ((-0.692985, 0.0992937, -0.613282), (0.961799, 1.6397, 0.539252))
BILL = ((0.8, 1.13, 0.0), (0.24, 0.065, 0.15))
EYE = (0.655, 1.33)


def duck_field(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Evaluate the duck's field at ``(..., 3)``, symmetric about z = 0."""
    x, y, z = np.moveaxis(p, -1, 0)
    body = _ball(p, (0.02, 0.52, 0.0), (0.66, 0.42, 0.52))
    body = _join(body, _limb(p, (-0.4, 0.6, 0.0), (-0.68, 0.93, 0.0), (0.2, 0.03)), 0.15)
    folded = np.stack([x, y, np.abs(z)], axis=-1)
    body = _join(body, _ball(folded, (-0.1, 0.58, 0.42), (0.38, 0.2, 0.16)), 0.04)  # wings
    body = _join(body, _ball(p, (0.44, 1.24, 0.0), (0.39, 0.39, 0.37)), 0.12)
    return _join(body, _ball(p, *BILL), 0.03)


def duck_paint(size: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the duck's colours seen from its side: indices ``(size, size)``, row 0 at the top, and the palette ``(K, 3)``."""
    low, high = np.array(DUCK_BOX)
    step = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(low[0] + (high[0] - low[0]) * step, high[1] - (high[1] - low[1]) * step)
    inks = np.array([(250, 200, 25), (240, 110, 15), (250, 250, 245), (20, 20, 25)])
    ink = np.zeros((size, size), dtype=np.int64)
    shade = np.clip(0.82 + 0.18 * (y - 0.1) / 0.8, 0.0, 1.0)  # the belly is darker
    (bx, by, _), (wide, tall, _) = BILL
    bill = ((x - bx) / (1.2 * wide)) ** 2 + ((y - by) / (1.6 * tall)) ** 2 < 1.0
    bill &= x > 0.78 + 0.02 * np.cos(2.0 * (y - by) / tall)
    ink[bill] = 1
    shade = np.where(bill, np.where(np.abs(y - by + 0.004) < 0.009, 0.55, 1.0), shade)  # the line between its halves
    away = np.hypot(x - EYE[0], y - EYE[1])
    ink[away < 0.085], ink[away < 0.055] = 2, 3
    shade = np.where(away < 0.085, 1.0, shade)
    ink[np.hypot(x - EYE[0] - 0.018, y - EYE[1] - 0.02) < 0.016] = 2
    # Feathers: rows of arcs on the wing.
    reach = np.hypot((x + 0.1) / 0.36, (y - 0.58) / 0.19)
    row = np.floor((x + 0.5) / 0.13)
    arc = np.hypot(((x + 0.5) / 0.13 - row) - 0.2, np.mod((y - 0.5) / 0.1 + 0.5 * np.mod(row, 2.0), 1.0) - 0.5)
    shade = np.where((ink == 0) & (reach < 0.95) & (np.abs(arc - 0.55) < 0.07), 0.72 * shade, shade)
    shade = np.where((ink == 0) & (np.abs(reach - 1.0) < 0.045), 0.72 * shade, shade)
    levels = 64
    level = np.round(shade * (levels - 1)).astype(np.int64)
    palette = np.round(inks[:, None] * (np.arange(levels) / (levels - 1))[:, None]).reshape(-1, 3)
    return (ink * levels + level).astype(np.uint8), palette.astype(np.uint8)


def png(index: NDArray[np.uint8], palette: NDArray[np.uint8]) -> bytes:
    """Encode a PNG with a palette, uncompressed so that its bytes are the same everywhere."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = index.shape
    rows = np.pad(index, ((0, 0), (1, 0))).tobytes()  # a filter byte of 0 before each row
    blocks = [rows[at : at + 65535] for at in range(0, len(rows), 65535)]
    stored = b"".join(
        struct.pack("<BHH", block is blocks[-1], len(block), len(block) ^ 0xFFFF) + block for block in blocks
    )
    body = b"\x78\x01" + stored + struct.pack(">I", zlib.adler32(rows))
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"PLTE", palette.tobytes()) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def write_toy_duck(path: Path) -> None:
    """Write the duck as a GLB file; its texture is projected from the side."""
    points, faces = surface_nets(duck_field, np.array([-0.82, 0.0, -0.7]), np.array([1.15, 1.75, 0.7]), 0.0575)
    low, high = np.array(DUCK_BOX)
    # In the field's own coordinates the paint fits; after that the box is made exact.
    uv = np.stack([(points[:, 0] - low[0]) / (high[0] - low[0]), (high[1] - points[:, 1]) / (high[1] - low[1])], axis=1)
    small, large = points.min(axis=0), points.max(axis=0)
    points = low + (points - small) / (large - small) * (high - low)
    image = png(*duck_paint(128))
    pieces = [points.astype("<f4").tobytes(), uv.astype("<f4").tobytes(), faces.astype("<u2").tobytes(), image]
    pieces = [piece + b"\0" * (-len(piece) % 4) for piece in pieces]
    starts = np.cumsum([0, *map(len, pieces)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": at, "byteLength": len(piece)} for at, piece in zip(starts, pieces, strict=False)
    ]
    views[3]["byteLength"] = len(image)
    box = {"min": points.astype("<f4").min(axis=0).tolist(), "max": points.astype("<f4").max(axis=0).tolist()}
    pbr = {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 0.4}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    document = {
        "asset": {"version": "2.0", "generator": "scripts/make_assets.py"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "duck"}],
        "meshes": [{"name": "duck", "primitives": [primitive]}],
        "materials": [{"name": "paint", "pbrMetallicRoughness": pbr}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 33071, "wrapT": 33071}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3", **box},
            {"bufferView": 1, "componentType": 5126, "count": len(points), "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(pieces)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)


def write_ply(path: Path, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
    """Write a binary little-endian PLY without normals."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment made by scripts/make_assets.py\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    records["count"], records["index"] = 3, faces
    path.write_bytes(header.encode() + vertices.tobytes() + records.tobytes())


#: Colours of the lanterns' paper: radiance.
PAPER = {
    "amber": (52.0, 18.0, 3.6),
    "gold": (44.0, 28.0, 6.4),
    "rose": (48.0, 6.4, 9.6),
    "jade": (4.8, 34.0, 14.0),
    "azure": (4.8, 16.0, 52.0),
    "pearl": (32.0, 30.0, 26.0),
}


def write_lanterns(path: Path) -> None:
    """Write an OBJ and its MTL: 110 emissive octahedra, 880 triangles, hung over a square about the origin.

    Sizes and radiances vary, each by a factor of several, so that the brightest have a hundred times the power
    of the faintest.
    """
    random = np.random.default_rng(1913)
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1.4, 0], [0, -1.4, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    faces = np.array([[3, 5, 1], [3, 1, 6], [3, 6, 2], [3, 2, 5], [4, 1, 5], [4, 6, 1], [4, 2, 6], [4, 5, 2]])
    names = list(PAPER)
    lines, material = ["# made by scripts/make_assets.py", f"mtllib {path.stem}.mtl"], []
    for number in range(110):
        row, column = divmod(number, 10)
        place = np.array([2.0 * column - 9.0, 1.9, 1.7 * row - 11.5])
        place += random.uniform(-1.0, 1.0, 3) * (0.7, 0.7, 0.6)
        size, strength = 0.2 * random.uniform(0.35, 1.0), 4.0 ** random.uniform(-1.0, 1.0)
        colour = names[random.integers(len(names))]
        turn = random.uniform(0.0, 2.0 * np.pi)
        spin = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        level = int(np.clip(np.round(2.0 * np.log2(strength)), -4, 4))
        lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in corners @ spin.T * size + place]
        lines.append(f"usemtl {colour}{level:+d}")
        material.append((colour, level))
        lines += ["f " + " ".join(str(6 * number + k) for k in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    shades = ["# made by scripts/make_assets.py"]
    for colour, level in sorted(set(material)):
        radiance = " ".join(f"{x * 2.0 ** (0.5 * level):.4g}" for x in PAPER[colour])
        shades += [f"newmtl {colour}{level:+d}", "Kd 0.6 0.6 0.6", f"Ke {radiance}"]
    path.with_suffix(".mtl").write_text("\n".join(shades) + "\n")


def main() -> None:
    """Write every asset."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=SCENES, help="folder to write to")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    for make in (standin, statue, cup, pot, curved_wall):
        write_ply(folder / f"{make.__name__}.ply", *make())
    write_toy_duck(folder / "toy_duck.glb")
    write_lanterns(folder / "lanterns.obj")


if __name__ == "__main__":
    main()
