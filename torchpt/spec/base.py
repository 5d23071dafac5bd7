"""What a spec is: one parameter of a kind, and what it accepts."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, Flag, auto
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["REQUIRED", "Moves", "Role", "Spec"]


class Moves(Enum):
    """What a parameter moves: what the derivative with respect to it must follow, or cannot."""

    NOTHING = 0
    SURFACES = 1  #: or the camera: points slide, and silhouettes move
    SHADOWS = 2  #: a light: shadow edges move, and no point does
    RAYS = 3  #: rays that a delta lobe sends on


class Role(Flag):
    """What a setting has to do with the samples of a picture."""

    NONE = 0
    FREE = auto()  #: nothing: no sample depends on it
    ENDS = auto()  #: it is a stop rule: it may end a render before ``spp`` samples are taken
    FILES = auto()  #: it says which files are written on the way


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
    traced: ClassVar[bool] = False
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
