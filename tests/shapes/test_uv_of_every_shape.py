"""Texture coordinates of every kind of shape are those that docs/reference/textures.md states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

import torchpt
from torchpt.physics.shapes import KINDS

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "textures.md"
CYLINDER = {"type": "cylinder", "height": 2.0}
CONE = {"type": "cone", "apex": [0.0, 1.0, 0.0], "height": -2.0, "slope": 0.5}
QUAD = {"type": "mesh", "vertices": [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "faces": [[0, 1, 2, 3]]}
R = math.sqrt(0.5)

#: A shape, points on it with the directions from there to the camera, and u and v there.
CASES: list[tuple[str, dict[str, Any], list[tuple[Sequence[float], Sequence[float], tuple[float, float]]]]] = [
    (
        "rectangle",
        {"type": "rectangle"},
        [((-0.8, -0.6, 0), (0, 0, 1), (0.1, 0.2)), ((0.8, -0.6, 0), (0, 0, 1), (0.9, 0.2))],
    ),
    (
        "disk",
        {"type": "disk"},
        [((0.3 * R, 0.3 * R, 0), (0, 0, 1), (0.3, 0.125)), ((0, -0.5, 0), (0, 0, 1), (0.5, 0.75))],
    ),
    (
        "sphere",
        {"type": "sphere"},
        [
            ((0, 1, 0), (0, 1, 0), (0.25, 0.5)),
            ((-R, 0, R), (-1, 0, 0), (0.5, 0.25)),
            ((-R, 0, -R), (-1, 0, 0), (0.5, 0.75)),
        ],
    ),
    (
        "cylinder",
        CYLINDER,
        [
            ((0, -0.8, -1), (0, 0, -1), (0.25, 0.1)),
            ((0, 0.8, 1), (0, 0, 1), (0.75, 0.9)),
            ((0, 1, 0.5), (0, 1, 0), (0.5, 0.75)),
            ((0, -1, 0.5), (0, -1, 0), (0.5, 0.25)),
        ],
    ),
    (
        "cone",
        CONE,
        [
            ((0, -0.6, -0.8), (0, 0, -1), (0.25, 0.2)),
            ((0, 0.6, 0.2), (0, 0, 1), (0.75, 0.8)),
            ((0, -1, 0.5), (0, -1, 0), (0.5, 0.25)),
        ],
    ),
    (
        "cube",
        {"type": "cube"},
        [
            ((1, -0.8, 0.6), (1, 0, 0), (0.1, 0.2)),
            ((-1, -0.8, -0.6), (-1, 0, 0), (0.1, 0.2)),
            ((0.8, 1, 0.6), (0, 1, 0), (0.1, 0.2)),
            ((-0.6, -1, -0.8), (0, -1, 0), (0.1, 0.2)),
            ((-0.6, -0.8, 1), (0, 0, 1), (0.1, 0.2)),
            ((-0.6, 0.8, -1), (0, 0, -1), (0.1, 0.2)),
        ],
    ),
    ("mesh", QUAD | {"uvs": [[0, 0], [2, 0], [2, 3], [0, 3]]}, [((0.5, -0.5, 0), (0, 0, 1), (1.5, 0.75))]),
    ("mesh", QUAD, [((-0.8, -0.9, 0), (0, 0, 1), (0.05, 0.05)), ((0.9, 0.8, 0), (0, 0, 1), (0.05, 0.9))]),
    ("instance", {"type": "instance", "of": "mesh"}, [((0.5, -0.5, 0), (0, 0, 1), (1.5, 0.75))]),
]


def seen(shape: dict[str, Any], point: Sequence[float], towards: Sequence[float]) -> list[float]:
    """The layer ``uv`` of a parallel camera that sees one point."""
    up = [0, 0, 1] if abs(towards[1]) > 0.5 else [0, 1, 0]
    origin = [p + 3.0 * d for p, d in zip(point, towards, strict=True)]
    shapes = {"shape": shape}
    if shape["type"] == "instance":
        far = [{"translate": [0, 0, -50]}]
        shapes["mesh"] = QUAD | {"uvs": [[0, 0], [2, 0], [2, 3], [0, 3]], "transform": far}
    scene = torchpt.load(
        {
            "camera": {"type": "orthographic", "origin": origin, "target": list(point), "up": up, "width": 1e-4},
            "film": {"width": 1, "height": 1, "filter": "box", "aovs": ["uv"]},
            "shapes": shapes,
            "lights": {"sky": {"type": "constant"}},
        },
        device="cpu",
    )
    return torchpt.render(scene, spp=1, integrator="aov", compile="off", full=True)["uv"].flatten()[:2].tolist()


@pytest.mark.parametrize(("kind", "shape", "points"), CASES, ids=[f"{kind}{n}" for n, (kind, _, _) in enumerate(CASES)])
def test_coordinates_lie_where_the_page_says(kind: str, shape: dict[str, Any], points: list[Any]) -> None:
    for point, towards, uv in points:
        assert seen(shape, point, towards) == pytest.approx(uv, abs=2e-3), (kind, point)


def test_every_kind_is_asked_and_stands_in_the_page() -> None:
    text = PAGE.read_text(encoding="utf-8").split("## Texture coordinates\n", 1)[1].split("\n## ", 1)[0]
    assert {kind for kind, _, _ in CASES} == set(KINDS)
    assert all(f"| `{kind}`" in text for kind in KINDS)


def test_an_image_on_a_rectangle_is_put_upright() -> None:
    texels = torch.zeros(4, 4, 3)
    texels[0] = 0.9  # the first row
    for transform, row in (({}, -1), ({"uv_transform": {"scale": [1, -1]}}, 0)):
        image = {"type": "image", "data": texels, "filter": "nearest", **transform}
        scene = torchpt.load(
            {
                "camera": {"type": "orthographic", "origin": [0, 0, 3], "target": [0, 0, 0], "width": 2},
                "film": {"width": 4, "height": 4, "filter": "box"},
                "shapes": {"picture": {"type": "rectangle", "material": {"type": "diffuse", "reflectance": image}}},
                "lights": {"sky": {"type": "constant"}},
            },
            device="cpu",
        )
        lit = torchpt.render(scene, spp=4, compile="off")[:, 0, 0] > 0.1
        assert lit.nonzero().flatten().tolist() == [row % 4]
