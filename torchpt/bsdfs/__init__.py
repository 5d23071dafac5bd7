"""Materials: one model a file, and the visible tuple of them. Lanes are grouped by model before they come here."""

from __future__ import annotations

from torchpt.bsdfs.base import Bsdf, Parameters, Table, gather, stacked
from torchpt.bsdfs.conductor import Conductor
from torchpt.bsdfs.diffuse import Diffuse

__all__ = ["MODELS", "Bsdf", "Conductor", "Diffuse", "Parameters", "Table", "gather", "stacked"]

#: Every model in every variant that scenes can ask for; tests run over it.
MODELS: tuple[Bsdf, ...] = (
    Diffuse(),
    Conductor(),
    Conductor(schlick=True),
)
