"""Roughness, index and albedo at their ends."""

from __future__ import annotations

import math
from typing import Any

from torchpt.stress.case import Case, powers
from torchpt.stress.cases._scenes import facing, furnace
from torchpt.stress.harness import Harness, relative

__all__ = ["CASES"]

ALPHA = tuple(10.0 ** (-5 + k / 4) for k in range(21))
INDEX = tuple(10.0 ** (k / 4) for k in range(-12, 13))


def gain(harness: Harness, material: dict[str, Any]) -> float:
    """By how much a ball gives back more than it receives; infinite where it gives back nothing at all."""
    mean = float(harness.render(furnace(material), spp=256, max_depth=-1).mean())
    return max(mean - 1.0, 0.0) if mean > 0.0 else math.inf


def beside_float64(harness: Harness, material: dict[str, Any], spp: int = 16) -> float:
    """How far a ball's reflectance is from that of float64, by the same random numbers."""
    scene = furnace(material)
    return relative(harness.render(scene, spp=spp, max_depth=8), harness.exact().render(scene, spp=spp, max_depth=8))


def rough(kind: str, **more: Any):
    """A material by its roughness."""
    return lambda alpha: {"type": kind, "alpha": alpha, **more}


METAL = rough("roughconductor", reflectance=1.0)
COMPENSATED = rough("roughconductor", reflectance=1.0, energy_compensation=True)
GLASS = rough("roughdielectric", int_ior=1.5)
PLASTIC = rough("roughplastic", diffuse_reflectance=1.0)


def one_direction(harness: Harness, alpha: float) -> float:
    """A pair of roughnesses of which one is 0."""
    pairs = ({"alpha_u": 0.0, "alpha_v": alpha}, {"alpha_u": alpha, "alpha_v": 0.0})
    return max(gain(harness, {"type": "roughconductor", "reflectance": 1.0, **pair}) for pair in pairs)


def glass_in_a_furnace(harness: Harness, index: float) -> float:
    """Smooth glass neither takes nor gives."""
    return relative(harness.render(furnace({"type": "dielectric", "int_ior": index}), max_depth=-1), 1.0)


def plastic(harness: Harness, index: float) -> float:
    """A coat over white keeps nothing."""
    material = {"type": "plastic", "diffuse_reflectance": 1.0, "int_ior": index, "nonlinear": True}
    return relative(harness.render(furnace(material), spp=256, max_depth=-1), 1.0)


def thin_glass(harness: Harness, index: float) -> float:
    """A pane."""
    return relative(harness.render(furnace({"type": "thindielectric", "int_ior": index}), max_depth=-1), 1.0)


def grazing(harness: Harness, height: float) -> float:
    """A square seen at so small an angle, under light from everywhere: no more than one comes back."""
    angle = math.asin(height)
    camera = {
        "type": "orthographic",
        "origin": [4 * math.cos(angle), 0, 4 * math.sin(angle)],
        "target": [0, 0, 0],
        "up": [0, 1, 0],
        "width": 0.1 * height,
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
    """A ball of this albedo gives back so many times what a white one does."""
    some, white = (harness.render(furnace({"type": "diffuse", "reflectance": r}), max_depth=2) for r in (value, 1.0))
    return relative(some, white.mean() * value)


def backs(harness: Harness, alpha: float) -> float:
    """The back of a two-sided metal is its front."""
    scenes = []
    for turn in (0, 180):
        shape = {
            "type": "rectangle",
            "material": METAL(alpha),
            "transform": [{"rotate": {"axis": [0, 1, 0], "angle": turn}}],
        }
        scenes.append({"camera": facing(), "shapes": {"it": shape}, "lights": furnace({})["lights"]})
    front, back = (harness.render(scene, spp=256) for scene in scenes)
    return relative(front, back)


CASES = (
    Case("rough metal gains nothing", "reflectance above 1", 2e-3, lambda b, a: gain(b, METAL(a)), "alpha", ALPHA),
    Case("compensated metal gains nothing", "reflectance above 1", 5e-3, lambda b, a: gain(b, COMPENSATED(a)), "alpha", ALPHA),
    Case("rough glass gains nothing", "radiance above 1", 2e-3, lambda b, a: gain(b, GLASS(a)), "alpha", ALPHA),
    Case("rough plastic gains nothing", "radiance above 1", 2e-3, lambda b, a: gain(b, PLASTIC(a)), "alpha", ALPHA),
    Case("rough metal as in float64", "relative", 2e-3, lambda b, a: beside_float64(b, METAL(a)), "alpha", ALPHA),
    Case("rough glass as in float64", "relative", 5e-3, lambda b, a: beside_float64(b, GLASS(a)), "alpha", ALPHA),
    Case("one roughness of two is 0", "reflectance above 1", 2e-3, one_direction, "alpha", ALPHA),
    Case("glass of any index", "relative to 1", 1e-4, glass_in_a_furnace, "index", INDEX),
    Case("white plastic of any index", "relative to 1", 2e-3, plastic, "index", tuple(n for n in INDEX if n > 1.0)),
    Case("panes of any index", "relative to 1", 1e-3, thin_glass, "index", INDEX),
    Case(
        "rough glass of any index as in float64", "relative", 5e-3,
        lambda b, n: beside_float64(b, {"type": "roughdielectric", "alpha": 0.2, "int_ior": n}), "index", INDEX,
    ),
    Case("grazing light", "radiance above 1", 5e-3, grazing, "sine of the angle", powers(-5, 0)),
    Case("albedo", "relative to a white one", 1e-5, albedo, "albedo", (*powers(-30, -2, 4), 0.5, 0.9, 0.999, 1.0)),
    Case("backs are fronts", "relative", 5e-3, backs, "alpha", ALPHA[::4]),
)  # fmt: skip
