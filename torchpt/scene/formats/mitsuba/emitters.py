"""Mitsuba's emitters other than ``area``, which its shape takes: what each becomes here.

An emitter becomes one or more mappings of the block ``lights``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchpt.physics.lights.sun_position import sun_angles
from torchpt.scene.formats.mitsuba.plugins import Plugin, exact, left_out, nearest
from torchpt.scene.formats.mitsuba.properties import Properties

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer

__all__ = ["EMITTERS"]

Light = dict[str, Any]
Matrix = NDArray[np.float64]

_ONE = [1.0, 1.0, 1.0]
_NARROWEST = 1e-6  # beam of a spot, of its cutoff
_SCALED = 1e-3  # a scale nearer to 1 is rounding of a rotation


def _common(p: Properties) -> None:
    p.ignore("sampling_weight", "shadow_sample_count")


def _position(p: Properties) -> list[float]:
    """Return ``position``, or the origin of ``to_world``."""
    point = p.point("position")
    return [float(x) for x in p.transform()[:3, 3]] if point is None else point


def _axis(p: Properties) -> list[float] | None:
    """Return the direction of a light: the property, or the z axis of ``to_world``; None where it is 0."""
    matrix, given = p.transform(), p.point("direction") if p.plugin == "directional" else None
    axis = matrix[:3, 2] if given is None else np.array(given)
    if not axis.any():
        p.note("it is left out: it has no direction")
        return None
    return [float(x) for x in axis]


def _point(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    return [{"type": "point", "position": _position(p), "intensity": p.colour("intensity", _ONE, light=True)}]


def _spot(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    matrix = p.transform()
    _turn(p)
    intensity, cutoff = p.colour("intensity", _ONE, light=True), p.number("cutoff_angle", 20.0)
    beam = p.number("beam_width", 0.75 * cutoff)
    if p.objects("texture"):
        p.note("the texture of the beam is left out")
    axis = _axis(p)
    if axis is None:
        return []
    if not cutoff > 0.0:
        p.note("it is left out: its cutoff_angle is not above 0")
        return []
    if cutoff > 180.0:
        p.note("a cutoff_angle above 180 becomes 180")
        cutoff = 180.0
    # A beam beyond the cutoff ends there; one of width 0 falls off from its axis.
    angles = {"cutoff_angle": cutoff, "beam_width": min(max(beam, _NARROWEST * cutoff), cutoff)}
    target = [float(a + b) for a, b in zip(matrix[:3, 3], axis, strict=True)]
    return [{"type": "spot", "position": matrix[:3, 3].tolist(), "target": target, "intensity": intensity, **angles}]


def _directional(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    irradiance, axis = p.colour("irradiance", _ONE, light=True), _axis(p)
    return [] if axis is None else [{"type": "directional", "direction": axis, "irradiance": irradiance}]


def _constant(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    return [{"type": "constant", "radiance": p.colour("radiance", _ONE, light=True)}]


def _envmap(p: Properties, importer: Importer) -> list[Light]:
    _common(p)
    p.ignore("mis_compensation", "cache")
    path, scale, matrix = p.file(), p.number("scale", 1.0), _turn(p)
    if p.number("gamma", -1.0) not in (-1.0, 0.0):
        p.note("gamma is left out")
    if path is None:
        return [{"type": "constant", "radiance": [0.5 * scale] * 3}]
    found: Light = {"type": "envmap", "path": importer.path(path), "colorspace": "srgb"}
    if scale != 1.0:
        found["scale"] = scale
    if not np.array_equal(matrix, np.eye(4)):
        found["transform"] = [{"matrix": [[float(x) for x in row] for row in matrix]}]
    return [found]


def _sun_sky(p: Properties, importer: Importer) -> list[Light]:
    """Return a sky: of ``sky`` without a sun, of ``sun`` without a sky."""
    _common(p)
    p.ignore("resolution", "complex_sun", "shutter_open", "shutter_close")
    scale = p.number("scale", 1.0)
    scales = {f"{part}_scale": p.number(f"{part}_scale", scale) for part in ("sky", "sun")}
    if p.plugin in ("sky", "sun"):
        scales |= {"sun_scale": 0.0} if p.plugin == "sky" else {"sky_scale": 0.0}
    albedo = p.slot("albedo", [0.3 if p.modern else 0.2] * 3)
    if isinstance(albedo, dict):
        p.note("the texture of albedo becomes 0.3")
        albedo = [0.3] * 3
    to_sun, pose = _to_sun(p), _upright(p)
    found: Light = {"type": "sky", "turbidity": _within(p, "turbidity", 3.0, 1.0, 10.0), "albedo": albedo}
    found |= {"sun_direction": [float(x) for x in to_sun], **scales}
    aperture = p.number("sun_aperture", 0.5358) * p.number("sun_radius_scale", 1.0)
    found["sun_aperture"] = min(max(aperture, 0.01), 60.0)
    if aperture > 60.0:
        p.note("a sun of more than 60 degrees becomes one of 60")
    found["stretch"] = _within(p, "stretch", 1.0, 1.0, 2.0)
    if p.flag("extend"):
        p.note("extend is left out: the sky is black below the horizon")
    if not p.modern and scales["sun_scale"]:
        p.note("the sun is that of Hosek and Wilkie, where Mitsuba of this file's time had that of Preetham et al.")
    if not np.allclose(pose, np.eye(4), atol=1e-9):
        found["transform"] = [{"matrix": [[float(x) for x in row] for row in pose]}]
    if float((np.linalg.inv(pose) @ [*to_sun, 0.0])[1]) < 0.0:
        p.note("it is left out: its sun is below the horizon")
        return []
    return [found]


def join_skies(sky: Light, other: Light) -> bool:
    """Add a sun without a sky to a sky without a sun, or the other way round; return False where they do not fit."""
    dome, sun = (sky, other) if other["sky_scale"] == 0.0 else (other, sky)
    apart = dome["sun_scale"] == sun["sky_scale"] == 0.0
    if not apart or any(sky.get(key) != other.get(key) for key in ("turbidity", "sun_direction", "transform")):
        return False
    sky |= {**dome, "sun_scale": sun["sun_scale"], "sun_aperture": sun["sun_aperture"]}
    return True


def _within(p: Properties, name: str, default: float, low: float, high: float) -> float:
    """Return a number, the nearest in a range; note one outside."""
    value = p.number(name, default)
    if not low <= value <= high:
        p.note(f"{name} outside of {low:g}..{high:g} is clamped")
    return min(max(value, low), high)


def _upright(p: Properties) -> Matrix:
    """Return the transform ``(4, 4)`` of a sky whose up is +y; in files of Mitsuba 2 and 3 it is +z."""
    pose = _turn(p)
    return pose @ _Z_UP if p.modern else pose


def _turn(p: Properties) -> Matrix:
    """Return the rotation ``(4, 4)`` of ``to_world``, which may mirror; note a scale, by which Mitsuba's picture differs."""
    pose = np.eye(4)
    u, scales, v = np.linalg.svd(p.transform()[:3, :3])
    if not np.allclose(scales, 1.0, atol=_SCALED):
        p.note(
            "the scale of to_world is left out; Mitsuba's directions are not of length 1 then, and its picture differs"
        )
    if scales[1] > 0.0:
        pose[:3, :3] = u @ v
    return pose


#: Turns +y to +z.
_Z_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def _to_sun(p: Properties) -> Matrix:
    """Return the unit direction ``(3,)`` to the sun in the scene, given or by place and time."""
    given = p.point("sun_direction")
    latitude, longitude = p.number("latitude", 35.6894), p.number("longitude", 139.6917)
    timezone = p.number("timezone", 9.0)
    timed = p.plugin == "timed_sunsky"
    start = "start_" if timed else ""
    year, month, day = (
        p.integer(start + key, value)
        for key, value in (("year", 2025 if timed else 2010), ("month", 1 if timed else 7), ("day", 1 if timed else 10))
    )
    if timed:
        p.ignore("end_year", "end_month", "end_day")
        hours = 0.5 * (p.number("window_start_time", 7.0) + p.number("window_end_time", 19.0))
    else:
        hours = p.number("hour", 15.0) + p.number("minute", 0.0) / 60.0 + p.number("second", 0.0) / 3600.0
    if given is not None:
        return _unit(p, given)
    if not (1900 <= year <= 2100 and 1 <= month <= 12 and abs(hours) < 1e4 and abs(timezone) < 1e4 and abs(day) < 1e4):
        raise p.element.error([year, month, day, hours], "a date of 1900 to 2100, and an hour")
    zenith, azimuth = sun_angles(latitude, longitude, timezone, year, month, day, hours)
    level, up = math.sin(zenith), math.cos(zenith)
    north, east = level * math.cos(azimuth), level * math.sin(azimuth)
    # Mitsuba 3 has up as z, south as x and west as y; before, up was y, south z and east x.
    local = (-north, -east, up) if p.modern else (east, up, -north)
    return _unit(p, p.transform()[:3, :3] @ local)


def _unit(p: Properties, along: Any) -> Matrix:
    """Return a vector at length 1."""
    along = np.asarray(along, np.float64)
    if not (np.isfinite(along).all() and along.any()):
        raise p.element.error([float(x) for x in along], "a direction to the sun other than 0")
    along = along / np.abs(along).max()
    return along / np.linalg.norm(along)


#: Plugins of the tag ``emitter``.
EMITTERS: dict[str, Plugin] = {
    "area": exact("emission", lambda p, importer: [], "of the shape around it"),
    "point": exact("point", _point),
    "spot": exact("spot", _spot, "a texture of the beam is left out, with a warning"),
    "directional": exact("directional", _directional),
    "constant": exact("constant", _constant),
    "envmap": exact("envmap", _envmap),
    "sky": exact("sky", _sun_sky),
    "sun": exact("sky", _sun_sky, "before version 2 the sun was that of Preetham et al., with a warning"),
    "sunsky": exact("sky", _sun_sky, "before version 2 the sun was that of Preetham et al., with a warning"),
    "timed_sunsky": nearest("sky", _sun_sky, "the first day, at the middle of its hours"),
    "collimated": left_out("a beam without width meets no surface by chance"),
    "directionalarea": left_out("surfaces shine in all directions"),
    "projector": left_out("there are no projectors"),
    "volumelight": left_out("there are no media"),
}
