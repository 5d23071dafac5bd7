"""The table of lights: sampling, and the densities that MIS asks for.

Rows are emissive primitives, then lights that are no surfaces; the environment, where there is one, is the last row. Delta
lights (points, spots, directional ones) have an infinite density, and no ray meets them. Kinds absent from the scene cost
nothing: ``Lights.kinds`` is static, and a single row is neither chosen nor gathered.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.lights import area, choice, quadric, solid_angle, sphere
from torchpt.lights.kinds import constant, point, spot
from torchpt.math.vectors import dot, safe_reciprocal, take
from torchpt.math.warps import concentric_disk
from torchpt.records import DISTANT, KINDS, Interaction, Lights, LightSample, Quadrics, rows

__all__ = ["emitted", "environment", "sample"]


def _rows(lights: Lights, row: Tensor | None) -> Lights:
    """Lane values of the table at ``row``; with a single row the table itself, which broadcasts."""
    if row is None:
        return lights
    names = ("p0", "e1", "e2", "normal", "flip", "area", "bound", "radiance")
    covered = None if lights.opacity is None else take(lights.opacity, row)
    return replace(lights, opacity=covered, **{name: take(getattr(lights, name), row) for name in names})


def _quadrics(lights: Lights, row: Tensor | None) -> Quadrics:
    """What quadrics need beside the table, at ``row``."""
    assert lights.quadric is not None and lights.quadrics is not None
    column = lights.quadric if row is None else take(lights.quadric, row)
    return rows(lights.quadrics, column)


def _is(lights: Lights, kind: str, row: Tensor | None) -> Tensor | None:
    """Mask of the lanes whose row is of ``kind``; ``None`` where all are."""
    if len(lights.kinds) == 1:
        return None
    assert lights.kind is not None and row is not None
    return take(lights.kind, row) == lights.kinds.index(kind)


def _pick(mask: Tensor | None, a: Tensor, b: Tensor | None) -> Tensor:
    return a if mask is None or b is None else torch.where(mask, a, b)


def sample(
    lights: Lights,
    x: Tensor,
    which: Tensor | None,
    u: Tensor,
    offset: float,
    n: Tensor | None = None,
    mis: bool = True,
) -> LightSample:
    """A point on the lights, seen from ``x (3, N)``.

    Args:
        lights: the table.
        x: reference points ``(3, N)``.
        which: ``(N,)`` float64 in [0, 1), picks the light, and what that leaves of it takes the place of ``u[0]``; unused
            (``None``) where there is but one.
        u: ``(2, N)`` in [0, 1), picks the point.
        offset: how far shadow rays stop off the light's surface, in units of ``Lights.bound``.
        n: normals ``(3, N)`` of surfaces that nothing lights from behind, zero for others; None: no such surface. Asked for
            where the choice is local, see :func:`torchpt.lights.choice.local`.
        mis: whether BSDF sampling shares the work: an environment map then leaves it the dim directions.
    """
    row: Tensor | None = None
    probability: Tensor | float = 1.0
    if lights.choice is not None and which is not None:
        row, probability, rest = choice.draw(lights.choice, which, x, n)
        u = torch.stack((rest.to(u.dtype).clamp_max(1.0 - 2.0**-24), u[1]))
    at = _rows(lights, row)
    surfaces = len([kind for kind in lights.kinds if kind in KINDS])
    near = len([kind for kind in lights.kinds if kind not in DISTANT])
    bare, distant = _from(lights, surfaces, row), _from(lights, near, row)
    drawn = _on_surfaces(lights, at, row, x, u, offset, probability) if surfaces else None
    if near > surfaces:
        drawn = _merged(bare, _at_points(lights, at, row, x, probability), drawn)
    if near < len(lights.kinds):
        drawn = _merged(distant, _from_afar(lights, at, row, u, probability, mis), drawn)
    assert drawn is not None
    return replace(drawn, distant=distant, bare=bare)


def _from(lights: Lights, first: int, row: Tensor | None) -> Tensor | None:
    """Mask of the lanes whose row is of the kinds from ``first`` on; ``None`` where there are no such kinds."""
    if first == len(lights.kinds):
        return None
    if row is None:
        return torch.full_like(lights.area, first == 0, dtype=torch.bool)
    assert lights.kind is not None
    return take(lights.kind, row) >= first


def _merged(mask: Tensor | None, a: LightSample, b: LightSample | None) -> LightSample:
    """``a`` where the mask holds, else ``b``; where there is no ``b``, ``a``."""
    if b is None:
        return a
    assert mask is not None
    names = ("wi", "target", "radiance", "pdf", "weight")
    return replace(b, **{name: torch.where(mask, getattr(a, name), getattr(b, name)) for name in names})


def _on_surfaces(
    lights: Lights, at: Lights, row: Tensor | None, x: Tensor, u: Tensor, offset: float, probability: Tensor | float
) -> LightSample:
    target: Tensor | None = None
    normal: Tensor | None = None
    bent: Quadrics | None = None
    place, angle = torch.zeros_like(u), None
    if lights.solid is not None:
        place, angle = solid_angle.sample(lights.solid, row, x, u, lights.shapes)
        target, normal = area.point(at.p0, at.e1, at.e2, place), at.normal.expand_as(x)
    for kind in lights.kinds:
        if kind not in KINDS or kind in solid_angle.KINDS:
            continue
        mask = _is(lights, kind, row)
        if kind == "sphere":
            # Detached: from a moving reference point the same spot on the light is held, as on planar lights.
            radius = at.e1[0]
            p, facing = sphere.sample(x.detach(), at.p0.detach(), radius.detach(), at.flip, u)
            grown = radius / torch.where(radius == 0, 1.0, radius).detach()  # 1; rows of other kinds may have a 0 there
            p = at.p0 + (p - at.p0).detach() * grown
        elif kind == "quadric":
            bent = _quadrics(lights, row)
            p, facing = quadric.point(at.p0, at.e1, at.e2, bent, u)
        else:
            here = concentric_disk(u)
            p, facing = area.point(at.p0, at.e1, at.e2, here), at.normal
            place = _pick(mask, here, place)
        target, normal = _pick(mask, p, target), _pick(mask, facing, normal)
    assert target is not None and normal is not None
    to = target - x
    square = dot(to, to)
    wi = to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()
    size, bound = at.area, at.bound
    if bent is not None:
        mask = _is(lights, "quadric", row)
        size = _pick(mask, quadric.world_area(size, at.e1, at.e2, bent.e3, normal), size)
        bound = _pick(mask, dot(normal.detach().abs(), bent.reach), bound)
    inverse = area.inverse_pdf(normal, size, wi, square)
    if angle is not None:
        inverse = solid_angle.inverse_pdf(angle, inverse)
    if "sphere" in lights.kinds:
        ball = sphere.inverse_pdf(x.detach(), at.p0.detach(), at.e1[0].detach(), normal, wi.detach(), square.detach())
        # In area measure the derivative of a sphere's share is that of the planar form.
        value = inverse.detach()
        ball = ball * torch.where(value > 0, inverse / torch.where(value > 0, value, 1.0), 1.0)
        inverse = _pick(_is(lights, "sphere", row), ball, inverse)
    if lights.choice is not None:
        inverse = inverse / probability
    # Where the light is not seen the weight is 0, and the density has no say.
    pdf = safe_reciprocal(inverse.detach())
    found = None if lights.prim is None else _textured(lights, row, target, normal, place, bent, u)
    target = torch.addcmul(target, normal, bound * offset)
    radiance = at.radiance if at.opacity is None else at.radiance * at.opacity
    return LightSample(wi, target, None, radiance.expand_as(wi), pdf, inverse, found)


def _textured(
    lights: Lights, row: Tensor | None, p: Tensor, normal: Tensor, place: Tensor, bent: Quadrics | None, u: Tensor
) -> Interaction:
    """The point on the light as textures ask for it."""
    assert lights.prim is not None
    prim = lights.prim.expand(p.shape[1]) if row is None else take(lights.prim, row)
    own = None if bent is None else quadric.own_point(bent, u)
    return Interaction(p, normal, normal, None, None, prim, prim, None, place[0], place[1], own)


def _at_points(lights: Lights, at: Lights, row: Tensor | None, x: Tensor, probability: Tensor | float) -> LightSample:
    wi, inverse = point.toward(x, at.p0)
    radiance = at.radiance.expand_as(wi)
    if "spot" in lights.kinds:
        share, mask = spot.falloff(wi, at.normal, at.e1[0], at.e1[1]), _is(lights, "spot", row)
        radiance = radiance * (share if mask is None else torch.where(mask, share, 1.0))
    infinite = torch.full_like(inverse, torch.inf)
    return LightSample(wi, at.p0.expand_as(wi), None, radiance, infinite, inverse / probability)


def _from_afar(
    lights: Lights, at: Lights, row: Tensor | None, u: Tensor, probability: Tensor | float, mis: bool
) -> LightSample:
    wi: Tensor | None = None
    pdf: Tensor | None = None
    weight: Tensor | None = None
    if "constant" in lights.kinds:
        wi = constant.sample(u).to(at.radiance.dtype)
        pdf, weight = (torch.full_like(wi[0], value) for value in (1.0 / constant.INVERSE_PDF, constant.INVERSE_PDF))
    radiance = at.radiance.expand(3, u.shape[1])
    if lights.environment is not None and not isinstance(lights.environment, Tensor):
        from torchpt.lights.kinds import envmap

        wi, pdf, light = envmap.sample(lights.environment, u, mis)
        weight = torch.where(pdf > 0, safe_reciprocal(pdf), 0.0)
        radiance = _pick(_is(lights, "envmap", row), light, radiance)
    if "directional" in lights.kinds:
        mask = _is(lights, "directional", row)
        one = torch.ones_like(u[0], dtype=at.radiance.dtype)
        wi = _pick(mask, (-at.normal).expand(3, u.shape[1]), wi)
        pdf, weight = _pick(mask, one * torch.inf, pdf), _pick(mask, one, weight)
    assert wi is not None and pdf is not None and weight is not None
    return LightSample(wi, wi, None, radiance, pdf * probability, weight / probability)


def emitted(lights: Lights, x: Tensor, at: Interaction, wi: Tensor, n: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """What emitters that were hit send back along ``wi``.

    Args:
        lights: the table.
        x: where the rays came from ``(3, N)``.
        at: points on emissive primitives.
        wi: unit directions from ``x`` to them ``(3, N)``.
        n: normals ``(3, N)`` where they came from, as :func:`sample` was given them.

    Returns:
        Radiance ``(3, N)``, zero from behind, and the density ``(N,)`` with which :func:`sample` would have drawn ``wi``.
    """
    assert lights.row_of_prim is not None
    row = take(lights.row_of_prim, at.slot) if len(lights.area) > 1 else None
    table = _rows(lights, row)
    with torch.no_grad():
        to = at.p - x
        size = table.area
        if "quadric" in lights.kinds:
            found = quadric.world_area(size, table.e1, table.e2, _quadrics(lights, row).e3, at.ng)
            size = _pick(_is(lights, "quadric", row), found, size)
        inverse = area.inverse_pdf(at.ng, size, wi, dot(to, to))
        if lights.solid is not None:
            inverse = solid_angle.inverse_pdf(solid_angle.angles(lights.solid, row, x, lights.shapes), inverse)
        if "sphere" in lights.kinds:
            ball = sphere.inverse_pdf(x, table.p0, table.e1[0], at.ng, wi, dot(to, to))
            inverse = _pick(_is(lights, "sphere", row), ball, inverse)
        facing = dot(wi, at.ng) < 0
        pdf = safe_reciprocal(inverse)
        if lights.choice is not None and row is not None:
            pdf = pdf * choice.probability(lights.choice, row, x, n)
        pdf = torch.where(facing, pdf, 0.0)
    return torch.where(facing, table.radiance, 0.0), pdf


def environment(lights: Lights, d: Tensor) -> tuple[Tensor, Tensor]:
    """Radiance ``(3, N)`` that escaped rays find, and the density ``(N,)`` with which :func:`sample` draws them for MIS."""
    assert lights.environment is not None
    probability = choice.environment(lights.choice)
    if not isinstance(lights.environment, Tensor):
        from torchpt.lights.kinds import envmap

        radiance, pdf = envmap.environment(lights.environment, d, mis=True)
        return radiance, pdf * probability
    pdf = torch.full_like(d[0], 1.0 / constant.INVERSE_PDF) * probability
    return lights.environment[:, None].expand_as(d), pdf
