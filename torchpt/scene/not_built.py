"""What the scene format knows but this version does not build: the one table.

Whoever builds a thing deletes its row here. Until then giving it is a :class:`~torchpt.errors.NotBuiltError`; its keys
are listed so that a misspelt key is still named as unknown.
"""

from __future__ import annotations

__all__ = ["AOVS", "KEYS", "TYPES"]

_POSE = ("origin", "target", "up", "to_world")
_MATERIAL = ("normal_map", "bump_map", "opacity", "emission", "emission_strength", "two_sided")
_SHAPE = ("material", "transform", "emission", "flip_normals")
_GLASS = ("int_ior", "ext_ior", "specular_reflectance", "specular_transmittance")
_METAL = ("eta", "k", "material", "reflectance", "alpha", "roughness", "alpha_u", "alpha_v", "energy_compensation")
_PLASTIC = ("diffuse_reflectance", "int_ior", "ext_ior", "nonlinear", "specular_reflectance")
_PRINCIPLED = (
    *("base_color", "roughness", "metallic", "specular", "eta", "spec_tint", "anisotropic", "sheen", "sheen_tint"),
    *("clearcoat", "clearcoat_gloss", "spec_trans", "flatness"),
)

#: kind of thing -> its types that are not built -> the keys each of them takes beside ``type``.
TYPES: dict[str, dict[str, tuple[str, ...]]] = {
    "camera": {
        "thinlens": (*_POSE, "fov", "fov_axis", "aperture_radius", "focus_distance", "blades"),
        "orthographic": (*_POSE, "width"),
    },
    "filter": {"tent": ("radius",), "mitchell": ("radius",)},
    "sampler": {"stratified": ("adaptive",), "hammersley": ("adaptive",), "zsobol": ("adaptive",)},
    "integrator": {
        "ibl": ("strict",),
        "bdpt": ("max_depth", "rr_depth", "rr_prob", "clamp", "strict"),
    },
    "material": {
        "phong": ("diffuse", "specular", "exponent", *_MATERIAL),
        "blinn_phong": ("diffuse", "specular", "exponent", *_MATERIAL),
        "conductor": (*_METAL, *_MATERIAL),
        "roughconductor": (*_METAL, *_MATERIAL),
        "dielectric": (*_GLASS, *_MATERIAL),
        "roughdielectric": (*_GLASS, "alpha", "roughness", "energy_compensation", *_MATERIAL),
        "thindielectric": (*_GLASS, *_MATERIAL),
        "plastic": (*_PLASTIC, *_MATERIAL),
        "roughplastic": (*_PLASTIC, "alpha", "roughness", *_MATERIAL),
        "nonmetal": ("base_color", "specular", "roughness", *_MATERIAL),
        "microfacet": ("diffuse", "specular", "roughness", "ior", *_MATERIAL),
        "principled": (*_PRINCIPLED, *_MATERIAL),
        "blend": ("a", "b", "weight", *_MATERIAL),
        "null": _MATERIAL,
    },
    "texture": {
        "image": ("path", "wrap", "filter", "colorspace", "scale", "uv_transform", "channel"),
        "checkerboard": ("color0", "color1", "scale", "uv_transform"),
        "vertex_color": (),
    },
    "shape": {
        "cylinder": ("center", "radius", "height", "capped", *_SHAPE),
        "cone": ("apex", "height", "slope", "capped", *_SHAPE),
        "instance": ("of", *_SHAPE),
    },
    "light": {
        "envmap": ("path", "scale", "transform"),
        "point": ("position", "intensity"),
        "spot": ("position", "target", "intensity", "cutoff_angle", "beam_width"),
        "directional": ("direction", "irradiance"),
    },
}

#: kind of thing -> keys of built types that are not built -> the value that asks for nothing.
KEYS: dict[str, dict[str, object]] = {
    "camera": {"aperture_radius": 0, "focus_distance": None, "blades": 0},
    "material": {"normal_map": None, "bump_map": None, "opacity": 1, "emission": 0, "emission_strength": 1},
    "mesh": {"displacement": None},
    "sampler": {"adaptive": False},
    "render": {"time_limit": None, "target_error": None, "checkpoint": None, "resume": False},
}

#: Layers that are not built.
AOVS: tuple[str, ...] = ("uv",)
