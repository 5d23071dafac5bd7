"""Textures that are no images: values computed on lanes from texture coordinates and from parameters gathered by node.

A kind is one class with two functions, see :class:`Computed`. Whatever reads images reads it: colours, numbers, normal and bump
maps, opacity, emission, displacement. Scenes without one hold nothing of it.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.math.vectors import luminance, take
from torchpt.physics.textures.base import (
    CHANNELS,
    SAME,
    Mapped,
    Matrix,
    Node,
    Opening,
    Table,
    TexturePoint,
    transform_uv,
)
from torchpt.spec import Color, parameters_of

__all__ = ["Computed", "ComputedNode", "ComputedTable"]

Values = Mapping[str, Tensor]
#: A footprint larger than this is all of a texture; its products stay far from the ends of float32.
_WIDE = 1e12


@dataclass(frozen=True)
class Computed(Mapped):
    """A kind whose values are computed. An instance is a variant: what is static of it, as fields.

    Its functions get coordinates ``(N,)`` after ``uv_transform``, and ``p``: its traced parameters by name. Numbers are
    ``(N,)``. A colour is ``(3, N)`` where the slot wants a colour and ``(N,)``, one channel of it, where it wants a number: so
    the functions treat all channels alike, and are linear in colours, as luminance is. They use operations that round alike
    on every lane (``tests/integrators/test_reproducible.py`` lists them) and that the lane compiler knows.
    """

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Computed:
        """The variant that the values of the parameters need."""
        return cls()

    def constants(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Numbers that lanes get in ``p`` beside the parameters: by name, each a number or a tuple; integers become int32."""
        return {}

    def value(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> Tensor:
        """Values ``(3, N)`` or ``(N,)``, as the colours are.

        Args:
            p: parameters by name.
            x: first coordinate.
            y: second.
            area: ``(N,)`` of the footprint in these coordinates, 0 for nodes that do not filter; None: none does.
        """
        raise NotImplementedError

    def slope(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> tuple[Tensor, Tensor]:
        """Derivatives ``(N,)`` of numbers with respect to ``x`` and ``y``."""
        raise NotImplementedError

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """See :class:`Texture`."""
        channel = opening.number(CHANNELS[:4], f"{cls.name} has no alpha")
        opening.declare_all(cls, values)
        made = cls.of(values)
        return ComputedNode(
            made,
            opening.name,
            channel,
            cls.matrix(values),
            tuple(made.constants(values).items()),
            values.get("filter") in cls.filters,
        )


@dataclass(frozen=True)
class ComputedNode(Node):
    """One way of reading a computed texture.

    Attributes:
        texture: its variant.
        name: dotted prefix of its parameters.
        channel: see :class:`Node`.
        transform: rows of the affine map ``(2, 3)`` of texture coordinates.
        constants: see :meth:`Computed.constants`.
        filtered: see :class:`Node`.
        unit: what values are divided by.
    """

    texture: Computed
    name: str
    channel: int | None
    transform: Matrix
    constants: tuple[tuple[str, Any], ...] = ()
    filtered: bool = False
    unit: float = 1.0

    @property
    def variant(self) -> Hashable:
        """See :class:`Node`."""
        return self.texture

    def divided(self, unit: float) -> ComputedNode:
        """See :class:`Node`."""
        return replace(self, unit=self.unit * unit)

    def values(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Its parameters ``()`` or ``(3,)`` by name, in float64; of a number's node colours as three times the channel."""
        found = {}
        for key, spec in parameters_of(type(self.texture)).items():
            value = parameters.get(f"{self.name}.{key}") if spec.differentiable else None
            if value is not None:
                value = value.double()
                if isinstance(spec, Color) and self.channel is not None:
                    value = (luminance(value) if self.channel < 0 else value[self.channel]).expand(3)
                found[key] = value
        return found

    def table(
        self, nodes: Sequence[Any], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> Table:
        """See :class:`Node`."""

        def column(rows: list[Any]) -> Tensor:
            made = torch.tensor(rows, dtype=dtype, device=device)
            return made.T.contiguous() if made.dim() > 1 else made

        rows = [node.values(parameters) for node in nodes]
        values = {key: torch.stack([row[key] for row in rows], -1).to(device=device, dtype=dtype) for key in rows[0]}
        for k, (key, first) in enumerate(self.constants):
            kind = torch.int32 if isinstance(first[0] if isinstance(first, tuple) else first, int) else dtype
            every = torch.tensor([node.constants[k][1] for node in nodes], dtype=kind, device=device)
            values[key] = every.T.contiguous() if every.dim() > 1 else every
        areas = [abs(a * d - b * c) * n.filtered for n in nodes for (a, b, _), (c, d, _) in [n.transform]]
        colors = [key for key, spec in parameters_of(type(self.texture)).items() if isinstance(spec, Color)]
        return ComputedTable(
            self.texture,
            len(nodes),
            values,
            tuple(key for key in colors if key in values),
            column([sum(n.transform, ()) for n in nodes]) if any(n.transform != SAME for n in nodes) else None,
            column(areas) if any(n.filtered for n in nodes) else None,
            column([1.0 / n.unit for n in nodes]) if any(n.unit != 1.0 for n in nodes) else None,
        )


@dataclass(frozen=True)
class ComputedTable(Table):
    """Nodes of one variant.

    Attributes:
        texture: the variant; static.
        rows: how many nodes; static.
        values: what its functions get, by name ``(M,)`` or ``(C, M)``.
        colors: which of those are colours ``(3, M)``; static.
        transform: ``(6, M)`` of the coordinates by rows; None where none transforms.
        areas: ``(M,)`` area in own coordinates of a unit square of texture coordinates, 0 where a node does not filter; None
            where none does.
        factor: ``(M,)`` of the values; None where it is 1.
    """

    texture: Computed
    rows: int
    values: dict[str, Tensor]
    colors: tuple[str, ...]
    transform: Tensor | None
    areas: Tensor | None
    factor: Tensor | None

    @property
    def count(self) -> int:
        """See :class:`Table`."""
        return self.rows

    @property
    def filtered(self) -> bool:
        """See :class:`Table`."""
        return self.areas is not None

    def _at(self, nodes: Tensor, point: TexturePoint, coloured: bool) -> tuple[Values, Tensor, Tensor, Tensor | None]:
        """What the texture's functions get."""
        assert point.uv is not None
        p = {
            key: take(value[0] if key in self.colors and not coloured else value, nodes)
            for key, value in self.values.items()
        }
        x, y = point.uv[0], point.uv[1]
        if self.transform is not None:
            x, y = transform_uv(take(self.transform, nodes), point.uv)
        area = None
        if self.areas is not None and point.footprint is not None:
            area = take(self.areas, nodes) * point.footprint.clamp_max(_WIDE)
        return p, x, y, area

    def look_up(self, nodes: Tensor, point: TexturePoint, coloured: bool) -> Tensor:
        """See :class:`Table`."""
        value = self.texture.value(*self._at(nodes, point, coloured))
        return value if self.factor is None else value * take(self.factor, nodes)

    def slope(self, nodes: Tensor, point: TexturePoint) -> tuple[Tensor, Tensor]:
        """See :class:`Table`."""
        across, along = self.texture.slope(*self._at(nodes, point, False))
        if self.factor is not None:
            factor = take(self.factor, nodes)
            across, along = across * factor, along * factor
        if self.transform is None:
            return across, along
        maps = take(self.transform, nodes)
        return across * maps[0] + along * maps[3], across * maps[1] + along * maps[4]
