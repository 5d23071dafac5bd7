"""Procedural textures: values computed from texture coordinates and parameters.

A kind is one class with two functions, see :class:`Computed`. It can be used wherever images can: colours, numbers, normal and
bump maps, opacity, emission, displacement. Scenes without one have no cost.
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
#: Footprints are clamped to this area, so that products stay in the range of float32.
_WIDE = 1e12


@dataclass(frozen=True)
class Computed(Mapped):
    """A kind of procedural texture. An instance is a variant, with its static values as fields.

    Its functions get coordinates ``(N,)`` after ``uv_transform``, and ``p``: the traced parameters by name. Numbers are
    ``(N,)``. A colour is ``(3, N)`` for a slot of a colour and ``(N,)``, one channel, for a slot of a number: so the functions
    must treat all channels alike, and be linear in colours, as luminance is. They may use operations that round alike on
    every lane (``tests/integrators/test_reproducible.py`` lists them) and that the lane compiler supports.
    """

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Computed:
        """Return the variant for the values of the parameters."""
        return cls()

    def constants(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return more entries of ``p`` by name, each a number or a tuple; integers become int32."""
        return {}

    def value(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> Tensor:
        """Return values ``(3, N)`` or ``(N,)``, shaped as the colours.

        Args:
            p: parameters by name.
            x: first coordinate ``(N,)``.
            y: second coordinate ``(N,)``.
            area: area ``(N,)`` of the footprint in these coordinates, 0 for unfiltered nodes; None if all are unfiltered.
        """
        raise NotImplementedError

    def slope(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return derivatives ``(N,)`` of numbers by ``x`` and ``y``."""
        raise NotImplementedError

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """See :meth:`Texture.open`."""
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
    """One use of a procedural texture.

    Attributes:
        texture: the variant.
        name: dotted prefix of the parameters.
        channel: see :class:`Node`.
        transform: rows of the affine map ``(2, 3)`` of texture coordinates.
        constants: see :meth:`Computed.constants`.
        filtered: see :class:`Node`.
        unit: divisor of the values.
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
        """See :attr:`Node.variant`."""
        return self.texture

    def divided(self, unit: float) -> ComputedNode:
        """See :meth:`Node.divided`."""
        return replace(self, unit=self.unit * unit)

    def values(self, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the parameters ``()`` or ``(3,)`` by name, float64; for a number, colours repeat the node's channel."""
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
        """See :meth:`Node.table`."""

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
        rows: number of nodes; static.
        values: entries of ``p`` by name, ``(M,)`` or ``(C, M)``.
        colors: names of the values that are colours ``(3, M)``; static.
        transform: ``(6, M)`` rows of the transforms of texture coordinates; None if all are the identity.
        areas: ``(M,)`` area of a unit square of texture coordinates after the transform, 0 for unfiltered nodes; None if all
            are unfiltered.
        factor: ``(M,)`` factor of the values; None if 1 everywhere.
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
        """See :attr:`Table.count`."""
        return self.rows

    @property
    def filtered(self) -> bool:
        """See :attr:`Table.filtered`."""
        return self.areas is not None

    def _at(self, nodes: Tensor, point: TexturePoint, coloured: bool) -> tuple[Values, Tensor, Tensor, Tensor | None]:
        """Return the arguments of the texture's functions."""
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
        """See :meth:`Table.look_up`."""
        value = self.texture.value(*self._at(nodes, point, coloured))
        return value if self.factor is None else value * take(self.factor, nodes)

    def slope(self, nodes: Tensor, point: TexturePoint) -> tuple[Tensor, Tensor]:
        """See :meth:`Table.slope`."""
        across, along = self.texture.slope(*self._at(nodes, point, False))
        if self.factor is not None:
            factor = take(self.factor, nodes)
            across, along = across * factor, along * factor
        if self.transform is None:
            return across, along
        maps = take(self.transform, nodes)
        return across * maps[0] + along * maps[3], across * maps[1] + along * maps[4]
