"""Materials in a scene file: what each type comes to, and one line for each way to say it wrong."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from torch import Tensor

import torchpt
from torchpt.core.errors import EnergyWarning, NotBuiltError, SceneError
from torchpt.gradients import attached
from torchpt.physics.bsdfs import KINDS, Bsdf, Parameters
from torchpt.physics.bsdfs.kinds.blend import Blend
from torchpt.physics.bsdfs.kinds.blinn_phong import BlinnPhong
from torchpt.physics.bsdfs.kinds.conductor import Conductor
from torchpt.physics.bsdfs.kinds.dielectric import Dielectric
from torchpt.physics.bsdfs.kinds.diffuse import Diffuse
from torchpt.physics.bsdfs.kinds.microfacet import Microfacet
from torchpt.physics.bsdfs.kinds.nonmetal import Nonmetal
from torchpt.physics.bsdfs.kinds.null import Null
from torchpt.physics.bsdfs.kinds.phong import Phong
from torchpt.physics.bsdfs.kinds.plastic import Plastic
from torchpt.physics.bsdfs.kinds.principled import Principled
from torchpt.physics.bsdfs.kinds.roughconductor import RoughConductor
from torchpt.physics.bsdfs.kinds.roughdielectric import RoughDielectric
from torchpt.physics.bsdfs.kinds.roughdiffuse import RoughDiffuse
from torchpt.physics.bsdfs.kinds.roughplastic import RoughPlastic
from torchpt.physics.bsdfs.kinds.thindielectric import ThinDielectric
from torchpt.physics.bsdfs.presets import INDICES, METALS, metal_index
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.scene.formats.description import Description, read_description
from torchpt.scene.formats.materials import MAX_BLENDS
from torchpt.scene.materials import resolved
from torchpt.spec import Color, Flag, Index, Refused, Scalar, parameters_of
from torchpt.spec.schema import ParsedParams

CAMERA = {"origin": [0, 0, 5], "target": [0, 0, 0]}
AIR, BK7, PP = 1.000277, 1.5046, 1.49
GREY, WHITE = (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)
COMMON = {"opacity": 0.25, "alpha_cutoff": 0.5, "emission": [1, 2, 3], "emission_strength": 4}


def scene(materials: dict[str, Any], **shape: Any) -> dict[str, Any]:
    return {"camera": CAMERA, "materials": materials, "shapes": {"s": {"type": "sphere", **shape}} if shape else {}}


def read(materials: dict[str, Any], models: dict[str, Any] | None = None, **shape: Any) -> Description:
    return read_description(scene(materials, **shape), models)


def slot(models: dict[str, Any] | None = None, **keys: Any) -> ResolvedMaterial:
    materials = read({"m": keys}, models).materials
    return resolved(materials["m"], "materials.m", materials)


def refused(materials: dict[str, Any], models: dict[str, Any] | None = None, **shape: Any) -> SceneError:
    with pytest.raises(SceneError) as caught:
        read(materials, models, **shape)
    assert "\n" not in str(caught.value)
    return caught.value


def rgb(*values: float) -> tuple[float, ...]:
    return values if len(values) == 3 else values * 3


GLASS = {"int_ior": BK7, "ext_ior": AIR}
RESOLVED: dict[str, tuple[dict[str, Any], Bsdf, dict[str, Any]]] = {  # keys, model, its values
    "diffuse": ({}, Diffuse(), {"reflectance": GREY}),
    "diffuse, a colour": ({"reflectance": [0.1, 0.2, 0.3]}, Diffuse(), {"reflectance": (0.1, 0.2, 0.3)}),
    "roughdiffuse": ({}, RoughDiffuse(), {"reflectance": GREY, "alpha": 0.2}),
    "roughdiffuse, all keys": (
        {"reflectance": [0.1, 0.2, 0.3], "alpha": 0.7, "use_fast_approx": True},
        RoughDiffuse(use_fast_approx=True),
        {"reflectance": (0.1, 0.2, 0.3), "alpha": 0.7},
    ),
    "phong": ({}, Phong(), {"diffuse": GREY, "specular": rgb(0.2), "exponent": 30.0}),
    "phong, all keys": (
        {"diffuse": 0.1, "specular": [0.2, 0.3, 0.4], "exponent": 7},
        Phong(),
        {"diffuse": rgb(0.1), "specular": (0.2, 0.3, 0.4), "exponent": 7.0},
    ),
    "blinn_phong": ({}, BlinnPhong(), {"diffuse": GREY, "specular": rgb(0.1), "exponent": 30.0}),
    "blinn_phong, all keys": (
        {"diffuse": 0.1, "specular": 0.2, "exponent": 0},
        BlinnPhong(),
        {"diffuse": rgb(0.1), "specular": rgb(0.2), "exponent": 0.0},
    ),
    "conductor": ({}, Conductor(schlick=True), {"reflectance": WHITE}),
    "conductor, none": ({"material": "none"}, Conductor(schlick=True), {"reflectance": WHITE}),
    "conductor, metal": (
        {"material": "Au", "specular_reflectance": 0.9, "roughness": 0, "alpha": 0, "alpha_u": 0.0, "alpha_v": None},
        Conductor(),
        {"eta": METALS["Au"][0], "k": METALS["Au"][1], "specular_reflectance": rgb(0.9)},
    ),
    "conductor, eta and k": (
        {"eta": 0.2, "k": [3, 2, 1]},
        Conductor(),
        {"eta": rgb(0.2), "k": (3.0, 2.0, 1.0)},
    ),
    "conductor, reflectance": (
        {"reflectance": [1, 0.5, 0]},
        Conductor(schlick=True),
        {"reflectance": (1.0, 0.5, 0.0)},
    ),
    "roughconductor": ({}, RoughConductor(schlick=True), {"reflectance": WHITE, "alpha": 0.1}),
    "roughconductor, eta and k": (
        {"eta": [0.1, 0.2, 0.3], "k": 4, "roughness": 0.3, "specular_reflectance": 0.5, "energy_compensation": True},
        RoughConductor(energy_compensation=True),
        {"eta": (0.1, 0.2, 0.3), "k": rgb(4.0), "roughness": 0.3, "specular_reflectance": GREY},
    ),
    "roughconductor, anisotropic": (
        {"reflectance": 0.5, "alpha_u": 0.3, "alpha_v": 0.01, "energy_compensation": False},
        RoughConductor(schlick=True, anisotropic=True),
        {"reflectance": GREY, "alpha_u": 0.3, "alpha_v": 0.01},
    ),
    "roughconductor, beckmann": (
        {"material": "Au", "distribution": "beckmann", "alpha": 0.2},
        RoughConductor(beckmann=True),
        {"eta": METALS["Au"][0], "k": METALS["Au"][1], "alpha": 0.2},
    ),
    "roughconductor, smooth": (
        {"material": "Cr", "alpha": 0},
        RoughConductor(),
        {"eta": METALS["Cr"][0], "k": METALS["Cr"][1], "alpha": 0.0},
    ),
    "dielectric": ({}, Dielectric(), GLASS),
    "dielectric, all keys": (
        {
            **{"int_ior": "Water", "ext_ior": 2, "alpha": 0, "roughness": 0},
            **{"specular_reflectance": 0.5, "specular_transmittance": [1, 1, 0]},
        },
        Dielectric(),
        {
            **{"int_ior": 1.333, "ext_ior": 2.0},
            **{"specular_reflectance": GREY, "specular_transmittance": (1.0, 1.0, 0.0)},
        },
    ),
    "thindielectric": ({}, ThinDielectric(), GLASS),
    "thindielectric, all keys": (
        {"int_ior": 1.5, "ext_ior": "vacuum", "specular_reflectance": 0, "specular_transmittance": 1}
        | {"alpha": 0, "roughness": 0},
        ThinDielectric(),
        {"int_ior": 1.5, "ext_ior": 1.0, "specular_reflectance": rgb(0.0), "specular_transmittance": WHITE},
    ),
    "roughdielectric": ({}, RoughDielectric(), {**GLASS, "alpha": 0.1}),
    "roughdielectric, all keys": (
        {"int_ior": "diamond", "ext_ior": 1, "roughness": 1, "energy_compensation": True, "specular_reflectance": 1},
        RoughDielectric(energy_compensation=True),
        {"int_ior": 2.419, "ext_ior": 1.0, "roughness": 1.0, "specular_reflectance": WHITE},
    ),
    "roughdielectric, beckmann": (
        {"distribution": "beckmann", "alpha_u": 0.2, "alpha_v": 0.4},
        RoughDielectric(beckmann=True, anisotropic=True),
        {**GLASS, "alpha_u": 0.2, "alpha_v": 0.4},
    ),
    "roughdielectric, alpha": (
        {"alpha": 0.02, "specular_transmittance": 0.5},
        RoughDielectric(),
        {**GLASS, "alpha": 0.02, "specular_transmittance": GREY},
    ),
    "roughdielectric, anisotropic": (
        {"alpha_u": 0.2, "alpha_v": 0.4},
        RoughDielectric(anisotropic=True),
        {**GLASS, "alpha_u": 0.2, "alpha_v": 0.4},
    ),
    "plastic": ({}, Plastic(), {"diffuse_reflectance": GREY, "int_ior": PP, "ext_ior": AIR}),
    "plastic, all keys": (
        {
            **{"diffuse_reflectance": [0.1, 0.2, 0.3], "int_ior": 1.9, "ext_ior": "acetone", "nonlinear": True},
            **{"specular_reflectance": 0.5, "alpha": 0, "roughness": 0},
        },
        Plastic(nonlinear=True),
        {"diffuse_reflectance": (0.1, 0.2, 0.3), "int_ior": 1.9, "ext_ior": 1.36, "specular_reflectance": GREY},
    ),
    "roughplastic": (
        {},
        RoughPlastic(),
        {"diffuse_reflectance": GREY, "int_ior": PP, "ext_ior": AIR, "alpha": 0.1},
    ),
    "roughplastic, all keys": (
        {
            **{"diffuse_reflectance": 0.2, "int_ior": "bk7", "ext_ior": 1, "nonlinear": True},
            **{"specular_reflectance": 1, "roughness": 0.4},
        },
        RoughPlastic(nonlinear=True),
        {
            **{"diffuse_reflectance": rgb(0.2), "int_ior": BK7, "ext_ior": 1.0},
            **{"specular_reflectance": WHITE, "roughness": 0.4},
        },
    ),
    "roughplastic, beckmann": (
        {"distribution": "beckmann"},
        RoughPlastic(beckmann=True),
        {"diffuse_reflectance": GREY, "int_ior": PP, "ext_ior": AIR, "alpha": 0.1},
    ),
    "roughplastic, alpha": (
        {"alpha": 1},
        RoughPlastic(),
        {"diffuse_reflectance": GREY, "int_ior": PP, "ext_ior": AIR, "alpha": 1.0},
    ),
    "nonmetal": ({}, Nonmetal(), {"base_color": GREY, "specular": 0.04, "roughness": 0.5}),
    "nonmetal, all keys": (
        {"base_color": 1, "specular": 1, "roughness": 0},
        Nonmetal(),
        {"base_color": WHITE, "specular": 1.0, "roughness": 0.0},
    ),
    "microfacet": ({}, Microfacet(), {"diffuse": GREY, "specular": WHITE, "roughness": 0.4, "ior": 1.85}),
    "microfacet, all keys": (
        {"diffuse": 0, "specular": 0.5, "roughness": 1, "ior": "amber"},
        Microfacet(),
        {"diffuse": rgb(0.0), "specular": GREY, "roughness": 1.0, "ior": 1.55},
    ),
    "principled": ({}, Principled(), {"base_color": GREY, "roughness": 0.5, "specular": 0.5}),
    "principled, all keys": (
        {
            **{"base_color": [0.1, 0.2, 0.3], "roughness": 0.1, "metallic": 0.2, "eta": 1.4, "spec_tint": 0.3},
            **{"anisotropic": 0.4, "sheen": 0.5, "sheen_tint": 0.6, "clearcoat": 0.7, "clearcoat_gloss": 0.8},
            **{"spec_trans": 0.9, "flatness": 1},
        },
        Principled(transmissive=True, anisotropic=True),
        {
            **{"base_color": (0.1, 0.2, 0.3), "roughness": 0.1, "metallic": 0.2, "eta": 1.4, "spec_tint": 0.3},
            **{"anisotropic": 0.4, "sheen": 0.5, "sheen_tint": 0.6, "clearcoat": 0.7, "clearcoat_gloss": 0.8},
            **{"spec_trans": 0.9, "flatness": 1.0},
        },
    ),
    "principled, features off": (
        {
            **{"roughness": 0, "metallic": 0, "specular": 0, "spec_tint": 0, "anisotropic": 0, "sheen": 0},
            **{"sheen_tint": 1, "clearcoat": 0, "clearcoat_gloss": 1, "spec_trans": 0, "flatness": 0},
        },
        Principled(),
        {"base_color": GREY, "roughness": 0.0, "specular": 0.0},
    ),
    "null": ({}, Null(), {}),
}


@pytest.mark.parametrize("name", RESOLVED)
def test_a_material_comes_to_its_model_and_values(name: str) -> None:
    keys, model, values = RESOLVED[name]
    found = slot(type=name.partition(",")[0], **keys)
    assert found == ResolvedMaterial(model, "materials.m", values)
    assert all(type(value) in (float, tuple) for value in found.values.values())


@pytest.mark.parametrize("name", RESOLVED)
def test_a_model_is_given_what_it_reads(name: str) -> None:
    found = slot(type=name.partition(",")[0], **RESOLVED[name][0])
    assert found.model.name == name.partition(",")[0]
    assert found.values.keys() <= own_keys(found.model)
    found.model.prepare(
        {
            key: torch.tensor([[channel] for channel in value] if isinstance(value, tuple) else [value])
            for key, value in found.values.items()
        }
    )


def own_keys(kind: Any) -> set[str]:
    return parameters_of(kind).keys() - Bsdf.parameters.keys()


def test_every_type_is_resolved_above_with_all_its_keys() -> None:
    said: dict[str, set[str]] = {}
    for name, (keys, _, _) in RESOLVED.items():
        said.setdefault(name.partition(",")[0], set()).update(keys)
    missing = {f"{name}.{key}" for name, keys in said.items() for key in own_keys(KINDS[name]) - keys}
    assert not missing


@pytest.mark.parametrize("name", [name for name in KINDS if name not in ("null", "blend")])
def test_every_type_takes_the_common_keys(name: str) -> None:
    found = slot(type=name, **COMMON)
    assert (found.opacity, found.alpha_cutoff, found.emission, found.emission_strength) == (0.25, 0.5, (1, 2, 3), 4)
    assert found.two_sided
    if found.model.transmits:
        assert "opaque" in str(refused({"m": {"type": name, "two_sided": True}}))
    else:
        assert not slot(type=name, two_sided=False).two_sided


def test_null_stands_for_what_is_not_said() -> None:
    every = {key: None for key in parameters_of(KINDS["roughconductor"])}
    assert slot(**{**every, "type": "roughconductor"}) == slot(type="roughconductor")


def test_the_type_null_may_be_written_bare() -> None:
    assert slot(type=None).model == Null()


CIRCLE = {
    "x": {"type": "blend", "a": "y", "b": "d", "weight": 0.5},
    "y": {"type": "blend", "a": "d", "b": {"type": "blend", "a": "x", "b": "d", "weight": 0.1}, "weight": 0.5},
    "d": {"type": "diffuse"},
}
DIFFUSE = {"type": "diffuse"}
BAD: dict[str, tuple[dict[str, Any], str, str]] = {  # name -> material, key below materials.m, part of the message
    "unknown key": ({"type": "phong", "shininess": 1}, "shininess", "diffuse, specular, exponent"),
    "near key": ({"type": "dielectric", "int_iro": 1}, "int_iro", "did you mean int_ior?"),
    "another type's key": ({"type": "roughplastic", "energy_compensation": True}, "energy_compensation", "nonlinear"),
    "unknown type": ({"type": "glass"}, "type", "dielectric, thindielectric, roughdielectric, plastic"),
    "near type": ({"type": "rough_conductor"}, "type", "did you mean roughconductor?"),
    "no type": ({"reflectance": 1}, "type", "diffuse, phong"),
    "reflectance": ({"type": "plastic", "diffuse_reflectance": 1.1}, "diffuse_reflectance", "in 0..1, or a texture, got 1.1"),
    "negative": ({"type": "phong", "exponent": -1}, "exponent", "in 0..100000, or a texture, got -1"),
    "text": ({"type": "nonmetal", "specular": "0.1"}, "specular", "in 0..1, or a texture, got '0.1'"),
    "not a number": ({"type": "microfacet", "roughness": math.nan}, "roughness", "in 0..1, or a texture, got nan"),
    "boolean": ({"type": "principled", "metallic": True}, "metallic", "in 0..1, or a texture, got True"),
    "flag": ({"type": "plastic", "nonlinear": 1}, "nonlinear", "true or false, got 1"),
    "alpha": ({"type": "roughconductor", "alpha": 1.5}, "alpha", "in 0..1, or a texture, got 1.5"),
    "distribution": ({"type": "roughplastic", "distribution": "phong"}, "distribution", "one of ggx, beckmann, got"),
    "roughness twice": ({"type": "roughconductor", "alpha": 0.1, "roughness": 0.1}, "roughness", "alpha or roughness"),
    "roughness thrice": ({"type": "roughdielectric", "roughness": 0, "alpha_u": 0.1, "alpha_v": 0.1}, "alpha_u", "not"),
    "half a pair": ({"type": "roughconductor", "alpha_v": 0.1}, "alpha_u", "alpha_u and alpha_v together"),
    "the other half": ({"type": "roughconductor", "alpha_u": 0.1}, "alpha_v", "alpha_u and alpha_v together"),
    "rough mirror": ({"type": "conductor", "roughness": 0.1}, "roughness", "use roughconductor"),
    "rough pane": ({"type": "thindielectric", "alpha": 0.1}, "alpha", "use roughdielectric"),
    "rough coat": ({"type": "plastic", "roughness": False}, "roughness", "use roughplastic"),
    "metal": ({"type": "conductor", "material": "Ai"}, "material", "one of a-C, Ag, Al"),
    "near metal": ({"type": "conductor", "material": "AU"}, "material", "none (a perfect mirror)"),
    "two metals": ({"type": "conductor", "material": "Au", "eta": 1, "k": 1}, "eta", "either material or eta and k"),
    "metal twice": ({"type": "conductor", "reflectance": 1, "material": "Au"}, "reflectance", "material or reflectance"),
    "eta alone": ({"type": "roughconductor", "eta": 1}, "k", "eta and k together"),
    "k alone": ({"type": "roughconductor", "k": [1, 1, 1]}, "eta", "eta and k together"),
    "eta below 0": ({"type": "conductor", "eta": -1, "k": 1}, "eta", ">= 0, or a texture, got -1"),
    "index 0": ({"type": "dielectric", "int_ior": 0}, "int_ior", "0.001..1000, a texture, or one of vacuum, helium"),
    "index above": ({"type": "plastic", "ext_ior": 1001}, "ext_ior", "0.001..1000"),
    "medium": ({"type": "dielectric", "int_ior": "bk-7"}, "int_ior", "did you mean bk7?"),
    "medium as a list": ({"type": "microfacet", "ior": ["air"]}, "ior", "one of vacuum"),
    "specular and eta": ({"type": "principled", "specular": 0.5, "eta": 1.5}, "eta", "either specular or eta"),
    "cutoff alone": ({"type": "diffuse", "alpha_cutoff": 0.5}, "alpha_cutoff", "an opacity beside alpha_cutoff"),
    "cutoff": ({"type": "diffuse", "opacity": 1, "alpha_cutoff": 2}, "alpha_cutoff", "in 0..1, got 2"),
    "opacity": ({"type": "diffuse", "opacity": -0.1}, "opacity", "in 0..1, or a texture, got -0.1"),
    "emission": ({"type": "diffuse", "emission": [1, -1, 0]}, "emission", ">= 0"),
    "strength": ({"type": "diffuse", "emission": 1, "emission_strength": -1}, "emission_strength", ">= 0, got -1"),
    "leaning alone": ({"type": "diffuse", "normal_strength": 2}, "normal_strength", "a normal_map beside"),
    "strength alone": ({"type": "diffuse", "emission_strength": 2}, "emission_strength", "an emission beside"),
    "two-sided glass": ({"type": "dielectric", "two_sided": False}, "two_sided", "opaque ones only"),
    "two-sided coat": ({"type": "principled", "spec_trans": 0.1, "two_sided": True}, "two_sided", "opaque ones only"),
    "glowing nothing": ({"type": "null", "emission": 1}, "emission", "nothing to cover or to emit"),
    "covering nothing": ({"type": "null", "opacity": 0.5}, "opacity", "use another type with opacity"),
    "two-sided nothing": ({"type": "null", "two_sided": False}, "two_sided", "light passes through"),
    "half a blend": ({"type": "blend", "a": DIFFUSE, "weight": 0.1}, "b", "required"),
    "no weight": ({"type": "blend", "a": DIFFUSE, "b": DIFFUSE}, "weight", "required"),
    "weight": ({"type": "blend", "a": DIFFUSE, "b": DIFFUSE, "weight": 1.5}, "weight", "in 0..1, or a texture, got 1.5"),
    "blend of a number": ({"type": "blend", "a": DIFFUSE, "b": 3, "weight": 1}, "b", "the name of a material, or a"),
    "unknown name": ({"type": "blend", "a": "n", "b": DIFFUSE, "weight": 1}, "a", "expected the name of a material ("),
    "of itself": ({"type": "blend", "a": DIFFUSE, "b": "m", "weight": 1}, "b", "(m -> m)"),
    "inner value": ({"type": "blend", "a": DIFFUSE, "b": {**DIFFUSE, "reflectance": 2}, "weight": 1}, "b.reflectance", "1"),
    "inner key": ({"type": "blend", "a": {**DIFFUSE, "alpha": 2}, "b": DIFFUSE, "weight": 1}, "a.alpha", "reflectance"),
    "inner light": ({"type": "blend", "a": {**DIFFUSE, "emission": 2}, "b": DIFFUSE, "weight": 1}, "a.emission", "blend"),
    "inner side": (
        {"type": "blend", "a": DIFFUSE, "b": {**DIFFUSE, "two_sided": False}, "weight": 1},
        "b.two_sided",
        "on the blend itself",
    ),
    "inner glass": (
        {"type": "blend", "a": DIFFUSE, "b": {"type": "dielectric", "two_sided": True}, "weight": 1},
        "b.two_sided",
        "opaque ones only",
    ),
    "two-sided blend with glass": (
        {"type": "blend", "a": DIFFUSE, "b": {"type": "dielectric"}, "weight": 1, "two_sided": False},
        "two_sided",
        "opaque ones only",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_one_line_that_names_the_key(name: str) -> None:
    material, key, part = BAD[name]
    found = {"materials.m": refused({"m": material})}
    if name != "of itself":
        found["shapes.s.material"] = refused({}, material=material)
    for where, error in found.items():
        assert not isinstance(error, NotBuiltError)
        assert error.key == f"{where}.{key}"
        assert part in str(error)


IMAGE = {"type": "image", "path": "a.png"}
TEXTURES: dict[str, tuple[dict[str, Any], str, str]] = {
    "no such texture": ({"type": "principled", "roughness": {"texture": "t"}}, "roughness.texture", "none is defined"),
    "no name": ({"type": "principled", "roughness": {"texture": 3}}, "roughness.texture", "the name of a texture"),
    "a wrong key": (
        {"type": "diffuse", "reflectance": {"texture": "t", "wrap": "clamp"}},
        "reflectance.wrap",
        "channel",
    ),
    "a wrong type": (
        {"type": "principled", "roughness": {"type": "checkboard"}},
        "roughness.type",
        "did you mean checker",
    ),
    "a wrong key of an image": (
        {"type": "diffuse", "reflectance": {**IMAGE, "wrapp": "clamp"}},
        "reflectance.wrapp",
        "did you mean wrap?",
    ),
    "wrap": (
        {"type": "diffuse", "reflectance": {**IMAGE, "wrap": "black"}},
        "reflectance.wrap",
        "repeat, clamp, mirror",
    ),
    "filter": ({"type": "diffuse", "reflectance": {**IMAGE, "filter": "cubic"}}, "reflectance.filter", "bilinear"),
    "space": ({"type": "diffuse", "reflectance": {**IMAGE, "colorspace": "aces"}}, "reflectance.colorspace", "srgb"),
    "path": ({"type": "diffuse", "reflectance": {**IMAGE, "path": 4}}, "reflectance.path", "a file path"),
    "no path": ({"type": "diffuse", "reflectance": {"type": "image"}}, "reflectance.path", "required"),
    "scale": ({"type": "phong", "exponent": {**IMAGE, "scale": [1, 2, 3]}}, "exponent.scale", "one number"),
    "channel": ({"type": "diffuse", "reflectance": {**IMAGE, "channel": "r"}}, "reflectance.channel", "no channel"),
    "no channel": ({"type": "phong", "exponent": {**IMAGE, "channel": "x"}}, "exponent.channel", "luminance, r, g"),
    "transform": (
        {"type": "diffuse", "reflectance": {**IMAGE, "uv_transform": {"rotate": "x"}}},
        "reflectance.uv_transform.rotate",
        "degrees",
    ),
    "transform rows": (
        {"type": "diffuse", "reflectance": {**IMAGE, "uv_transform": {"matrix": [[1, 0], [0, 1]]}}},
        "reflectance.uv_transform.matrix",
        "two rows of three finite numbers",
    ),
    "two transforms": (
        {"type": "diffuse", "reflectance": {**IMAGE, "uv_transform": {"matrix": [[1, 0, 0], [0, 1, 0]], "scale": 2}}},
        "reflectance.uv_transform.matrix",
        "either matrix, or scale",
    ),
    "transform key": (
        {"type": "diffuse", "reflectance": {**IMAGE, "uv_transform": {"turn": 1}}},
        "reflectance.uv_transform.turn",
        "rotate",
    ),
    "smooth": ({"type": "conductor", "alpha": IMAGE}, "alpha", "use roughconductor"),
    "cutoff": ({"type": "diffuse", "opacity": 1, "alpha_cutoff": IMAGE}, "alpha_cutoff", "in 0..1, got"),
    "flag": ({"type": "diffuse", "two_sided": IMAGE}, "two_sided", "true or false"),
    "a normal map of a number": ({"type": "diffuse", "normal_map": 0.5}, "normal_map", "hold normals"),
    "both maps": ({"type": "diffuse", "normal_map": IMAGE, "bump_map": IMAGE}, "bump_map", "not both"),
    "colours as opacity": (
        {"type": "diffuse", "opacity": {"type": "vertex_color"}},
        "opacity",
        "read by coordinates",
    ),
    "an inner map": (
        {"type": "blend", "a": {"type": "diffuse", "normal_map": IMAGE}, "b": DIFFUSE, "weight": 0.5},
        "a.normal_map",
        "give it to the blend itself",
    ),
}
LATER: dict[str, tuple[dict[str, Any], str]] = {
    "compensation": ({"type": "roughconductor", "alpha": IMAGE, "energy_compensation": True}, "alpha"),
    "a table": ({"type": "roughplastic", "roughness": IMAGE}, "roughness"),
    "an inner opacity": (
        {"type": "blend", "a": {"type": "diffuse", "opacity": IMAGE}, "b": DIFFUSE, "weight": 0.5},
        "a.opacity",
    ),
    "a weight beside opacity": (
        {"type": "blend", "a": {"type": "diffuse", "opacity": 0.5}, "b": DIFFUSE, "weight": IMAGE},
        "a",
    ),
}


@pytest.mark.parametrize("name", TEXTURES)
def test_what_is_wrong_with_a_texture(name: str) -> None:
    material, key, part = TEXTURES[name]
    error = refused({"m": material})
    assert not isinstance(error, NotBuiltError)
    assert error.key == f"materials.m.{key}" and part in str(error) and "\n" not in str(error)


@pytest.mark.parametrize("name", LATER)
def test_textures_that_are_not_built(name: str) -> None:
    material, key = LATER[name]
    error = refused({"m": material})
    assert isinstance(error, NotBuiltError) and error.key == f"materials.m.{key}"


def test_errors_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    blend = "{type: blend, a: later, b: nobody, weight: 0.5}"
    path.write_text(
        f"camera: {{origin: [0, 0, 1], target: [0, 0, 0]}}\nmaterials: {{m: {blend}, later: {{type: null}}}}\n"
    )
    with pytest.raises(SceneError, match=r"a\.yaml: materials\.m\.b: expected the name of a material \(m, later\)"):
        read_description(path)


# --- blends ---


def test_blends_of_names_and_of_materials_in_place() -> None:
    materials = read(
        {
            "m": {
                "type": "blend",
                "a": "late",
                "b": {"type": "conductor"},
                "weight": 0.25,
                "two_sided": False,
                **COMMON,
            },
            "late": {"type": "blend", "a": "red", "b": {"type": "diffuse", "opacity": 0.5}, "weight": 1},
            "red": {"type": "diffuse", "reflectance": [1, 0, 0]},
        }
    ).materials
    found = resolved(materials["m"], "materials.m", materials)
    red = ResolvedMaterial(Diffuse(), "materials.red", {"reflectance": (1, 0, 0)})
    clear = ResolvedMaterial(Diffuse(), "materials.late.b", {"reflectance": GREY}, opacity=0.5)
    mirror = ResolvedMaterial(Conductor(schlick=True), "materials.m.b", {"reflectance": WHITE})
    late = ResolvedMaterial(Blend(red.model, clear.model), "materials.late", {"weight": 1.0}, inner=(red, clear))
    assert found == ResolvedMaterial(
        model=Blend(late.model, mirror.model),
        name="materials.m",
        values={"weight": 0.25},
        two_sided=False,
        opacity=0.25,
        alpha_cutoff=0.5,
        emission=(1, 2, 3),
        emission_strength=4.0,
        inner=(late, mirror),
    )


def test_a_blend_in_a_shape() -> None:
    found = read({"d": DIFFUSE}, material={"type": "blend", "a": "d", "b": {"type": "phong"}, "weight": 0})
    material = found.shapes["s"]["material"]
    assert isinstance(material, ParsedParams)
    inner = resolved(material, "shapes.s.material", found.materials).inner
    assert [slot.name for slot in inner] == ["materials.d", "shapes.s.material.b"]


def test_a_circle_of_blends_is_named() -> None:
    error = refused(CIRCLE)
    assert error.key == "materials.x.a.b.a" and error.value == "x"
    assert "does not contain itself (x -> y -> x)" in str(error)


def test_a_circle_that_does_not_hold_the_blend_itself() -> None:
    error = refused({"w": {"type": "blend", "a": "d", "b": "x", "weight": 0}, **CIRCLE})
    assert "(x -> y -> x)" in str(error)


@pytest.mark.parametrize(("keys", "part"), [({"emission": 1}, "without emission"), ({"two_sided": False}, "two-sided")])
def test_named_materials_in_a_blend_neither_glow_nor_have_one_side(keys: dict[str, Any], part: str) -> None:
    error = refused({"m": {"type": "blend", "a": "d", "b": DIFFUSE, "weight": 1}, "d": {**DIFFUSE, **keys}})
    assert error.key == "materials.m.a" and error.value == "d" and part in str(error)


def test_blends_are_nested_so_deep() -> None:
    def chain(depth: int) -> dict[str, Any]:
        return {f"m{i}": {"type": "blend", "a": f"m{i + 1}", "b": DIFFUSE, "weight": 1} for i in range(depth)} | {
            f"m{depth}": DIFFUSE
        }

    inline: dict[str, Any] = DIFFUSE
    for _ in range(MAX_BLENDS):
        inline = {"type": "blend", "a": inline, "b": inline, "weight": 1}
    read({"m": inline})
    read(chain(MAX_BLENDS))
    assert "nested at most 8 deep" in str(refused(chain(MAX_BLENDS + 1)))
    assert "nested at most 8 deep" in str(refused({"m": {"type": "blend", "a": DIFFUSE, "b": inline, "weight": 1}}))


# --- emission ---


@pytest.mark.parametrize("glow", [{"material": "m"}, {"material": {**DIFFUSE, "emission": 2}}])
def test_shape_and_material_do_not_both_emit(glow: dict[str, Any]) -> None:
    error = refused({"m": {**DIFFUSE, "emission": 2}}, emission=1, **glow)
    where = "materials.m" if glow["material"] == "m" else "shapes.s.material"
    assert error.key == "shapes.s.emission" and f"({where}.emission)" in str(error)


def test_either_may_emit() -> None:
    found = read({"m": {**DIFFUSE, "emission": 2}, "n": DIFFUSE}, emission=1, material="n")
    assert found.shapes["s"]["emission"] == (1, 1, 1)
    assert found.materials["m"]["emission"] == (2, 2, 2) and found.materials["m"]["emission_strength"] == 1


# --- presets ---


def test_presets_have_names_of_their_own() -> None:
    assert {"Au", "Ag", "Al", "Cu", "Cr", "Fe"} <= METALS.keys()
    assert (
        metal_index("Ni") == metal_index("Ni_palik")
        and metal_index("Cu") != metal_index("Cu_palik")
        and metal_index("ni") is None
    )
    assert all(name == name.lower() for name in INDICES)


@pytest.mark.mitsuba
def test_metals_are_mitsubas() -> None:
    mi: Any = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # colours outside sRGB are clamped, and reported
    try:
        for name in METALS.keys() - {"Fe"}:
            oracle = name if name not in ("Na", "Ni", "V") else f"{name}_palik"
            parameters = mi.traverse(mi.load_dict({"type": "roughconductor", "material": oracle}))
            for key, value in zip(("eta", "k"), METALS[name], strict=True):
                assert value == pytest.approx(list(parameters[f"{key}.value"]), rel=1e-5, abs=1e-9), (name, key)
    finally:
        mi.set_log_level(level)


@pytest.mark.mitsuba
def test_indices_are_mitsubas() -> None:
    mi: Any = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    for name, value in INDICES.items():
        glass = mi.load_dict({"type": "dielectric", "int_ior": name, "ext_ior": "vacuum"})
        assert value == pytest.approx(mi.traverse(glass)["eta"], rel=1e-6), name


# --- warnings ---

WARNED: dict[str, tuple[dict[str, Any], str]] = {
    "phong": ({"type": "phong", "diffuse": [0.1, 0.8, 0.1], "specular": 0.3}, "diffuse + specular is 1.1"),
    "blinn_phong": ({"type": "blinn_phong", "diffuse": 0.4, "specular": 0.2}, "diffuse + 4 specular is 1.2"),
    "roughdiffuse": ({"type": "roughdiffuse", "reflectance": [0.1, 0.96, 0.1]}, "a reflectance of 0.96 is above 0.95"),
}


@pytest.mark.parametrize("name", WARNED)
def test_a_gain_of_energy_is_warned_of_once(name: str) -> None:
    material, text = WARNED[name]
    inside = {"type": "blend", "a": material, "b": "m", "weight": 0.5}
    for source, key in (
        (scene({"m": material}), "materials.m"),
        (scene({}, material=material), "shapes.s.material"),
        (scene({"m": DIFFUSE, "n": inside}), "materials.n.a"),
    ):
        with pytest.warns(EnergyWarning) as caught:
            read_description(source)
        assert [str(warning.message).startswith(f"{key}: {text}") for warning in caught] == [True]


def test_no_gain_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read({"p": {"type": "phong", "diffuse": 0.7, "specular": 0.3}})
        read({"p": {"type": "blinn_phong", "diffuse": 0.2, "specular": 0.2}})
        read({"p": {"type": "roughdiffuse", "reflectance": 0.95, "alpha": 1}})
        read({"p": {"type": "roughdiffuse", "reflectance": 1, "alpha": 0}})


# --- the caller's own models ---


@dataclass(frozen=True)
class Tinted(Bsdf):
    name = "tinted"
    parameters = {"tint": (0.5, 0.25, 1.0), "amount": -2.0}  # noqa: RUF012
    clear: bool = False

    @property
    def transmits(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.clear

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        return parameters["tint"] * wi[2], wi[2]

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        return BsdfSample(wo, wo[2], parameters["tint"])


OWN = {"mine": Tinted()}


def test_a_model_of_the_callers_own() -> None:
    assert slot(OWN, type="mine") == ResolvedMaterial(
        Tinted(), "materials.m", {"tint": (0.5, 0.25, 1.0), "amount": -2.0}
    )
    found = slot(OWN, type="mine", tint=-3, amount=1e6, **COMMON)
    assert found.values == {"tint": (-3, -3, -3), "amount": 1e6} and found.emission == (1, 2, 3)
    assert found.model is OWN["mine"]


@pytest.mark.parametrize("name", ["copy", "json", "values", "model_fields"])
def test_a_parameter_may_have_any_name(name: str) -> None:
    assert slot({"mine": with_parameters({name: 0.5})}, type="mine", **{name: 2}).values[name] == 2.0


def test_models_of_their_own_stay_apart() -> None:
    plain: Any = Tinted()
    materials = read({"m": {"type": "one"}, "n": {"type": "two"}}, {"one": plain, "two": Tinted(clear=True)}).materials
    assert resolved(materials["m"], "m", materials).model is plain
    assert resolved(materials["n"], "n", materials).model == Tinted(clear=True)


def test_their_own_model_in_a_blend_and_in_a_shape() -> None:
    blend = {"type": "blend", "a": {"type": "mine", "amount": 3}, "b": DIFFUSE, "weight": 0.5}
    found = slot(OWN, **blend).inner[0]
    assert found.name == "materials.m.a" and found.values["amount"] == 3 and found.model is OWN["mine"]
    assert isinstance(read({}, OWN, material=blend).shapes["s"]["material"], ParsedParams)


OWN_BAD: dict[str, tuple[dict[str, Any], str, str]] = {
    "unknown key": ({"type": "mine", "tin": 1}, "tin", "did you mean tint?"),
    "three numbers": ({"type": "mine", "amount": [1, 2, 3]}, "amount", "a finite number, or a texture, got"),
    "two numbers": (
        {"type": "mine", "tint": [1, 2]},
        "tint",
        "[r, g, b] or one number, each finite, or a texture, got",
    ),
    "infinite": ({"type": "mine", "tint": math.inf}, "tint", "finite, or a texture, got inf"),
    "two-sided": ({"type": "clear", "two_sided": True}, "two_sided", "opaque ones only"),
    "unknown type": ({"type": "mien"}, "type", "did you mean mine?"),
}


@pytest.mark.parametrize("name", OWN_BAD)
def test_what_is_wrong_with_their_own_material(name: str) -> None:
    material, key, part = OWN_BAD[name]
    error = refused({"m": material}, {**OWN, "clear": Tinted(clear=True)})
    assert error.key == f"materials.m.{key}" and part in str(error)


def with_parameters(parameters: Any) -> Bsdf:
    return type("Odd", (Tinted,), {"parameters": parameters})()


MODELS_BAD: dict[str, tuple[Any, str, str]] = {
    "a built-in name": ({"phong": Tinted()}, "bsdfs.phong", "a name of its own"),
    "a class": ({"mine": Tinted}, "bsdfs.mine", "an instance of a subclass of torchpt.Bsdf"),
    "a module": ({"mine": torch.nn.Linear(1, 1)}, "bsdfs.mine", "an instance of a subclass of torchpt.Bsdf"),
    "no name": ({"a b": Tinted()}, "bsdfs", "letters, digits and underscores"),
    "no mapping": ([Tinted()], "bsdfs", "a mapping from type names"),
    "parameters": ({"mine": with_parameters(["tint"])}, "bsdfs.mine.parameters", "a mapping from names to defaults"),
    "a default": ({"mine": with_parameters({"x": "1"})}, "bsdfs.mine.parameters.x", "a finite number, or three"),
    "a pair": ({"mine": with_parameters({"x": (1, 2)})}, "bsdfs.mine.parameters.x", "a finite number, or three"),
    "a common key": ({"mine": with_parameters({"opacity": 1})}, "bsdfs.mine.parameters.opacity", "another name"),
    "a later key": ({"mine": with_parameters({"bump_map": 1})}, "bsdfs.mine.parameters.bump_map", "another name"),
    "the type": ({"mine": with_parameters({"type": 1})}, "bsdfs.mine.parameters.type", "another name"),
    "a default out of range": (
        {"mine": with_parameters({"x": Scalar(2.0, high=1.0)})},
        "bsdfs.mine.parameters.x",
        "in 0..1, got 2",
    ),
    "a dotted name": ({"mine": with_parameters({"a.b": 1})}, "bsdfs.mine.parameters", "letters, digits"),
}


@pytest.mark.parametrize("name", MODELS_BAD)
def test_models_that_cannot_be_taken(name: str) -> None:
    models, key, part = MODELS_BAD[name]
    error = refused({"m": DIFFUSE}, models)
    assert error.key == key and part in str(error)


def test_the_example_in_the_docs_learns(capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / "materials.md").read_text()
    code = text.partition("```python\n")[2].partition("```")[0]
    exec(code.replace("    loss.backward()", "    print(loss.item())\n    loss.backward()"), {})
    losses = [float(line) for line in capsys.readouterr().out.splitlines()]
    assert len(losses) == 20 and losses[-1] < 0.1 * losses[0]


# --- what they are among the parameters of a scene


@dataclass(frozen=True)
class Specified(Tinted):
    parameters = {  # noqa: RUF012
        "level": Scalar(0.25, high=0.5, texture=True, doc="a number with bounds"),
        "tint": Color((1.0, 0.5, 0.25), high=1.0, doc="a colour with bounds"),
        "index": Index(1.5, media=INDICES, doc="an index"),
        "maybe": Scalar(None, doc="one that may be left out"),
        "half": Flag(False, doc="what the model itself never sees"),
    }

    @classmethod
    def check(cls, values: Any, given: frozenset[str]) -> None:
        super().check(values, given)
        if values["half"] and "level" in given:
            raise Refused("no level beside half", values["level"], ("level",))

    @classmethod
    def given(cls, values: Any) -> dict[str, Any]:
        return {**super().given(values), **({"level": 0.5} if values["half"] else {})}


SPECIFIED = {"specified": Specified()}


def loaded(material: dict[str, Any], models: dict[str, Any] | None = None) -> torchpt.Scene:
    return torchpt.load(scene({"m": material}, material="m"), "cpu", bsdfs=models)


def test_a_model_of_the_callers_own_may_have_specs() -> None:
    found = slot(SPECIFIED, type="specified", index="water")
    assert found.values == {"tint": (1.0, 0.5, 0.25), "amount": -2.0, "level": 0.25, "index": 1.333}
    assert slot(SPECIFIED, type="specified", maybe=3).values["maybe"] == 3.0
    assert slot(SPECIFIED, type="specified", half=True).values["level"] == 0.5
    error = refused({"m": {"type": "specified", "half": True, "level": 0.1}}, SPECIFIED)
    assert error.key == "materials.m.level" and "no level beside half" in str(error)
    error = refused({"m": {"type": "specified", "level": 0.6}}, SPECIFIED)
    assert error.key == "materials.m.level" and "in 0..0.5, or a texture, got 0.6" in str(error)
    error = refused({"m": {"type": "specified", "tint": {"type": "vertex_color"}}}, SPECIFIED)
    assert error.key == "materials.m.tint" and "or a texture" not in error.expected


PARAMETERS: dict[str, tuple[dict[str, Any], str, Any, str]] = {  # material, name, a value, what is said of it
    "roughness": ({"type": "roughconductor", "roughness": 0.3}, "roughness", 7.0, "in 0..1"),
    "reflectance": ({"type": "diffuse"}, "reflectance", [0.5, 1.5, 0.5], "in 0..1"),
    "exponent": ({"type": "phong"}, "exponent", -1.0, "in 0..100000"),
    "eta": ({"type": "conductor", "material": "Au"}, "eta", [1.0, -1.0, 1.0], ">= 0"),
    "int_ior": ({"type": "dielectric"}, "int_ior", 0.0, "in 0.001..1000"),
    "weight": ({"type": "blend", "a": DIFFUSE, "b": DIFFUSE, "weight": 0.5}, "weight", 1.5, "in 0..1"),
    "an inner one": (
        {"type": "blend", "a": DIFFUSE, "b": DIFFUSE, "weight": 0.5},
        "a.reflectance",
        [2.0] * 3,
        "in 0..1",
    ),
    "opacity": ({"type": "diffuse", "opacity": 0.5}, "opacity", -0.5, "in 0..1"),
    "emission": ({"type": "diffuse", "emission": 2}, "emission", [-1.0, 1.0, 1.0], ">= 0"),
    "emission_strength": ({"type": "diffuse", "emission": 2}, "emission_strength", -1.0, ">= 0"),
    "a user's": ({"type": "specified"}, "level", 0.6, "in 0..0.5"),
    "a user's index": ({"type": "specified"}, "index", 0.0, "in 0.001..1000"),
    "a user's without bounds": ({"type": "mine"}, "amount", math.nan, "finite"),
    "a checkerboard": (
        {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
        "reflectance.color0",
        [0.5, 0.5, 2.0],
        "in 0..1",
    ),
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_are_refused_as_a_file_refuses_them(name: str) -> None:
    material, key, value, part = PARAMETERS[name]
    found = loaded(material, {**OWN, **SPECIFIED})
    with pytest.raises(SceneError) as caught:
        torchpt.render(found, params={f"materials.m.{key}": torch.tensor(value)}, spp=1)
    assert caught.value.key == f"params.materials.m.{key}" and part in str(caught.value)
    torchpt.render(
        found, params={f"materials.m.{key}": found.params[f"materials.m.{key}"]}, film={"width": 2, "height": 2}
    )


def test_texels_are_held_to_what_their_slots_accept(tmp_path: Path) -> None:
    torchpt.write_image(tmp_path / "a.exr", torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(0)) * 0.5)
    image = {"type": "image", "path": str(tmp_path / "a.exr")}
    textures = {"shared": image, "heights": image}
    material = {
        "type": "principled",
        "base_color": {"texture": "shared"},
        "roughness": {**image, "scale": 2},
        "bump_map": {"texture": "heights"},
    }
    found = torchpt.load({**scene({"m": material}, material="m"), "textures": textures}, "cpu")

    def bounds(name: str) -> tuple[float | None, float | None]:
        spec: Any = found.spec(name)
        return spec.low, spec.high

    assert bounds("textures.shared") == (0.0, 1.0) and bounds("materials.m.roughness") == (0.0, 0.5)
    assert bounds("textures.heights") == (None, None)  # a bump map may go down as well as up
    down = {"textures.heights": -found.params["textures.heights"]}
    torchpt.render(found, params=down, spp=1, film={"width": 4, "height": 4})
    with pytest.raises(SceneError, match="roughness: expected texels in 0..0.5"):
        torchpt.render(found, params={"materials.m.roughness": found.params["materials.m.roughness"] + 0.5}, spp=1)


def test_indices_bend_rays_and_textures_of_them_too(tmp_path: Path) -> None:
    def bending(**keys: Any) -> set[str]:
        made = loaded(keys)
        return {name for name in made.params if name.startswith("materials.m.") and attached(made, [name])}

    squares = {"type": "checkerboard", "color0": 1.3, "color1": 1.5}
    assert bending(type="dielectric") == {"materials.m.int_ior", "materials.m.ext_ior"}
    assert bending(type="roughdielectric", int_ior=squares) == {
        "materials.m.int_ior.color0", "materials.m.int_ior.color1", "materials.m.ext_ior",
    }  # fmt: skip
    assert not bending(type="plastic") and not bending(type="thindielectric")


@pytest.mark.parametrize("kind", few(["roughconductor", "roughdielectric"], 1))
def test_energy_compensation_beside_textures(kind: str) -> None:
    """Its table is made once a material, also where the rest is prepared on lanes."""

    def picture(**keys: Any) -> Tensor:
        lights, film = {"sky": {"type": "constant"}}, {"width": 8, "height": 8}
        material = {"type": kind, "alpha": 0.5, "energy_compensation": True, **keys}
        read_typed = {**scene({"m": material}, material="m"), "lights": lights, "film": film}
        return torchpt.render(torchpt.load(read_typed, "cpu"), spp=64, seed=1, compile="off")

    def even(*color: float) -> dict[str, Any]:
        return {"type": "checkerboard", "color0": list(color), "color1": list(color)}

    flat = picture(normal_map=even(0.5, 0.5, 1.0))
    torch.testing.assert_close(flat.mean(), picture().mean(), rtol=0.02, atol=0)
    tint = picture(specular_reflectance=even(0.25, 0.5, 0.75))
    torch.testing.assert_close(tint, picture(specular_reflectance=[0.25, 0.5, 0.75]), rtol=1e-4, atol=1e-5)
