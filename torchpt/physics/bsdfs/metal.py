"""What smooth and rough metals share: which metal it is, by one of three ways to say it, and its colour."""

from __future__ import annotations

import difflib
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.microfacet import fresnel_conductor, schlick
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.lobes import tinted
from torchpt.physics.bsdfs.presets import METALS
from torchpt.physics.bsdfs.presets import metal as preset
from torchpt.physics.bsdfs.records import SplitSumMaterial
from torchpt.physics.bsdfs.specs import WHITE, reflectance
from torchpt.spec import Color, Custom, Refused

__all__ = ["Metal", "by_reflectance", "metal", "metal_colour", "metal_split_sum"]

_MIRROR = "none"  # Mitsuba's name of the metal that reflects everything
_NAMES = f"{_MIRROR} (a perfect mirror) or one of {', '.join(METALS)}"


def _name(value: Any) -> str:
    if value != _MIRROR and (not isinstance(value, str) or preset(value) is None):
        close = difflib.get_close_matches(value, METALS, 1) if isinstance(value, str) else []
        raise Refused(f"{_NAMES}{f' (did you mean {close[0]}?)' if close else ''}")
    return value


class Metal(Bsdf, part=True):
    """A part of a model: a metal by its name, by ``eta`` and ``k``, or by its reflectance at normal incidence."""

    parameters: ClassVar = {
        "material": Custom(
            None, reader=_name, words=f"{_MIRROR} (a perfect mirror), or a metal's name", doc="which metal"
        ),
        "eta": Color(None, texture=True, doc="the real part of its index, with `k`"),
        "k": Color(None, texture=True, doc="the imaginary part, with `eta`"),
        "reflectance": reflectance(None, "at normal incidence, by Schlick; 1 where no metal is said"),
        "specular_reflectance": reflectance(None, "a tint: a factor of what is reflected; 1 where it is not said"),
    }

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """One metal only."""
        super().check(values, given)
        ways = {"material": ("material",), "eta and k": ("eta", "k"), "reflectance": ("reflectance",)}
        said = {way: [key for key in keys if values[key] is not None] for way, keys in ways.items()}
        chosen = [way for way, keys in said.items() if keys]
        if len(chosen) > 1:
            key = said[chosen[1]][0]
            raise Refused(f"either {chosen[0]} or {chosen[1]}, not both", values[key], (key,))
        if (values["eta"] is None) != (values["k"] is None):
            raise Refused("eta and k together", None, ("k" if values["k"] is None else "eta",))

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """``reflectance``, or ``eta`` and ``k``."""
        found = super().given(values)
        if by_reflectance(values):
            return {"reflectance": WHITE, **found}
        known = None if values["material"] is None else preset(values["material"])
        return found if known is None else {**found, "eta": known[0], "k": known[1]}


def by_reflectance(values: Values) -> bool:
    """Whether a metal is given by its reflectance at normal incidence."""
    return values["eta"] is None and values["material"] in (None, _MIRROR)


def metal(values: Parameters) -> Parameters:
    """What :func:`metal_colour` reads: ``eta`` and ``k``, or ``reflectance``; the others are None."""
    names = ("reflectance",) if "reflectance" in values else ("eta", "k")
    absent = dict.fromkeys(("eta", "k", "reflectance", "specular_reflectance"))
    return {
        **absent,
        **{name: values[name] for name in names},
        "specular_reflectance": values.get("specular_reflectance"),
    }


def metal_colour(parameters: Parameters, cos: Tensor) -> Tensor:
    """Reflectance ``(3, N)`` at a cosine ``(N,)``, without the factor ``specular_reflectance``."""
    if parameters["reflectance"] is not None:
        return schlick(cos, parameters["reflectance"])
    return fresnel_conductor(cos, parameters["eta"], parameters["k"])


def metal_split_sum(parameters: Parameters, roughness: Tensor) -> SplitSumMaterial:
    """A metal in the preview, of some roughness ``(N,)``."""
    factor, one = parameters["specular_reflectance"], torch.ones_like(roughness)
    f0 = metal_colour(parameters, one)
    black = torch.zeros_like(f0)
    return SplitSumMaterial(black, tinted(one, factor) * f0, tinted(one, factor), roughness, None)
