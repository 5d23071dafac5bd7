"""Declarations of parameters, and the tables that find the kinds that declare them.

A *kind* is a class with a ``name`` (its ``type`` in a scene file) and ``parameters`` (a :class:`Spec` by name), one a file in
the folder ``kinds/`` of its package. The schema of scene files, errors, defaults, the checks of ``scene.params``, config files
and the tables of the docs are all made from these declarations; gradients read from them what a parameter moves.

Start with ``parameters.py``, which has the specs. ``schema.py`` has the tables of kinds and reads whole blocks; ``reading.py``
reads plain values; ``arguments.py`` writes the signatures of functions whose keyword arguments are declared.

May import: ``core``, ``math``.
"""

from __future__ import annotations

from torchpt.spec.parameters import (
    REQUIRED,
    Angle,
    Choice,
    Color,
    Custom,
    Direction,
    Flag,
    Index,
    Integer,
    Map,
    Moves,
    Pair,
    Path,
    Point,
    Pose,
    Role,
    Scalar,
    Spec,
    Texels,
    VertexAttribute,
    VertexColors,
    Vertices,
    spec_of,
)
from torchpt.spec.reading import Refused
from torchpt.spec.schema import Block, FrozenConfig, Kinds, parameters_of

__all__ = [
    "REQUIRED",
    "Angle",
    "Block",
    "Choice",
    "Color",
    "Custom",
    "Direction",
    "Flag",
    "FrozenConfig",
    "Index",
    "Integer",
    "Kinds",
    "Map",
    "Moves",
    "Pair",
    "Path",
    "Point",
    "Pose",
    "Refused",
    "Role",
    "Scalar",
    "Spec",
    "Texels",
    "VertexAttribute",
    "VertexColors",
    "Vertices",
    "parameters_of",
    "spec_of",
]
