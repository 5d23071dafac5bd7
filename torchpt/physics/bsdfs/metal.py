"""Parameters and Fresnel reflectance that smooth and rough conductors share.

A metal is given in one of three ways: by name, by its complex index of refraction ``eta + i k``, or by its reflectance at
normal incidence, from which Schlick's approximation gives the other angles. The first becomes the second when it is read.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.core.errors import did_you_mean
from torchpt.math.microfacet import fresnel_conductor, schlick
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.lobes import tinted
from torchpt.physics.bsdfs.presets import METALS, metal_index
from torchpt.physics.bsdfs.records import SplitSumMaterial
from torchpt.physics.bsdfs.specs import WHITE, reflectance
from torchpt.spec import Color, Custom, Refused

__all__ = ["Metal", "by_reflectance", "metal_colour", "metal_parameters", "metal_split_sum"]

_MIRROR = "none"  # Mitsuba's name of the metal that reflects everything
_NAMES = f"{_MIRROR} (a perfect mirror) or one of {', '.join(METALS)}"


def _read_name(value: Any) -> str:
    """Return the name of a metal from a scene file, or refuse it."""
    if value != _MIRROR and (not isinstance(value, str) or metal_index(value) is None):
        raise Refused(f"{_NAMES}{did_you_mean(value, METALS)}")
    return value


class Metal(Bsdf, part=True):
    """Mixin of conductors: a metal by its name, by ``eta`` and ``k``, or by its reflectance at normal incidence."""

    parameters: ClassVar = {
        "material": Custom(
            None, reader=_read_name, words=f"{_MIRROR} (a perfect mirror), or a metal's name", doc="which metal"
        ),
        "eta": Color(None, texture=True, doc="real part of the index of refraction, with `k`"),
        "k": Color(None, texture=True, doc="imaginary part of the index of refraction, with `eta`"),
        "reflectance": reflectance(
            None, "reflectance at normal incidence, with Schlick's approximation; 1 without a metal"
        ),
        "specular_reflectance": reflectance(None, "factor of reflected light, 1 by default"),
    }

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """Refuse more than one of the three ways to specify the metal."""
        super().check(values, given)
        ways = {"material": ("material",), "eta and k": ("eta", "k"), "reflectance": ("reflectance",)}
        present = {way: [key for key in keys if values[key] is not None] for way, keys in ways.items()}
        chosen = [way for way, keys in present.items() if keys]
        if len(chosen) > 1:
            first, second, *_ = chosen
            key = present[second][0]
            raise Refused(f"either {first} or {second}, not both", values[key], (key,))
        if (values["eta"] is None) != (values["k"] is None):
            raise Refused("eta and k together", None, ("k" if values["k"] is None else "eta",))

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """Return the values with ``reflectance``, or with ``eta`` and ``k``, in place of the metal's name."""
        found = super().given(values)
        if by_reflectance(values):
            return {"reflectance": WHITE, **found}
        index = None if values["material"] is None else metal_index(values["material"])
        if index is None:
            return found
        eta, k = index
        return {**found, "eta": eta, "k": k}


def by_reflectance(values: Values) -> bool:
    """Return True if a metal is specified by its reflectance at normal incidence, as a perfect mirror is too."""
    return values["eta"] is None and values["material"] in (None, _MIRROR)


def metal_parameters(values: Parameters) -> Parameters:
    """Return the parameters of :func:`metal_colour`: ``eta`` and ``k``, or ``reflectance``; the others None."""
    names = ("reflectance",) if "reflectance" in values else ("eta", "k")
    absent = dict.fromkeys(("eta", "k", "reflectance", "specular_reflectance"))
    return {
        **absent,
        **{name: values[name] for name in names},
        "specular_reflectance": values.get("specular_reflectance"),
    }


def metal_colour(parameters: Parameters, cos: Tensor) -> Tensor:
    """Return the Fresnel reflectance ``(3, N)`` without the factor ``specular_reflectance``.

    Args:
        parameters: from :func:`metal_parameters`, per lane.
        cos: ``(N,)`` cosine of the angle between a direction and the normal of the surface or of a facet, 0 to 1.
    """
    if parameters["reflectance"] is not None:
        return schlick(cos, parameters["reflectance"])
    return fresnel_conductor(cos, parameters["eta"], parameters["k"])


def metal_split_sum(parameters: Parameters, roughness: Tensor) -> SplitSumMaterial:
    """Return the split-sum material of a metal with roughness ``(N,)``: its specular lobe alone."""
    factor, one = parameters["specular_reflectance"], torch.ones_like(roughness)
    f0 = metal_colour(parameters, one)
    black = torch.zeros_like(f0)
    return SplitSumMaterial(
        diffuse=black,
        f0=tinted(one, factor) * f0,
        f90=tinted(one, factor),
        roughness=roughness,
        over=None,  # no diffuse lobe below, which would lose light
    )
