"""Names of plugins and properties in files of earlier versions of Mitsuba, and those of today.

What was renamed from 0.3 to 0.4 and 0.5 stands in ``data/schema/upgrade_*.xsl`` of Mitsuba 0.6; versions from 2.0 on write
``snake_case`` in place of ``camelCase``.
"""

from __future__ import annotations

import re

__all__ = ["plugin_name", "property_name"]

#: Plugins by tag and old name.
PLUGINS: dict[tuple[str, str], str] = {
    ("bsdf", "lambertian"): "diffuse",
    ("bsdf", "microfacet"): "roughplastic",
    ("bsdf", "roughmetal"): "roughconductor",
    ("bsdf", "roughglass"): "roughdielectric",
    ("bsdf", "composite"): "mixturebsdf",
    ("bsdf", "bump"): "bumpmap",
    ("bsdf", "blend"): "blendbsdf",
    ("bsdf", "mixture"): "mixturebsdf",
    ("texture", "exrtexture"): "bitmap",
    ("texture", "ldrtexture"): "bitmap",
    ("texture", "vertexcolors"): "mesh_attribute",
    ("integrator", "errctrl"): "adaptive",
    ("film", "exrfilm"): "hdrfilm",
    ("film", "pngfilm"): "ldrfilm",
}

#: Properties by tag, plugin (of today) and old name in snake case; the plugin "" stands for all of the tag.
PROPERTIES: dict[tuple[str, str, str], str] = {
    ("bsdf", "", "alpha_b"): "alpha",
    ("bsdf", "", "alpha_x"): "alpha_u",
    ("bsdf", "", "alpha_y"): "alpha_v",
    ("bsdf", "diffuse", "diffuse_reflectance"): "reflectance",
    ("bsdf", "roughdiffuse", "diffuse_reflectance"): "reflectance",
    ("bsdf", "bumpmap", "bump_texture"): "texture",
    ("shape", "sphere", "inverted"): "flip_normals",
    ("texture", "", "bright_color"): "color0",
    ("texture", "", "dark_color"): "color1",
    ("emitter", "area", "intensity"): "radiance",
    ("emitter", "constant", "intensity"): "radiance",
    ("emitter", "directional", "intensity"): "irradiance",
    ("emitter", "", "intensity_scale"): "scale",
    ("sensor", "", "focus_depth"): "focus_distance",
    ("integrator", "", "luminaire_samples"): "emitter_samples",
}

_HUMP = re.compile(r"(?<=[a-z0-9])([A-Z]+)")


def plugin_name(tag: str, name: str) -> str:
    """Return the present name of a plugin."""
    name = name.lower()  # `shapeGroup` was found where files are, whatever their case
    return PLUGINS.get((tag, name), name)


def property_name(tag: str, plugin: str, name: str) -> str:
    """Return the present name of a property: ``intIOR`` becomes ``int_ior``.

    Args:
        tag: tag of the element that has the property.
        plugin: present name of its plugin.
        name: as written.
    """
    snake = _HUMP.sub(lambda match: "_" + match[1].lower(), name)
    for owner in (plugin, ""):
        if (tag, owner, snake) in PROPERTIES:
            return PROPERTIES[tag, owner, snake]
    return snake
