"""The table of lights: a row for each emissive primitive, then one for each light that is no surface."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.accel.bounds import chosen, primitive_bounds
from torchpt.errors import SceneError
from torchpt.lights import KINDS as LIGHTS
from torchpt.lights import choice_of
from torchpt.lights.solid_angle import shapes_of, table_of
from torchpt.math.threads import mean_all
from torchpt.math.vectors import dot, luminance, normalize
from torchpt.records import KINDS, SOURCES, Geometry, Lights
from torchpt.scene.assembly.primitives import Primitives
from torchpt.scene.parts import Part, Source
from torchpt.scene.space import Space
from torchpt.scene.texels import images_of
from torchpt.shapes import quadrics

if TYPE_CHECKING:
    from torchpt.lights.kinds.envmap import EnvironmentMap

__all__ = ["lights_of"]


def _emission(part: Part, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> Tensor:
    """Radiance ``(3,)`` of a part that emits."""
    radiance, *strength = (parameters[name].to(dtype) for name in part.emission_names)
    if part.emission_texture is not None:
        return radiance.expand(3)  # the strength alone: the texture's share is looked up
    return radiance if not strength else radiance * strength[0]


def _mean_emission(part: Part, parameters: Mapping[str, Tensor]) -> float:
    """Mean luminance of the texture that a part shines by; 1 without."""
    if part.emission_texture is None:
        return 1.0
    image = images_of([part.emission_texture], parameters)[part.emission_texture.texels].detach().double()
    color = image[..., :3].mean((0, 1)) if image.shape[2] >= 3 else mean_all(image[..., 0]).expand(3)
    return float(luminance((color * color.new_tensor(part.emission_texture.scale)).abs()))


@dataclass(frozen=True)
class _Rows:
    """Columns of :class:`~torchpt.records.Lights` for some of its rows, and their power."""

    kind: list[str]  # of each row
    p0: Tensor
    e1: Tensor
    e2: Tensor
    normal: Tensor
    flip: Tensor
    area: Tensor
    bound: Tensor
    radiance: Tensor
    power: Tensor  # float64, detached


def lights_of(
    parts: Sequence[Part],
    sources: Sequence[Source],
    primitives: Primitives,
    geometry: Geometry,
    parameters: Mapping[str, Tensor],
    space: Space,
    opacity: Tensor | None,
    emissive: Tensor,
    opacity_mapped: bool,
    choice: str = "auto",
) -> Lights | None:
    """The lights; None where nothing emits.

    Args:
        parts: ordered by kind.
        sources: lights that are no surfaces, ordered by kind.
        primitives: of ``parts``.
        geometry: of them, as the search sees it.
        parameters: every tensor by dotted name.
        space: the lanes' coordinates.
        opacity: ``(P + I,)``, or None.
        emissive: ``(P + I,)`` bool, which primitives emit.
        opacity_mapped: whether opacity textures opacity_texture any of them.
        choice: how one of them is chosen, from ``lights.WAYS``.
    """
    prim = emissive.nonzero().squeeze(1)
    if not len(prim) and not sources:
        return None
    dtype, device = primitives.p0.dtype, primitives.p0.device
    emitting = [(part, n) for part, n in zip(parts, primitives.sizes, strict=True) if part.emission is not None and n]
    groups, column = [], None
    if emitting:
        surfaces, column = _surfaces(emitting, primitives, parameters, prim)
        groups.append(surfaces)
    reach = _reach(geometry) if sources else torch.ones((), device=device)
    around = [_surroundings(source, parameters, dtype) for source in sources if LIGHTS[source.kind].environment]
    environment = around[0] if around else None
    groups += [_source(source, parameters, environment, space, reach, dtype) for source in sources]
    names = [name for group in groups for name in group.kind]
    kinds = tuple(kind for kind in (*KINDS, *SOURCES) if kind in names)
    joined = {
        name: torch.cat([getattr(group, name) for group in groups], -1)
        for name in ("p0", "e1", "e2", "normal", "flip", "area", "bound", "radiance", "power")
    }
    rest = len(names) - len(prim)
    power, seen = joined.pop("power"), None
    if opacity is not None:
        seen = torch.cat((opacity.index_select(0, prim), opacity.new_ones(rest)))
        power = power * seen.detach().double()
    index = None
    if len(prim):
        index = torch.full((len(emissive),), -1, dtype=torch.int64, device=device)
        index[prim] = torch.arange(len(prim), device=device)
    if column is not None:
        column = torch.cat((column, column.new_zeros(rest)))
    textured = opacity_mapped or any(part.emission_texture is not None for part, _ in emitting)
    many = len(names) > 1
    solid = table_of(names, joined["p0"], joined["e1"], joined["e2"])
    lights = Lights(
        choice=None,
        kinds=kinds,
        kind=torch.tensor([kinds.index(name) for name in names], device=device) if many else None,
        **joined,
        opacity=seen,
        environment=environment,
        row_of_prim=index,
        quadric=column,
        quadrics=None if column is None else primitives.quadrics,
        prim=torch.cat((prim, prim.new_zeros(rest))) if textured else None,
        solid=solid,
        shapes=shapes_of(solid),
    )
    low, high = (box.double() for box in primitive_bounds(chosen(geometry, prim)))
    return replace(lights, choice=choice_of(lights, power, (low, high), choice))


def _reach(geometry: Geometry) -> Tensor:
    """Radius of the scene: half the diagonal of its box, float64."""
    low, high = (box.double() for box in primitive_bounds(geometry))
    return (high.amax(1) - low.amin(1)).norm() * 0.5 if low.shape[1] else torch.ones((), device=low.device)


#: Area over the length of the cross product of the edges.
_SHARES = {"triangle": 0.5, "rectangle": 1.0, "disk": math.pi, "sphere": 0.0, "quadric": 0.0}


def _surfaces(
    emitting: Sequence[tuple[Part, int]], primitives: Primitives, parameters: Mapping[str, Tensor], prim: Tensor
) -> tuple[_Rows, Tensor | None]:
    """Rows of emissive primitives ``prim``, and where any is a quadric their columns among the quadrics."""
    dtype, device = primitives.p0.dtype, primitives.p0.device
    counts = torch.tensor([n for _, n in emitting], dtype=torch.int64, device=device)
    names = [part.kind for part, n in emitting for _ in range(n)]
    of_kind = torch.tensor([KINDS.index(part.kind) for part, _ in emitting], dtype=torch.int64, device=device)
    of_kind = torch.repeat_interleave(of_kind, counts)
    share = torch.tensor([_SHARES[kind] for kind in KINDS], dtype=dtype, device=device)[of_kind]
    p0, e1, e2, face, normal = (
        x.index_select(1, prim)
        for x in (primitives.p0, primitives.e1, primitives.e2, primitives.face, primitives.normal)
    )
    # In float64: the fourth power of a length leaves float32 long before the length is extreme.
    area = dot(face.double(), face.double()).clamp_min(torch.finfo(torch.float64).tiny).sqrt() * share
    area = torch.where(of_kind == KINDS.index("sphere"), (4.0 * math.pi) * e1[0].double() ** 2, area)
    whole, column = area.detach(), None
    area = area.to(dtype)
    if primitives.frame is not None and primitives.quadrics is not None and "quadric" in names:
        bent = of_kind == KINDS.index("quadric")
        column = torch.where(bent, prim - sum(primitives.counts[:4]), 0)
        own, world_area = quadrics.areas(primitives.quadrics, primitives.frame)
        area = torch.where(bent, own.to(dtype).index_select(0, column), area)
        whole = torch.where(bent, world_area.index_select(0, column), whole)
    radiance = torch.cat([_emission(part, parameters, dtype)[:, None].expand(3, n) for part, n in emitting], 1)
    power = math.pi * luminance(radiance.detach().double().abs()) * whole
    if any(part.emission_texture is not None for part, _ in emitting):
        shares = [_mean_emission(part, parameters) for part, _ in emitting]
        power = power * torch.repeat_interleave(torch.tensor(shares, dtype=torch.float64, device=device), counts)
    flip, bound = (x.index_select(0, prim) for x in (primitives.sign, primitives.bound))
    return _Rows(names, p0, e1, e2, normal, flip, area, bound, radiance, power), column


def _surroundings(source: Source, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> Tensor | EnvironmentMap:
    """What an environment sends: one radiance, or a map."""
    if source.kind == "constant":
        return parameters[f"{source.name}.radiance"].to(dtype)
    texels, scale, pose = (parameters[f"{source.name}.{key}"] for key in ("texels", "scale", "to_world"))
    linear = pose[:3, :3].double()
    turn = torch.linalg.inv(linear) * torch.linalg.det(linear).abs() ** (1.0 / 3.0)
    from torchpt.lights.kinds import envmap

    return envmap.build(texels.to(dtype), turn.to(dtype), scale.to(dtype))


def _in_units(source: Source, intensity: Tensor, unit: float) -> Tensor:
    """An intensity ``(3,)`` where lengths are counted in ``unit``: what arrives at a distance is the same."""
    found = intensity / unit**2
    if not bool(torch.isfinite(found.float()).all()):
        most = torch.finfo(torch.float32).max * unit**2
        expected = f"at most {most:.3g} in a scene this small: what arrives is beyond float32"
        raise SceneError(f"{source.name}.intensity", intensity.tolist(), expected)
    return found


def _source(
    source: Source,
    parameters: Mapping[str, Tensor],
    environment: Tensor | EnvironmentMap | None,
    space: Space,
    reach: Tensor,
    dtype: torch.dtype,
) -> _Rows:
    """The row of a light that is no surface; columns as its file in :mod:`torchpt.lights` reads them.

    Args:
        source: the light.
        parameters: every tensor by dotted name.
        environment: of the scene.
        space: the lanes' coordinates.
        reach: radius of the scene, float64.
        dtype: of the lanes.
    """

    def given(key: str) -> Tensor:
        return parameters[f"{source.name}.{key}"].double()

    blank = torch.zeros(3, dtype=torch.float64, device=space.centre.device)
    p0, e1, normal = blank, blank, blank
    if source.kind in ("point", "spot"):
        p0, color = space.point(given("position")), _in_units(source, given("intensity"), space.unit)
        share = 4.0 * math.pi
        if source.kind == "spot":
            normal = normalize((given("target") - given("position"))[:, None])[:, 0]
            cutoff, beam = (given(key) * (math.pi / 180.0) for key in ("cutoff_angle", "beam_width"))
            # How fast it falls from the beam's edge to the cutoff; finite where the two are one.
            slope = 1.0 / (cutoff - beam).clamp_min(1e-6)
            e1 = torch.stack((cutoff, slope, torch.zeros_like(cutoff)))
            share = 2.0 * math.pi * (1.0 - 0.5 * (torch.cos(cutoff) + torch.cos(beam))).detach()
    elif source.kind == "directional":
        normal, color = normalize(given("direction")[:, None])[:, 0], given("irradiance")
        share = math.pi * reach**2
    else:
        if environment is None or isinstance(environment, Tensor):
            color = given("radiance")
        else:
            color = (environment.mean * environment.scale.detach()).expand(3)
        share = 4.0 * math.pi**2 * reach**2
    one = torch.ones(1, dtype=dtype, device=space.centre.device)
    p0, e1, e2, normal, light = (x[:, None].to(dtype) for x in (p0, e1, blank, normal, color))
    power = (share * luminance(color.detach().double().abs())).reshape(1)
    return _Rows([source.kind], p0, e1, e2, normal, one, one, one, light, power)
