"""Materials: one model a file, and the visible tuple of them. Lanes are grouped by model before they come here."""

from __future__ import annotations

from torchpt.bsdfs.base import Bsdf, Parameters, Table, gather, stacked
from torchpt.bsdfs.blend import Blend
from torchpt.bsdfs.blinn_phong import BlinnPhong
from torchpt.bsdfs.conductor import Conductor
from torchpt.bsdfs.dielectric import Dielectric
from torchpt.bsdfs.diffuse import Diffuse
from torchpt.bsdfs.microfacet import Microfacet
from torchpt.bsdfs.nonmetal import Nonmetal
from torchpt.bsdfs.null import Null
from torchpt.bsdfs.phong import Phong
from torchpt.bsdfs.plastic import Plastic
from torchpt.bsdfs.principled import Principled
from torchpt.bsdfs.roughconductor import RoughConductor
from torchpt.bsdfs.roughdielectric import RoughDielectric
from torchpt.bsdfs.roughplastic import RoughPlastic
from torchpt.bsdfs.thindielectric import ThinDielectric

__all__ = [
    "MODELS",
    "Blend",
    "BlinnPhong",
    "Bsdf",
    "Conductor",
    "Dielectric",
    "Diffuse",
    "Microfacet",
    "Nonmetal",
    "Null",
    "Parameters",
    "Phong",
    "Plastic",
    "Principled",
    "RoughConductor",
    "RoughDielectric",
    "RoughPlastic",
    "Table",
    "ThinDielectric",
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
    RoughConductor(),
    RoughConductor(schlick=True),
    RoughConductor(anisotropic=True),
    RoughConductor(schlick=True, anisotropic=True),
    Dielectric(),
    ThinDielectric(),
    RoughDielectric(),
    RoughDielectric(anisotropic=True),
    Null(),
    Principled(),
    Principled(transmissive=True),
    Principled(anisotropic=True),
    Principled(transmissive=True, anisotropic=True),
    Plastic(),
    Plastic(nonlinear=True),
    RoughPlastic(),
    RoughPlastic(nonlinear=True),
    Blend(Diffuse(), RoughConductor()),
    Blend(Dielectric(), Diffuse()),
    Blend(Blend(Diffuse(), Conductor(schlick=True)), RoughDielectric()),
    RoughConductor(energy_compensation=True),
    RoughConductor(anisotropic=True, energy_compensation=True),
    RoughDielectric(energy_compensation=True),
    RoughDielectric(anisotropic=True, energy_compensation=True),
)
