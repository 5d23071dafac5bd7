"""Spot lights: points that emit in a cone about ``Lights.normal``; ``Lights.e1`` holds the cutoff angle and the slope.

The intensity is constant up to the beam's edge and falls linearly in the angle to zero at the cutoff, as in Mitsuba's ``spot``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.sampling import uniform_cone
from torchpt.math.vectors import Frame, azimuth, cross, dot, luminance, normalize
from torchpt.physics.lights.base import BoundingSphere, Cone, EmittedRay, Light, Row, Setting, bright
from torchpt.physics.lights.kinds import point
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.spec import Angle, Color, Moves, Point, Refused

__all__ = ["Spot", "falloff"]


def falloff(wi: Tensor, axis: Tensor, cutoff: Tensor, slope: Tensor) -> Tensor:
    """Return the fraction ``(N,)`` of the intensity along ``-wi``.

    Args:
        wi: unit directions toward the light ``(3, N)``.
        axis: unit ``(3, N)``.
        cutoff: cutoff angle in radians ``(N,)``.
        slope: one over the angle from the beam's edge to the cutoff ``(N,)``.
    """
    aside = cross(axis.expand_as(wi), wi)
    sine = dot(aside, aside).clamp_min(torch.finfo(wi.dtype).tiny).sqrt()
    # `azimuth(cosine, sine)` is the angle between the axis and the direction away from the light.
    return ((cutoff - azimuth(-dot(wi, axis), sine)) * slope).clamp(0.0, 1.0)


def _width(cutoff: Tensor) -> Tensor:
    """Return ``1 - cos(cutoff)``, positive also for angles below a float's resolution of the cosine."""
    half = torch.sin(0.5 * cutoff)
    return (2.0 * half * half).clamp_min(torch.finfo(cutoff.dtype).tiny)


def _most_of_the_cone(values: Mapping[str, Any]) -> float:
    """Return the default beam width, as in Mitsuba."""
    return 0.75 * values["cutoff_angle"]


class Spot(Light):
    """A point that emits in a cone about the direction to ``target``."""

    name = "spot"
    parameters: ClassVar = {
        "position": Point(moves=Moves.SHADOWS, doc="position"),
        "target": Point(moves=Moves.SHADOWS, doc="point at which the light is aimed"),
        "intensity": Color((1.0, 1.0, 1.0), doc="radiant intensity within the beam"),
        "cutoff_angle": Angle(20.0, above=0.0, high=180.0, doc="angle from the axis beyond which nothing is emitted"),
        "beam_width": Angle(
            _most_of_the_cone,
            above=0.0,
            high=180.0,
            doc="angle from the axis up to which the intensity is constant; it falls linearly from there to 0 at the cutoff",
        ),
    }
    places = (
        "position",
    )  # parameters that are points, by which the world's unit is chosen; the target is a direction only

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :meth:`Light.check`."""
        if values["position"] == values["target"]:
            raise Refused("a point other than the position", list(values["target"]), ("target",))
        if values["beam_width"] > values["cutoff_angle"]:
            expected = f"an angle of at most cutoff_angle ({values['cutoff_angle']:g})"
            raise Refused(expected, values["beam_width"], ("beam_width",))

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """See :meth:`Light.row`."""
        color = scene.intensity("intensity")
        axis = normalize((scene["target"] - scene["position"])[:, None])[:, 0]
        cutoff, beam = (scene[key] * (math.pi / 180.0) for key in ("cutoff_angle", "beam_width"))
        # Slope of the falloff from the beam's edge to the cutoff; finite where both are equal.
        slope = 1.0 / (cutoff - beam).clamp_min(1e-6)
        # The solid angle of a linear falloff from a to b depends on the mean cosine between them, which is this product.
        mean = torch.cos(0.5 * (cutoff + beam)) * torch.sinc((cutoff - beam) * (0.5 / math.pi))
        solid_angle = 2.0 * math.pi * (1.0 - mean).detach()
        numbers = torch.stack((cutoff, slope, torch.zeros_like(cutoff)))
        power = solid_angle * bright(color)  # `bright` is the detached luminance
        return Row(radiance=color, power=power, p0=scene.point("position"), e1=numbers, normal=axis)

    @classmethod
    def bounds(cls, at: Lights, intensity: Tensor) -> Cone:
        """See :meth:`Emitter.bounds`: the cone of the beam, extended by the angle from its edge to the cutoff."""
        cutoff, slope = at.e1[0], at.e1[1]
        edge = 1.0 / slope  # angle from the beam's edge to the cutoff
        return Cone(
            cos_o=torch.cos((cutoff - edge).clamp_min(0.0)),
            cos_e=torch.cos(edge),
            intensity=luminance(at.radiance.abs()),
        )

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """See :meth:`Light.sample`."""
        drawn = point.Point.sample(at, x, u, mis)
        fraction = falloff(drawn.wi, axis=at.normal, cutoff=at.e1[0], slope=at.e1[1])
        return replace(drawn, radiance=drawn.radiance * fraction)

    @classmethod
    def emit(cls, at: Lights, u: Tensor, v: Tensor, sphere: BoundingSphere, mis: bool) -> EmittedRay:
        """See :meth:`Light.emit`: evenly within the cone."""
        axis = at.normal.expand(3, v.shape[1])
        d = Frame.about(axis).to_world(uniform_cone(v.to(axis.dtype), _width(at.e1[0])))
        fraction = falloff(-d, axis=at.normal, cutoff=at.e1[0], slope=at.e1[1])
        one = torch.ones_like(d[0])
        density = cls.emission_density(at, one, sphere)
        return EmittedRay(at.p0.expand_as(d), d, at.radiance * fraction, density, one)

    @classmethod
    def emission_density(cls, at: Lights, pdf: Tensor, sphere: BoundingSphere) -> Tensor:
        """See :meth:`Light.emission_density`: by solid angle alone."""
        return (0.5 / math.pi) / _width(at.e1[0]).expand_as(pdf)
