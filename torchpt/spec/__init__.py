"""What kinds of things declare: their parameters, once, and the tables that find the kinds.

A *kind* is a class with a ``name`` (its ``type`` in a scene file) and ``parameters`` (a :class:`Spec` by name), one a file in
the folder ``kinds/`` of its room. Schema, errors, defaults, the checks of ``scene.params``, what a gradient must know, config
files and the tables of the docs are made of these.

``parameters.py`` has the specs: start there. ``schema.py`` has the tables of kinds and reads whole blocks; ``reading.py`` reads
plain numbers; ``arguments.py`` spells the signatures of functions whose arguments are declared.

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
    "Vertices",
    "parameters_of",
    "spec_of",
]
