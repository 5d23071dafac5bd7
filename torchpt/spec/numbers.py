"""Specs of numbers: one, three for a colour, or the texels of an image; in a range."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from torchpt.spec import reading
from torchpt.spec.base import Moves, Spec
from torchpt.spec.reading import LARGEST, Refused

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Angle", "Color", "Index", "Scalar", "Texels", "spec_of"]


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

    traced: ClassVar[bool] = True

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
