"""Mitsuba's emitters other than ``area``, which its shape takes: what each becomes here.

An emitter becomes one or more mappings of the block ``lights``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchpt.math.transforms import apply_points
from torchpt.scene.formats.mitsuba.plugins import Plugin, exact, left_out, nearest
from torchpt.scene.formats.mitsuba.properties import Properties

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer

__all__ = ["EMITTERS"]

Light = dict[str, Any]
Matrix = NDArray[np.float64]

_ONE = [1.0, 1.0, 1.0]
# The sky and the sun of Mitsuba's `sunsky` without properties: mean radiance of the upper half of the sky, irradiance of a
# surface that faces the sun, and the direction to it (up is z).
_SKY = (0.071, 0.107, 0.166)
_SUN = (1.47, 1.21, 0.894)
_TO_SUN = (0.05, 0.69, 0.72)


def _common(p: Properties) -> None:
    p.ignore("sampling_weight", "shadow_sample_count")


def _times(colour: list[float], factor: float) -> list[float]:
    return [value * factor for value in colour]


def _position(p: Properties) -> list[float]:
    """Return ``position``, or the origin of ``to_world``."""
    point = p.point("position")
    return [float(x) for x in p.transform()[:3, 3]] if point is None else point


def _axis(p: Properties, name: str = "direction") -> list[float]:
    """Return a direction: the property, or the z axis of ``to_world``."""
    matrix, given = p.transform(), p.point(name)
    axis = matrix[:3, 2] if given is None else np.array(given)
    if not np.isfinite(axis).all() or not axis.any():
        raise p.element.error([float(x) for x in axis], f"a {name} other than 0")
    return [float(x) for x in axis]


def _point(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    return [{"type": "point", "position": _position(p), "intensity": p.colour("intensity", _ONE, light=True)}]


def _spot(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    matrix = p.transform()
    position, target = apply_points(matrix, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])).tolist()
    found: Light = {"type": "spot", "position": position, "target": target}
    found["intensity"] = p.colour("intensity", _ONE, light=True)
    found["cutoff_angle"] = p.number("cutoff_angle", 20.0)
    if p.has("beam_width"):
        found["beam_width"] = p.number("beam_width", 15.0)
    if p.objects("texture"):
        p.note("the texture of the beam is left out")
    return [found]


def _directional(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    return [{"type": "directional", "direction": _axis(p), "irradiance": p.colour("irradiance", _ONE, light=True)}]


def _constant(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    return [{"type": "constant", "radiance": p.colour("radiance", _ONE, light=True)}]


def _envmap(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    p.ignore("mis_compensation", "cache")
    path, scale, matrix = p.file(), p.number("scale", 1.0), p.transform()
    if p.number("gamma", -1.0) not in (-1.0, 0.0):
        p.note("gamma is left out")
    if path is None:
        return [{"type": "constant", "radiance": [0.5 * scale] * 3}]
    found: Light = {"type": "envmap", "path": importer.path(path)}
    if scale != 1.0:
        found["scale"] = scale
    if not np.array_equal(matrix, np.eye(4)):
        found["transform"] = [{"matrix": [[float(x) for x in row] for row in matrix]}]
    return [found]


def _sky(p: Properties, importer: Importer) -> list[Light]:
    scale = p.number("scale", 1.0) * p.number("sky_scale", 1.0)
    _ignore_sky(p)
    p.ignore("sun_scale")
    return [{"type": "constant", "radiance": _times(list(_SKY), scale)}]


def _sun(p: Properties, importer: Importer) -> list[Light]:
    scale = p.number("scale", 1.0) * p.number("sun_scale", 1.0)
    matrix, to_sun = p.transform(), p.point("sun_direction")
    _ignore_sky(p)
    p.ignore("sky_scale")
    if to_sun is None:
        x, y, z = _TO_SUN
        to_sun = [x, y, z] if p.modern else [x, z, -y]  # up was y
    direction = -(matrix[:3, :3] @ np.array(to_sun))
    if scale <= 0.0 or not direction.any():
        return []
    return [
        {"type": "directional", "direction": [float(x) for x in direction], "irradiance": _times(list(_SUN), scale)}
    ]


def _sun_sky(p: Properties, importer: Importer) -> list[Light]:
    return [*_sky(p, importer), *_sun(p, importer)]


def _ignore_sky(p: Properties) -> None:
    """Mark the properties of the sky as read that the warning of its entry covers."""
    _common(p)
    p.ignore(
        "turbidity", "albedo", "latitude", "longitude", "timezone", "year", "month", "day", "hour", "minute", "second"
    )
    p.ignore(
        "resolution",
        "stretch",
        "sun_radius_scale",
        "sun_aperture",
        "to_world",
        "sun_direction",
        "complex_sun",
        "extend",
    )
    p.objects("texture")


_SUN_AND_SKY = nearest(
    "constant and directional", _sun_sky, "the mean radiance of a clear sky, and a sun that is a point"
)

#: Plugins of the tag ``emitter``.
EMITTERS: dict[str, Plugin] = {
    "area": exact("emission", lambda p, importer: [], "of the shape around it"),
    "point": exact("point", _point),
    "spot": exact("spot", _spot, "a texture of the beam is left out, with a warning"),
    "directional": exact("directional", _directional),
    "constant": exact("constant", _constant),
    "envmap": exact("envmap", _envmap),
    "sky": nearest("constant", _sky, "the mean radiance of a clear sky from all directions"),
    "sun": nearest("directional", _sun, "the sun is a point"),
    "sunsky": _SUN_AND_SKY,
    "timed_sunsky": _SUN_AND_SKY,
    "collimated": left_out("a beam without width meets no surface by chance"),
    "directionalarea": left_out("surfaces shine in all directions"),
    "projector": left_out("there are no projectors"),
    "volumelight": left_out("there are no media"),
}
