"""What kinds of things declare: their parameters, once, and the tables that find the kinds.

A *kind* is a class with a ``name`` (its ``type`` in a scene file) and ``parameters`` (a :class:`Spec` by name), one a file in
the folder ``kinds/`` of its room. Schema, errors, defaults, the checks of ``scene.params``, what a gradient must know, config
files and the tables of the docs are made of these.
"""

from __future__ import annotations

from torchpt.spec.kinds import Kinds, parameters_of
from torchpt.spec.parameters import (
    REQUIRED,
    Angle,
    Choice,
    Color,
    Direction,
    Flag,
    Index,
    Moves,
    Other,
    Pair,
    Path,
    Point,
    Pose,
    Scalar,
    Spec,
    Texels,
    Vertices,
    Whole,
    spec_of,
)
from torchpt.spec.reading import Refused

__all__ = [
    "REQUIRED",
    "Angle",
    "Choice",
    "Color",
    "Direction",
    "Flag",
    "Index",
    "Kinds",
    "Moves",
    "Other",
    "Pair",
    "Path",
    "Point",
    "Pose",
    "Refused",
    "Scalar",
    "Spec",
    "Texels",
    "Vertices",
    "Whole",
    "parameters_of",
    "spec_of",
]
