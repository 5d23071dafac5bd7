"""Materials: one model a file, in ``kinds/``. Lanes are grouped by model before they come here."""

from __future__ import annotations

from torchpt.physics.bsdfs.base import Bsdf, Parameters, Table, gather, stacked
from torchpt.spec import Kinds

__all__ = ["KINDS", "Bsdf", "Parameters", "Table", "gather", "stacked", "variants"]

#: The types of materials.
KINDS: Kinds[Bsdf] = Kinds(
    "torchpt.physics.bsdfs.kinds",
    (
        "diffuse",
        "phong",
        "blinn_phong",
        "conductor",
        "roughconductor",
        "dielectric",
        "thindielectric",
        "roughdielectric",
        "plastic",
        "roughplastic",
        "nonmetal",
        "microfacet",
        "principled",
        "blend",
        "null",
    ),
)


def variants() -> tuple[Bsdf, ...]:
    """Every model in every variant that scenes can ask for: tests run over it. Imports all of them."""
    return tuple(model for kind in KINDS.values() for model in kind.variants())
