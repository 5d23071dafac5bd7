"""Extreme roughness, index and albedo."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from torchpt.stress.case import Case, powers_of_ten
from torchpt.stress.cases._scenes import front_camera, furnace
from torchpt.stress.harness import Harness, relative

__all__ = ["CASES"]

#: Swept roughness, 1e-5 to 1, and swept index of refraction, 1e-3 to 1e3: four points a decade.
ALPHA = tuple(10.0 ** (-5 + k / 4) for k in range(21))
INDEX = tuple(10.0 ** (k / 4) for k in range(-12, 13))


def gain(harness: Harness, material: dict[str, Any]) -> float:
    """Return the excess of a ball's albedo in a furnace over 1; infinite for a black picture."""
    mean = float(harness.render(furnace(material), spp=256, max_depth=-1).mean())
    return max(mean - 1.0, 0.0) if mean > 0.0 else math.inf


def beside_float64(harness: Harness, material: dict[str, Any], spp: int = 16) -> float:
    """Return the relative difference of a ball's albedo from that in float64, with the same random numbers."""
    scene = furnace(material)
    return relative(harness.render(scene, spp=spp, max_depth=8), harness.exact().render(scene, spp=spp, max_depth=8))


def rough(kind: str, **keys: Any) -> Callable[[float], dict[str, Any]]:
    """Return a function from roughness to a material of type ``kind`` with further keys."""
    return lambda alpha: {"type": kind, "alpha": alpha, **keys}


METAL = rough("roughconductor", reflectance=1.0)
COMPENSATED = rough("roughconductor", reflectance=1.0, energy_compensation=True)
GLASS = rough("roughdielectric", int_ior=1.5)
PLASTIC = rough("roughplastic", diffuse_reflectance=1.0)


def one_direction(harness: Harness, alpha: float) -> float:
    """Return the gain of metals whose roughness is 0 along u or along v, and ``alpha`` along the other; the larger one."""
    pairs = ({"alpha_u": 0.0, "alpha_v": alpha}, {"alpha_u": alpha, "alpha_v": 0.0})
    return max(gain(harness, {"type": "roughconductor", "reflectance": 1.0, **pair}) for pair in pairs)


def glass_in_a_furnace(harness: Harness, index: float) -> float:
    """Compare smooth glass in a furnace with 1."""
    return relative(harness.render(furnace({"type": "dielectric", "int_ior": index}), max_depth=-1), 1.0)


def plastic(harness: Harness, index: float) -> float:
    """Compare white plastic in a furnace with 1."""
    material = {"type": "plastic", "diffuse_reflectance": 1.0, "int_ior": index, "nonlinear": True}
    return relative(harness.render(furnace(material), spp=256, max_depth=-1), 1.0)


def thin_glass(harness: Harness, index: float) -> float:
    """Compare a thin pane in a furnace with 1."""
    return relative(harness.render(furnace({"type": "thindielectric", "int_ior": index}), max_depth=-1), 1.0)


def grazing(harness: Harness, height: float) -> float:
    """Return the excess over 1 of a square in a furnace, the largest of four materials; ``height``: sine of its angle."""
    angle = math.asin(height)
    camera = {
        "type": "orthographic",
        "origin": [4 * math.cos(angle), 0, 4 * math.sin(angle)],
        "target": [0, 0, 0],
        "up": [0, 1, 0],
        "width": 0.1 * height,  # the square looks that much lower: it fills the picture
    }
    worst = 0.0
    for material in (
        METAL(0.3),
        PLASTIC(0.3),
        {"type": "plastic", "diffuse_reflectance": 1.0},
        COMPENSATED(0.3),
    ):
        scene = {
            "camera": camera,
            "shapes": {"it": {"type": "rectangle", "material": material}},
            "lights": furnace({})["lights"],
        }
        worst = max(worst, float(harness.render(scene).mean()) - 1.0)
    return worst


def albedo(harness: Harness, value: float) -> float:
    """Compare a ball of albedo ``value`` with that multiple of a white one."""
    some, white = (harness.render(furnace({"type": "diffuse", "reflectance": r}), max_depth=2) for r in (value, 1.0))
    return relative(some, white.mean() * value)


def backs(harness: Harness, alpha: float) -> float:
    """Compare the back of a two-sided metal square with its front."""
    scenes = []
    for turn in (0, 180):
        shape = {
            "type": "rectangle",
            "material": METAL(alpha),
            "transform": [{"rotate": {"axis": [0, 1, 0], "angle": turn}}],
        }
        scenes.append({"camera": front_camera(), "shapes": {"it": shape}, "lights": furnace({})["lights"]})
    front, back = (harness.render(scene, spp=256) for scene in scenes)
    return relative(front, back)


CASES = (
    Case(
        name="rough metal gains nothing",
        measures="reflectance above 1",
        bound=2e-3,
        figure=lambda harness, alpha: gain(harness, METAL(alpha)),
        axis="alpha",
        sweep=ALPHA,
    ),
    Case(
        name="compensated metal gains nothing",
        measures="reflectance above 1",
        bound=5e-3,
        figure=lambda harness, alpha: gain(harness, COMPENSATED(alpha)),
        axis="alpha",
        sweep=ALPHA,
    ),
    Case(
        name="rough glass gains nothing",
        measures="radiance above 1",
        bound=2e-3,
        figure=lambda harness, alpha: gain(harness, GLASS(alpha)),
        axis="alpha",
        sweep=ALPHA,
    ),
    Case(
        name="rough plastic gains nothing",
        measures="radiance above 1",
        bound=2e-3,
        figure=lambda harness, alpha: gain(harness, PLASTIC(alpha)),
        axis="alpha",
        sweep=ALPHA,
    ),
    Case(
        name="rough metal as in float64",
        measures="relative",
        bound=2e-3,
        figure=lambda harness, alpha: beside_float64(harness, METAL(alpha)),
        axis="alpha",
        sweep=ALPHA,
    ),
    Case(
        name="rough glass as in float64",
        measures="relative",
        bound=5e-3,
        figure=lambda harness, alpha: beside_float64(harness, GLASS(alpha)),
        axis="alpha",
        sweep=ALPHA,
    ),
    Case(
        name="one roughness of two is 0",
        measures="reflectance above 1",
        bound=2e-3,
        figure=one_direction,
        axis="alpha",
        sweep=ALPHA,
    ),
    Case(
        name="glass of any index",
        measures="relative to 1",
        bound=1e-4,
        figure=glass_in_a_furnace,
        axis="index",
        sweep=INDEX,
    ),
    Case(
        name="white plastic of any index",
        measures="relative to 1",
        bound=2e-3,
        figure=plastic,
        axis="index",
        sweep=tuple(n for n in INDEX if n > 1.0),
    ),
    Case(name="panes of any index", measures="relative to 1", bound=1e-3, figure=thin_glass, axis="index", sweep=INDEX),
    Case(
        name="rough glass of any index as in float64",
        measures="relative",
        bound=5e-3,
        figure=lambda harness, index: beside_float64(
            harness, {"type": "roughdielectric", "alpha": 0.2, "int_ior": index}
        ),
        axis="index",
        sweep=INDEX,
    ),
    Case(
        name="grazing light",
        measures="radiance above 1",
        bound=5e-3,
        figure=grazing,
        axis="sine of the angle",
        sweep=powers_of_ten(-5, 0),
    ),
    Case(
        name="albedo",
        measures="relative to a white one",
        bound=1e-5,
        figure=albedo,
        axis="albedo",
        sweep=(*powers_of_ten(-30, -2, step=4), 0.5, 0.9, 0.999, 1.0),
    ),
    Case(name="backs are fronts", measures="relative", bound=5e-3, figure=backs, axis="alpha", sweep=ALPHA[::4]),
)
