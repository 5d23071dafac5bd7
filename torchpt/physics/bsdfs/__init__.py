"""BSDF models, one a file, in ``kinds/``. Read ``base.py`` first: it states the conventions.

Stages group lanes (paths that are traced together) by model, so that each call of a model has lanes of this model alone.
``resolved.py`` has a material as its file gives it, ``records.py`` what lanes read; ``lobes.py``, ``rough.py``, ``metal.py``
and ``specs.py`` have what several models share. Other rooms import the names below, the records and the specs.
"""

from __future__ import annotations

from torchpt.physics.bsdfs.base import Bsdf, Parameters, Table, gather, stacked
from torchpt.spec import Kinds

__all__ = ["KINDS", "Bsdf", "Parameters", "Table", "gather", "stacked", "variants"]

#: The types of materials by name; a module of ``kinds/`` is imported when its type is first looked up.
KINDS: Kinds[Bsdf] = Kinds(
    "torchpt.physics.bsdfs.kinds",
    (
        "diffuse",
        "roughdiffuse",
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
    """Return every model in each of its variants, for tests. Imports all of them."""
    return tuple(model for kind in KINDS.values() for model in kind.variants())
