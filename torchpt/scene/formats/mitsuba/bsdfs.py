"""Mitsuba's BSDFs: what each becomes here.

A BSDF becomes a mapping of the block ``materials``. Mitsuba's opaque models are black from behind unless they are
``twosided``: they say ``two_sided: false`` here, until a ``twosided`` around them takes it away.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from torchpt.physics.bsdfs.presets import INDICES, METALS, metal_index
from torchpt.scene.formats.materials import MAX_BLENDS
from torchpt.scene.formats.mitsuba.plugins import Plugin, exact, nearest
from torchpt.scene.formats.mitsuba.properties import Properties
from torchpt.scene.formats.mitsuba.textures import scaled

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer

__all__ = ["BSDFS", "UNKNOWN", "opacity_of"]

Material = dict[str, Any]

#: Keys of a material that a blend has itself, never the materials inside.
_OUTER = ("normal_map", "bump_map")


def _opaque(type: str, **keys: Any) -> Material:
    """Return a material that is black from behind; keys of None are left out."""
    return _clear(type, **keys) | {"two_sided": False}


def _clear(type: str, **keys: Any) -> Material:
    """Return a material that light passes; keys of None are left out."""
    return {"type": type, **{key: value for key, value in keys.items() if value is not None}}


def _diffuse(p: Properties, importer: Importer) -> Material:
    return _opaque("diffuse", reflectance=p.slot("reflectance"))


def _rough_diffuse(p: Properties, importer: Importer) -> Material:
    fast = p.flag("use_fast_approx") or None
    return _opaque("roughdiffuse", reflectance=p.slot("reflectance"), alpha=p.scalar("alpha"), use_fast_approx=fast)


def _index(p: Properties, name: str, default: Any) -> Any:
    """Return an index of refraction: a number, or the name of a medium."""
    text = p.text(name)
    if not text:
        return default
    if text.lower() in INDICES:
        return text.lower()
    if text[:1].isalpha():
        raise p.element.error(text, f"a number or a medium as {name}: {', '.join(INDICES)}")
    value = p.number(name, 1.0)
    if not value > 0.0:
        raise p.element.error(value, f"an index > 0 as {name}")
    return value


def _glass(p: Properties) -> Material:
    return {
        "int_ior": _index(p, "int_ior", "bk7"),
        "ext_ior": _index(p, "ext_ior", "air"),
        "specular_reflectance": p.slot("specular_reflectance"),
        "specular_transmittance": p.slot("specular_transmittance"),
    }


def _dielectric(p: Properties, importer: Importer) -> Material:
    return _clear("dielectric", **_glass(p))


def _thin_dielectric(p: Properties, importer: Importer) -> Material:
    return _clear("thindielectric", **_glass(p))


def _rough_dielectric(p: Properties, importer: Importer) -> Material:
    return _clear("roughdielectric", **_glass(p), **_alphas(p))


def _distribution(p: Properties) -> Any:
    """Return the distribution of microfacets, None for GGX.

    Phong's, of the exponent ``2 / alpha^2 - 2``, is nearest to Beckmann's (Walter et al. 2007, section 5.2).
    """
    p.ignore("sample_visible", "exponent_u", "exponent_v")
    kind = p.text("distribution", "beckmann").lower()
    if kind in ("ggx", "trowbridge-reitz"):
        return None
    if kind != "beckmann":
        p.note(f'distribution "{kind}" becomes beckmann of the same alpha')
    return "beckmann"


def _alphas(p: Properties) -> Material:
    """Return the distribution of facets and their roughness, for two directions where they are given."""
    found: Material = {"distribution": _distribution(p)}
    if p.has("alpha_u", "alpha_v"):
        for one, other in (("alpha_u", "alpha_v"), ("alpha_v", "alpha_u")):
            if not p.has(one):
                p.note(f"{other} without {one}, which becomes 0.1")
        return found | {key: p.scalar(key, 0.1) for key in ("alpha_u", "alpha_v")}
    return found | {"alpha": p.scalar("alpha", 0.1)}


def _metal(p: Properties) -> Material:
    """Return the metal: ``eta`` and ``k`` over the index of the medium around, or its name."""
    name = p.text("material", "none" if p.modern else "Cu")
    outside = _index(p, "ext_eta", 1.0)
    divisor = INDICES[outside] if isinstance(outside, str) else outside
    found: Material = {"specular_reflectance": p.slot("specular_reflectance")}
    if not p.has("eta", "k"):
        if name != "none" and metal_index(name) is None:
            raise p.element.error(name, f"none or one of the metals {', '.join(METALS)}")
        if name == "none" or divisor == 1.0:
            return found | {"material": name}
        index = metal_index(name)
        assert index is not None
        eta, k = (list(values) for values in index)
    else:
        eta, k = p.slot("eta", [0.0] * 3, bounded=False), p.slot("k", [1.0] * 3, bounded=False)
    if divisor != 1.0:
        factor = [1.0 / divisor] * 3
        eta, k = scaled(eta, factor, p), scaled(k, factor, p)
    return found | {"eta": eta, "k": k}


def _conductor(p: Properties, importer: Importer) -> Material:
    return _opaque("conductor", **_metal(p))


def _rough_conductor(p: Properties, importer: Importer) -> Material:
    return _opaque("roughconductor", **_metal(p), **_alphas(p))


def _coat(p: Properties) -> Material:
    return {
        "diffuse_reflectance": p.slot("diffuse_reflectance"),
        "specular_reflectance": p.slot("specular_reflectance"),
        "int_ior": _index(p, "int_ior", "polypropylene"),
        "ext_ior": _index(p, "ext_ior", "air"),
        "nonlinear": p.flag("nonlinear") or None,
    }


def _plastic(p: Properties, importer: Importer) -> Material:
    return _opaque("plastic", **_coat(p))


def _rough_plastic(p: Properties, importer: Importer) -> Material:
    alpha = p.scalar("alpha", 0.1)
    if isinstance(alpha, dict):
        p.note("the texture of alpha becomes 0.1")
        alpha = 0.1
    return _opaque("roughplastic", **_coat(p), distribution=_distribution(p), alpha=alpha)


_PRINCIPLED = (
    "roughness", "metallic", "spec_tint", "anisotropic", "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "spec_trans",
    "flatness",
)  # fmt: skip


def _principled(p: Properties, importer: Importer) -> Material:
    p.ignore("diffuse_reflectance_sampling_rate", "main_specular_sampling_rate", "clearcoat_sampling_rate")
    p.ignore("main_reflectance_sampling_rate", "main_transmission_sampling_rate")
    keys: Material = {"base_color": p.slot("base_color")} | {key: p.scalar(key) for key in _PRINCIPLED}
    keys["specular"] = p.scalar("specular")
    keys["eta"] = _index(p, "eta", None)
    return (_opaque if keys["spec_trans"] in (None, 0.0) else _clear)("principled", **keys)


def _principled_thin(p: Properties, importer: Importer) -> Material:
    p.ignore(
        "diff_trans", "eta", "spec_trans", "diffuse_transmission_sampling_rate", "specular_reflectance_sampling_rate"
    )
    p.ignore("diffuse_reflectance_sampling_rate", "specular_transmission_sampling_rate")
    keys = {key: p.scalar(key) for key in ("roughness", "spec_tint", "anisotropic", "sheen", "sheen_tint", "flatness")}
    return _opaque("principled", base_color=p.slot("base_color"), **keys) | {"two_sided": True}


def _twosided(p: Properties, importer: Importer) -> Material:
    inner = p.objects("bsdf")
    if not 1 <= len(inner) <= 2:
        raise p.element.error(p.element.label, f"one or two bsdf inside it, not {len(inner)}")
    if len(inner) == 2 and inner[0] is not inner[1]:
        p.note("the second bsdf, of the back, is left out: the first has both sides")
    material = dict(importer.material(inner[0]))
    material.pop("two_sided", None)
    return material


def _mask(p: Properties, importer: Importer) -> Material:
    material = dict(importer.material(p.only("bsdf")))
    opacity = p.scalar("opacity", 0.5)
    before = material.get("opacity", 1.0)
    if before != 1.0:
        if isinstance(before, dict) or isinstance(opacity, dict):
            p.note("the opacity of the bsdf inside is left out")
        else:
            opacity = opacity * before
    return material | {"opacity": opacity}


def _blend(p: Properties, importer: Importer) -> Material:
    inner = p.objects("bsdf")
    if len(inner) != 2:
        raise p.element.error(p.element.label, f"two bsdf inside it, not {len(inner)}")
    textures = [] if p.has("weight") else p.objects("texture")
    weight = p.fraction(importer.texture(textures[0]), "weight") if textures else p.scalar("weight", 0.5)
    if isinstance(weight, list):
        weight = weight[0]
    return _blended([importer.material(element) for element in inner], weight, p)


def _blended(sides: list[Material], weight: Any, p: Properties) -> Material:
    """Return a blend of two materials; what only the blend itself may have is taken from them."""
    if not isinstance(weight, dict):
        for null, other, share in ((*sides, weight), (*sides[::-1], 1.0 - weight)):
            # Light passes one of them: the other is less opaque, and stays black from behind if it is.
            if null == {"type": "null"} and "opacity" not in other and other["type"] != "null":
                return other | {"opacity": share}
    inner: list[Material] = []
    one_sided = [side.get("two_sided") is False for side in sides]
    clear = [_passes(side) for side in sides]
    for side in sides:
        kept = {key: value for key, value in side.items() if key not in (*_OUTER, "two_sided")}
        opacity = kept.get("opacity", 1.0)
        if isinstance(opacity, dict) or (isinstance(weight, dict) and opacity != 1.0):
            words = (
                "an opacity texture inside a blend"
                if isinstance(opacity, dict)
                else "an opacity inside a textured blend"
            )
            p.note(f"{words} is left out")
            del kept["opacity"]
        for key in _OUTER:
            if key in side:
                p.note(f"a {key} inside a blend is left out")
        inner.append(kept)
    if max(map(_depth, inner)) >= MAX_BLENDS:
        raise p.element.error(p.element.label, f"at most {MAX_BLENDS} blends inside each other")
    found: Material = {"type": "blend", "a": inner[0], "b": inner[1], "weight": weight}
    if any(clear):
        if any(one_sided):
            p.note("both sides of the blend are seen from behind, as light passes one part of it")
        return found
    if one_sided[0] != one_sided[1]:
        p.note("both sides of the blend are seen from behind, as one of them is")
    return found | ({"two_sided": False} if all(one_sided) else {})


def _depth(material: Material) -> int:
    """Return how many blends are inside each other."""
    return 1 + max(_depth(material["a"]), _depth(material["b"])) if material["type"] == "blend" else 0


def _passes(material: Material) -> bool:
    """Return True where light passes a material."""
    kind = material["type"]
    if kind == "blend":
        return _passes(material["a"]) or _passes(material["b"])
    return kind in ("dielectric", "thindielectric", "roughdielectric", "null") or (
        kind == "principled" and material.get("spec_trans", 0.0) != 0.0
    )


def opacity_of(material: Material) -> float | None:
    """Return the share of light that a material does not let straight through; None where a texture gives it."""
    found = material.get("opacity", 1.0)
    if material["type"] == "null":
        found = 0.0
    elif material["type"] == "blend":
        a, b, weight = opacity_of(material["a"]), opacity_of(material["b"]), material["weight"]
        if a == b == 1.0:
            inner = 1.0
        elif a is None or b is None or isinstance(weight, dict):
            return None
        else:
            inner = a + (b - a) * weight
        return None if isinstance(found, dict) else found * inner
    return None if isinstance(found, dict) else float(found)


def _mixture(p: Properties, importer: Importer) -> Material:
    inner = [importer.material(element) for element in p.objects("bsdf")]
    text = p.text("weights")
    weights = [float(word) for word in text.replace(",", " ").split()] if _are_numbers(text) else []
    if not inner or len(weights) != len(inner) or min(weights) < 0.0 or not sum(weights) > 0.0:
        raise p.element.error(text, f"weights >= 0 for the {len(inner)} bsdf inside")
    total = sum(weights)
    if total < 1.0 - 1e-6:
        inner.append(_opaque("diffuse", reflectance=[0.0] * 3))
        weights.append(1.0 - total)
    found, share = inner[0], weights[0]
    for material, weight in zip(inner[1:], weights[1:], strict=True):
        share += weight
        found = _blended([found, material], weight / share if share else 0.0, p)
    return found


def _are_numbers(text: str) -> bool:
    try:
        return all(math.isfinite(float(word)) for word in text.replace(",", " ").split())
    except ValueError:
        return False


def _null(p: Properties, importer: Importer) -> Material:
    return {"type": "null"}


def _bump_map(p: Properties, importer: Importer) -> Material:
    return _mapped(p, importer, "bump_map")


def _normal_map(p: Properties, importer: Importer) -> Material:
    return _mapped(p, importer, "normal_map")


def _mapped(p: Properties, importer: Importer, key: str) -> Material:
    material = dict(importer.material(p.only("bsdf")))
    textures = p.objects("texture")
    if len(textures) != 1:
        raise p.element.error(p.element.label, f"one texture inside it, not {len(textures)}")
    value = importer.texture(textures[0])
    scale = p.number("scale", 1.0) if key == "bump_map" else 1.0
    if isinstance(value, list):
        p.note("a constant map is left out")
        return material
    if key == "normal_map":
        value = p.fraction(value, "normals")
    for other in _OUTER:
        if material.pop(other, None) is not None:
            p.note(f"the {other} of the bsdf inside is left out")
    if scale != 1.0:
        value = scaled(value, [scale] * 3, p)
    return material | {key: value}


def _phong(p: Properties, importer: Importer) -> Material:
    exponent = p.scalar("exponent", 30.0, high=1e6)
    return _opaque(
        "phong",
        diffuse=p.slot("diffuse_reflectance"),
        specular=p.slot("specular_reflectance"),
        exponent=exponent,
    )


def _ward(p: Properties, importer: Importer) -> Material:
    p.ignore("variant")
    alphas = {key: p.scalar(key, 0.1) for key in ("alpha_u", "alpha_v")}
    if p.has("alpha"):
        alphas = {"alpha": p.scalar("alpha", 0.1)}
    diffuse, specular = p.slot("diffuse_reflectance", [0.5] * 3), p.slot("specular_reflectance", [0.2] * 3)
    metal = _opaque("roughconductor", distribution="beckmann", material="none", specular_reflectance=specular, **alphas)
    if diffuse == [0.0] * 3:
        return metal
    # A blend halves both sides: each reflects twice as much, as far as that is a fraction.
    sides = [_opaque("diffuse", reflectance=_twice(diffuse, p)), metal]
    sides[1]["specular_reflectance"] = _twice(specular, p)
    return _blended(sides, 0.5, p)


def _twice(value: Any, p: Properties) -> Any:
    found = scaled(value, [2.0] * 3, p)
    return [min(number, 1.0) for number in found] if isinstance(found, list) else found


def _coating(p: Properties, importer: Importer) -> Material:
    """Return plastic over a diffuse base; any other base without its coat."""
    p.ignore("thickness", "sigma_a")
    index, outside = _index(p, "int_ior", "bk7"), _index(p, "ext_ior", "air")
    alpha, distribution = (p.scalar("alpha", 0.1), _distribution(p)) if p.plugin == "roughcoating" else (None, None)
    tint = p.slot("specular_reflectance")
    base = importer.material(p.only("bsdf"))
    if base["type"] != "diffuse":
        p.note(f"the coat over {base['type']} is left out")
        return dict(base)
    kept = {key: value for key, value in base.items() if key not in ("type", "reflectance")}
    keys = {"diffuse_reflectance": base.get("reflectance"), "specular_reflectance": tint}
    if alpha is None:
        return _opaque("plastic", **keys, int_ior=index, ext_ior=outside) | kept
    if isinstance(alpha, dict):
        p.note("the texture of alpha becomes 0.1")
        alpha = 0.1
    rough = {"int_ior": index, "ext_ior": outside, "distribution": distribution, "alpha": alpha}
    return _opaque("roughplastic", **keys, **rough) | kept


def _grey(p: Properties, importer: Importer) -> Material:
    for name in ("reflectance", "diffuse_reflectance", "base_color", "transmittance", "albedo"):
        if p.has(name):
            return _opaque("diffuse", reflectance=p.slot(name))
    return _opaque("diffuse", reflectance=[0.5] * 3)


_GREY = "a model of its own; its reflectance is kept where it has one"

#: Plugins of the tag ``bsdf``.
BSDFS: dict[str, Plugin] = {
    "diffuse": exact("diffuse", _diffuse),
    "dielectric": exact("dielectric", _dielectric),
    "thindielectric": exact("thindielectric", _thin_dielectric),
    "roughdielectric": exact("roughdielectric", _rough_dielectric, "phong becomes beckmann, with a warning"),
    "conductor": exact("conductor", _conductor),
    "roughconductor": exact("roughconductor", _rough_conductor, "phong becomes beckmann, with a warning"),
    "plastic": exact("plastic", _plastic),
    "roughplastic": exact("roughplastic", _rough_plastic, "phong becomes beckmann, with a warning; alpha is a number"),
    "principled": exact("principled", _principled),
    "twosided": exact("two_sided", _twosided, "two bsdf: nearest, the first has both sides, with a warning"),
    "mask": exact("opacity", _mask),
    "blendbsdf": exact("blend", _blend, "maps and opacity textures inside are left out, with a warning"),
    "mixturebsdf": exact("blend", _mixture, "as blendbsdf"),
    "null": exact("null", _null),
    "bumpmap": exact("bump_map", _bump_map),
    "normalmap": exact("normal_map", _normal_map),
    "phong": exact("phong", _phong),
    "roughdiffuse": exact("roughdiffuse", _rough_diffuse, "alpha above 1 becomes 1, with a warning"),
    "coating": nearest("plastic", _coating, "the coat absorbs nothing, and one over other than diffuse is left out"),
    "roughcoating": nearest(
        "roughplastic", _coating, "the coat absorbs nothing, and one over other than diffuse is left out"
    ),
    "ward": nearest("roughconductor", _ward, "beckmann facets blended with diffuse in place of Ward's lobe"),
    "principledthin": nearest("principled", _principled_thin, "light does not pass"),
    "difftrans": nearest("diffuse", _grey, "light does not pass"),
    "hk": nearest("diffuse", _grey, "without scattering below the surface"),
    "irawan": nearest("diffuse", _grey, "the weave is left out"),
    "hair": nearest("diffuse", _grey, _GREY),
    "measured": nearest("diffuse", _grey, _GREY),
    "measured_polarized": nearest("diffuse", _grey, _GREY),
    "pplastic": nearest("diffuse", _grey, _GREY),
    "polarizer": nearest("null", _null, "light is not polarized"),
    "retarder": nearest("null", _null, "light is not polarized"),
    "circular": nearest("null", _null, "light is not polarized"),
}
#: The entry of plugins that are not in the table.
UNKNOWN = nearest("diffuse", _grey, "it is unknown")
