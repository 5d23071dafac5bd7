"""The clear sky and the sun of Hosek and Wilkie, an environment.

Radiance is evaluated by the formulas of :mod:`torchpt.physics.lights.hosek_wilkie`, black below the horizon. Half of the
samples go to the sky, by an environment map of it (:mod:`torchpt.physics.lights.kinds.envmap`) that serves as density
only, and half into the cone of the sun.

The light's own space has up +y, north -z and east +x.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.math.vectors import azimuth, dot, safe_reciprocal
from torchpt.physics.ibl.equirect import coordinates, corners, directions, solid_angles
from torchpt.physics.lights.base import Environment, EnvironmentImage, Row, Setting, bright
from torchpt.physics.lights.hosek_wilkie import SUN_RADIUS, sky_model, sky_radiance, sun_profile
from torchpt.physics.lights.kinds import envmap
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.lights.sun_position import sun_angles
from torchpt.spec import Angle, Color, Direction, Integer, Pose, Refused, Scalar

__all__ = ["Atmosphere", "Dome", "Sky", "Sun", "SunFrame", "direction_of", "sky_angles", "sky_turn"]

#: Rows and columns of the map; a row lies on the horizon.
_HEIGHT, _WIDTH = 257, 512
#: Smallest cosine of the angle from the zenith: the sky's formula has the square root of it, whose slope has no bound at 0.
_LEAST_COSINE = 1e-8
#: Points of the disc, in each of two directions, by which its light is summed.
_POINTS = 48
_BELOW_ONE = 1.0 - 2.0**-24


# ---- What is fixed once the scene is loaded: where the sun stands, and how the sky is turned


@dataclass(frozen=True)
class _FixedScalar(Scalar):
    """A number that is no tensor of ``scene.params``."""

    differentiable: ClassVar[bool] = False


@dataclass(frozen=True)
class _FixedAngle(Angle):
    """An angle that is no tensor of ``scene.params``."""

    differentiable: ClassVar[bool] = False


@dataclass(frozen=True)
class _FixedDirection(Direction):
    """A direction that is no tensor of ``scene.params``."""

    differentiable: ClassVar[bool] = False


@dataclass(frozen=True)
class _FixedPose(Pose):
    """A pose that is no tensor of ``scene.params``."""

    differentiable: ClassVar[bool] = False


#: Keys of the place and the time, which say where the sun is.
_TIME = ("latitude", "longitude", "timezone", "year", "month", "day", "hour", "minute", "second")

Matrix = NDArray[np.float64]


def sky_turn(values: Mapping[str, Any]) -> Matrix:
    """Return the orthogonal matrix ``(3, 3)`` from the world to the light's own space."""
    pose = values["transform"]
    if pose is None:
        return np.eye(3)
    linear = np.asarray(pose, np.float64)[:3, :3]
    return np.linalg.inv(linear) * abs(np.linalg.det(linear)) ** (1.0 / 3.0)


def _sun_direction(values: Mapping[str, Any]) -> Matrix:
    """Return the unit direction ``(3,)`` to the sun, in the light's own space, before ``stretch``."""
    given = values["sun_direction"]
    if given is not None:
        along = np.asarray(given, np.float64) / np.abs(given).max()
        return sky_turn(values) @ (along / np.linalg.norm(along))
    hours = values["hour"] + values["minute"] / 60.0 + values["second"] / 3600.0
    latitude, longitude, timezone, year, month, day = (values[key] for key in _TIME[:6])
    return direction_of(*sun_angles(latitude, longitude, timezone, year, month, day, hours))


def direction_of(zenith: float, bearing: float) -> Matrix:
    """Return the direction ``(3,)`` of angles from the zenith, and from north over east."""
    sine = math.sin(zenith)
    return np.array([sine * math.sin(bearing), math.cos(zenith), -sine * math.cos(bearing)])


def _angles(direction: Matrix) -> tuple[float, float]:
    """Return the angles of a direction ``(3,)`` from the zenith, and from north over east."""
    x, y, z = direction.tolist()
    return math.atan2(math.hypot(x, z), y), math.atan2(x, -z)


def sky_angles(values: Mapping[str, Any]) -> tuple[float, float]:
    """Return where the sun of a light stands, before ``stretch``: radians from the zenith, and from north over east."""
    return _angles(_sun_direction(values))


# ---- The records of the world


@dataclass(frozen=True)
class SunFrame:
    """Directions about the sun, ``(3,)`` each, unit, in the world.

    Attributes:
        axis: to its middle.
        side: level, across the axis.
        rise: from the middle of the disc to its upper rim.
    """

    axis: Tensor
    side: Tensor
    rise: Tensor


@dataclass(frozen=True)
class Sun:
    """The sun's disc.

    Attributes:
        frame: where it is.
        over_sine: ``()`` one over the sine of its angular radius.
        cap: ``()`` one minus the cosine of its angular radius.
        scale: ``()`` factor of the radiance.
        profile: six of ``(4, 3)``, radiance as :func:`~torchpt.physics.lights.hosek_wilkie.sun_profile` has it. Kernels sum no
            gradient of a larger tensor in each lane.
    """

    frame: SunFrame
    over_sine: Tensor
    cap: Tensor
    scale: Tensor
    profile: tuple[Tensor, ...]


@dataclass(frozen=True)
class Atmosphere:
    """The sky without its sun.

    Attributes:
        turn: ``(3, 3)`` orthogonal, from the world to the light's own space; its second row is the zenith.
        model: parameters ``(9, 3)`` and mean radiance ``(3,)``, scaled.
        about: where the sun is for the formula: that of the disc, or before ``stretch``.
        stretch: ``()`` factor of all angles from the zenith; None for 1.
        horizon: ``()`` cosine of the angle from the zenith below which all is black.
    """

    turn: Tensor
    model: tuple[Tensor, Tensor]
    about: SunFrame
    stretch: Tensor | None
    horizon: Tensor


@dataclass(frozen=True)
class Dome:
    """The sky and its sun.

    Attributes:
        atmosphere: the sky.
        sun: the sun.
        map: the density of samples of the sky, in the light's own space.
        share: ``()`` probability with which light sampling takes the map, else the sun.
    """

    atmosphere: Atmosphere
    sun: Sun
    map: envmap.EnvironmentMap
    share: Tensor


def _sky(atmosphere: Atmosphere, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radiance ``(3, N)`` of the sky from unit directions, 0 below the horizon; and whether they are above it."""
    up = atmosphere.turn[1][:, None]
    cosine = dot(up, d)
    above = cosine >= atmosphere.horizon
    if atmosphere.stretch is not None:
        level = torch.addcmul(d, up, cosine, value=-1)
        sine = dot(level, level).clamp_min(_LEAST_COSINE**2).sqrt()
        zenith = (azimuth(cosine, sine) * (1.0 / atmosphere.stretch)).clamp_max(0.5 * math.pi)
        cosine = torch.cos(zenith)
        d = up * cosine + level * (torch.sin(zenith) / sine)
    cos_gamma, across, rise = (
        dot(axis[:, None], d) for axis in (atmosphere.about.axis, atmosphere.about.side, atmosphere.about.rise)
    )
    sin_gamma = torch.addcmul(across * across, rise, rise).clamp_min(_LEAST_COSINE**2).sqrt()
    gamma = azimuth(cos_gamma, sin_gamma)
    radiance = sky_radiance(atmosphere.model, cosine.clamp_min(_LEAST_COSINE), cos_gamma, gamma)
    return torch.where(above, radiance, 0.0), above


def _disc(sun: Sun, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radiance ``(3, N)`` of the sun along unit directions as if they met it, and whether they do ``(N,)``."""
    across = dot(sun.frame.side[:, None], d) * sun.over_sine  # on the disc, whose radius is 1
    up = dot(sun.frame.rise[:, None], d) * sun.over_sine
    square = across * across + up * up
    met = (square <= 1.0) & (dot(sun.frame.axis[:, None], d) > 0.0)
    m = (1.0 - square).clamp_min(1e-12).sqrt()
    v = up.clamp(-1.0, 1.0)
    radiance: Tensor | None = None
    for coefficients in reversed(sun.profile):
        a, b, c, e = (coefficients[k][:, None] for k in range(4))
        term = ((e * v + c) * v + b) * v + a
        radiance = term if radiance is None else radiance * m + term
    assert radiance is not None
    return radiance.clamp_min(0.0) * sun.scale, met


def _toward_sun(sun: Sun, u: Tensor) -> Tensor:
    """Return unit directions ``(3, N)`` uniform over the disc for ``u (2, N)`` in [0, 1)."""
    missing = u[0] * sun.cap  # one minus the cosine of the angle from the axis
    sine = (missing * (2.0 - missing)).sqrt()
    phi = u[1] * (2.0 * math.pi)
    across, up = sine * torch.cos(phi), sine * torch.sin(phi)
    axis, side, rise = (x[:, None] for x in (sun.frame.axis, sun.frame.side, sun.frame.rise))
    return axis * (1.0 - missing) + side * across + rise * up


def _shining(dome: Dome, d: Tensor, mis: bool, aimed: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return radiance ``(3, N)`` from unit directions and their density ``(N,)``.

    Args:
        dome: the sky.
        d: ``(3, N)``.
        mis: whether samples are combined with BSDF sampling by MIS.
        aimed: ``(N,)`` True for directions that were sampled on the sun, which meet it whatever rounding says.
    """
    light, above = _sky(dome.atmosphere, d)
    sun, met = _disc(dome.sun, d)
    met = met if aimed is None else met | aimed
    cone = (1.0 - dome.share) / (2.0 * math.pi * dome.sun.cap)
    density = envmap.pdf(dome.map, d, mis) * dome.share + torch.where(met, cone, 0.0)
    return light + torch.where(met & above, sun, 0.0), density


def _sun_points(sun: Sun, atmosphere: Atmosphere) -> tuple[Tensor, Tensor]:
    """Return directions ``(3, N)`` to the sun and the radiance ``(3, N)`` from each, 0 below the horizon."""
    like = sun.cap
    middles = (torch.arange(_POINTS, dtype=torch.float64, device=like.device) + 0.5) / _POINTS
    d = _toward_sun(sun, torch.cartesian_prod(middles, middles).T.to(like.dtype))
    above = dot(atmosphere.turn[1][:, None], d) >= atmosphere.horizon
    return d, torch.where(above, _disc(sun, d)[0], 0.0)


# ---- The light


def _frame(zenith: float, bearing: float, turn: Matrix) -> Matrix:
    """Return the rows ``(3, 3)`` of a :class:`SunFrame` in the world, of a sun at two angles of the light's own space."""
    rows = (direction_of(zenith, bearing), (math.cos(bearing), 0.0, math.sin(bearing)))
    return np.stack((*rows, direction_of(zenith - 0.5 * math.pi, bearing))) @ turn


def _texels(atmosphere: Atmosphere, below: float) -> Tensor:
    """Return the sky at the texels of the map ``(3, H, W)``; ``below`` lowers the cosine of the horizon."""
    d = directions(_HEIGHT, _WIDTH).to(atmosphere.turn).reshape(3, -1)
    world = torch.stack([dot(atmosphere.turn[:, k][:, None], d) for k in range(3)])
    return _sky(replace(atmosphere, horizon=atmosphere.horizon - below), world)[0].view(3, _HEIGHT, _WIDTH)


class Sky(Environment):
    """The clear sky and the sun of Hosek and Wilkie."""

    name = "sky"
    parameters: ClassVar = {
        "turbidity": Scalar(3.0, low=1.0, high=10.0, doc="haze: 2 arctic, 3 clear, 6 warm and moist, 10 hazy"),
        "albedo": Color(0.3, high=1.0, doc="reflectance of the ground that lights the sky"),
        "sky_scale": Scalar(1.0, doc="factor of the sky's radiance"),
        "sun_scale": Scalar(1.0, doc="factor of the sun's radiance"),
        "sun_direction": _FixedDirection(None, doc="direction to the sun in the scene; in place of place and time"),
        "latitude": _FixedScalar(35.6894, low=-90.0, high=90.0, doc="degrees north"),
        "longitude": _FixedScalar(139.6917, low=-180.0, high=180.0, doc="degrees east"),
        "timezone": _FixedScalar(9.0, low=-16.0, high=16.0, doc="hours ahead of Greenwich, summer time included"),
        "year": Integer(2010, low=1900, high=2100, doc="year"),
        "month": Integer(7, low=1, high=12, doc="month"),
        "day": Integer(10, low=1, high=31, doc="day of the month"),
        "hour": _FixedScalar(15.0, low=0.0, high=24.0, doc="local time: hours since midnight"),
        "minute": _FixedScalar(0.0, low=0.0, high=60.0, doc="minutes after the hour"),
        "second": _FixedScalar(0.0, low=0.0, high=60.0, doc="seconds after the minute"),
        "sun_aperture": _FixedAngle(0.5358, low=0.01, high=60.0, doc="how wide the sun looks; its irradiance stays"),
        "stretch": _FixedScalar(1.0, low=1.0, high=2.0, doc="factor of all angles from the zenith, past the horizon"),
        "transform": _FixedPose(
            None,
            angles=True,
            doc="from a space where up is +y, north -z and east +x; rotation, may mirror",
        ),
    }

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :meth:`Light.check`; refuse two places of the sun, and one below the horizon."""
        both = [key for key in _TIME if key in given]
        if values["sun_direction"] is not None and both:
            raise Refused("either sun_direction or a place and a time, not both", values[both[0]], (both[0],))
        height = math.degrees(0.5 * math.pi - sky_angles(values)[0])
        if height < -1e-6:  # rounding lets no sun set
            key = "hour" if values["sun_direction"] is None else "sun_direction"
            raise Refused(f"a sun above the horizon (it stands at {height:.1f} degrees)", values[key], (key,))

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """See :meth:`Light.row`; :attr:`Row.environment` is a :class:`Dome`."""
        turbidity, albedo, sky_scale, sun_scale = (
            scene[key] for key in ("turbidity", "albedo", "sky_scale", "sun_scale")
        )
        values, device = scene.values, turbidity.device
        zenith, bearing = sky_angles(values)
        stretch, elevation = values["stretch"], max(0.0, 0.5 * math.pi - zenith)

        def number(value: Any) -> Tensor:
            return torch.as_tensor(value, dtype=torch.float64, device=device).to(scene.dtype)

        turn = sky_turn(values)
        before, after = (SunFrame(*map(number, _frame(z, bearing, turn))) for z in (zenith, zenith * stretch))
        parameters, mean = sky_model(turbidity, albedo, elevation)
        horizon = math.cos(0.5 * math.pi * stretch) if stretch > 1.0 else 0.0
        atmosphere = Atmosphere(
            turn=number(turn),
            model=(number(parameters), number(mean * sky_scale)),
            about=before,
            stretch=number(stretch) if stretch > 1.0 else None,
            horizon=number(horizon if stretch < 2.0 else -1.01),  # rounding hides no direction
        )
        half = math.radians(values["sun_aperture"]) / 2.0
        cap = 2.0 * math.sin(half / 2.0) ** 2
        wider = 2.0 * math.sin(SUN_RADIUS / 2.0) ** 2 / cap  # a wider sun sends as much light
        profile = tuple(map(number, (sun_profile(turbidity, elevation) * wider).unbind()))
        sun = Sun(after, number(1.0 / math.sin(half)), number(cap), number(sun_scale), profile)
        # Half of the samples each, whatever the numbers; all for one where the other is switched off.
        sky_off, sun_off = (
            torch.zeros_like(scale) if scale.requires_grad else (scale.detach() == 0.0).double()
            for scale in (sky_scale, sun_scale)
        )
        share = 0.5 + 0.5 * (sun_off - sky_off)
        # Texels on the horizon, and those next below it where no row lies on it, have the sky's colour.
        texels = _texels(atmosphere, 1e-4 if stretch == 1.0 else math.pi / (_HEIGHT - 1))
        density = envmap.build(texels.detach().permute(1, 2, 0), atmosphere.turn, number(1.0))
        color = _mean_sky(texels.double(), horizon) + _sun_points(sun, atmosphere)[1].double().mean(1) * (0.5 * cap)
        # From each direction through a disk as wide as the scene, whose radius is `reach`; `bright` is the detached luminance.
        power = 4.0 * math.pi**2 * scene.reach**2 * bright(color)
        return Row(radiance=color, power=power, environment=Dome(atmosphere, sun, density, number(share)))

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """See :meth:`Light.sample`."""
        dome: Dome = at.environment
        share = dome.share
        aimed = u[0] >= share
        rest = torch.where(aimed, (u[0] - share) * safe_reciprocal(1.0 - share), u[0] * safe_reciprocal(share))
        remapped = torch.stack((rest.to(u.dtype).clamp(0.0, _BELOW_ONE), u[1]))
        wi, _, _ = envmap.sample(dome.map, remapped, mis)
        wi = torch.where(aimed, _toward_sun(dome.sun, remapped.to(wi.dtype)), wi)
        light, density = _shining(dome, wi, mis, aimed)
        weight = torch.where(density > 0, safe_reciprocal(density), 0.0)
        return LightSample(wi=wi, target=wi, distant=None, radiance=light, pdf=density, weight=weight)

    @classmethod
    def radiance_pdf(cls, around: Dome, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
        """See :meth:`Environment.radiance_pdf`."""
        radiance, density = _shining(around, d, mis)
        return radiance, density.detach()

    @classmethod
    def environment_image(cls, around: Dome) -> EnvironmentImage:
        """See :meth:`Environment.environment_image`; the sun is spread over the texels next to it."""
        texture = around.map
        d, radiance = _sun_points(around.sun, around.atmosphere)
        local = torch.stack([dot(texture.turn[k][:, None], d) for k in range(3)])
        cells, weights = corners(*coordinates(local), texture.height, texture.width)
        size = solid_angles(texture.height, texture.width).to(d).repeat_interleave(texture.width)
        each = radiance * (around.sun.cap * (2.0 * math.pi / d.shape[1]))  # of a point, times its solid angle
        texels = _texels(around.atmosphere, 1e-4).reshape(3, -1)
        for cell, weight in zip(cells, weights, strict=True):
            texels = texels.index_add(1, cell, each * (weight / size[cell]))
        return EnvironmentImage(texels=texels.T.reshape(texture.height, texture.width, 3), turn=texture.turn)

    @classmethod
    def info(cls, around: Dome) -> dict[str, Any]:
        """See :meth:`Environment.info`."""
        zenith, bearing = _angles((around.map.turn @ around.sun.frame.axis).double().cpu().numpy())
        sun = {"elevation": round(90.0 - math.degrees(zenith), 3), "azimuth": round(math.degrees(bearing) % 360.0, 3)}
        return {
            "sun": sun,
            "texels": [around.map.width, around.map.height],
            "mis_compensation": around.map.compensated is not None,
        }


def _mean_sky(texels: Tensor, horizon: float) -> Tensor:
    """Return the mean radiance ``(3,)`` over the sphere of a sky ``(3, H, W)`` that ends at the cosine ``horizon``."""
    cosines = torch.linspace(0.0, math.pi, _HEIGHT, dtype=torch.float64, device=texels.device).cos().clamp_min(horizon)
    rows = texels.mean(2)
    return 0.25 * ((rows[:, 1:] + rows[:, :-1]) * (cosines[:-1] - cosines[1:])).sum(1)
