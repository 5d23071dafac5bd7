"""What a texture is: what a scene file says of it, how it is opened, and what lanes read of it.

A *kind* of texture is a file in ``kinds/``. Opened for a slot (:class:`Opening`) it becomes a *node*, one way of reading it;
nodes that lanes read by the same code are rows of one *table*.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.transforms import uv_matrix
from torchpt.spec import Angle, Color, Custom, Moves, Pair, Refused, Spec, parameters_of
from torchpt.spec.reading import LARGEST, as_refused
from torchpt.spec.schema import ParsedParams, read_params

if TYPE_CHECKING:
    from torchpt.physics.parts import Parameters

__all__ = [
    "CHANNELS", "SAME", "Mapped", "Matrix", "Named", "Node", "Opening", "Table", "Texture", "TextureInput", "TexturePoint",
    "UvTransform", "transform_uv",
]  # fmt: skip

#: What a number may be read from.
CHANNELS = ("luminance", "r", "g", "b", "a")

Matrix = tuple[tuple[float, float, float], tuple[float, float, float]]
#: Texture coordinates as they are.
SAME: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
_ONE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Named:
    """A texture of the block ``textures``; ``channel``: which of its channels a number takes."""

    texture: str
    channel: str | None = None


@dataclass(frozen=True)
class TextureInput:
    """A texture where a number or a colour could stand.

    Attributes:
        texture: as written.
        coloured: whether three channels are wanted.
        linear: whether the numbers are no colours: then ``colorspace: auto`` leaves them as they are.
        low: least value that the slot accepts.
        high: greatest.
        moves: what changes place with the slot's values.
    """

    texture: ParsedParams | Named
    coloured: bool
    linear: bool
    low: float
    high: float
    moves: Moves = Moves.NOTHING


@dataclass(frozen=True)
class TexturePoint:
    """Where textures are read."""

    uv: Tensor | None = None  # (2, N); None where nothing is read by coordinates
    footprint: Tensor | None = None  # (N,) area in texture coordinates; None: they are read at points
    colors: Tensor | None = None  # (3, N) of the mesh's vertices; None where nothing reads them

    @property
    def bare(self) -> TexturePoint:
        """The same, for what averages over no footprint."""
        return self if self.footprint is None else replace(self, footprint=None)


class Table:
    """The nodes that lanes read by the same code, one a row; a dataclass of tensors and of what is static."""

    @property
    def count(self) -> int:
        """How many nodes it holds."""
        raise NotImplementedError

    @property
    def filtered(self) -> bool:
        """Whether any of them averages over footprints; static."""
        return False

    def look_up(self, nodes: Tensor, point: TexturePoint, coloured: bool) -> Tensor:
        """Values of nodes ``(N,)`` at points: ``(3, N)`` where ``coloured``, else ``(N,)``; nodes are of that sort."""
        raise NotImplementedError

    def slope(self, nodes: Tensor, point: TexturePoint) -> tuple[Tensor, Tensor]:
        """Derivatives ``(N,)`` of number-valued nodes with respect to ``u`` and ``v``."""
        raise NotImplementedError


class Node:
    """One way of reading a texture: a frozen dataclass, static, equal where the same is read alike.

    Attributes:
        channel: None for a colour, else the channel read as a number: its index, or -1 for luminance.
        filtered: whether it averages over footprints.
        reads: what of a surface it asks for: ``uv`` or ``colors``.
    """

    channel: int | None
    filtered: bool
    reads: ClassVar[str] = "uv"

    @property
    def variant(self) -> Hashable:
        """What nodes of one table have in common."""
        raise NotImplementedError

    @property
    def form(self) -> Hashable:
        """What the slots have in common that lanes of one group read it for."""
        return self.variant, self.channel is None

    def at_points(self) -> Any:
        """The same node without filtering, for slots that are read at points."""
        return replace(self, filtered=False) if self.filtered else self  # type: ignore[type-var]

    def divided(self, unit: float) -> Any:
        """The same node with its values divided by a unit of length."""
        raise NotImplementedError

    def table(
        self, nodes: Sequence[Any], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> Table:
        """The table of ``nodes``, all of this variant, in their order; differentiable in the parameters.

        Args:
            nodes: the rows.
            parameters: every tensor by dotted name.
            dtype: of the lanes.
            device: where it lies.
        """
        raise NotImplementedError

    def mean(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Mean colour ``(3,)`` over a unit square of texture coordinates, float64, detached; of a colour's node."""
        side = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
        uv = torch.stack(torch.meshgrid(side, side, indexing="xy")).reshape(2, -1)
        given = {name: value.detach().cpu() for name, value in parameters.items()}
        table = self.table([self], given, torch.float64, uv.device)
        lanes = torch.zeros(uv.shape[1], dtype=torch.int64)
        return table.look_up(lanes, TexturePoint(uv), True).mean(1)


@dataclass(frozen=True)
class Opening:
    """A texture's slot, and the scene that it is opened in.

    Attributes:
        slot: what is wanted.
        key: the slot's dotted key, for errors.
        name: dotted name of the texture, which its parameters begin with.
        channel: what a number is read from, where the slot says so.
        parameters: numbers of the scene, where the texture adds its own.
        resolve: from a path as written and its dotted key to a file.
        file: scene file for errors.
        pictures: files that were read for other slots, for a kind's own use.
    """

    slot: TextureInput
    key: str
    name: str
    channel: str | None
    parameters: Parameters
    resolve: Callable[[tuple[str, ...], str], Path]
    file: str | None = None
    pictures: dict[Any, Any] = field(default_factory=dict)

    def number(self, channels: Sequence[str], without: str) -> int | None:
        """The channel of a node whose colours have no alpha; None where a colour is wanted.

        Raises:
            SceneError: none of ``channels`` is asked for; ``without`` says why it is not there.
        """
        channel = self.channel or "luminance"
        if channel not in channels:
            raise SceneError(f"{self.key}.channel", channel, f"one of {', '.join(channels)} ({without})", self.file)
        return None if self.slot.coloured else CHANNELS.index(channel) - 1

    def declare(self, name: str, value: Any, spec: Spec) -> None:
        """Add a parameter; where another slot did before, it must suit both."""
        known = self.parameters.specs.get(name)
        self.parameters.declare(name, value, spec if known is None else _both(known, spec))

    def declare_all(self, kind: Any, values: Mapping[str, Any]) -> None:
        """Add those parameters of a kind that are traced: colours are what the slot gets, and have its range.

        Raises:
            SceneError: a colour that the slot does not accept.
        """
        for key, spec in parameters_of(kind).items():
            if not spec.differentiable or values[key] is None:
                continue
            name = f"{self.name}.{key}"
            if isinstance(spec, Color):
                self.check(np.asarray(values[key]), name)
                spec = self.ranged(spec)
            self.declare(name, values[key], replace(spec, moves=self.slot.moves))

    def check(self, values: np.ndarray, key: str, label: str = "", scale: tuple[float, float, float] = _ONE) -> None:
        """Refuse values, times ``scale``, that the slot does not accept.

        Raises:
            SceneError: says what is accepted; ``label``: of which file.
        """
        slot = self.slot
        ends = [float(end) * factor for end in (values.min(), values.max()) for factor in scale]
        low, high = min(ends), max(ends)
        if low < slot.low - _CLOSE or high > slot.high * (1 + _CLOSE):
            where = f" in the texels of {label}" if label else ""
            raise SceneError(key, [low, high], f"numbers{_words(slot.low, slot.high)}{where}", self.file)

    def ranged(self, spec: Any, scale: tuple[float, float, float] = _ONE) -> Any:
        """A spec of numbers narrowed to what the slot accepts once they are multiplied by ``scale``."""
        low, high = -LARGEST, LARGEST
        for factor in {factor for factor in scale if factor != 0.0}:
            a, b = sorted((self.slot.low / factor, self.slot.high / factor))
            low, high = max(low, a), min(high, b)
        mine = replace(spec, low=low if low > -LARGEST else None, high=high if high < LARGEST else None)
        return _both(spec, mine)


#: What is taken for rounding in numbers that a slot gets.
_CLOSE = 1e-6


def _words(low: float, high: float) -> str:
    return f" in {low:g}..{high:g}" if high < 1e30 else f" >= {low:g}"


def _both(a: Any, b: Any) -> Any:
    """The spec of what must suit two slots."""
    if not hasattr(a, "bounds") or not hasattr(b, "bounds"):
        return b
    lows, highs = ([low for low in (a.low, b.low) if low is not None], [h for h in (a.high, b.high) if h is not None])
    moves = max(a.moves, b.moves, key=lambda moves: moves.value)
    return replace(b, low=max(lows, default=None), high=min(highs, default=None), moves=moves)


class Texture:
    """A kind of texture.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares. Of a scene's own are those that are traced; colours among them are what the slot gets.
        reads: what of a surface it asks for: ``uv`` or ``colors``.
        filters: values of its parameter ``filter`` with which it averages over footprints.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    reads: ClassVar[str] = "uv"
    filters: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that do not go together.

        Raises:
            Refused: says which, and what is accepted.
        """

    @classmethod
    def check_slot(cls, values: Mapping[str, Any], coloured: bool) -> None:
        """Refuse what a slot of a colour, or of a number, cannot read of a texture that is written in it.

        Raises:
            Refused: says what is accepted.
        """

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """The node of a slot, its parameters declared.

        Raises:
            SceneError: what the slot cannot read.
            AssetError: a file that is missing or malformed.
        """
        raise NotImplementedError

    @classmethod
    def label(cls, values: Mapping[str, Any]) -> str | None:
        """The file that it is named after where a mesh file brings it; None: it is named after its slot."""
        return None


@dataclass(frozen=True)
class UvTransform:
    """How texture coordinates are transformed: scaled, then turned, then moved."""

    parameters: ClassVar = {
        "scale": Pair((1.0, 1.0), single=True, doc="factors of u and v"),
        "rotate": Angle(0.0, low=None, doc="turns from u to v, after the scale"),
        "translate": Pair((0.0, 0.0), doc="is added last"),
    }

    scale: tuple[float, float] = (1.0, 1.0)
    rotate: float = 0.0
    translate: tuple[float, float] = (0.0, 0.0)

    def matrix(self, repeats: tuple[float, float] = (1.0, 1.0)) -> Matrix:
        """Rows ``(2, 3)`` of the transform; with ``repeats`` as a scale after it."""
        return uv_matrix(self.scale, self.rotate, self.translate, repeats)


def _uv_transform(value: Any) -> UvTransform:
    if not isinstance(value, Mapping):
        raise Refused("a mapping with scale, rotate, translate")
    try:
        return UvTransform(**read_params(UvTransform, value, "", None, "uv_transform").values)
    except SceneError as error:
        raise as_refused(error) from None


class Mapped(Texture):
    """A texture that is read by texture coordinates."""

    parameters: ClassVar = {
        "uv_transform": Custom(
            None,
            reader=_uv_transform,
            words="a mapping with scale, rotate, translate",
            doc="applied to texture coordinates: `scale` 1 (a number or [u, v]), `rotate` 0 (degrees, from u to v), "
            "`translate` [0, 0], in this order",
        ),
    }

    @staticmethod
    def matrix(values: Mapping[str, Any], repeats: tuple[float, float] = (1.0, 1.0)) -> Matrix:
        """Rows ``(2, 3)`` of what is done to texture coordinates; with ``repeats`` as a scale after it."""
        return (values["uv_transform"] or UvTransform()).matrix(repeats)


def transform_uv(maps: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates ``(N,)`` under affine maps: rows of ``maps (6 or more, N)`` are those of the transform."""
    u, v = uv[0], uv[1]
    return (
        torch.addcmul(torch.addcmul(maps[2], u, maps[0]), v, maps[1]),
        torch.addcmul(torch.addcmul(maps[5], u, maps[3]), v, maps[4]),
    )
