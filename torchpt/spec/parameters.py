"""The parameters that kinds declare: numbers, colours, places, choices, and how each is read, checked and converted."""

from __future__ import annotations

import difflib
import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from torchpt.math.transforms import WITHIN, is_rigid, is_usable, similarity_scale
from torchpt.spec import reading
from torchpt.spec.reading import LARGEST, Refused

if TYPE_CHECKING:
    from torch import Tensor

    pass

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
    "Vertices",
    "spec_of",
]


# ---- What a spec is: one parameter of a kind, and what it accepts


class Moves(Enum):
    """What a parameter moves: what the derivative with respect to it must follow, or cannot."""

    NOTHING = 0
    SURFACES = 1  #: or the camera: points slide, and silhouettes move
    SHADOWS = 2  #: a light: shadow edges move, and no point does
    RAYS = 3  #: rays that a delta lobe sends on


class Role(enum.Flag):
    """What a setting has to do with the samples of a picture."""

    NONE = 0
    FREE = enum.auto()  #: nothing: no sample depends on it
    ENDS = enum.auto()  #: it is a stop rule: it may end a render before ``spp`` samples are taken
    FILES = enum.auto()  #: it says which files are written on the way


class _Required(Enum):
    REQUIRED = 0

    def __repr__(self) -> str:
        return "required"


#: In place of a default: a value must be given.
REQUIRED = _Required.REQUIRED


@dataclass(frozen=True)
class Spec:
    """One parameter.

    Attributes:
        default: its value where none is given: :data:`REQUIRED`, None (it may be left out), a value, or a function of the
            other values by name.
        doc: what it is, for tables and help: a phrase without a full stop.
        texture: whether a texture may give it.
        length: whether it is a length in the scene's units.
        moves: what changes place with it.
        words: what errors say is accepted; by default made of the bounds.
        role: of a run setting.
    """

    default: Any = REQUIRED
    doc: str = field(default="", kw_only=True)
    texture: bool = field(default=False, kw_only=True)
    length: bool = field(default=False, kw_only=True)
    moves: Moves = field(default=Moves.NOTHING, kw_only=True)
    words: str = field(default="", kw_only=True)
    role: Role = field(default=Role.NONE, kw_only=True)

    #: Whether it is a tensor of ``scene.params``; else it is fixed once the scene is loaded.
    differentiable: ClassVar[bool] = False
    #: Whether it is a place, in the scene's own coordinates: kept in float64 where the scene lies far from the origin.
    place: ClassVar[bool] = False
    #: How many channels of a texture it takes.
    coloured: ClassVar[bool] = False
    #: Whether a texture's numbers stand for no colours, so that 8-bit files are not decoded.
    linear: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """What is accepted, in words."""
        raise NotImplementedError

    @property
    def expected(self) -> str:
        """The same, with a texture where one may stand."""
        return f"{self.words or self.accepted}{', or a texture' if self.texture else ''}"

    @property
    def brief(self) -> str:
        """The same without lists of names, for tables."""
        return self.expected

    def read(self, value: Any) -> Any:
        """A value as written, checked.

        Raises:
            Refused: it is not accepted.
        """
        raise NotImplementedError

    def check(self, value: Tensor) -> None:
        """Refuse numbers that no scene file could hold, in a tensor that takes the parameter's place.

        Raises:
            Refused: says what is accepted.
        """


# ---- Specs of numbers: one, three for a colour, or the texels of an image; in a range


@dataclass(frozen=True)
class _Numbers(Spec):
    """Numbers in a range.

    Attributes:
        low: least that is accepted; None: any.
        high: greatest.
        above: what all must be above.
        below: what all must be below.
    """

    low: float | None = field(default=0.0, kw_only=True)
    high: float | None = field(default=None, kw_only=True)
    above: float | None = field(default=None, kw_only=True)
    below: float | None = field(default=None, kw_only=True)

    differentiable: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if isinstance(self.default, int | float) and not isinstance(self.default, bool):  # as a file's would be read
            grey = float(self.default)
            object.__setattr__(self, "default", (grey, grey, grey) if self.coloured else grey)

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest number that float32 holds among those accepted, open ends included."""
        return -LARGEST if self.low is None else self.low, LARGEST if self.high is None else self.high

    @property
    def _range(self) -> str:
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
        """Whether a number is in the range, as the float32 that it becomes."""
        low, high = self.bounds
        if not low <= number <= high:
            return False
        rounded = float(np.float32(number))
        return (self.above is None or rounded > self.above) and (self.below is None or rounded < self.below)

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        import torch

        if not bool(torch.isfinite(value.float()).all()):
            raise Refused("numbers finite in float32", "a value that is not finite in float32")
        low, high = self.bounds
        # What is rounded on its way here is not refused for it.
        slack = getattr(self, "slack", 0.0)
        bad = (value < low - 1e-6 * abs(low) - slack) | (value > high + 1e-6 * abs(high) + slack)
        rounded = value.float()
        if self.above is not None:
            bad = bad | (rounded <= self.above)
        if self.below is not None:
            bad = bad | (rounded >= self.below)
        if bool(bad.any()):
            shown = value.tolist() if value.numel() <= 16 else float(value[bad].reshape(-1)[0])
            raise Refused(f"{self.words or self.accepted} (clamp before rendering)", shown)


@dataclass(frozen=True)
class Scalar(_Numbers):
    """A number."""

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
    """A linear RGB colour: three numbers, or one for all."""

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
        media: index of refraction by name, in lower case.
    """

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
            close = difflib.get_close_matches(value, self.media, 1)
            raise Refused(f"{self.expected}{f' (did you mean {close[0]}?)' if close else ''}")
        return found


@dataclass(frozen=True)
class Texels(_Numbers):
    """An image ``(H, W, C)`` that a file holds: never written in a scene, but a tensor of it.

    Attributes:
        slack: how far beyond the range is taken for rounding.
    """

    slack: float = field(default=0.0, kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"texels{self._range}"


def spec_of(value: Any) -> Spec:
    """A spec, or the plain default that stands for one: a number, or three for a colour; without bounds, or a texture.

    Raises:
        Refused: neither.
    """
    if isinstance(value, Spec):
        return value
    expected = "a finite number, or three of them for a colour"
    if isinstance(value, tuple | list):
        return Color(reading.vector(value, expected), low=None, texture=True)
    return Scalar(reading.number(value, expected), low=None, texture=True)


# ---- Specs of places: points, directions, poses, and the vertices of a mesh


@dataclass(frozen=True)
class _Vector(Spec):
    """Three numbers."""

    differentiable: ClassVar[bool] = True

    def read(self, value: Any) -> tuple[float, float, float]:
        """See :class:`Spec`."""
        return reading.vector(value, self.expected)

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        import torch

        if not bool(torch.isfinite(value.float()).all()):
            raise Refused("numbers finite in float32", "a value that is not finite in float32")


@dataclass(frozen=True)
class Point(_Vector):
    """A point of the scene."""

    place: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "three finite numbers [x, y, z]"


@dataclass(frozen=True)
class Direction(_Vector):
    """A direction; its length does not matter."""

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
    """Points ``(V, 3)`` of a mesh in its own space."""

    moves: Moves = field(default=Moves.SURFACES, kw_only=True)

    place: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a list of [x, y, z], finite numbers each"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        return reading.rows(value, 3, "[x, y, z]")


@dataclass(frozen=True)
class VertexAttribute(Vertices):
    """Normals ``(V, 3)`` or coordinates ``(V, 2)`` of a mesh: a tensor of the scene where its gradients are wanted."""

    place: ClassVar[bool] = False


@dataclass(frozen=True)
class Pose(Spec):
    """Where a thing stands: ``(4, 4)``, from its own space to the world.

    Attributes:
        angles: whether it must keep angles (rotation, reflection, uniform scale).
        rigid: whether a tensor in its place must keep lengths too (rotation, reflection). What is written is not held to it
            here: kinds say what goes with a pose, and how a scale is meant.
        operations: whether it is written as a list of operations; else as a matrix.
    """

    angles: bool = field(default=False, kw_only=True)
    rigid: bool = field(default=False, kw_only=True)
    operations: bool = field(default=True, kw_only=True)
    moves: Moves = field(default=Moves.SURFACES, kw_only=True)

    differentiable: ClassVar[bool] = True
    place: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        if self.angles:
            return "a transform that keeps angles (rotation, reflection, uniform scale)"
        return f"a matrix that can be inverted, {WITHIN}"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        found = reading.transform(value) if self.operations else reading.matrix(value)
        if self.angles and similarity_scale(found) is None:
            raise Refused(self.expected, found.tolist())
        return found

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        import torch

        matrix = value.double().cpu().numpy()
        if not bool(torch.isfinite(value.float()).all()):
            raise Refused("numbers finite in float32", "a value that is not finite in float32")
        if not is_usable(matrix):
            raise Refused(f"a matrix that can be inverted, {WITHIN}", matrix.tolist())
        if abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-4:
            raise Refused("a transform whose last row is 0 0 0 1", matrix[3].tolist())
        if self.angles and similarity_scale(matrix, 1e-4) is None:
            raise Refused(self.expected, matrix.tolist())
        if self.rigid and not is_rigid(matrix):
            raise Refused("a pose without scale or shear (torchpt.nn.Renderer keeps one so)", matrix.tolist())


# ---- Specs of what is fixed once a scene is loaded: flags, words, whole numbers, files, and whatever a function reads


@dataclass(frozen=True)
class Flag(Spec):
    """True or false."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "true or false"

    def read(self, value: Any) -> bool:
        """See :class:`Spec`."""
        return reading.flag(value)


@dataclass(frozen=True)
class Choice(Spec):
    """One of some words.

    Attributes:
        names: the words.
        booleans: which word a YAML boolean stands for.
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
    """A whole number in a range, or one of some other values.

    Attributes:
        low: least.
        high: greatest.
        also: what else is accepted.
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
        single: whether one number stands for both.
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
    """A file's path, or several of which the first that is there is used."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a file path, or a list of them (the first that is there is used)"

    def read(self, value: Any) -> tuple[str, ...]:
        """See :class:`Spec`."""
        return reading.file_paths(value)


@dataclass(frozen=True)
class Map(Spec):
    """A texture that gives numbers, or its name; read by whoever reads textures (:data:`torchpt.spec.schema.ReadTexture`)."""

    texture: bool = field(default=True, kw_only=True)
    words: str = field(default="the name of a texture", kw_only=True)

    #: Numbers that it may give, as of a number that a texture may give.
    bounds: ClassVar[tuple[float, float]] = (-LARGEST, LARGEST)

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Custom(Spec):
    """Whatever a function reads.

    Attributes:
        reader: from the value as written to the parameter's; raises :class:`Refused`.
    """

    reader: Callable[[Any], Any] = field(default=lambda value: value, kw_only=True, hash=False)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a value"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        return self.reader(value)
