"""Rays that leave the lights, from which light paths start, and their densities.

A light is chosen by power, then a point on it by area and a direction by the cosine; of a distant light a direction, and a
point on a disk as wide as the scene. The density of a ray is one by area across the ray and by solid angle, so it does not
depend on how the light's surface is turned: of a Lambertian surface of area A it is ``1 / (pi A)``. A light without extent has
a density by one of the two alone. Radiance (or intensity, or irradiance) over the density is the weight of a light path, as
in Veach, *Robust Monte Carlo Methods for Light Transport Simulation*, 1997, section 10.3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.math.sampling import Distribution1D, cosine_hemisphere
from torchpt.math.vectors import Frame, dot, safe_reciprocal, take
from torchpt.physics.lights import choice, solid_angle
from torchpt.physics.lights.base import KINDS, BoundingSphere, lane_rows
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.lights.surface import Surface
from torchpt.physics.lights.table import (
    inverse_pdf,
    kind_indices,
    off_surface,
    pick,
    remapped,
    sizes,
    surface_kinds,
    textured_point,
)
from torchpt.physics.shapes.geometry import Interaction

__all__ = [
    "Emission",
    "LightRay",
    "density_of_environment",
    "density_of_hit",
    "density_of_sample",
    "emission_of",
    "emit",
    "light_weight",
]


@dataclass(frozen=True)
class Emission:
    """The lights as light paths leave them.

    Attributes:
        lights: the table.
        choice: of a row, by power; None for a single row.
        sphere: a ball around the scene, through which light of distant lights is sent.
    """

    lights: Lights
    choice: Distribution1D | None
    sphere: BoundingSphere


@dataclass(frozen=True)
class LightRay:
    """Rays that leave lights, N lanes.

    Attributes:
        row: ``(N,)`` int64 row in the table; None for a single row.
        o: origins ``(3, N)``, moved off the light's surface.
        d: unit directions ``(3, N)``.
        p: the points ``(3, N)`` on the light's surface; ``o`` where it has none.
        normal: unit normals ``(3, N)`` there; None where no surface emits.
        radiance: ``(3, N)`` along the ray, without textures; the intensity or irradiance of a light without extent.
        density: ``(N,)`` of the ray, with the probability of the light.
        met: ``(N,)`` 1 where a ray can meet the light, 0 for lights without extent.
        direction_pdf: ``(N,)`` density of ``-d`` seen from anywhere; of environments.
        at: the points, for textured emission; None without it.
        bare: ``(N,)`` bool: the light has no surface; None: nowhere.
    """

    row: Tensor | None
    o: Tensor
    d: Tensor
    p: Tensor
    normal: Tensor | None
    radiance: Tensor
    density: Tensor
    met: Tensor
    direction_pdf: Tensor
    at: Interaction | None
    bare: Tensor | None


def emission_of(lights: Lights, centre: Tensor, radius: Tensor) -> Emission:
    """Return the lights as light paths leave them.

    Args:
        lights: the table.
        centre: ``(3,)`` centre of a ball around all surfaces.
        radius: ``()`` its radius.
    """
    dtype = lights.area.dtype
    chosen = None if len(lights.power) == 1 else Distribution1D.of(lights.power, dtype)
    # A little wider, so that rounding leaves no surface outside.
    return Emission(lights, chosen, BoundingSphere(centre.to(dtype), (radius * (1.0 + 2.0**-12)).to(dtype)))


def emit(emission: Emission, which: Tensor | None, u: Tensor, v: Tensor, offset: float, mis: bool = True) -> LightRay:
    """Sample rays that leave the lights.

    Args:
        emission: the lights.
        which: ``(N,)`` float64 in [0, 1), chooses the light; remapped, it replaces ``u[0]``. None for a single light.
        u: ``(2, N)`` in [0, 1), chooses the point; of a distant light the direction.
        v: ``(2, N)`` in [0, 1), chooses the direction; of a distant light the point.
        offset: distance of the origins from the light's surface, in units of ``Lights.bound``.
        mis: whether light paths are combined with other strategies by MIS, as for :func:`torchpt.physics.lights.sample`.
    """
    lights, row, probability = emission.lights, None, torch.ones_like(u[0])
    if emission.choice is not None and which is not None:
        row, rest = emission.choice.draw(which)
        probability, u = take(emission.choice.pmf, row), remapped(u, rest)
    at, number = lane_rows(lights, row), kind_indices(lights, row)
    surfaces = surface_kinds(lights)
    found = _leaving_surfaces(lights, at, row, number, surfaces, u, v, offset) if surfaces else None
    bare: Tensor | None = None
    for k, name in enumerate(lights.kinds[len(surfaces) :], len(surfaces)):
        in_kinds = torch.ones_like(u[0], dtype=torch.bool) if number is None else number >= k
        bare = in_kinds if bare is None else bare
        ray = KINDS[name].emit(at, u, v, emission.sphere, mis)
        one = torch.ones_like(ray.density)
        met = one if KINDS[name].environment else torch.zeros_like(one)
        given = LightRay(row, ray.o, ray.d, ray.o, None, ray.radiance, ray.density, met, ray.pdf, None, None)
        found = given if found is None else _merged(in_kinds, given, found)
    assert found is not None
    return replace(found, density=found.density * probability, bare=bare)


def _merged(mask: Tensor, a: LightRay, b: LightRay) -> LightRay:
    """Return ``a`` where ``mask`` is True, else ``b``."""
    names = ("o", "d", "p", "radiance", "density", "met", "direction_pdf")
    return replace(b, **{name: torch.where(mask, getattr(a, name), getattr(b, name)) for name in names})


def _leaving_surfaces(
    lights: Lights,
    at: Lights,
    row: Tensor | None,
    number: Tensor | None,
    kinds: list[tuple[int, type[Surface]]],
    u: Tensor,
    v: Tensor,
    offset: float,
) -> LightRay:
    """Return rays that leave surfaces, without the choice of the light; values in lanes of other lights are arbitrary."""
    p: Tensor | None = None
    normal: Tensor | None = None
    uv, in_object = torch.zeros_like(u), None
    for k, kind in kinds:
        found = kind.sample_area(at, u)
        p, normal = pick(number, k, found.p, p), pick(number, k, found.normal.expand_as(found.p), normal)
        uv = uv if found.uv is None else pick(number, k, found.uv, uv)
        in_object = in_object if found.own is None else found.own
    assert p is not None and normal is not None
    density = _surface_density(at, kinds, number, normal)
    one = torch.ones_like(p[0])
    return LightRay(
        row=row,
        o=off_surface(at, kinds, number, p, normal, offset),
        d=Frame.about(normal).to_world(cosine_hemisphere(v)),
        p=p,
        normal=normal,
        radiance=(at.radiance if at.opacity is None else at.radiance * at.opacity).expand_as(p),
        density=density.expand_as(one),
        met=one,
        direction_pdf=one,
        at=None if lights.prim is None else textured_point(lights, row, p, normal, uv, in_object),
        bare=None,
    )


def _surface_density(
    at: Lights, kinds: list[tuple[int, type[Surface]]], number: Tensor | None, normal: Tensor
) -> Tensor:
    """Return the density ``(N,)`` of rays that leave surfaces at unit normals ``normal (3, N)``."""
    return safe_reciprocal(sizes(at, kinds, number, normal) * math.pi)


def _probability(emission: Emission, row: Tensor | None) -> Tensor | float:
    return 1.0 if emission.choice is None or row is None else take(emission.choice.pmf, row)


def density_of_sample(emission: Emission, sample: LightSample) -> Tensor:
    """Return the density ``(N,)`` with which :func:`emit` draws the rays of light samples, the other way."""
    lights, row = emission.lights, sample.row
    at, number, surfaces = lane_rows(lights, row), kind_indices(lights, row), surface_kinds(lights)
    density: Tensor | None = None
    if surfaces:
        assert sample.normal is not None
        density = _surface_density(at, surfaces, number, sample.normal)
    for k, name in enumerate(lights.kinds[len(surfaces) :], len(surfaces)):
        kind = KINDS[name]
        pdf = sample.pdf / choice.environment(lights.choice) if kind.environment else sample.pdf
        density = pick(number, k, kind.emission_density(at, pdf, emission.sphere), density)
    assert density is not None
    return (density * _probability(emission, row)).expand_as(sample.pdf)


def density_of_hit(emission: Emission, at: Interaction) -> Tensor:
    """Return the density ``(N,)`` with which :func:`emit` draws rays from points on emissive primitives."""
    lights = emission.lights
    assert lights.row_of_prim is not None
    row = take(lights.row_of_prim, at.slot) if len(lights.area) > 1 else None
    table = lane_rows(lights, row)
    density = _surface_density(table, surface_kinds(lights), kind_indices(lights, row), at.ng)
    return density * _probability(emission, row)


def density_of_environment(emission: Emission, pdf: Tensor) -> Tensor:
    """Return the density ``(N,)`` with which :func:`emit` draws rays of the environment.

    ``pdf``: density ``(N,)`` of their directions, as :func:`torchpt.physics.lights.environment` returns it.
    """
    lights = emission.lights
    pdf = pdf / choice.environment(lights.choice)
    probability = 1.0 if emission.choice is None else emission.choice.pmf[-1]
    return KINDS[lights.kinds[-1]].emission_density(lights, pdf, emission.sphere) * probability


def light_weight(emission: Emission, ray: LightRay, x: Tensor, n: Tensor | None) -> Tensor:
    """Return one over the density ``(N,)`` with which a light sample at ``x`` is the start of a ray that came to ``x``.

    It is ``LightSample.weight``: per steradian, of a light without extent the factor of its intensity or irradiance.

    Args:
        emission: the lights.
        ray: the rays.
        x: the points ``(3, N)`` that they came to.
        n: normals there, as for :func:`torchpt.physics.lights.sample`.
    """
    lights, row = emission.lights, ray.row
    at, number, surfaces = lane_rows(lights, row), kind_indices(lights, row), surface_kinds(lights)
    weight: Tensor | None = None
    if surfaces:
        assert ray.normal is not None
        to = ray.p - x
        square = dot(to, to)
        wi = to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()
        angle = None if lights.solid is None else solid_angle.angles(lights.solid, row, x, lights.shapes)
        weight = inverse_pdf(at, surfaces, number, x, ray.normal, wi, square, angle)
    for k, name in enumerate(lights.kinds[len(surfaces) :], len(surfaces)):
        kind = KINDS[name]
        if kind.environment:
            own = safe_reciprocal(ray.direction_pdf)
        else:  # the weight depends on no random number
            own = kind.sample(at, x, torch.zeros_like(x[:2]), mis=True).weight
        weight = pick(number, k, own, weight)
    assert weight is not None
    if lights.choice is not None and row is not None:
        weight = weight / choice.probability(lights.choice, row, x, n)
    return weight
