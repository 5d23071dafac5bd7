"""Analytic shapes in the user's own terms, intersected plainly in extended precision: what the tests compare with."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["CASES", "TRANSFORMS", "inside", "thickness", "trace"]

_WIDE = np.longdouble
TRANSFORMS: dict[str, list[dict[str, Any]]] = {
    "as it is": [],
    "mirrored": [
        {"scale": [-1, 2, 0.3]},
        {"rotate": {"axis": [1, -1, 2], "angle": 77}},
        {"translate": [0.3, -0.2, 0.5]},
    ],
    "sheared": [{"matrix": [[1, 0.8, -0.3, 0.2], [0.1, 0.5, 0.6, 0], [-0.7, 0.2, 1.1, -0.4], [0, 0, 0, 1]]}],
    "needle": [{"scale": [1e-3, 1, 2e-3]}, {"rotate": {"axis": [1, 2, 3], "angle": 130}}, {"translate": [0.5, 1, 0]}],
    "sliver": [{"scale": [1, 1, 1e-3]}, {"rotate": {"axis": [3, 1, -1], "angle": 40}}, {"translate": [1, 0, -0.5]}],
}
CASES: dict[str, dict[str, Any]] = {
    "sphere": {"type": "sphere", "center": [0.125, 0.25, -0.375], "radius": 0.875},
    "cylinder": {"type": "cylinder", "center": [0.2, -0.1, 0.3], "radius": 0.6, "height": 1.4},
    "tube": {"type": "cylinder", "radius": 0.8, "height": 0.7, "capped": False},
    "cone": {"type": "cone", "apex": [0.1, 0.9, -0.2], "height": -1.5, "slope": 0.5},
    "hanging cone": {"type": "cone", "apex": [0, -0.5, 0], "height": 1.2, "slope": 0.8, "flip_normals": True},
    "funnel": {"type": "cone", "apex": [0, 0.5, 0], "height": -1, "slope": 1, "capped": False},
}


def _terms(case: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, float, float, float]:
    """``p^T A p + level = 0`` about a centre as a diagonal, and the range of y about that centre."""
    if case["type"] == "sphere":
        r = case.get("radius", 1.0)
        return np.array(case.get("center", [0, 0, 0])), np.ones(3), -(r**2), -np.inf, np.inf
    if case["type"] == "cylinder":
        half, r = 0.5 * case.get("height", 1.0), case.get("radius", 1.0)
        return np.array(case.get("center", [0, 0, 0])), np.array([1.0, 0, 1]), -(r**2), -half, half
    height, slope = case["height"], case["slope"]
    return np.array(case["apex"]), np.array([1.0, -(slope**2), 1]), 0.0, min(0.0, height), max(0.0, height)


def trace(case: dict[str, Any], matrix: np.ndarray, o: np.ndarray, d: np.ndarray) -> dict[str, np.ndarray]:
    """The nearest hit of rays ``(3, N)``.

    Returns:
        ``t`` (inf for a miss), ``part`` (0 the side, 1 a cap), ``normal`` and ``uv`` of hits on the side, and ``margin``: how
        far from another answer the decision was, relative to the shape's own size.
    """
    o, d = o.astype(_WIDE), d.astype(_WIDE)
    inverse = _inverse(matrix)
    centre, form, level, low, high = _terms(case)
    f = inverse @ (o - matrix[:3, 3:].astype(_WIDE)) - centre[:, None]
    e = inverse @ d
    form = form[:, None].astype(_WIDE)
    # From the point nearest to the centre: the plain formula is then accurate for far rays too.
    shift = -(f * e).sum(0) / (e * e).sum(0)
    g = f + shift * e
    a, b, c = (form * e * e).sum(0), 2 * (form * g * e).sum(0), (form * g * g).sum(0) + level
    best = np.full(o.shape[1], np.inf, _WIDE)
    part, margin = np.zeros(o.shape[1], int), np.full(o.shape[1], np.inf, _WIDE)
    speed = np.sqrt((e * e).sum(0))
    size = max(abs(level) ** 0.5, max(abs(low), abs(high)) if np.isfinite(low) else 0.0)
    with np.errstate(all="ignore"):
        disc = b * b - 4 * a * c
        whole = b * b + np.abs(4 * a * c)
        margin = np.minimum(margin, np.abs(disc) / np.where(whole > 0, whole, 1))
        for sign in (-1, 1):
            t = (-b + sign * np.sqrt(disc)) / (2 * a) + shift
            y = f[1] + t * e[1]
            hit = (t > 0) & np.isfinite(t) & (y >= low) & (y <= high)
            if np.isfinite(low):
                near = np.minimum(np.abs(y - low), np.abs(y - high)) / size
                margin = np.where(t > 0, np.minimum(margin, near), margin)
            margin = np.where(np.isfinite(t), np.minimum(margin, np.abs(t * speed) / size), margin)
            best = np.where(hit & (t < best), t, best)
        ends = []
        if case.get("capped", True) and case["type"] != "sphere":
            ends = [low, high] if case["type"] == "cylinder" else [case["height"]]
        for end in ends:
            t = (end - f[1]) / e[1]
            x, z = f[0] + t * e[0], f[2] + t * e[2]
            radius = (-level) ** 0.5 if case["type"] == "cylinder" else abs(end) * case["slope"]
            rim = (radius - np.sqrt(x * x + z * z)) / size
            hit = (t > 0) & np.isfinite(t) & (rim >= 0)
            steep = np.abs(e[1]) / speed
            margin = np.where(
                np.isfinite(t), np.minimum(margin, np.minimum(np.abs(rim), np.abs(t * speed) / size) * steep), margin
            )
            part = np.where(hit & (t < best), 1, part)
            best = np.where(hit & (t < best), t, best)
        p = f + np.where(np.isfinite(best), best, 0) * e
        n = inverse.T @ (form * p)
        if case["type"] == "cone":
            tip = np.abs(p[1]) < 1e-12 * size
            n = np.where(tip, inverse.T @ np.array([[0], [1], [0]]), n)
        n = n / np.sqrt((n * n).sum(0)) * (-1 if case.get("flip_normals") else 1)
        if case["type"] == "sphere":
            u, v = np.arctan2(p[1], p[0]), np.arccos(np.clip(p[2] / case["radius"], -1, 1)) / np.pi
        else:
            turn = 1 if case["type"] == "cone" and case["height"] > 0 else -1  # counter-clockwise from base to tip
            base = low if case["type"] == "cylinder" else case["height"]
            tall = high - low
            u, v = np.arctan2(turn * p[2], p[0]), np.abs(p[1] - base) / tall
    return {
        "t": best.astype(float),
        "part": part,
        "normal": n.astype(float),
        "uv": np.stack([u / (2 * np.pi) % 1, v]).astype(float),
        "margin": margin.astype(float),
    }


def inside(case: dict[str, Any], matrix: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Negative within the side's surface, positive without: its equation at points ``(3, N)``."""
    centre, form, level, _, _ = _terms(case)
    q = _inverse(matrix) @ (p.astype(_WIDE) - matrix[:3, 3:].astype(_WIDE)) - centre[:, None]
    return ((form[:, None] * q * q).sum(0) + level).astype(float)


def thickness(case: dict[str, Any], matrix: np.ndarray, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return how long lines through points ``p (3, N)`` along unit ``n (3, N)`` are within the side's surface: ``(N,)``."""
    centre, form, level, _, _ = _terms(case)
    inverse = _inverse(matrix)
    q, e = inverse @ (p.astype(_WIDE) - matrix[:3, 3:].astype(_WIDE)) - centre[:, None], inverse @ n.astype(_WIDE)
    form = form[:, None].astype(_WIDE)
    a, b, c = (form * e * e).sum(0), 2 * (form * q * e).sum(0), (form * q * q).sum(0) + level
    inner = np.sqrt(np.maximum(b * b - 4 * a * c, 0)) / np.where(a > 0, a, 1)
    return np.where(a > 0, inner, np.inf).astype(float)  # along a cone's axis there is no end


def _inverse(matrix: np.ndarray) -> np.ndarray:
    m = matrix[:3, :3].astype(_WIDE)
    rows = np.stack([np.cross(m[:, 1], m[:, 2]), np.cross(m[:, 2], m[:, 0]), np.cross(m[:, 0], m[:, 1])])
    return rows / (m[:, 0] @ rows[0])
