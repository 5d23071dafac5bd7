"""The table of lights: sampling, and the densities that MIS asks for.

Rows are emissive primitives, then lights that are no surfaces; the environment, where there is one, is the last row. What a row
means is its class's to say (:mod:`torchpt.physics.lights.surface`, :mod:`torchpt.physics.lights.base`): here the kinds of the
scene are gone through and put together. Kinds absent from it cost nothing: ``Lights.kinds`` is static, and a single row is
neither chosen nor gathered.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.math.vectors import dot, safe_reciprocal, take
from torchpt.physics.lights import choice, solid_angle
from torchpt.physics.lights.base import COLUMNS, KINDS, Environment, EnvironmentImage, taken
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.lights.surface import SURFACES, Surface, emitter, flat_inverse_pdf, flat_point
from torchpt.physics.shapes.geometry import Interaction

__all__ = ["emitted", "environment", "environment_image", "sample", "without_environment"]


def _surfaces(lights: Lights) -> list[tuple[int, type[Surface]]]:
    """The kinds of surfaces among the rows, each with its number there."""
    return [(number, SURFACES[name]) for number, name in enumerate(lights.kinds) if name in SURFACES]


def _numbers(lights: Lights, row: Tensor | None) -> Tensor | None:
    """Number of the lanes' kinds ``(N,)``; None where there is but one."""
    if len(lights.kinds) == 1:
        return None
    assert lights.kind is not None and row is not None
    return take(lights.kind, row)


def _pick(number: Tensor | None, k: int, a: Tensor, b: Tensor | None) -> Tensor:
    """``a`` in the lanes of kind ``k``, else ``b``; where there is no ``b``, ``a``."""
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
    """A point on the lights, seen from ``x (3, N)``.

    Args:
        lights: the table.
        x: reference points ``(3, N)``.
        which: ``(N,)`` float64 in [0, 1), picks the light, and what that leaves of it takes the place of ``u[0]``; unused
            (``None``) where there is but one.
        u: ``(2, N)`` in [0, 1), picks the point.
        offset: how far shadow rays stop off the light's surface, in units of ``Lights.bound``.
        n: normals ``(3, N)`` of surfaces that nothing lights from behind, zero for others; None: no such surface. Asked for
            where the choice is local, see :func:`torchpt.physics.lights.choice.depends_on_point`.
        mis: whether BSDF sampling shares the work: an environment map then leaves it the dim directions.
    """
    row: Tensor | None = None
    probability: Tensor | float = 1.0
    if lights.choice is not None and which is not None:
        row, probability, rest = choice.draw(lights.choice, which, x, n)
        u = torch.stack((rest.to(u.dtype).clamp_max(1.0 - 2.0**-24), u[1]))
    at, number = taken(lights, row), _numbers(lights, row)
    surfaces = _surfaces(lights)
    drawn = _on_surfaces(lights, at, row, number, x, u, offset, probability) if surfaces else None
    bare: Tensor | None = None
    distant: Tensor | None = None
    for k, name in enumerate(lights.kinds[len(surfaces) :], len(surfaces)):
        kind = KINDS[name]
        # Kinds follow each other: what comes from this one on.
        here = torch.ones_like(at.area, dtype=torch.bool) if number is None else number >= k
        bare = here if bare is None else bare
        distant = here if distant is None and kind.distant else distant
        own = kind.sample(at, x, u, mis)
        own = replace(own, pdf=own.pdf * probability, weight=own.weight / probability)
        drawn = own if drawn is None else _merged(here, own, drawn)
    assert drawn is not None
    return replace(drawn, distant=distant, bare=bare, row=row)


def _merged(mask: Tensor, a: LightSample, b: LightSample) -> LightSample:
    """``a`` where the mask holds, else ``b``."""
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
    target: Tensor | None = None
    normal: Tensor | None = None
    inside: Tensor | None = None
    uv, angle, kinds = torch.zeros_like(u), None, _surfaces(lights)
    if lights.solid is not None:
        uv, angle = solid_angle.sample(lights.solid, row, x, u, lights.shapes)
        target, normal = flat_point(at.p0, at.e1, at.e2, uv), at.normal.expand_as(x)
    for k, kind in kinds:
        if kind.code != solid_angle.OTHER:
            continue
        own = kind.sample(at, x, u)
        target, normal = _pick(number, k, own.p, target), _pick(number, k, own.normal, normal)
        uv = uv if own.uv is None else _pick(number, k, own.uv, uv)
        inside = inside if own.own is None else own.own
    assert target is not None and normal is not None
    to = target - x
    square = dot(to, to)
    wi = to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()
    bound = at.bound
    for k, kind in kinds:
        other = kind.bound(at, normal)
        bound = bound if other is None else _pick(number, k, other, bound)
    inverse = _inverse_pdf(at, kinds, number, x, normal, wi, square, angle)
    if lights.choice is not None:
        inverse = inverse / probability
    # Where the light is not seen the weight is 0, and the density has no say.
    pdf = safe_reciprocal(inverse.detach())
    point = None if lights.prim is None else _textured(lights, row, target, normal, uv, inside)
    target = torch.addcmul(target, normal, bound * offset)
    radiance = at.radiance if at.opacity is None else at.radiance * at.opacity
    return LightSample(wi, target, None, radiance.expand_as(wi), pdf, inverse, point)


def _inverse_pdf(
    at: Lights,
    kinds: list[tuple[int, type[Surface]]],
    number: Tensor | None,
    x: Tensor,
    normal: Tensor,
    wi: Tensor,
    square: Tensor,
    angle: Tensor | None,
) -> Tensor:
    """``1 / pdf`` in solid angle ``(N,)`` of points drawn or met, the choice of the light left out; 0 from behind."""
    size = at.area
    for k, kind in kinds:
        other = kind.size(at, normal)
        size = size if other is None else _pick(number, k, other, size)
    inverse = flat_inverse_pdf(normal, size, wi, square)
    if angle is not None:
        inverse = solid_angle.inverse_pdf(angle, inverse)
    for k, kind in kinds:
        other = kind.inverse_pdf(at, x, normal, wi, square, inverse)
        inverse = inverse if other is None else _pick(number, k, other, inverse)
    return inverse


def _textured(
    lights: Lights, row: Tensor | None, p: Tensor, normal: Tensor, uv: Tensor, own: Tensor | None
) -> Interaction:
    """The point on the light as textures ask for it."""
    assert lights.prim is not None
    prim = lights.prim.expand(p.shape[1]) if row is None else take(lights.prim, row)
    return Interaction(p, normal, normal, None, None, prim, prim, None, uv[0], uv[1], own)


def emitted(lights: Lights, x: Tensor, at: Interaction, wi: Tensor, n: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return what emitters that were hit send back along ``wi``.

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
    table = taken(lights, row)
    with torch.no_grad():
        to = at.p - x
        angle = None if lights.solid is None else solid_angle.angles(lights.solid, row, x, lights.shapes)
        number = _numbers(lights, row)
        inverse = _inverse_pdf(table, _surfaces(lights), number, x, at.ng, wi, dot(to, to), angle)
        facing = dot(wi, at.ng) < 0
        pdf = safe_reciprocal(inverse)
        if lights.choice is not None and row is not None:
            pdf = pdf * choice.probability(lights.choice, row, x, n)
        pdf = torch.where(facing, pdf, 0.0)
    return torch.where(facing, table.radiance, 0.0), pdf


def _environment(lights: Lights) -> type[Environment]:
    """The class of the environment, which is the last row."""
    kind = emitter(lights.kinds[-1])
    assert issubclass(kind, Environment)
    return kind


def environment(lights: Lights, d: Tensor) -> tuple[Tensor, Tensor]:
    """Radiance ``(3, N)`` that escaped rays find, and the density ``(N,)`` with which :func:`sample` draws them for MIS."""
    radiance, pdf = _environment(lights).radiance_pdf(lights.environment, d, mis=True)
    return radiance, pdf * choice.environment(lights.choice)


def environment_image(lights: Lights | None) -> EnvironmentImage | None:
    """The environment as a picture of all directions, differentiable; None where there is none."""
    if lights is None or lights.environment is None:
        return None
    return _environment(lights).environment_image(lights.environment)


def without_environment(lights: Lights | None) -> Lights | None:
    """The table without its last row, where that is the environment; None where nothing is left."""
    if lights is None or lights.environment is None:
        return lights
    left = len(lights.area) - 1
    if not left:
        return None
    columns = (*COLUMNS, "opacity", "quadric", "prim", "kind")
    cut = {name: getattr(lights, name) for name in columns}
    cut = {name: None if value is None else value[..., :left] for name, value in cut.items()}
    cut["solid"] = None if lights.solid is None else lights.solid[:left]
    if left == 1 or lights.choice is None:
        return replace(lights, **{**cut, "kind": None}, kinds=lights.kinds[:1], choice=None, environment=None)
    fewer = choice.without_last(lights.choice)
    return replace(lights, **cut, kinds=lights.kinds[:-1], choice=fewer, environment=None)
