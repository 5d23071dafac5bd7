"""Base classes of textures: kinds, nodes and tables.

A *kind* of texture is a class in a file of ``kinds/``. A *slot* is a parameter whose values a texture gives, such as the
roughness of a material. Opened for a slot (:class:`Opening`) a texture becomes a *node*, one use of it; nodes that are looked
up by the same code are rows of one *table*. Scenes open textures when they are loaded; stages look tables up on lanes, the N
points that are shaded together.
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
from torchpt.core.threads import ReadAhead
from torchpt.images import ByteImage, PackedTexels
from torchpt.math.transforms import uv_matrix
from torchpt.spec import Angle, Color, Custom, Moves, Pair, Refused, Spec, parameters_of
from torchpt.spec.reading import LARGEST, as_refused, vector
from torchpt.spec.schema import ParsedParams, read_params

if TYPE_CHECKING:
    from torchpt.physics.parts import Parameters

__all__ = [
    "CHANNELS", "IDENTITY", "Find", "Mapped", "Matrix", "Node", "Opening", "Table", "TexelSource", "Texture", "TextureInput",
    "TexturePoint", "TextureReference", "UvTransform", "transform_uv",
]  # fmt: skip

#: Channels from which a number may be read. A node holds the index minus 1: -1 for luminance, else the component of a texel.
CHANNELS = ("luminance", "r", "g", "b", "a")

#: Rows of an affine transform of texture coordinates; the third column is the translation.
Matrix = tuple[tuple[float, float, float], tuple[float, float, float]]
#: The identity transform of texture coordinates.
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
#: Returns the file of a path as written, or None where there is none.
Find = Callable[[tuple[str, ...]], Path | None]
_ONE = (1.0, 1.0, 1.0)
_TRANSFORM = "a mapping with scale, rotate, translate, or with matrix"
_ROWS = "two rows of three finite numbers [[a, b, c], [d, e, f]]"


@dataclass(frozen=True)
class TextureReference:
    """A reference to the texture ``texture`` of the block ``textures``; ``channel``: the channel for a slot of a number."""

    texture: str
    channel: str | None = None


@dataclass(frozen=True)
class TextureInput:
    """A texture as the value of a parameter that takes a number or a colour.

    Attributes:
        texture: the texture as written in the file.
        coloured: whether the slot takes three channels.
        linear: whether the values are not colours: then ``colorspace: auto`` means linear.
        low: least accepted value.
        high: greatest accepted value.
        moves: the geometry that moves with the values, for gradients.
    """

    texture: ParsedParams | TextureReference
    coloured: bool
    linear: bool
    low: float
    high: float
    moves: Moves = Moves.NOTHING


@dataclass(frozen=True)
class TexturePoint:
    """Points at which textures are looked up."""

    uv: Tensor | None = None  # (2, N) texture coordinates; None if not needed
    footprint: Tensor | None = None  # (N,) area in texture coordinates; None: no filtering
    colors: Tensor | None = None  # (3, N) interpolated vertex colours; None if not needed

    @property
    def unfiltered(self) -> TexturePoint:
        """The points without footprints."""
        return self if self.footprint is None else replace(self, footprint=None)


class TexelSource(Mapping[str, Tensor]):
    """The parameters of a scene by dotted name, some of whose images may be packed."""

    def packed(self, name: str) -> PackedTexels | None:
        """Return an image packed; None for one that is not."""
        raise NotImplementedError


class Table:
    """Nodes that are looked up by the same code, one a row; a dataclass of tensors and static values.

    Static values (numbers, words, flags: whatever is no tensor) are part of the code that is compiled for a look-up; tensors
    are its data.
    """

    @property
    def count(self) -> int:
        """Number of nodes."""
        raise NotImplementedError

    @property
    def filtered(self) -> bool:
        """True if any node averages over footprints; static."""
        return False

    def look_up(self, nodes: Tensor, point: TexturePoint, *, coloured: bool) -> Tensor:
        """Return values at points, ``nodes (N,)`` being rows of the table: ``(3, N)`` if ``coloured``, else ``(N,)``.

        All nodes of a call are colours, or all are numbers.
        """
        raise NotImplementedError

    def slope(self, nodes: Tensor, point: TexturePoint) -> tuple[Tensor, Tensor]:
        """Return derivatives ``(N,)`` of number-valued nodes by ``u`` and ``v``, for bump maps."""
        raise NotImplementedError


class Node:
    """One use of a texture: a frozen dataclass without tensors; equal nodes give equal values.

    Attributes:
        channel: None for a colour; for a number the index of the channel, or -1 for luminance.
        filtered: whether look-ups average over footprints.
        reads: what a look-up needs from the surface: texture coordinates, ``uv``, or vertex colours, ``colors``.
    """

    channel: int | None
    filtered: bool
    reads: ClassVar[str] = "uv"

    @property
    def variant(self) -> Hashable:
        """Key that is equal for all nodes of one table."""
        raise NotImplementedError

    @property
    def form(self) -> Hashable:
        """Key of nodes that one call can look up: the variant, and whether the value is a colour."""
        return self.variant, self.channel is None

    def unfiltered(self) -> Any:
        """Return the node without filtering, for slots without a footprint."""
        return replace(self, filtered=False) if self.filtered else self  # type: ignore[type-var]

    def divided(self, unit: float) -> Any:
        """Return the node with its values, which are lengths, divided by the unit of length of the world's coordinates."""
        raise NotImplementedError

    def table(
        self, nodes: Sequence[Any], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> Table:
        """Build the table of ``nodes``, all of this variant, in their order; differentiable in the parameters.

        Args:
            nodes: the rows.
            parameters: all parameter tensors of the scene by dotted name.
            dtype: dtype of the world.
            device: device of the table.
        """
        raise NotImplementedError

    def mean(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return the mean colour ``(3,)`` over a unit square of texture coordinates, float64, detached; for colours only.

        ``parameters``: all parameter tensors of the scene by dotted name, on the host.
        """
        # Centres of a grid of 64 x 64 cells: the mean decides how often a light is chosen, not what it emits.
        side = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
        uv = torch.stack(torch.meshgrid(side, side, indexing="xy")).reshape(2, -1)
        with torch.no_grad():
            table = self.table([self], parameters, torch.float64, uv.device)
            rows = torch.zeros(uv.shape[1], dtype=torch.int64)  # this node is the only one of the table
            return table.look_up(rows, TexturePoint(uv), coloured=True).mean(1)


@dataclass(frozen=True)
class Opening:
    """A slot for which a texture is opened, and the scene around it.

    Attributes:
        slot: the texture and the requirements of the slot.
        key: dotted key of the slot, for errors.
        name: dotted name of the texture, the prefix of its parameters.
        channel: channel for a number, if the slot sets it.
        parameters: parameters of the scene, to which the texture adds its own.
        resolve: maps candidates of a path as written, and the dotted key, to the first file that exists.
        file: the scene file, for errors.
        image_cache: images read for other slots, shared by all openings of a scene; keys are those of the kind.
    """

    slot: TextureInput
    key: str
    name: str
    channel: str | None
    parameters: Parameters
    resolve: Callable[[tuple[str, ...], str], Path]
    file: str | None = None
    image_cache: dict[Any, Any] = field(default_factory=dict)

    def channel_index(self, channels: Sequence[str], reason: str) -> int | None:
        """Return the channel of the node (:attr:`Node.channel`) for a slot of a number, None for a slot of a colour.

        Raises:
            SceneError: the slot's channel is not one of ``channels``, those of the texture; ``reason`` says why.
        """
        channel = self.channel or "luminance"
        if channel not in channels:
            raise SceneError(f"{self.key}.channel", channel, f"one of {', '.join(channels)} ({reason})", self.file)
        return None if self.slot.coloured else CHANNELS.index(channel) - 1

    def declare(self, name: str, value: Any, spec: Spec) -> None:
        """Add a parameter; if another slot added it before, its spec becomes the intersection of both."""
        declared = self.parameters.specs.get(name)
        self.parameters.declare(name, value, spec if declared is None else _intersection(declared, spec))

    def declare_all(self, kind: Any, values: Mapping[str, Any]) -> None:
        """Add the differentiable parameters of a kind; colours are restricted to the range of the slot.

        Raises:
            SceneError: a colour that the slot does not accept.
        """
        for key, spec in parameters_of(kind).items():
            if not spec.differentiable or values[key] is None:
                continue
            name = f"{self.name}.{key}"
            if isinstance(spec, Color):
                self.check(np.asarray(values[key]), name)
                spec = self.restricted(spec)
            self.declare(name, values[key], replace(spec, moves=self.slot.moves))

    def check(
        self, values: np.ndarray | ByteImage, key: str, label: str = "", scale: tuple[float, float, float] = _ONE
    ) -> None:
        """Refuse values, times ``scale``, that the slot does not accept.

        Raises:
            SceneError: with the accepted range; ``label`` names the file.
        """
        slot = self.slot
        extremes = [float(extreme) * factor for extreme in (values.min(), values.max()) for factor in scale]
        low, high = min(extremes), max(extremes)
        if low < slot.low - _TOLERANCE or high > slot.high * (1 + _TOLERANCE):
            where = f" in the texels of {label}" if label else ""
            raise SceneError(key, [low, high], f"numbers{_range_words(slot.low, slot.high)}{where}", self.file)

    def restricted(self, spec: Any, scale: tuple[float, float, float] = _ONE) -> Any:
        """Return a spec restricted to values that the slot accepts after multiplication by ``scale``."""
        low, high = -LARGEST, LARGEST
        for factor in {factor for factor in scale if factor != 0.0}:  # a factor of 0 gives 0, whatever the value
            least, greatest = sorted((self.slot.low / factor, self.slot.high / factor))
            low, high = max(low, least), min(high, greatest)
        of_slot = replace(spec, low=low if low > -LARGEST else None, high=high if high < LARGEST else None)
        return _intersection(spec, of_slot)


#: Tolerance for rounding in the range check of a slot.
_TOLERANCE = 1e-6


def _range_words(low: float, high: float) -> str:
    """Return a range in words; from 1e30 on ``high`` is no bound."""
    return f" in {low:g}..{high:g}" if high < 1e30 else f" >= {low:g}"


def _intersection(a: Any, b: Any) -> Any:
    """Return the spec of a parameter that two slots share: the intersection of the ranges, the larger `moves`."""
    if not hasattr(a, "bounds") or not hasattr(b, "bounds"):  # specs without ranges
        return b
    lows = [low for low in (a.low, b.low) if low is not None]
    highs = [high for high in (a.high, b.high) if high is not None]
    moves = max(a.moves, b.moves, key=lambda moves: moves.value)  # ordered by how much geometry a parameter moves
    return replace(b, low=max(lows, default=None), high=min(highs, default=None), moves=moves)


class Texture:
    """A kind of texture.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters. Differentiable ones become parameters of the scene; their colours are values
            of the slot.
        reads: as of :class:`Node`.
        filters: values of the parameter ``filter`` for which look-ups average over footprints.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    reads: ClassVar[str] = "uv"
    filters: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that contradict each other.

        Raises:
            Refused: with the parameter and the accepted values.
        """

    @classmethod
    def check_slot(cls, values: Mapping[str, Any], coloured: bool) -> None:
        """Refuse values that do not fit the slot in which the texture is written: a colour if ``coloured``, else a number.

        Raises:
            Refused: with the accepted values.
        """

    @classmethod
    def read_ahead(
        cls, slot: TextureInput, values: Mapping[str, Any], find: Find, image_cache: dict[Any, Any], ahead: ReadAhead
    ) -> None:
        """Begin to read the files that :meth:`open` will ask for; errors come when it does.

        Args:
            slot: the slot for which the texture will be opened.
            values: the values of the parameters.
            find: returns the file of a path as written, or None where there is none.
            image_cache: as of :class:`Opening`; gets what was begun, under keys of the kind's own.
            ahead: makes calls beside.
        """

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """Declare the parameters of the texture, and return the node for a slot.

        Raises:
            SceneError: values that the slot does not accept.
            AssetError: a missing or malformed file.
        """
        raise NotImplementedError

    @classmethod
    def label(cls, values: Mapping[str, Any]) -> str | None:
        """Return the image file that names a texture of a mesh file's material; None: it is named after its slot."""
        return None


def _read_rows(value: Any) -> Matrix:
    """Return the two rows of an affine transform from lists or arrays of three numbers."""
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 2:
        raise Refused(_ROWS)
    return vector(value[0], _ROWS), vector(value[1], _ROWS)


@dataclass(frozen=True)
class UvTransform:
    """An affine transform of texture coordinates: scale, then rotation, then translation; or a matrix."""

    parameters: ClassVar = {
        "scale": Pair((1.0, 1.0), single=True, doc="factors of u and v"),
        "rotate": Angle(0.0, low=None, doc="rotation from u to v, after the scale"),
        "translate": Pair((0.0, 0.0), doc="added last"),
        "matrix": Custom(None, reader=_read_rows, words=_ROWS, doc="any affine transform, in place of the others"),
    }

    scale: tuple[float, float] = (1.0, 1.0)
    rotate: float = 0.0
    translate: tuple[float, float] = (0.0, 0.0)
    matrix: Matrix | None = None

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse a matrix beside the parts of another transform."""
        if values["matrix"] is not None and len(given) > 1:
            raise Refused("either matrix, or scale, rotate and translate", values["matrix"], ("matrix",))

    def rows(self, repeats: tuple[float, float] = (1.0, 1.0)) -> Matrix:
        """Return the rows ``(2, 3)`` of the transform, followed by a scale by ``repeats``."""
        if self.matrix is None:
            return uv_matrix(self.scale, self.rotate, self.translate, repeats)
        (a, b, c), (d, e, f) = self.matrix
        x, y = repeats
        return (x * a, x * b, x * c), (y * d, y * e, y * f)


def _uv_transform(value: Any) -> UvTransform:
    """Return the transform of a mapping of a scene file, or refuse it."""
    if not isinstance(value, Mapping):
        raise Refused(_TRANSFORM)
    try:
        return UvTransform(**read_params(UvTransform, value, key="", file=None, words="uv_transform").values)
    except SceneError as error:
        raise as_refused(error) from None


class Mapped(Texture):
    """A texture that is looked up by texture coordinates."""

    parameters: ClassVar = {
        "uv_transform": Custom(
            None,
            reader=_uv_transform,
            words=_TRANSFORM,
            doc="applied to texture coordinates: `scale` 1 (a number or [u, v]), `rotate` 0 (degrees, from u to v), "
            "`translate` [0, 0], in this order; or `matrix` [[a, b, c], [d, e, f]]: u becomes a u + b v + c, v d u + e v + f",
        ),
    }

    @staticmethod
    def matrix(values: Mapping[str, Any], repeats: tuple[float, float] = (1.0, 1.0)) -> Matrix:
        """Return the rows ``(2, 3)`` of the transform of texture coordinates, followed by a scale by ``repeats``."""
        return (values["uv_transform"] or UvTransform()).rows(repeats)


def transform_uv(maps: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Transform ``uv (2, N)`` by affine maps; return ``u, v``, each ``(N,)``.

    The first six rows of ``maps (., N)`` are the elements of a :data:`Matrix`, row by row: u is ``m0 u + m1 v + m2``.
    """
    u, v = uv[0], uv[1]
    return (
        torch.addcmul(torch.addcmul(maps[2], u, maps[0]), v, maps[1]),
        torch.addcmul(torch.addcmul(maps[5], u, maps[3]), v, maps[4]),
    )
