"""Specs of the parameters that kinds declare: numbers, colours, points, poses, choices; each reads and checks its values.

A spec says what a key of a scene file accepts, its default, and what depends on it. ``read`` takes a value from a file,
``check`` a tensor that a caller puts into ``scene.params``; both raise :class:`Refused`, which ``schema.py`` turns into an
error that names the key.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from torchpt.core.errors import did_you_mean
from torchpt.math.transforms import FINITE_WORDS, is_rigid, is_usable, similarity_scale
from torchpt.spec import reading
from torchpt.spec.reading import LARGEST, Refused

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "REQUIRED",
    "Angle",
    "Choice",
    "Color",
    "Custom",
    "Direction",
    "Flag",
    "Index",
    "Integer",
    "Map",
    "Moves",
    "Pair",
    "Path",
    "Point",
    "Pose",
    "Role",
    "Scalar",
    "Spec",
    "Texels",
    "VertexAttribute",
    "VertexColors",
    "Vertices",
    "spec_of",
]


# ---- Spec: the declaration of one parameter


class Moves(Enum):
    """The geometry that a parameter moves, which its derivative must follow."""

    NOTHING = 0
    SURFACES = 1  #: surfaces or the camera: hit points and silhouettes move
    SHADOWS = 2  #: a light: edges of shadows move, hit points do not
    RAYS = 3  #: the directions that a delta lobe samples


class Role(enum.Flag):
    """The influence of a setting on the samples of a picture."""

    NONE = 0  #: samples depend on it; it neither ends a render nor writes files
    FREE = enum.auto()  #: no sample depends on it
    ENDS = enum.auto()  #: a stop rule: it may end a render before ``spp`` samples are taken
    FILES = enum.auto()  #: it decides which files are written during the render


class _Required(Enum):
    REQUIRED = 0

    def __repr__(self) -> str:
        return "required"


#: Stands in place of a default where a value must be given.
REQUIRED = _Required.REQUIRED


@dataclass(frozen=True)
class Spec:
    """Declaration of one parameter.

    Attributes:
        default: the value of a key that is left out: a value, None (stays unset), a function of the dict of the other
            values, or :data:`REQUIRED`.
        doc: description for tables and help: a phrase without a full stop.
        texture: True where a texture may give the value.
        length: True for a length in the scene's units.
        moves: the geometry that the parameter moves.
        words: phrase of what is accepted, for errors; by default made from the bounds.
        role: influence of a run setting on samples.
    """

    default: Any = REQUIRED
    doc: str = field(default="", kw_only=True)
    texture: bool = field(default=False, kw_only=True)
    length: bool = field(default=False, kw_only=True)
    moves: Moves = field(default=Moves.NOTHING, kw_only=True)
    words: str = field(default="", kw_only=True)
    role: Role = field(default=Role.NONE, kw_only=True)

    #: True for a tensor of ``scene.params``; else the value is fixed once the scene is loaded.
    differentiable: ClassVar[bool] = False
    #: True where it holds positions (points, vertices in whatever space, the translation of a pose): kept in float64 where the
    #: scene lies far from the origin, since float32 would round them to coarse steps.
    holds_positions: ClassVar[bool] = False
    #: True where it takes three channels of a texture, else one.
    coloured: ClassVar[bool] = False
    #: True where texels are plain numbers, so that 8-bit image files are read without sRGB decoding.
    linear: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """Return a phrase of what is accepted, without textures."""
        raise NotImplementedError

    @property
    def expected(self) -> str:
        """Return a phrase of all that is accepted, textures included; errors print it."""
        return f"{self.words or self.accepted}{', or a texture' if self.texture else ''}"

    @property
    def brief(self) -> str:
        """Return :attr:`expected` without lists of names, for tables."""
        return self.expected

    def read(self, value: Any) -> Any:
        """Check a value as a scene file or a caller writes it, and return it converted.

        Raises:
            Refused: the value is not accepted.
        """
        raise NotImplementedError

    def check(self, value: Tensor) -> None:
        """Check the numbers of a tensor that is to replace the parameter in ``scene.params``.

        Raises:
            Refused: numbers that a scene file could not hold.
        """


# ---- Specs of numbers in a range: scalars, colours, the texels of an image


#: Relative tolerance of bounds for tensors: some roundings of float32.
TOLERANCE = 1e-6
#: Most numbers of a refused tensor that an error prints; of a larger one it prints the first that is wrong.
MOST_SHOWN = 16


@dataclass(frozen=True)
class _Numbers(Spec):
    """Numbers in a range.

    Attributes:
        low: closed lower bound; None: none.
        high: closed upper bound; None: none.
        above: open lower bound; None: none.
        below: open upper bound; None: none.
    """

    low: float | None = field(default=0.0, kw_only=True)
    high: float | None = field(default=None, kw_only=True)
    above: float | None = field(default=None, kw_only=True)
    below: float | None = field(default=None, kw_only=True)

    differentiable: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if isinstance(self.default, int | float) and not isinstance(self.default, bool):  # convert it as `read` does
            grey = float(self.default)
            object.__setattr__(self, "default", (grey, grey, grey) if self.coloured else grey)

    @property
    def bounds(self) -> tuple[float, float]:
        """Return the closed bounds, with the limits of float32 for missing ones."""
        return -LARGEST if self.low is None else self.low, LARGEST if self.high is None else self.high

    @property
    def _range(self) -> str:
        """Return the bounds as words that follow "a finite number", with a space before them."""
        low, high = self.low, self.high
        if self.above is None and self.below is None and low is not None and high is not None:
            return f" in {low:g}..{high:g}"
        least = f">= {low:g}" if low is not None and self.above is None else ""
        ends = [
            least if self.above is None else f"> {self.above:g}",
            ("" if high is None else f"<= {high:g}") if self.below is None else f"< {self.below:g}",
        ]
        words = " and ".join(end for end in ends if end)
        return f" {words}" if words else ""

    def _fits(self, number: float) -> bool:
        """Return True for a number that lies in the range after rounding to float32."""
        low, high = self.bounds
        if not low <= number <= high:
            return False
        rounded = float(np.float32(number))
        return (self.above is None or rounded > self.above) and (self.below is None or rounded < self.below)

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        _check_finite(value)
        low, high = self.bounds
        # Rounding on the way here must not get a value refused.
        slack = getattr(self, "slack", 0.0)  # of texels
        bad = (value < low - TOLERANCE * abs(low) - slack) | (value > high + TOLERANCE * abs(high) + slack)
        rounded = value.float()
        if self.above is not None:
            bad = bad | (rounded <= self.above)
        if self.below is not None:
            bad = bad | (rounded >= self.below)
        if bool(bad.any()):
            shown = value.tolist() if value.numel() <= MOST_SHOWN else float(value[bad].reshape(-1)[0])
            raise Refused(f"{self.words or self.accepted} (clamp before rendering)", shown)


@dataclass(frozen=True)
class Scalar(_Numbers):
    """A single number."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"a finite number{self._range}"

    def read(self, value: Any) -> float:
        """See :class:`Spec`."""
        found = reading.number(value, self.expected)
        if not self._fits(found):
            raise Refused(self.expected)
        return found


@dataclass(frozen=True)
class Color(_Numbers):
    """A linear RGB colour: three numbers, or one for all channels."""

    coloured: ClassVar[bool] = True
    linear: ClassVar[bool] = False

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        bound = self._range
        return f"[r, g, b] or one number, each finite{' and' if bound else ''}{bound}"

    def read(self, value: Any) -> tuple[float, float, float]:
        """See :class:`Spec`."""
        expected = self.expected
        if isinstance(value, list | tuple | np.ndarray):
            rgb = reading.vector(value, expected)
        else:
            grey = reading.number(value, expected)
            rgb = (grey, grey, grey)
        if not all(self._fits(channel) for channel in rgb):
            raise Refused(expected)
        return rgb


@dataclass(frozen=True)
class Angle(Scalar):
    """An angle in degrees."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"an angle in degrees{self._range}"


@dataclass(frozen=True)
class Index(Scalar):
    """An index of refraction: a number, or the name of a medium.

    Attributes:
        media: indices of refraction by the medium's name in lower case.
    """

    # Bounds far beyond any medium, between which stress cases find that energy is kept.
    low: float | None = field(default=1e-3, kw_only=True)
    high: float | None = field(default=1e3, kw_only=True)
    moves: Moves = field(default=Moves.RAYS, kw_only=True)
    media: Mapping[str, float] = field(default_factory=dict, kw_only=True, hash=False)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"a number in {self.low:g}..{self.high:g}"

    @property
    def expected(self) -> str:
        """See :class:`Spec`."""
        texture = ", a texture" if self.texture else ""
        return f"{self.accepted}{texture}, or one of {', '.join(self.media)}" if self.media else super().expected

    @property
    def brief(self) -> str:
        """See :class:`Spec`."""
        return (
            f"{self.accepted}{', the name of a medium' if self.media else ''}{', or a texture' if self.texture else ''}"
        )

    def read(self, value: Any) -> float:
        """See :class:`Spec`."""
        if not isinstance(value, str):
            return super().read(value)
        found = self.media.get(value.lower())
        if found is None:
            raise Refused(f"{self.expected}{did_you_mean(value, self.media)}")
        return found


@dataclass(frozen=True)
class Texels(_Numbers):
    """An image ``(H, W, C)``: comes from a file, and is a tensor of ``scene.params``.

    Attributes:
        slack: tolerance for rounding beyond the bounds.
    """

    slack: float = field(default=0.0, kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"texels{self._range}"


def spec_of(value: Any) -> Spec:
    """Return a spec unchanged; for a plain default (a number, or three for a colour) an unbounded spec that takes textures.

    Raises:
        Refused: neither a spec nor such a default.
    """
    if isinstance(value, Spec):
        return value
    expected = "a finite number, or three of them for a colour"
    if isinstance(value, tuple | list):
        return Color(reading.vector(value, expected), low=None, texture=True)
    return Scalar(reading.number(value, expected), low=None, texture=True)


# ---- Specs of geometry: points, directions, poses, and the vertices of a mesh


#: Tolerance of a pose in a tensor, relative to its scale: steps of an optimizer in float32 drift from a rotation.
POSE_TOLERANCE = 1e-4


@dataclass(frozen=True)
class _Vector(Spec):
    """Three numbers."""

    differentiable: ClassVar[bool] = True

    def read(self, value: Any) -> tuple[float, float, float]:
        """See :class:`Spec`."""
        return reading.vector(value, self.expected)

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        _check_finite(value)


@dataclass(frozen=True)
class Point(_Vector):
    """A point in the scene's coordinates."""

    holds_positions: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "three finite numbers [x, y, z]"


@dataclass(frozen=True)
class Direction(_Vector):
    """A direction of any length but zero."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a direction other than [0, 0, 0]"

    def read(self, value: Any) -> tuple[float, float, float]:
        """See :class:`Spec`."""
        found = reading.vector(value)
        if not any(found):
            raise Refused(self.expected, list(found))
        return found

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        super().check(value)
        if not bool(value.any()):
            raise Refused(self.expected, value.tolist())


@dataclass(frozen=True)
class Vertices(_Vector):
    """Vertex positions ``(V, 3)`` of a mesh in its own space."""

    moves: Moves = field(default=Moves.SURFACES, kw_only=True)

    holds_positions: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a list of [x, y, z], finite numbers each"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        return reading.rows(value, 3, "[x, y, z]")


@dataclass(frozen=True)
class VertexAttribute(Vertices):
    """Vertex normals ``(V, 3)`` or texture coordinates ``(V, 2)`` of a mesh."""

    holds_positions: ClassVar[bool] = False


@dataclass(frozen=True)
class VertexColors(_Numbers):
    """Vertex colours ``(V, 3)`` of a mesh, linear RGB."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"a list of colours [r, g, b], finite numbers{self._range} each"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        found = reading.rows(value, 3, "colours [r, g, b]")
        for index, row in enumerate(found.tolist()) if found.min() < 0 else ():
            if min(row) < 0:
                raise Refused(self.expected, row, at=(index,))
        return found


@dataclass(frozen=True)
class Pose(Spec):
    """A transform ``(4, 4)`` from an object's own space to the world.

    Attributes:
        angles: True where it must keep angles (rotation, reflection, uniform scale).
        rigid: True where a tensor that replaces it must keep lengths too (rotation, reflection). Values in files are not
            checked for it here: a kind may read a scale in its own way.
        operations: True where files give a list of operations or a matrix; else a matrix only.
    """

    angles: bool = field(default=False, kw_only=True)
    rigid: bool = field(default=False, kw_only=True)
    operations: bool = field(default=True, kw_only=True)
    moves: Moves = field(default=Moves.SURFACES, kw_only=True)

    differentiable: ClassVar[bool] = True
    holds_positions: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        if self.angles:
            return "a transform that keeps angles (rotation, reflection, uniform scale)"
        return f"a matrix that can be inverted, {FINITE_WORDS}"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        found = reading.transform(value) if self.operations else reading.matrix(value)
        if self.angles and similarity_scale(found) is None:
            raise Refused(self.expected, found.tolist())
        return found

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        matrix = value.double().cpu().numpy()
        _check_finite(value)
        if not is_usable(matrix):
            raise Refused(f"a matrix that can be inverted, {FINITE_WORDS}", matrix.tolist())
        if abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > POSE_TOLERANCE:
            raise Refused("a transform whose last row is 0 0 0 1", matrix[3].tolist())
        if self.angles and similarity_scale(matrix, POSE_TOLERANCE) is None:
            raise Refused(self.expected, matrix.tolist())
        if self.rigid and not is_rigid(matrix):
            raise Refused("a pose without scale or shear (torchpt.nn.Renderer keeps one so)", matrix.tolist())


# ---- Specs of values that are fixed once a scene is loaded: flags, names, whole numbers, files, and values with a reader


@dataclass(frozen=True)
class Flag(Spec):
    """A boolean."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "true or false"

    def read(self, value: Any) -> bool:
        """See :class:`Spec`."""
        return reading.flag(value)


@dataclass(frozen=True)
class Choice(Spec):
    """One of several names.

    Attributes:
        names: the names.
        booleans: the name that each YAML boolean stands for.
    """

    names: tuple[str, ...] = field(default=(), kw_only=True)
    booleans: Mapping[bool, str] | None = field(default=None, kw_only=True, hash=False)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"one of {', '.join(self.names)}"

    def read(self, value: Any) -> str:
        """See :class:`Spec`."""
        if self.booleans is not None and isinstance(value, bool):
            value = self.booleans[value]
        if not isinstance(value, str) or value not in self.names:
            raise Refused(self.expected)
        return value


@dataclass(frozen=True)
class Integer(Spec):
    """A whole number in a range, or one of a few other values.

    Attributes:
        low: smallest number, included.
        high: largest number, included.
        also: other values that are accepted.
    """

    low: int = field(default=0, kw_only=True)
    high: int = field(default=2**31 - 1, kw_only=True)
    also: tuple[Any, ...] = field(default=(), kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        words = "".join(f" or {'null' if item is None else item}" for item in self.also)
        return f"a whole number {self.low}..{self.high}{words}"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        if isinstance(value, bool | np.bool_):
            raise Refused(self.expected)
        if (value is None or isinstance(value, int | str)) and value in self.also:
            return value
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int | np.integer) or not self.low <= value <= self.high:
            raise Refused(self.expected)
        return int(value)


@dataclass(frozen=True)
class Pair(Spec):
    """Two numbers, along u and along v.

    Attributes:
        single: True where one number may stand for both.
    """

    single: bool = field(default=False, kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a number or [u, v]" if self.single else "two numbers [u, v]"

    def read(self, value: Any) -> tuple[float, float]:
        """See :class:`Spec`."""
        return reading.pair(value, self.expected, single=self.single)


@dataclass(frozen=True)
class Path(Spec):
    """The path of a file, or a list of paths of which the first that exists is used; the value is a tuple of all of them."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a file path, or a list of them (the first that is there is used)"

    def read(self, value: Any) -> tuple[str, ...]:
        """See :class:`Spec`."""
        return reading.file_paths(value)


@dataclass(frozen=True)
class Map(Spec):
    """A texture of numbers, or its name; :data:`torchpt.spec.schema.ReadTexture` reads it."""

    texture: bool = field(default=True, kw_only=True)
    words: str = field(default="the name of a texture", kw_only=True)

    #: Bounds of its numbers, as those of a :class:`Scalar` with a texture.
    bounds: ClassVar[tuple[float, float]] = (-LARGEST, LARGEST)

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Custom(Spec):
    """A value with a reader of its own.

    Attributes:
        reader: returns the parameter's value for the value as written, or raises :class:`Refused`; unchanged by default.
    """

    reader: Callable[[Any], Any] = field(default=lambda value: value, kw_only=True, hash=False)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a value"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        return self.reader(value)


def _check_finite(value: Tensor) -> None:
    """Raise Refused unless all numbers are finite in float32; the error names the first that is not."""
    import torch

    finite = torch.isfinite(value.float())
    if not bool(finite.all()):
        index = tuple((~finite).nonzero()[0].tolist())
        place = f" at {list(index)}" if index else ""
        raise Refused("numbers finite in float32", f"{float(value[index])}{place}")
