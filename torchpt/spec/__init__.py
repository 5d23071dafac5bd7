"""What kinds of things declare: their parameters, once, and the tables that find the kinds.

A *kind* is a class with a ``name`` (its ``type`` in a scene file) and ``parameters`` (a :class:`Spec` by name), one a file in
the folder ``kinds/`` of its room. Schema, errors, defaults, the checks of ``scene.params``, what a gradient must know, config
files and the tables of the docs are made of these.
"""

from __future__ import annotations

from torchpt.spec.base import REQUIRED, Moves, Role, Spec
from torchpt.spec.choices import Choice, Flag, Map, Other, Pair, Path, Whole
from torchpt.spec.kinds import Block, Kinds, parameters_of
from torchpt.spec.numbers import Angle, Color, Index, Scalar, Texels, spec_of
from torchpt.spec.places import Corners, Direction, Point, Pose, Vertices
from torchpt.spec.reading import Refused
from torchpt.spec.valued import Valued

__all__ = [
    "REQUIRED",
    "Angle",
    "Block",
    "Choice",
    "Color",
    "Corners",
    "Direction",
    "Flag",
    "Index",
    "Kinds",
    "Map",
    "Moves",
    "Other",
    "Pair",
    "Path",
    "Point",
    "Pose",
    "Refused",
    "Role",
    "Scalar",
    "Spec",
    "Texels",
    "Valued",
    "Vertices",
    "Whole",
    "parameters_of",
    "spec_of",
]
