"""Mitsuba's textures: what each becomes here. A texture becomes a mapping of a scene file, or the colour that stands for it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from torchpt.scene.formats.mitsuba.elements import Element
from torchpt.scene.formats.mitsuba.plugins import Plugin, exact, nearest
from torchpt.scene.formats.mitsuba.properties import Properties
from torchpt.scene.formats.mitsuba.versions import plugin_name

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer

__all__ = ["TEXTURES", "attributes_of"]

_GREY = [0.5, 0.5, 0.5]
_WRAPS = ("repeat", "clamp", "mirror")
_SHEAR = 1e-6  # relative to the scale: less is rounding


def _uv_transform(p: Properties) -> dict[str, Any]:
    """Return the block ``uv_transform`` of ``to_uv`` and of the older ``uoffset uscale``.

    Before version 2 the offset was added after the scale; Mitsuba 3, which reads old files too, scales after it shifts. A
    transform that shears is given as a matrix, any other by its parts.
    """
    matrix = p.transform("to_uv")
    linear, shift = matrix[:2, :2], matrix[:2, 3]
    offset = np.array([p.number("uoffset", 0.0), p.number("voffset", 0.0)])
    factors = np.array([p.number("uscale", 1.0), p.number("vscale", 1.0)])
    linear, shift = factors[:, None] * linear, factors * shift + (factors * offset if p.modern else offset)
    across, along = linear[:, 0], linear[:, 1]
    length = math.hypot(*across)
    angle = math.atan2(across[1], across[0]) if length else math.atan2(-along[0], along[1])
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    along = turn @ along
    if abs(along[0]) > _SHEAR * (length + math.hypot(*along)):
        rows = np.column_stack((linear, shift)).tolist()
        return {"uv_transform": {"matrix": rows}}
    found: dict[str, Any] = {}
    degrees = math.degrees(angle)
    if abs(degrees - 180.0) < 1e-9 or abs(degrees + 180.0) < 1e-9:  # a mirror image without rotation
        length, along, degrees = -length, -along, 0.0
    if (length, along[1]) != (1.0, 1.0):
        found["scale"] = [float(length), float(along[1])]
    if degrees:
        found["rotate"] = degrees
    if shift.any():
        found["translate"] = [float(value) for value in shift]
    return {"uv_transform": found} if found else {}


def _bitmap(p: Properties, importer: Importer) -> Any:
    """Return an image. What is not ``raw`` is decoded from sRGB in every slot, opacity and roughness included."""
    p.ignore("accel", "format", "cache", "max_anisotropy")
    path = p.file()
    raw = p.flag("raw")
    gamma = p.number("gamma", -1.0)
    if gamma not in (-1.0, 0.0, 1.0):
        p.note(f"gamma {gamma:g} becomes that of sRGB")
    found: dict[str, Any] = {"type": "image", "path": "" if path is None else importer.path(path)}
    kind = p.text("filter_type", "bilinear" if p.modern else "ewa")
    if kind == "nearest":
        found["filter"] = "nearest"
    elif kind != "bilinear" and p.has("filter_type"):
        p.note(f'filter_type "{kind}" becomes bilinear')
    wraps = [p.text(key, "") for key in ("wrap_mode", "wrap_mode_u", "wrap_mode_v")]
    if wraps[1] != wraps[2]:
        p.note("one wrap_mode is taken for both directions")
    for wrap in dict.fromkeys(filter(None, wraps)):
        if wrap not in _WRAPS:
            p.note(f'wrap_mode "{wrap}" becomes repeat')
        elif wrap != "repeat":
            found["wrap"] = wrap
    found["colorspace"] = "linear" if raw or gamma == 1.0 else "srgb"
    channel = p.text("channel")
    if channel in ("r", "g", "b", "a"):
        found["channel"] = channel
    elif channel:
        p.note(f'channel "{channel}" becomes the luminance')
    found |= _uv_transform(p)
    return list(_GREY) if path is None else found


def _checkerboard(p: Properties, importer: Importer) -> Any:
    colours = {key: p.colour(key) for key in ("color0", "color1")}
    return {"type": "checkerboard", **{k: v for k, v in colours.items() if v is not None}, **_uv_transform(p)}


def _scale(p: Properties, importer: Importer) -> Any:
    factor = p.slot("scale", [1.0] * 3, bounded=False)
    inner = p.objects("texture")
    value = importer.texture(inner[0]) if inner else p.slot("value", [1.0] * 3, bounded=False)
    if isinstance(factor, dict):
        p.note("the texture of scale is left out")
        return value
    return scaled(value, factor, p)


def scaled(value: Any, factor: list[float], p: Properties) -> Any:
    """Return a texture, or a colour, multiplied by a colour; note where a texture cannot be."""
    if isinstance(value, list):
        return [a * b for a, b in zip(value, factor, strict=True)]
    if "texture" in value:
        value = p.importer.textures[value["texture"]]
    if value["type"] == "image":
        before = value.get("scale", [1.0] * 3)
        return {**value, "scale": [a * b for a, b in zip(before, factor, strict=True)]}
    if value["type"] == "checkerboard":
        defaults = {"color0": [0.4] * 3, "color1": [0.2] * 3}
        return value | {
            key: [a * b for a, b in zip(value.get(key, default), factor, strict=True)]
            for key, default in defaults.items()
        }
    p.note(f"the scale of a {value['type']} texture is left out")
    return value


def _vertex_color(p: Properties, importer: Importer) -> Any:
    p.text("name")  # the shape reads it, by :func:`attributes_of`
    return {"type": "vertex_color"}


def attributes_of(elements: Iterable[Element], importer: Importer) -> list[str]:
    """Return the mesh attributes that textures in some elements name, references followed, each once."""
    names: dict[str, None] = {}
    seen: set[int] = set()
    stack = list(elements)[::-1]
    while stack:
        element = stack.pop()
        if id(element) in seen:
            continue
        seen.add(id(element))
        if element.tag == "texture" and plugin_name(element.tag, element.type) == "mesh_attribute":
            given = [
                child.attributes.get("value", "")
                for child in element.children
                if child.attributes.get("name") == "name"
            ]
            names[given[0].strip() if given else "vertex_color"] = None
        stack.extend(importer.target(child) if child.tag == "ref" else child for child in reversed(element.children))
    return list(names)


def _grid(p: Properties, importer: Importer) -> Any:
    return p.colour("color0", [0.2] * 3)


def _colour(p: Properties, importer: Importer) -> Any:
    return p.colour("color", _GREY)


def _mean(p: Properties, importer: Importer) -> Any:
    return list(_GREY)


#: Plugins of the tag ``texture``.
TEXTURES: dict[str, Plugin] = {
    "bitmap": exact("image", _bitmap, "a filter_type other than nearest is bilinear"),
    "checkerboard": exact("checkerboard", _checkerboard, "its colours are no textures"),
    "mesh_attribute": exact(
        "vertex_color",
        _vertex_color,
        "one attribute of 1 or 3 numbers for each PLY mesh, of vertices or faces; integers are fractions of their largest",
    ),
    "scale": exact("scaled", _scale, "of an image, a checkerboard or a colour"),
    "srgb": exact("a colour", _colour),
    "gridtexture": nearest("a colour", _grid, "the lines are left out"),
    "wireframe": nearest("a colour", _mean, "grey takes its place"),
    "curvature": nearest("a colour", _mean, "grey takes its place"),
    "volume": nearest("a colour", _mean, "grey takes its place"),
}
