"""Sample the light table, and evaluate emission and its pdf for MIS.

Rows are emissive primitives, then lights without a surface, the environment last. The class of a row's kind samples it
(:mod:`torchpt.physics.lights.surface`, :mod:`torchpt.physics.lights.base`); the functions here loop over the kinds of the
scene and merge the results. Absent kinds cost nothing, as ``Lights.kinds`` is static; a single row is neither chosen nor
gathered.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.math.vectors import dot, safe_reciprocal, take
from torchpt.physics.lights import choice, solid_angle
from torchpt.physics.lights.base import COLUMNS, KINDS, Environment, EnvironmentImage, lane_rows
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.lights.surface import SURFACES, Surface, emitter, flat_inverse_pdf, flat_point
from torchpt.physics.shapes.geometry import Interaction

__all__ = [
    "emitted",
    "environment",
    "environment_image",
    "inverse_pdf",
    "kind_indices",
    "off_surface",
    "pick",
    "remapped",
    "sample",
    "sizes",
    "surface_kinds",
    "textured_point",
    "without_environment",
]

#: The largest float32 below 1.
_BELOW_ONE = 1.0 - 2.0**-24


def surface_kinds(lights: Lights) -> list[tuple[int, type[Surface]]]:
    """Return the kinds of emissive surfaces in the table, each with its index in ``Lights.kinds``."""
    return [(number, SURFACES[name]) for number, name in enumerate(lights.kinds) if name in SURFACES]


def kind_indices(lights: Lights, row: Tensor | None) -> Tensor | None:
    """Return the index of each lane's kind ``(N,)``; None for a single kind."""
    if len(lights.kinds) == 1:
        return None
    assert lights.kind is not None and row is not None
    return take(lights.kind, row)


def remapped(u: Tensor, rest: Tensor) -> Tensor:
    """Return ``u (2, N)`` with ``rest (N,)``, float64 in [0, 1], which the choice of a light has left, as its first row."""
    return torch.stack((rest.to(u.dtype).clamp_max(_BELOW_ONE), u[1]))


def pick(number: Tensor | None, k: int, a: Tensor, b: Tensor | None) -> Tensor:
    """Return ``a`` in the lanes whose kind is ``k``, else ``b``; ``a`` everywhere without ``b`` or with a single kind."""
    return a if number is None or b is None else torch.where(number == k, a, b)


def sample(
    lights: Lights,
    x: Tensor,
    which: Tensor | None,
    u: Tensor,
    offset: float,
    n: Tensor | None = None,
    mis: bool = True,
) -> LightSample:
    """Choose a light and sample a point on it, as seen from ``x``.

    Args:
        lights: the table.
        x: reference points ``(3, N)``.
        which: ``(N,)`` float64 in [0, 1), chooses the light; remapped, it replaces ``u[0]``. None for a single light.
        u: ``(2, N)`` in [0, 1), chooses the point.
        offset: distance of the end of shadow rays from the light's surface, in units of ``Lights.bound``.
        n: normals ``(3, N)`` of opaque surfaces, zero for others; None: no such surface. Needed if
            :func:`torchpt.physics.lights.choice.depends_on_point` is True.
        mis: whether the sample is combined with BSDF sampling by MIS: environment maps then leave dim directions to it.
    """
    row: Tensor | None = None
    probability: Tensor | float = 1.0
    if lights.choice is not None and which is not None:
        row, probability, rest = choice.draw(lights.choice, which, x, n)
        u = remapped(u, rest)
    at, number = lane_rows(lights, row), kind_indices(lights, row)
    surfaces = surface_kinds(lights)
    drawn = _on_surfaces(lights, at, row, number, x, u, offset, probability) if surfaces else None
    bare: Tensor | None = None
    distant: Tensor | None = None
    for k, name in enumerate(lights.kinds[len(surfaces) :], len(surfaces)):
        kind = KINDS[name]
        # Rows are sorted by kind: this kind and all later ones; those overwrite it below.
        in_kinds = torch.ones_like(at.area, dtype=torch.bool) if number is None else number >= k
        bare = in_kinds if bare is None else bare
        distant = in_kinds if distant is None and kind.distant else distant
        found = kind.sample(at, x, u, mis)
        found = replace(found, pdf=found.pdf * probability, weight=found.weight / probability)
        drawn = found if drawn is None else _merged(in_kinds, found, drawn)
    assert drawn is not None
    return replace(drawn, distant=distant, bare=bare, row=row)


def _merged(mask: Tensor, a: LightSample, b: LightSample) -> LightSample:
    """Return ``a`` where ``mask`` is True, else ``b``."""
    names = ("wi", "target", "radiance", "pdf", "weight")
    return replace(b, **{name: torch.where(mask, getattr(a, name), getattr(b, name)) for name in names})


def _on_surfaces(
    lights: Lights,
    at: Lights,
    row: Tensor | None,
    number: Tensor | None,
    x: Tensor,
    u: Tensor,
    offset: float,
    probability: Tensor | float,
) -> LightSample:
    """Return samples of emissive surfaces; values in lanes of other lights are arbitrary.

    Args:
        lights: the table.
        at: rows of the table, one a lane.
        row: their numbers ``(N,)``; None for a single row.
        number: index of each lane's kind ``(N,)``; None for a single kind.
        x: reference points ``(3, N)``.
        u: ``(2, N)`` in [0, 1).
        offset: as for :func:`sample`.
        probability: of the choice of the light ``(N,)``.
    """
    target: Tensor | None = None
    normal: Tensor | None = None
    in_object: Tensor | None = None  # SurfaceSample.own, of quadrics
    uv, angle, kinds = torch.zeros_like(u), None, surface_kinds(lights)
    if lights.solid is not None:
        uv, angle = solid_angle.sample(lights.solid, row, x, u, lights.shapes)
        target, normal = flat_point(at.p0, at.e1, at.e2, uv), at.normal.expand_as(x)
    for k, kind in kinds:
        if kind.code != solid_angle.OTHER:  # sampled above, by solid angle
            continue
        found = kind.sample(at, x, u)
        target, normal = pick(number, k, found.p, target), pick(number, k, found.normal, normal)
        uv = uv if found.uv is None else pick(number, k, found.uv, uv)
        in_object = in_object if found.own is None else found.own
    assert target is not None and normal is not None
    to = target - x
    square = dot(to, to)
    wi = to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()
    inverse = inverse_pdf(at, kinds, number, x, normal, wi, square, angle)
    if lights.choice is not None:
        inverse = inverse / probability
    # Where the light is not visible the weight is 0, and the pdf does not matter.
    pdf = safe_reciprocal(inverse.detach())
    point = None if lights.prim is None else textured_point(lights, row, target, normal, uv, in_object)
    # Shadow rays end off the surface of the light, so that they do not hit it.
    target = off_surface(at, kinds, number, target, normal, offset)
    radiance = at.radiance if at.opacity is None else at.radiance * at.opacity
    return LightSample(
        wi=wi,
        target=target,
        distant=None,
        radiance=radiance.expand_as(wi),
        pdf=pdf,
        weight=inverse,
        at=point,
        normal=normal,
    )


def inverse_pdf(
    at: Lights,
    kinds: list[tuple[int, type[Surface]]],
    number: Tensor | None,
    x: Tensor,
    normal: Tensor,
    wi: Tensor,
    square: Tensor,
    angle: Tensor | None,
) -> Tensor:
    """Return ``1 / pdf`` in steradians ``(N,)`` of sampled or hit points, without the choice of the light; 0 from behind.

    ``square (N,)`` is the squared distance, ``angle (N,)`` the solid angle of the light, 0 where it is sampled by area.
    """
    inverse = flat_inverse_pdf(normal, sizes(at, kinds, number, normal), wi, square)
    if angle is not None:
        inverse = solid_angle.inverse_pdf(angle, inverse)
    for k, kind in kinds:
        other = kind.inverse_pdf(at, x, normal, wi, square, inverse)
        inverse = inverse if other is None else pick(number, k, other, inverse)
    return inverse


def sizes(at: Lights, kinds: list[tuple[int, type[Surface]]], number: Tensor | None, normal: Tensor) -> Tensor:
    """Return one over the density by area ``(N,)`` of :meth:`Surface.sample_area` at unit normals ``normal (3, N)``."""
    area = at.area
    for k, kind in kinds:
        other = kind.size(at, normal)
        area = area if other is None else pick(number, k, other, area)
    return area


def off_surface(
    at: Lights, kinds: list[tuple[int, type[Surface]]], number: Tensor | None, p: Tensor, normal: Tensor, offset: float
) -> Tensor:
    """Return points ``p (3, N)`` moved off lights along their normals, by ``offset`` in units of ``Lights.bound``."""
    bound = at.bound
    for k, kind in kinds:
        other = kind.bound(at, normal)
        bound = bound if other is None else pick(number, k, other, bound)
    return torch.addcmul(p, normal, bound * offset)


def textured_point(
    lights: Lights, row: Tensor | None, p: Tensor, normal: Tensor, uv: Tensor, in_object: Tensor | None
) -> Interaction:
    """Return the point on the light as an interaction, for textured emission."""
    assert lights.prim is not None
    prim = lights.prim.expand(p.shape[1]) if row is None else take(lights.prim, row)
    return Interaction(
        p=p,
        ng=normal,
        ns=normal,
        tangent=None,
        bitangent=None,
        prim=prim,
        slot=prim,
        bound=None,
        u=uv[0],
        v=uv[1],
        own=in_object,
    )


def emitted(lights: Lights, x: Tensor, at: Interaction, wi: Tensor, n: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return radiance and pdf of emissive surfaces that rays hit.

    Args:
        lights: the table.
        x: origins of the rays ``(3, N)``.
        at: hit points on emissive primitives.
        wi: unit directions from ``x`` to the hit points ``(3, N)``.
        n: normals ``(3, N)`` at ``x``, as for :func:`sample`.

    Returns:
        Radiance ``(3, N)``, zero from behind, and the pdf ``(N,)`` of ``wi`` under :func:`sample`, per steradian.
    """
    assert lights.row_of_prim is not None
    row = take(lights.row_of_prim, at.slot) if len(lights.area) > 1 else None
    table = lane_rows(lights, row)
    with torch.no_grad():
        to = at.p - x
        angle = None if lights.solid is None else solid_angle.angles(lights.solid, row, x, lights.shapes)
        number = kind_indices(lights, row)
        inverse = inverse_pdf(table, surface_kinds(lights), number, x, at.ng, wi, dot(to, to), angle)
        facing = dot(wi, at.ng) < 0
        pdf = safe_reciprocal(inverse)
        if lights.choice is not None and row is not None:
            pdf = pdf * choice.probability(lights.choice, row, x, n)
        pdf = torch.where(facing, pdf, 0.0)
    return torch.where(facing, table.radiance, 0.0), pdf


def _environment(lights: Lights) -> type[Environment]:
    """Return the class of the environment, the last row."""
    kind = emitter(lights.kinds[-1])
    assert issubclass(kind, Environment)
    return kind


def environment(lights: Lights, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return radiance ``(3, N)`` of the environment along ``d (3, N)``, and the pdf ``(N,)`` of ``d`` under :func:`sample`."""
    radiance, pdf = _environment(lights).radiance_pdf(lights.environment, d, mis=True)
    return radiance, pdf * choice.environment(lights.choice)


def environment_image(lights: Lights | None) -> EnvironmentImage | None:
    """Return the environment as an image of all directions, differentiable; None without an environment."""
    if lights is None or lights.environment is None:
        return None
    return _environment(lights).environment_image(lights.environment)


def without_environment(lights: Lights | None) -> Lights | None:
    """Return the table without the environment; None if no row is left."""
    if lights is None or lights.environment is None:
        return lights
    num_left = len(lights.area) - 1
    if not num_left:
        return None
    columns = (*COLUMNS, "opacity", "quadric", "prim", "kind", "power")
    kept = {name: getattr(lights, name) for name in columns}
    kept = {name: None if value is None else value[..., :num_left] for name, value in kept.items()}
    kept["solid"] = None if lights.solid is None else lights.solid[:num_left]
    if num_left == 1 or lights.choice is None:
        return replace(lights, **{**kept, "kind": None}, kinds=lights.kinds[:1], choice=None, environment=None)
    light_sampler = choice.without_last(lights.choice)
    return replace(lights, **kept, kinds=lights.kinds[:-1], choice=light_sampler, environment=None)
