"""The materials of a scene file: what each type accepts, and which model with which numbers it comes to."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import create_model, model_validator
from pydantic_core import PydanticCustomError

from torchpt import bsdfs
from torchpt.bsdfs import Bsdf
from torchpt.bsdfs.presets import INDICES, METALS, metal
from torchpt.bsdfs.resolved import ResolvedMaterial
from torchpt.errors import EnergyWarning, NotBuiltError, SceneError
from torchpt.format.textures import TextureInput, check_texture, texture_input
from torchpt.spec import Moves
from torchpt.spec.declared import Described
from torchpt.spec.fields import Check, Flag, bounded, color, number, scalar, vector, wrong
from torchpt.spec.validate import Model, select
from torchpt.textures import Node

__all__ = [
    "MATERIALS", "Blend", "BlinnPhong", "Conductor", "Custom", "Dielectric", "Diffuse", "Material", "Microfacet",
    "Nonmetal", "Null", "Phong", "Plastic", "Principled", "RoughConductor", "RoughDielectric", "RoughPlastic",
    "ThinDielectric", "check_material", "custom_types", "read_material", "resolved",
]  # fmt: skip

Rgb = tuple[float, float, float]
Number = float | TextureInput
Color = Rgb | TextureInput
Values = dict[str, Number | Color]
#: What makes the texture of a slot, by its dotted key, one that can be read.
Resolve = Callable[[TextureInput, str], Node]

#: How deep blends may be nested: every level can double the models that a lane evaluates.
MAX_BLENDS = 8

_GREY: Rgb = (0.5, 0.5, 0.5)
_WHITE: Rgb = (1.0, 1.0, 1.0)
_MIRROR = "none"  # Mitsuba's name of the metal that reflects everything


def _index(value: Any) -> Number:
    """An index of refraction: a number, the name of a medium, or a texture."""
    expected = f"a number in 0.001..1000, a texture, or one of {', '.join(INDICES)}"
    if isinstance(value, Mapping):
        return texture_input(value, False, 1e-3, 1e3, moves=Moves.RAYS)
    if isinstance(value, str):
        found = INDICES.get(value.lower())
        if found is None:
            raise wrong(f"{expected}{_hint(value, INDICES)}")
        return found
    return bounded(value, 1e-3, 1e3, expected)


def _metal(value: Any) -> str:
    """The name of a metal."""
    if value != _MIRROR and (not isinstance(value, str) or metal(value) is None):
        hint = _hint(value, METALS) if isinstance(value, str) else ""
        raise wrong(f"{_MIRROR} (a perfect mirror) or one of {', '.join(METALS)}{hint}")
    return value


def _hint(name: str, known: Mapping[str, Any]) -> str:
    close = difflib.get_close_matches(name, known, 1)
    return f" (did you mean {close[0]}?)" if close else ""


def _mirror_like(rough: str) -> Check:
    """A validator for the roughness of a type that has none: 0, which says nothing."""
    expected = f"0, as this type is smooth (use {rough})"

    def check(value: Any) -> None:
        if value is not None and (isinstance(value, bool) or value != 0):
            raise wrong(expected)

    return Check(check)


def _normals(value: Any) -> TextureInput | None:
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise wrong("a texture whose colours hold normals: {type: image, path: FILE} or {texture: NAME}")
    return texture_input(value, True, 0.0, 1.0, linear=True)


def _heights(value: Any) -> TextureInput | None:
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise wrong(
            "a texture of heights in the scene's units: {type: image, path: FILE, scale: UNITS} or {texture: NAME}"
        )
    return texture_input(value, False, -_LARGEST, _LARGEST)


_LARGEST = float(np.finfo(np.float32).max)

Fraction = Annotated[Number, scalar(0.0, 1.0, texture=True)]
MaybeFraction = Annotated[Number | None, scalar(0.0, 1.0, optional=True, texture=True)]
Reflectance = Annotated[Color, color(0.0, 1.0, texture=True)]
MaybeReflectance = Annotated[Color | None, color(0.0, 1.0, optional=True, texture=True)]
MaybeColor = Annotated[Color | None, color(optional=True, texture=True)]
Index = Annotated[Number, Check(_index)]


class Material(Model):
    """What every material has.

    Attributes:
        two_sided: whether the back of an opaque material reflects as the front does; else it is black.
        opacity: fraction of the light that meets the surface; the rest passes as if it were not there.
        alpha_cutoff: opacity below it counts as 0, else as 1.
        emission: radiance leaving the front side, linear RGB.
        emission_strength: factor of it.
        normal_map: shading normals in the surface's own frame, ``2 c - 1`` of the colours c.
        normal_strength: factor of how far the map's normals lean.
        bump_map: heights along the normal, in the scene's units, whose slope tilts the shading normal.
    """

    two_sided: Flag = True
    opacity: Fraction = 1.0
    alpha_cutoff: Annotated[float | None, scalar(0.0, 1.0, optional=True)] = None
    emission: MaybeColor = None
    emission_strength: Annotated[float, scalar(0.0)] = 1.0
    normal_map: Annotated[TextureInput | None, Check(_normals)] = None
    normal_strength: Annotated[float, scalar(0.0)] = 1.0
    bump_map: Annotated[TextureInput | None, Check(_heights)] = None

    @model_validator(mode="after")
    def _asks_for_something(self) -> Material:
        given = self.model_fields_set
        if self.alpha_cutoff is not None and "opacity" not in given:
            raise wrong("an opacity beside alpha_cutoff", self.alpha_cutoff, ("alpha_cutoff",))
        if self.normal_map is not None and self.bump_map is not None:
            raise wrong("either normal_map or bump_map, not both", self.bump_map, ("bump_map",))
        if "normal_strength" in given and self.normal_map is None:
            raise wrong("a normal_map beside normal_strength", self.normal_strength, ("normal_strength",))
        if "emission_strength" in given and self.emission is None:
            raise wrong("an emission beside emission_strength", self.emission_strength, ("emission_strength",))
        return self

    def bsdf(self) -> Bsdf:
        """The model, in the variant that the given keys need."""
        raise NotImplementedError

    def values(self) -> Values:
        """What the model is given: the type's own numbers and colours, those left out without a default excepted."""
        own = {key: getattr(self, key) for key in type(self).model_fields if key not in Material.model_fields}
        return {key: value for key, value in own.items() if type(value) in (float, tuple, TextureInput)}

    def slots(self) -> Iterator[tuple[str, TextureInput]]:
        """Its textures by key, those of inline materials excepted."""
        for key in type(self).model_fields:
            value = getattr(self, key)
            if isinstance(value, TextureInput):
                yield key, value

    def energy(self) -> str:
        """Why the material reflects more than it receives, or ""."""
        return ""


class Diffuse(Material):
    """A Lambertian reflector."""

    type: Literal["diffuse"] = "diffuse"
    reflectance: Reflectance = _GREY

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Diffuse()


class Phong(Material):
    """Lambert plus a lobe about the mirror direction."""

    type: Literal["phong"] = "phong"
    diffuse: Reflectance = _GREY
    specular: Reflectance = (0.2, 0.2, 0.2)
    exponent: Annotated[Number, scalar(0.0, 1e5, texture=True)] = 30.0

    _share: ClassVar[float] = 1.0  # most energy that a unit of `specular` reflects

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Phong()

    def energy(self) -> str:
        """See :class:`Material`."""
        if isinstance(self.diffuse, TextureInput) or isinstance(self.specular, TextureInput):
            return ""  # images are not open yet
        most = max(kd + self._share * ks for kd, ks in zip(self.diffuse, self.specular, strict=True))
        if most <= 1.0 + 1e-6:
            return ""
        terms = "diffuse + specular" if self._share == 1.0 else f"diffuse + {self._share:g} specular"
        return f"{terms} is {most:.4g}: above 1 it may reflect more light than it receives"


class BlinnPhong(Phong):
    """Lambert plus a lobe about the half vector, as published: it gains energy, about fourfold where it is sharp."""

    type: Literal["blinn_phong"] = "blinn_phong"
    specular: Reflectance = (0.1, 0.1, 0.1)

    _share: ClassVar[float] = 4.0

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.BlinnPhong()


class _Metal(Material):
    """What smooth and rough conductors share: one of three ways to say which metal it is."""

    material: Annotated[str | None, Check(_metal)] = None
    eta: MaybeColor = None
    k: MaybeColor = None
    reflectance: MaybeReflectance = None
    specular_reflectance: MaybeReflectance = None

    @model_validator(mode="after")
    def _one_metal(self) -> _Metal:
        ways = {"material": ("material",), "eta and k": ("eta", "k"), "reflectance": ("reflectance",)}
        said = {way: [key for key in keys if getattr(self, key) is not None] for way, keys in ways.items()}
        given = [way for way, keys in said.items() if keys]
        if len(given) > 1:
            key = said[given[1]][0]
            raise wrong(f"either {given[0]} or {given[1]}, not both", getattr(self, key), (key,))
        if (self.eta is None) != (self.k is None):
            raise wrong("eta and k together", None, ("k" if self.k is None else "eta",))
        return self

    @property
    def schlick(self) -> bool:
        """Whether it is given by its reflectance at normal incidence."""
        return self.eta is None and self.material in (None, _MIRROR)

    def values(self) -> Values:
        """See :class:`Material`."""
        values = super().values()
        if self.schlick:
            values.setdefault("reflectance", _WHITE)
        elif self.material is not None:
            found = metal(self.material)
            assert found is not None
            values["eta"], values["k"] = found
        return values


class _Alpha(Material):
    """The roughness of an isotropic microfacet model: ``alpha``, or ``roughness`` with alpha = roughness^2."""

    alpha: MaybeFraction = None
    roughness: MaybeFraction = None

    @model_validator(mode="after")
    def _one_roughness(self) -> _Alpha:
        given = [key for key in ("alpha", "roughness", "alpha_u", "alpha_v") if getattr(self, key, None) is not None]
        if len(given) > 1 and given != ["alpha_u", "alpha_v"]:
            raise wrong(f"either {given[0]} or {given[1]}, not both", getattr(self, given[1]), (given[1],))
        if given in (["alpha_u"], ["alpha_v"]):
            raise wrong("alpha_u and alpha_v together", None, ("alpha_v" if given == ["alpha_u"] else "alpha_u",))
        return self

    def values(self) -> Values:
        """See :class:`Material`."""
        values = super().values()
        return values if values.keys() & {"alpha", "roughness", "alpha_u"} else {**values, "alpha": 0.1}


class _Anisotropic(_Alpha):
    """The same with another roughness along u and v."""

    alpha_u: MaybeFraction = None
    alpha_v: MaybeFraction = None
    energy_compensation: Flag = False


class Conductor(_Metal):
    """A polished metal."""

    type: Literal["conductor"] = "conductor"
    alpha: Annotated[None, _mirror_like("roughconductor")] = None
    roughness: Annotated[None, _mirror_like("roughconductor")] = None
    alpha_u: Annotated[None, _mirror_like("roughconductor")] = None
    alpha_v: Annotated[None, _mirror_like("roughconductor")] = None

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Conductor(schlick=self.schlick)


class RoughConductor(_Metal, _Anisotropic):
    """A metal with GGX microfacets."""

    type: Literal["roughconductor"] = "roughconductor"

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.RoughConductor(
            schlick=self.schlick,
            anisotropic=self.alpha_u is not None,
            energy_compensation=self.energy_compensation,
        )


class _Glass(Material):
    """What clear boundaries share."""

    int_ior: Index = INDICES["bk7"]
    ext_ior: Index = INDICES["air"]
    specular_reflectance: MaybeReflectance = None
    specular_transmittance: MaybeReflectance = None


class Dielectric(_Glass):
    """A polished boundary between two clear media."""

    type: Literal["dielectric"] = "dielectric"
    alpha: Annotated[None, _mirror_like("roughdielectric")] = None
    roughness: Annotated[None, _mirror_like("roughdielectric")] = None

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Dielectric()


class ThinDielectric(_Glass):
    """A thin polished pane: both its boundaries in one surface."""

    type: Literal["thindielectric"] = "thindielectric"
    alpha: Annotated[None, _mirror_like("roughdielectric")] = None
    roughness: Annotated[None, _mirror_like("roughdielectric")] = None

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.ThinDielectric()


class RoughDielectric(_Glass, _Anisotropic):
    """A boundary between two clear media with GGX microfacets."""

    type: Literal["roughdielectric"] = "roughdielectric"

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.RoughDielectric(anisotropic=self.alpha_u is not None, energy_compensation=self.energy_compensation)


class _Coated(Material):
    """What plastics share: a diffuse base under a clear coat."""

    diffuse_reflectance: Reflectance = _GREY
    int_ior: Index = INDICES["polypropylene"]
    ext_ior: Index = INDICES["air"]
    specular_reflectance: MaybeReflectance = None
    nonlinear: Flag = False


class Plastic(_Coated):
    """A polished coat over a diffuse base."""

    type: Literal["plastic"] = "plastic"
    alpha: Annotated[None, _mirror_like("roughplastic")] = None
    roughness: Annotated[None, _mirror_like("roughplastic")] = None

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Plastic(nonlinear=self.nonlinear)


class RoughPlastic(_Coated, _Alpha):
    """A coat with GGX microfacets over a diffuse base."""

    type: Literal["roughplastic"] = "roughplastic"

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.RoughPlastic(nonlinear=self.nonlinear)


class Nonmetal(Material):
    """A fixed share of a GGX highlight over Lambert."""

    type: Literal["nonmetal"] = "nonmetal"
    base_color: Reflectance = _GREY
    specular: Fraction = 0.04
    roughness: Fraction = 0.5

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Nonmetal()


class Microfacet(Material):
    """The course's Cook-Torrance highlight over Lambert."""

    type: Literal["microfacet"] = "microfacet"
    diffuse: Reflectance = _GREY
    specular: Reflectance = _WHITE
    roughness: Fraction = 0.4
    ior: Index = 1.85

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Microfacet()


class Principled(Material):
    """Burley's principled model. A feature whose amount is 0 is left out, not computed."""

    type: Literal["principled"] = "principled"
    base_color: Reflectance = _GREY
    roughness: Fraction = 0.5
    metallic: Fraction = 0.0
    specular: MaybeFraction = None
    eta: Annotated[Number | None, scalar(1e-3, 1e3, optional=True, texture=True)] = None
    spec_tint: Fraction = 0.0
    anisotropic: Fraction = 0.0
    sheen: Fraction = 0.0
    sheen_tint: Fraction = 0.0
    clearcoat: Fraction = 0.0
    clearcoat_gloss: Fraction = 0.0
    spec_trans: Fraction = 0.0
    flatness: Fraction = 0.0

    _ALWAYS: ClassVar[tuple[str, ...]] = ("base_color", "roughness", "specular", "eta")
    _PART_OF: ClassVar[dict[str, str]] = {"sheen_tint": "sheen", "clearcoat_gloss": "clearcoat"}

    @model_validator(mode="after")
    def _one_index(self) -> Principled:
        if self.specular is not None and self.eta is not None:
            raise wrong("either specular or eta, not both", self.eta, ("eta",))
        return self

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Principled(transmissive=self.spec_trans != 0.0, anisotropic=self.anisotropic != 0.0)

    def values(self) -> Values:
        """See :class:`Material`."""
        values = super().values()
        if self.specular is None and self.eta is None:
            values["specular"] = 0.5
        for feature, whole in self._PART_OF.items():
            if values[whole] == 0.0:
                values[feature] = 0.0
        return {key: value for key, value in values.items() if key in self._ALWAYS or value != 0.0}


def _inner(value: Any) -> Any:
    """A material's name; an inline one has become a model before the blend is validated."""
    if isinstance(value, Material) or (isinstance(value, str) and value):
        return value
    raise wrong("the name of a material, or a material")


class Blend(Material):
    """A mixture: ``1 - weight`` of ``a`` and ``weight`` of ``b``."""

    type: Literal["blend"] = "blend"
    a: Annotated[str | Material, Check(_inner)]
    b: Annotated[str | Material, Check(_inner)]
    weight: Fraction

    def values(self) -> Values:
        """See :class:`Material`."""
        return {"weight": self.weight}


class Null(Material):
    """Nothing: light passes as if the surface were not there."""

    type: Literal["null"] = "null"

    @model_validator(mode="after")
    def _nothing_there(self) -> Null:
        for key in ("opacity", "alpha_cutoff", "emission"):
            if key in self.model_fields_set:
                expected = (
                    f"no {key}, as a null surface has nothing to cover or to emit (use another type with opacity)"
                )
                raise wrong(expected, getattr(self, key), (key,))
        return self

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return bsdfs.Null()


class Custom(Material):
    """A material of a class that the caller brought; subclasses add its parameters."""

    model: ClassVar[Bsdf]

    def bsdf(self) -> Bsdf:
        """See :class:`Material`."""
        return self.model

    def values(self) -> Values:
        """See :class:`Material`."""
        return {key: getattr(self, key) for key in self.model.parameters}


#: Slots that the colours of vertices cannot give.
_IMAGED = ("opacity", "emission", "normal_map", "bump_map")
#: What is read at points, without regard to how large a pixel is: light and cut-outs are the same for every ray.
_POINTS = ("opacity", "emission")

MATERIALS: dict[str, type[Material]] = {
    "diffuse": Diffuse,
    "phong": Phong,
    "blinn_phong": BlinnPhong,
    "conductor": Conductor,
    "roughconductor": RoughConductor,
    "dielectric": Dielectric,
    "thindielectric": ThinDielectric,
    "roughdielectric": RoughDielectric,
    "plastic": Plastic,
    "roughplastic": RoughPlastic,
    "nonmetal": Nonmetal,
    "microfacet": Microfacet,
    "principled": Principled,
    "blend": Blend,
    "null": Null,
}


def custom_types(models: Mapping[str, Bsdf] | None) -> dict[str, type[Material]]:
    """The types that a caller's own models add to the table.

    Args:
        models: type name to model instance.

    Raises:
        SceneError: key ``bsdfs.NAME``: no model, the name of a type that exists, or parameters that cannot be read.
    """
    if models is not None and not isinstance(models, Mapping):
        raise SceneError("bsdfs", models, "a mapping from type names to instances of torchpt.Bsdf")
    types: dict[str, type[Material]] = {}
    for name, model in (models or {}).items():
        key = f"bsdfs.{name}"
        if not isinstance(name, str) or not name.isidentifier():
            raise SceneError("bsdfs", name, "names made of letters, digits and underscores")
        if name in MATERIALS:
            raise SceneError(key, model, f"a name of its own ({name} is a type that exists)")
        if not isinstance(model, Bsdf):
            raise SceneError(key, model, "an instance of a subclass of torchpt.Bsdf")
        types[name] = _custom(name, model, key)
    return types


def _custom(name: str, model: Bsdf, key: str) -> type[Material]:
    if not isinstance(model.parameters, Mapping):
        raise SceneError(f"{key}.parameters", model.parameters, "a mapping from names to defaults")
    fields: dict[str, Any] = {"type": (Literal[name], name)}
    for parameter, default in model.parameters.items():
        at = f"{key}.parameters.{parameter}"
        if not isinstance(parameter, str) or not parameter.isidentifier() or parameter.startswith("_"):
            raise SceneError(f"{key}.parameters", parameter, "names made of letters, digits and underscores")
        if parameter == "type" or parameter in Material.model_fields or hasattr(Custom, parameter):
            raise SceneError(at, default, f"another name ({parameter} is taken)")
        colored = isinstance(default, tuple | list)
        try:
            start = vector(default) if colored else number(default)
        except PydanticCustomError:
            raise SceneError(at, default, "a finite number, or three of them for a colour") from None
        fields[parameter] = (
            Annotated[Any, color(None, texture=True) if colored else scalar(None, texture=True)],
            start,
        )
    made = create_model("Custom", __base__=Custom, **fields)
    made.model = model
    return made


def read_material(
    raw: Any, key: str, types: Mapping[str, type[Material]], file: str | None, depth: int = 0
) -> Material:
    """The material of a mapping, with inline materials inside it.

    Args:
        raw: the mapping as written.
        key: its dotted key.
        types: the table: :data:`MATERIALS` and the caller's own.
        file: scene file for errors.
        depth: how many blends it lies in.

    Raises:
        SceneError: what is wrong with it.
        NotBuiltError: a key that the format knows and this version does not build.
    """
    if isinstance(raw, Mapping) and "type" in raw and raw["type"] is None:
        raw = {**raw, "type": "null"}  # YAML reads the bare word as nothing
    if isinstance(raw, Mapping) and raw.get("type") == "blend":
        if depth == MAX_BLENDS:
            raise SceneError(key, "blend", f"blends nested at most {MAX_BLENDS} deep", file)
        inline = {side: raw[side] for side in ("a", "b") if isinstance(raw.get(side), Mapping)}
        made = {side: read_material(item, f"{key}.{side}", types, file, depth + 1) for side, item in inline.items()}
        raw = {**raw, **made}
    return select("material", types, raw, key, file)


def resolved(
    material: Material, name: str, materials: Mapping[str, Material], resolve: Resolve | None = None
) -> ResolvedMaterial:
    """What a material comes to: a model and what it is given.

    Args:
        material: the material.
        name: its dotted name, e.g. ``materials.red``.
        materials: all materials by name, for blends.
        resolve: opens textures; without it only the model and the numbers can be asked for.
    """
    inner: tuple[ResolvedMaterial, ...] = ()
    if isinstance(material, Blend):
        inner = tuple(_inner_slot(item, f"{name}.{side}", materials, resolve) for side, item in _sides(material))
        model: Bsdf = bsdfs.Blend(*(slot.model for slot in inner))
    else:
        model = material.bsdf()

    def opened(value: Any, key: str) -> Any:
        if resolve is None or not isinstance(value, TextureInput):
            return value
        node = resolve(value, f"{name}.{key}")
        return node.at_points() if key in _POINTS else node

    return ResolvedMaterial(
        model=model,
        name=name,
        values={key: opened(value, key) for key, value in material.values().items()},
        two_sided=material.two_sided,
        opacity=opened(material.opacity, "opacity"),
        alpha_cutoff=material.alpha_cutoff,
        emission=opened(material.emission, "emission"),
        emission_strength=material.emission_strength,
        normal_map=opened(material.normal_map, "normal_map"),
        normal_strength=material.normal_strength,
        bump_map=opened(material.bump_map, "bump_map"),
        inner=inner,
    )


def _inner_slot(
    item: str | Material, name: str, materials: Mapping[str, Material], resolve: Resolve | None
) -> ResolvedMaterial:
    if isinstance(item, str):
        return resolved(materials[item], f"materials.{item}", materials, resolve)
    return resolved(item, name, materials, resolve)


def _sides(blend: Blend) -> tuple[tuple[str, str | Material], tuple[str, str | Material]]:
    return ("a", blend.a), ("b", blend.b)


def check_material(
    material: Material,
    key: str,
    materials: Mapping[str, Material],
    textures: Mapping[str, Described],
    file: str | None,
) -> None:
    """What can be said of a material only once all are known.

    Args:
        material: the material.
        key: its dotted key.
        materials: all materials by name.
        textures: all textures by name.
        file: scene file for errors.

    Raises:
        SceneError: a texture that does not exist; a blend of what does not exist, of itself or of what cannot be
            blended; ``two_sided`` where light passes through.
        NotBuiltError: a texture where none is built yet.

    Warns:
        EnergyWarning: it may reflect more light than it receives.
    """
    if isinstance(material, Blend):
        name = key.removeprefix("materials.")
        _check_blend(material, key, materials, file, (name,) if materials.get(name) is material else (), 1)
        for side, item in _sides(material):
            if isinstance(item, Material):
                check_material(item, f"{key}.{side}", materials, textures, file)
    for slot, found in material.slots():
        sheer = slot == "weight" and any(isinstance(item, Null) for item in _materials(material, materials))
        points, coordinates = slot in _POINTS or sheer, slot in _IMAGED or sheer
        check_texture(found, f"{key}.{slot}", textures, file, coordinates=coordinates, points=points)
    if not isinstance(material, Blend):
        compensated = getattr(material, "energy_compensation", False)
        fixed = tuple(material.values()) if compensated else material.bsdf().tabulated
        for slot, _ in material.slots():
            if slot in fixed:
                beside = " beside energy_compensation" if compensated else ""
                raise NotBuiltError(f"{key}.{slot}", "a texture", f"a number{beside}", file)
    if "two_sided" in material.model_fields_set and resolved(material, key, materials).model.transmits:
        expected = "no two_sided, as light passes through this material (it is for opaque ones only)"
        raise SceneError(f"{key}.two_sided", material.two_sided, expected, file)
    if problem := material.energy():
        where = f"{file}: {key}" if file else key
        warnings.warn(f"{where}: {problem}", EnergyWarning, stacklevel=2)


def _check_blend(
    blend: Blend, key: str, materials: Mapping[str, Material], file: str | None, trail: tuple[str, ...], depth: int
) -> None:
    if depth > MAX_BLENDS:
        raise SceneError(key, "blend", f"blends nested at most {MAX_BLENDS} deep", file)
    for side, item in _sides(blend):
        at, beyond = f"{key}.{side}", trail
        if isinstance(item, str):
            if item not in materials:
                known = ", ".join(materials) or "none is defined"
                raise SceneError(at, item, f"the name of a material ({known}) or a material", file)
            if item in trail:
                circle = " -> ".join((*trail[trail.index(item) :], item))
                raise SceneError(at, item, f"a blend that does not contain itself ({circle})", file)
            beyond = (*trail, item)
        inner = materials[item] if isinstance(item, str) else item
        if inner.emission is not None:
            where, value = (at, item) if isinstance(item, str) else (f"{at}.emission", inner.emission)
            raise SceneError(where, value, "a material without emission (give it to the blend itself)", file)
        _check_sides(blend, inner, item, at, materials, file)
        if not inner.two_sided:
            where, value = (at, item) if isinstance(item, str) else (f"{at}.two_sided", False)
            raise SceneError(where, value, "a two-sided material (say two_sided on the blend itself)", file)
        if isinstance(inner, Blend):
            _check_blend(inner, at, materials, file, beyond, depth + 1)


def _check_sides(
    blend: Blend, inner: Material, item: str | Material, at: str, materials: Mapping[str, Material], file: str | None
) -> None:
    """Refuse textures that would have to be known before a blend can be: of normals and of how much is there at all."""
    for key, advice in (("normal_map", "give it to the blend itself"), ("bump_map", "give it to the blend itself")):
        if getattr(inner, key) is not None:
            where = at if isinstance(item, str) else f"{at}.{key}"
            raise SceneError(where, item if isinstance(item, str) else "a texture", f"no {key} ({advice})", file)
    if isinstance(inner.opacity, TextureInput):
        where = at if isinstance(item, str) else f"{at}.opacity"
        raise NotBuiltError(where, "an opacity texture inside a blend", "an opacity texture of the blend itself", file)
    if isinstance(blend.weight, TextureInput) and _sheer(inner, materials):
        if not isinstance(inner, Null) or isinstance(blend.opacity, TextureInput):
            expected = "an opacity texture instead, or numbers"
            raise NotBuiltError(at, "a blend by a texture with what light passes by chance", expected, file)


def _materials(material: Material, materials: Mapping[str, Material]) -> list[Material | None]:
    """The two materials of a blend; of others none."""
    if not isinstance(material, Blend):
        return []
    return [materials.get(item) if isinstance(item, str) else item for _, item in _sides(material)]


def _sheer(material: Material, materials: Mapping[str, Material]) -> bool:
    """Whether rays may pass a material as if it were not there."""
    if isinstance(material, Null) or material.opacity != 1.0:
        return True
    return any(side is not None and _sheer(side, materials) for side in _materials(material, materials))
