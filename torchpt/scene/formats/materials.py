"""Read the materials of a scene file, and check references between materials and to textures once all are read.

A *blend* has two inner materials, each named or written in place under a key of the blend (a *side*: ``a`` and ``b``). A *slot*
is a parameter that may be a texture. A material is *sheer* if rays pass it as if it were not there (``null``).
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterator, Mapping
from typing import Any

from torchpt.core.errors import EnergyWarning, NotBuiltError, SceneError, did_you_mean, warn_caller
from torchpt.physics.bsdfs import KINDS, Bsdf
from torchpt.physics.bsdfs.base import model_and_values
from torchpt.physics.bsdfs.specs import Inner
from torchpt.scene.formats.textures import TextureInput, check_texture, texture_of
from torchpt.spec import REQUIRED, Refused, Spec, parameters_of, spec_of
from torchpt.spec.schema import ParsedParams, read_params, read_typed

__all__ = [
    "MAX_BLENDS", "POINTS", "Kind", "check_material", "inner_of", "material_types", "model_of", "plain_material",
    "read_material",
]  # fmt: skip

#: A type of material: a class of :data:`torchpt.physics.bsdfs.KINDS`, or an instance from the caller.
Kind = type[Bsdf] | Bsdf

#: Maximum depth of nested blends: every level can double the BSDFs that a lane evaluates.
MAX_BLENDS = 8

#: Slots whose textures must have texture coordinates, so they cannot be vertex colours.
_NEED_COORDINATES = ("opacity", "emission", "normal_map", "bump_map")
#: Slots whose textures are not filtered by the footprint: emission and opacity must be the same for every ray.
POINTS = ("opacity", "emission")


def material_types(models: Mapping[str, Bsdf] | None) -> Mapping[str, Kind]:
    """Return the table of material types: those of the package and the caller's.

    Args:
        models: the caller's BSDF instances by type name.

    Raises:
        SceneError: key ``bsdfs.NAME``: no BSDF, a name that is taken, or wrong declarations of parameters.
    """
    if models is not None and not isinstance(models, Mapping):
        raise SceneError("bsdfs", models, "a mapping from type names to instances of torchpt.Bsdf")
    for name, model in (models or {}).items():
        key = f"bsdfs.{name}"
        if not isinstance(name, str) or not name.isidentifier():
            raise SceneError("bsdfs", name, "names made of letters, digits and underscores")
        if name in KINDS:
            raise SceneError(key, model, f"a name of its own ({name} is a type that exists)")
        if not isinstance(model, Bsdf):
            raise SceneError(key, model, "an instance of a subclass of torchpt.Bsdf")
        _check_own(model, key)
    own_types: Mapping[str, Kind] = models or {}
    return ChainMap(own_types, KINDS)  # type: ignore[arg-type]


def _check_own(model: Bsdf, key: str) -> None:
    """Check the names and defaults of the parameters that the caller's BSDF declares; ``key`` is ``bsdfs.NAME``.

    Raises:
        SceneError: a name that is no identifier or is taken, or an invalid default.
    """
    if not isinstance(model.parameters, Mapping):
        raise SceneError(f"{key}.parameters", model.parameters, "a mapping from names to defaults")
    declared = {} if model.parameters is Bsdf.parameters else model.parameters
    for parameter, value in declared.items():
        where = f"{key}.parameters.{parameter}"
        if not isinstance(parameter, str) or not parameter.isidentifier() or parameter.startswith("_"):
            raise SceneError(f"{key}.parameters", parameter, "names made of letters, digits and underscores")
        if parameter == "type" or parameter in Bsdf.parameters:
            raise SceneError(where, value, f"another name ({parameter} is taken)")
        try:
            spec = spec_of(value)
            if spec.default not in (REQUIRED, None) and not callable(spec.default):  # a function of other parameters
                spec.read(spec.default)
        except Refused as error:
            raise SceneError(where, value.default if isinstance(value, Spec) else value, error.expected) from None


def read_material(raw: Any, key: str, types: Mapping[str, Kind], file: str | None, depth: int = 0) -> ParsedParams:
    """Read a material, including materials written in place inside a blend.

    Args:
        raw: the mapping as written.
        key: its dotted key.
        types: the table from :func:`material_types`.
        file: scene file, for errors.
        depth: number of enclosing blends.

    Raises:
        SceneError: a wrong key or value.
        NotBuiltError: a key that the format knows and this version does not support.
    """
    if isinstance(raw, Mapping) and "type" in raw and raw["type"] is None:
        raw = {**raw, "type": "null"}  # YAML reads the bare word as nothing
    name = raw.get("type") if isinstance(raw, Mapping) else None
    # The keys of materials inside a blend; none if ``type`` is wrong, which ``read_typed`` reports.
    sides = _inner_keys(types[name]) if isinstance(name, str) and name in types else ()
    if sides:
        if depth == MAX_BLENDS:
            raise SceneError(key, name, f"blends nested at most {MAX_BLENDS} deep", file)
        inline = {side: raw[side] for side in sides if isinstance(raw.get(side), Mapping)}
        inner = {
            side: read_material(item, key=f"{key}.{side}", types=types, file=file, depth=depth + 1)
            for side, item in inline.items()
        }
        raw = {**raw, **inner}
    return read_typed("material", types, raw, key=key, file=file, texture=texture_of)


def plain_material() -> ParsedParams:
    """Return the default material of shapes: grey and diffuse."""
    return read_params(KINDS["diffuse"], {}, key="", file=None, texture=texture_of)


def _inner_keys(kind: Kind) -> tuple[str, ...]:
    """Return the parameters of a material type that are materials themselves: those of a blend."""
    return tuple(key for key, spec in parameters_of(kind).items() if isinstance(spec, Inner))


def inner_of(material: ParsedParams) -> dict[str, str | ParsedParams]:
    """Return the materials inside a blend by key, as names or in place; an empty dict for other materials."""
    return {key: material[key] for key in _inner_keys(material.kind)}


def model_of(material: ParsedParams, materials: Mapping[str, ParsedParams]) -> tuple[Bsdf, dict[str, Any]]:
    """Return the BSDF of a material and the values of its parameters; a blend's BSDF has those of its inner materials.

    Args:
        material: the material.
        materials: all materials by name, for blends.
    """
    models: dict[str, Bsdf] = {}
    for key, item in inner_of(material).items():
        models[key], _ = model_of(materials[item] if isinstance(item, str) else item, materials)
    return model_and_values(material.kind, {**material.values, **models})


def check_material(
    material: ParsedParams,
    key: str,
    materials: Mapping[str, ParsedParams],
    textures: Mapping[str, ParsedParams],
    file: str | None,
) -> None:
    """Check a material's references to other materials and to textures, once all are read.

    Args:
        material: the material.
        key: its dotted key.
        materials: all materials by name.
        textures: all textures by name.
        file: scene file, for errors.

    Raises:
        SceneError: an unknown texture; a blend of an unknown material, of itself or of one that cannot be blended;
            ``two_sided`` for a material that transmits light.
        NotBuiltError: a texture where textures are not supported yet.

    Warns:
        EnergyWarning: the material may reflect more light than it receives.
    """
    inner = inner_of(material)
    if inner:
        name = key.removeprefix("materials.")
        # A material written in place has no name by which a blend inside could refer to it.
        trail = (name,) if materials.get(name) is material else ()
        _check_blend(material, key=key, materials=materials, file=file, trail=trail, depth=1)
        for side, item in inner.items():
            if isinstance(item, ParsedParams):
                check_material(item, key=f"{key}.{side}", materials=materials, textures=textures, file=file)
    slots = {slot: value for slot, value in material.values.items() if isinstance(value, TextureInput)}
    for slot, value in slots.items():
        # The weight of a blend with a null surface acts as its opacity, so it has the limits of an opacity texture.
        is_opacity = slot == "weight" and any(item.kind.sheer for item in _inner_materials(material, materials))
        coordinates, points = slot in _NEED_COORDINATES or is_opacity, slot in POINTS or is_opacity
        check_texture(value, key=f"{key}.{slot}", textures=textures, file=file, coordinates=coordinates, points=points)
    model, _ = model_of(material, materials)
    for slot in slots:
        if slot in model.tabulated:
            expected = f"a number, as {material.name} tabulates what depends on it"
            raise NotBuiltError(f"{key}.{slot}", "a texture", expected, file)
    if "two_sided" in material.given and model.transmits:
        expected = "no two_sided, as light passes through this material (it is for opaque ones only)"
        raise SceneError(f"{key}.two_sided", material["two_sided"], expected, file)
    if problem := material.kind.energy(material.values):  # says how the material may gain energy, or ""
        where = f"{file}: {key}" if file else key
        warn_caller(f"{where}: {problem}", EnergyWarning)


def _check_blend(
    blend: ParsedParams,
    key: str,
    materials: Mapping[str, ParsedParams],
    file: str | None,
    trail: tuple[str, ...],
    depth: int,
) -> None:
    """Check the materials inside a blend, and those inside inner blends.

    Args:
        blend: the blend.
        key: its dotted key.
        materials: all materials by name.
        file: scene file, for errors.
        trail: names of the blends that contain these materials, outermost first, to find a blend that contains itself.
        depth: number of nested blends, this one included.

    Raises:
        SceneError: too many nested blends, an unknown material, a blend of itself or of a material that cannot be blended.
        NotBuiltError: a texture that is not supported inside a blend.
    """
    if depth > MAX_BLENDS:
        raise SceneError(key, blend.name, f"blends nested at most {MAX_BLENDS} deep", file)
    for side, item in inner_of(blend).items():
        at, inner_trail = f"{key}.{side}", trail  # at: dotted key of the inner material
        if isinstance(item, str):
            if item not in materials:
                known = ", ".join(materials) or "none is defined"
                hint = did_you_mean(item, materials)
                raise SceneError(at, item, f"the name of a material ({known}){hint} or a material", file)
            if item in trail:
                circle = " -> ".join((*trail[trail.index(item) :], item))
                raise SceneError(at, item, f"a blend that does not contain itself ({circle})", file)
            inner_trail = (*trail, item)
        inner = materials[item] if isinstance(item, str) else item
        if inner["emission"] is not None:
            where, value = (at, item) if isinstance(item, str) else (f"{at}.emission", inner["emission"])
            raise SceneError(where, value, "a material without emission (give it to the blend itself)", file)
        _check_maps(blend, inner, item, at=at, materials=materials, file=file)
        if not inner["two_sided"]:
            where, value = (at, item) if isinstance(item, str) else (f"{at}.two_sided", False)
            raise SceneError(where, value, "a two-sided material (say two_sided on the blend itself)", file)
        if inner_of(inner):
            _check_blend(inner, key=at, materials=materials, file=file, trail=inner_trail, depth=depth + 1)


def _check_maps(
    blend: ParsedParams,
    inner: ParsedParams,
    item: str | ParsedParams,
    at: str,
    materials: Mapping[str, ParsedParams],
    file: str | None,
) -> None:
    """Check that a material inside a blend has no normal map, bump map or opacity texture: the blend itself must have them.

    Args:
        blend: the blend.
        inner: the material inside.
        item: the same as the blend has it: the name of a material, or ``inner`` written in place.
        at: dotted key of ``item``.
        materials: all materials by name.
        file: scene file, for errors.

    Raises:
        SceneError: a normal map or a bump map.
        NotBuiltError: an opacity texture, or a textured weight where ``inner`` has an opacity below 1.
    """
    for key in ("normal_map", "bump_map"):
        if inner[key] is not None:
            where, value = (at, item) if isinstance(item, str) else (f"{at}.{key}", "a texture")
            raise SceneError(where, value, f"no {key} (give it to the blend itself)", file)
    if isinstance(inner["opacity"], TextureInput):
        where = at if isinstance(item, str) else f"{at}.opacity"
        raise NotBuiltError(where, "an opacity texture inside a blend", "an opacity texture of the blend itself", file)
    # A textured weight can be the opacity of the other side only where one side is `null` itself.
    if isinstance(blend.values.get("weight"), TextureInput) and _may_pass_rays(inner, materials):
        if not inner.kind.sheer or isinstance(blend["opacity"], TextureInput):
            expected = "an opacity texture instead, or numbers"
            raise NotBuiltError(at, "a blend by a texture with what light passes by chance", expected, file)


def _inner_materials(material: ParsedParams, materials: Mapping[str, ParsedParams]) -> Iterator[ParsedParams]:
    """Yield the existing materials inside a blend."""
    for item in inner_of(material).values():
        if not isinstance(item, str):
            yield item
        elif item in materials:
            yield materials[item]


def _may_pass_rays(material: ParsedParams, materials: Mapping[str, ParsedParams]) -> bool:
    """Return True where a material may have an opacity below 1."""
    if material.kind.sheer or material["opacity"] != 1.0:
        return True
    return any(_may_pass_rays(side, materials) for side in _inner_materials(material, materials))
