"""One row a kind of shape: what it is in the user's own terms, in numpy, for the contract that all kinds keep."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["PLACES", "ROWS", "SIMILAR", "Row", "Vectors"]

Vectors = np.ndarray[Any, Any]

TURN = {"rotate": {"axis": [1, -1, 2], "angle": 77}}
#: Transforms that every shape must bear.
PLACES: dict[str, list[dict[str, Any]]] = {
    "as it is": [],
    "turned": [{"scale": 1.5}, TURN, {"translate": [0.3, -0.2, 0.5]}],
    "mirrored": [{"scale": [-1, 1, 1]}, TURN, {"translate": [-0.4, 0.1, 0.2]}],
    "sheared": [{"matrix": [[1, 0.8, -0.3, 0.2], [0.1, 0.5, 0.6, 0], [-0.7, 0.2, 1.1, -0.4], [0, 0, 0, 1]]}],
    "sheared and mirrored": [
        {"matrix": [[-1, 0.3, 0.2, 0], [0.2, 1.2, 0, 0.1], [0.1, -0.4, 0.7, 0], [0, 0, 0, 1]]},
        TURN,
    ],
}
#: Those that keep angles.
SIMILAR = ("as it is", "turned", "mirrored")


@dataclass(frozen=True)
class Row:
    """A shape before its transform.

    Attributes:
        shape: as in a scene file.
        level: at points ``(3, N)``: for each of its smooth surfaces a function that is 0 on it and grows toward its front;
            the shape's own is the largest of them.
        chart: by the surface's label, from texture coordinates ``u, v (N,)`` to points ``(3, N)``; none where a file has them.
        bad: values that go wrong together or alone, by the key that the error names.
        open: whether rays may meet it from behind.
    """

    shape: Mapping[str, Any]
    level: Callable[[Vectors], list[Vectors]]
    chart: Mapping[str, Callable[[Vectors, Vectors], Vectors]] = field(default_factory=dict)
    bad: Mapping[str, Any] = field(default_factory=dict)
    open: bool = False


def _turned(u: Vectors, radius: Any, y: Any, turn: float = -1.0) -> Vectors:
    """Points about y at an azimuth ``u`` in turns from +x: ``turn`` -1 is counter-clockwise seen from +y."""
    return np.stack((radius * np.cos(2 * np.pi * u), y + 0 * u, turn * radius * np.sin(2 * np.pi * u)))


def _about_y(p: Vectors, x: float, z: float) -> Vectors:
    return np.hypot(p[0] - x, p[2] - z)


def _disk(centre: tuple[float, float, float], radius: float, turn: float) -> Callable[[Vectors, Vectors], Vectors]:
    """A cap: ``u`` is the share of the radius, ``v`` the azimuth in turns, counter-clockwise about its normal."""

    def chart(u: Vectors, v: Vectors) -> Vectors:
        return _turned(v, radius * u, 0.0, turn) + np.array(centre)[:, None]

    return chart


def _sphere(u: Vectors, v: Vectors) -> Vectors:
    a, b = 2 * np.pi * u, np.pi * v
    unit = np.stack((np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)))
    return 0.8 * unit + np.array([0.1, 0.2, -0.1])[:, None]


_TETRAHEDRON = np.array([[-1.0, -1, -0.6], [1, -1, -0.8], [0, 1, -0.7], [0.1, 0.2, 1]])
_FACES = np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]])


def _sides(p: Vectors) -> list[Vectors]:
    """Of the tetrahedron."""
    levels = []
    for a, b, c in _TETRAHEDRON[_FACES]:
        n = np.cross(b - a, c - a)
        levels.append((n / np.linalg.norm(n)) @ (p - a[:, None]))
    return levels


#: By name; a kind of shape has one row or more.
ROWS: dict[str, Row] = {
    "mesh": Row(
        {"type": "mesh", "vertices": _TETRAHEDRON.tolist(), "faces": _FACES.tolist(), "face_normals": True},
        _sides,
        bad={"vertices": [[0, 0, 0]], "faces": [[0, 1, 9]], "path": None},
    ),
    "sphere": Row(
        {"type": "sphere", "center": [0.1, 0.2, -0.1], "radius": 0.8},
        lambda p: [np.linalg.norm(p - np.array([0.1, 0.2, -0.1])[:, None], axis=0) - 0.8],
        {"": _sphere},
        bad={"radius": 0, "center": [1, 2]},
    ),
    "rectangle": Row(
        {"type": "rectangle"},
        lambda p: [p[2]],
        {"": lambda u, v: np.stack((2 * u - 1, 2 * v - 1, 0 * u))},
        open=True,
    ),
    "disk": Row(
        {"type": "disk"},
        lambda p: [p[2]],
        {"": lambda u, v: np.stack((u * np.cos(2 * np.pi * v), u * np.sin(2 * np.pi * v), 0 * u))},
        open=True,
    ),
    "cube": Row({"type": "cube"}, lambda p: [s * x - 1 for x in p for s in (-1, 1)]),
    "cylinder": Row(
        {"type": "cylinder", "center": [0.2, -0.1, 0.3], "radius": 0.6, "height": 1.4},
        lambda p: [_about_y(p, 0.2, 0.3) - 0.6, p[1] - 0.6, -0.8 - p[1]],
        {
            "side": lambda u, v: _turned(u, 0.6, 1.4 * v) + np.array([[0.2], [-0.8], [0.3]]),
            "bottom": _disk((0.2, -0.8, 0.3), 0.6, 1.0),
            "top": _disk((0.2, 0.6, 0.3), 0.6, -1.0),
        },
        bad={"radius": -1, "height": 0, "capped": 1},
    ),
    "tube": Row(
        {"type": "cylinder", "radius": 0.8, "height": 0.7, "capped": False},
        lambda p: [_about_y(p, 0, 0) - 0.8],
        {"": lambda u, v: _turned(u, 0.8, 0.7 * v - 0.35)},
        open=True,
    ),
    "cone": Row(
        {"type": "cone", "apex": [0.1, 0.9, -0.2], "height": -1.5, "slope": 0.5},
        lambda p: [(_about_y(p, 0.1, -0.2) - 0.5 * (0.9 - p[1])) / np.sqrt(1.25), -0.6 - p[1]],
        {
            "side": lambda u, v: _turned(u, 0.75 * (1 - v), 1.5 * v) + np.array([[0.1], [-0.6], [-0.2]]),
            "bottom": _disk((0.1, -0.6, -0.2), 0.75, 1.0),
        },
        bad={"height": 0, "slope": 0},
    ),
    "hanging funnel": Row(
        {"type": "cone", "apex": [0, -0.5, 0], "height": 1.2, "slope": 0.8, "capped": False},
        lambda p: [(_about_y(p, 0, 0) - 0.8 * (p[1] + 0.5)) / np.sqrt(1.64)],
        {"": lambda u, v: _turned(u, 0.96 * (1 - v), 0.7 - 1.2 * v, 1.0)},
        open=True,
    ),
    "instance": Row({"type": "instance", "of": "other"}, _sides, bad={"of": "nothing", "emission": 1}),
}
