"""A scene with a ball of every material in every variant, for tests that must hold for any scene."""

from __future__ import annotations

from typing import Any

from torchpt.physics.bsdfs import KINDS

__all__ = ["MATERIALS", "showcase"]

#: Materials by name, at least one for each variant in ``bsdfs.variants()``.
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": {"type": "diffuse", "reflectance": [0.6, 0.3, 0.2]},
    "phong": {"type": "phong", "diffuse": [0.3, 0.4, 0.5], "specular": 0.3, "exponent": 40},
    "blinn_phong": {"type": "blinn_phong", "diffuse": [0.3, 0.2, 0.1], "specular": 0.1, "exponent": 60},
    "mirror": {"type": "conductor"},
    "silver": {"type": "conductor", "material": "Ag"},
    "clay": {"type": "roughdiffuse", "reflectance": [0.6, 0.4, 0.3], "alpha": 0.5},
    "clay_fast": {"type": "roughdiffuse", "alpha": 0.5, "use_fast_approx": True},
    "gold": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "bronze": {"type": "roughconductor", "reflectance": [0.7, 0.5, 0.3], "roughness": 0.5},
    "brushed": {"type": "roughconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.4},
    "brushed_tint": {"type": "roughconductor", "reflectance": [0.9, 0.6, 0.5], "alpha_u": 0.3, "alpha_v": 0.1},
    "full_gold": {"type": "roughconductor", "material": "Au", "alpha": 0.7, "energy_compensation": True},
    "full_tint": {"type": "roughconductor", "reflectance": 0.8, "alpha": 0.9, "energy_compensation": True},
    "full_brushed": {
        "type": "roughconductor",
        "material": "Cu",
        "alpha_u": 0.3,
        "alpha_v": 0.6,
        "energy_compensation": True,
    },
    "glass": {"type": "dielectric"},
    "pane": {"type": "thindielectric", "specular_transmittance": [0.8, 0.9, 1.0]},
    "gaussian_gold": {"type": "roughconductor", "distribution": "beckmann", "material": "Au", "alpha": 0.2},
    "gaussian_brushed": {
        "type": "roughconductor",
        "distribution": "beckmann",
        "material": "Al",
        "alpha_u": 0.1,
        "alpha_v": 0.4,
    },
    "gaussian_full": {
        "type": "roughconductor",
        "distribution": "beckmann",
        "material": "Au",
        "alpha": 0.7,
        "energy_compensation": True,
    },
    "gaussian_frosted": {"type": "roughdielectric", "distribution": "beckmann", "alpha": 0.3},
    "gaussian_wiped": {"type": "roughdielectric", "distribution": "beckmann", "alpha_u": 0.1, "alpha_v": 0.3},
    "gaussian_satin": {"type": "roughplastic", "distribution": "beckmann", "alpha": 0.15},
    "frosted": {"type": "roughdielectric", "alpha": 0.3},
    "wiped": {"type": "roughdielectric", "alpha_u": 0.05, "alpha_v": 0.3},
    "full_frosted": {"type": "roughdielectric", "alpha": 0.6, "energy_compensation": True},
    "clear_rough": {"type": "roughdielectric", "alpha": 0.0},
    "plastic": {"type": "plastic", "diffuse_reflectance": [0.1, 0.3, 0.6]},
    "plastic_nonlinear": {"type": "plastic", "diffuse_reflectance": [0.1, 0.3, 0.6], "nonlinear": True},
    "satin": {"type": "roughplastic", "diffuse_reflectance": [0.6, 0.3, 0.1], "alpha": 0.15},
    "satin_nonlinear": {"type": "roughplastic", "diffuse_reflectance": [0.6, 0.3, 0.1], "nonlinear": True},
    "nonmetal": {"type": "nonmetal", "base_color": [0.4, 0.6, 0.4], "roughness": 0.3},
    "microfacet": {"type": "microfacet", "diffuse": [0.7, 0.7, 0.6], "roughness": 0.4},
    "paint": {
        "type": "principled",
        "base_color": [0.7, 0.1, 0.1],
        "roughness": 0.3,
        "metallic": 0.3,
        "clearcoat": 0.8,
        "clearcoat_gloss": 0.7,
        "sheen": 0.4,
        "sheen_tint": 0.5,
        "spec_tint": 0.5,
        "flatness": 0.3,
    },
    "lathe": {"type": "principled", "base_color": 0.8, "metallic": 0.8, "roughness": 0.4, "anisotropic": 0.7},
    "gel": {"type": "principled", "base_color": [0.3, 0.8, 0.4], "roughness": 0.2, "spec_trans": 0.8, "eta": 1.4},
    "comb": {"type": "principled", "roughness": 0.4, "spec_trans": 0.5, "anisotropic": 0.6},
    "mixed": {"type": "blend", "a": "gold", "b": "satin", "weight": 0.4},
    "window": {"type": "blend", "a": "glass", "b": "diffuse", "weight": 0.5},
    "nothing": {"type": "null"},
    "lace": {"type": "diffuse", "opacity": 0.5},
    "shell": {"type": "diffuse", "two_sided": False, "reflectance": 0.6},
    "tiles": {"type": "diffuse", "reflectance": {"type": "checkerboard", "scale": [8, 4], "color0": [0.7, 0.3, 0.2]}},
    "inlay": {
        "type": "principled",
        "base_color": {"type": "checkerboard", "scale": 6, "color0": [0.9, 0.7, 0.3], "color1": 0.1},
        "metallic": {"type": "checkerboard", "scale": 6, "color0": 1, "color1": 0},
        "roughness": {"type": "checkerboard", "scale": 3, "color0": 0.2, "color1": 0.6},
        "spec_trans": {"type": "checkerboard", "scale": 3, "color0": 0.5, "color1": 0},
        "anisotropic": {"type": "checkerboard", "scale": 3, "color0": 0.5, "color1": 0},
    },
    "lattice": {
        "type": "roughplastic",
        "diffuse_reflectance": {"type": "checkerboard", "scale": 5},
        "opacity": {"type": "checkerboard", "scale": [8, 4], "color0": 1, "color1": 0.2},
    },
    "patches": {
        "type": "blend",
        "a": "gold",
        "b": "frosted",
        "weight": {"type": "checkerboard", "scale": 4, "color0": 1, "color1": 0.3},
        "normal_map": {"type": "checkerboard", "scale": 9, "color0": [0.6, 0.45, 0.95], "color1": [0.4, 0.5, 0.95]},
    },
    "ember": {"type": "roughconductor", "alpha": 0.3, "material": "Cu", "emission": [0.5, 0.2, 0.1]},
}
_TYPES = {material["type"] for material in MATERIALS.values()}
MATERIALS |= {kind: {"type": kind} for kind in KINDS if kind not in _TYPES}


def showcase(*names: str) -> dict[str, Any]:
    """Return balls of the materials ``names`` (default: all) in rows on a floor, under a lamp and a dim sky."""
    chosen = names or tuple(MATERIALS)
    side = max(int(len(chosen) ** 0.5), 1)
    shapes: dict[str, Any] = {
        "floor": {
            "type": "rectangle",
            "transform": [{"scale": 3 * side}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "lamp": {"type": "sphere", "center": [side, 3 * side, 3 * side], "radius": 0.5 * side, "emission": 12},
    }
    for number, name in enumerate(chosen):
        x, z = number % side, number // side
        shapes[f"ball_{name}"] = {
            "type": "sphere",
            "center": [2.4 * (x - 0.5 * (side - 1)), 1, -2.4 * z],
            "radius": 1,
            "material": name,
        }
    needed = set(chosen)
    for name in chosen:
        needed |= {MATERIALS[name][key] for key in ("a", "b") if MATERIALS[name]["type"] == "blend"}
    return {
        "camera": {"origin": [0, 2.2 * side, 3.2 * side], "target": [0, 0, -1.2 * side], "fov": 50},
        "materials": {name: material for name, material in MATERIALS.items() if name in needed},
        "lights": {"sky": {"type": "constant", "radiance": [0.3, 0.35, 0.4]}},
        "shapes": shapes,
        "integrator": {"type": "path", "max_depth": 8},
    }
