"""Materials: one model a file, and the visible tuple of them. Lanes are grouped by model before they come here."""

from __future__ import annotations

from torchpt.bsdfs.base import Bsdf, Parameters, Table, gather, stacked
from torchpt.bsdfs.blend import Blend
from torchpt.bsdfs.blinn_phong import BlinnPhong
from torchpt.bsdfs.conductor import Conductor
from torchpt.bsdfs.diffuse import Diffuse
from torchpt.bsdfs.microfacet import Microfacet
from torchpt.bsdfs.nonmetal import Nonmetal
from torchpt.bsdfs.phong import Phong

__all__ = [
    "MODELS",
    "Blend",
    "BlinnPhong",
    "Bsdf",
    "Conductor",
    "Diffuse",
    "Microfacet",
    "Nonmetal",
    "Parameters",
    "Phong",
    "Table",
    "gather",
    "stacked",
]

#: Every model in every variant that scenes can ask for; tests run over it.
MODELS: tuple[Bsdf, ...] = (
    Diffuse(),
    Conductor(),
    Conductor(schlick=True),
    Phong(),
    BlinnPhong(),
    Nonmetal(),
    Microfacet(),
    Blend(Diffuse(), Microfacet()),
)
