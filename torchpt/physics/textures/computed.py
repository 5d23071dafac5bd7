"""Procedural textures: values computed from texture coordinates and parameters.

A kind is one class with two functions, see :class:`Computed`. It can be used wherever images can: colours, numbers, normal and
bump maps, opacity, emission, displacement. Scenes without one have no cost. A node is one use of a texture; the nodes of one
variant are rows of one table, which stages look up on lanes.
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
    IDENTITY,
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

#: Parameters by name, as the functions of a texture get them.
Values = Mapping[str, Tensor]
#: Footprints are clamped to this area in texture coordinates, so that products stay in the range of float32.
_MAX_FOOTPRINT = 1e12


@dataclass(frozen=True)
class Computed(Mapped):
    """A kind of procedural texture. An instance is a variant, with its static values as fields.

    Its functions get coordinates ``(N,)`` after ``uv_transform``, and ``p``: the parameters by name, per lane. Numbers are
    ``(N,)``. A colour is ``(3, N)`` for a slot of a colour and ``(N,)``, one channel, for a slot of a number: so the functions
    must treat all channels alike, and be linear in colours, as luminance is. They may use operations that round alike on
    every lane (``tests/integrators/test_reproducible.py`` lists them) and that the lane compiler supports.
    """

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Computed:
        """Return the variant for the values of the parameters."""
        return cls()

    def constants(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return more entries of ``p`` by name, each a number or a tuple, from the values of the scene file.

        Integers become int32, other numbers the world's dtype.
        """
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
        channel = opening.channel_index(CHANNELS[:4], f"{cls.name} has no alpha")
        opening.declare_all(cls, values)
        variant = cls.of(values)
        return ComputedNode(
            texture=variant,
            name=opening.name,
            channel=channel,
            transform=cls.matrix(values),
            constants=tuple(variant.constants(values).items()),
            filtered=values.get("filter") in cls.filters,  # the values of `filter` that average over footprints
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
        unit: divisor of the values, for lengths: the world's unit.
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
        values = {}
        for key, spec in parameters_of(type(self.texture)).items():
            value = parameters.get(f"{self.name}.{key}") if spec.differentiable else None
            if value is not None:
                value = value.double()
                if isinstance(spec, Color) and self.channel is not None:
                    value = (luminance(value) if self.channel < 0 else value[self.channel]).expand(3)
                values[key] = value
        return values

    def table(
        self, nodes: Sequence[Any], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> Table:
        """See :meth:`Node.table`."""

        def by_node(rows: list[Any], kind: torch.dtype = dtype) -> Tensor:
            """Return ``(M,)`` for numbers, ``(C, M)`` for tuples, one of each node."""
            tensor = torch.tensor(rows, dtype=kind, device=device)
            return tensor.T.contiguous() if tensor.dim() > 1 else tensor

        rows = [node.values(parameters) for node in nodes]
        values = {key: torch.stack([row[key] for row in rows], -1).to(device=device, dtype=dtype) for key in rows[0]}
        for key, example in self.constants:
            number = example[0] if isinstance(example, tuple) else example
            kind = torch.int32 if isinstance(number, int) else dtype
            values[key] = by_node([dict(node.constants)[key] for node in nodes], kind)
        # Area of a transformed unit square: the determinant of the linear map.
        areas = [abs(a * d - b * c) * node.filtered for node in nodes for (a, b, _), (c, d, _) in [node.transform]]
        colors = [key for key, spec in parameters_of(type(self.texture)).items() if isinstance(spec, Color)]
        is_transformed = any(node.transform != IDENTITY for node in nodes)
        return ComputedTable(
            texture=self.texture,
            rows=len(nodes),
            values=values,
            colors=tuple(key for key in colors if key in values),
            transform=by_node([sum(node.transform, ()) for node in nodes]) if is_transformed else None,
            areas=by_node(areas) if any(node.filtered for node in nodes) else None,
            factor=by_node([1.0 / node.unit for node in nodes]) if any(node.unit != 1.0 for node in nodes) else None,
        )


@dataclass(frozen=True)
class ComputedTable(Table):
    """M nodes of one variant.

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

    def _arguments(
        self, nodes: Tensor, point: TexturePoint, *, coloured: bool
    ) -> tuple[Values, Tensor, Tensor, Tensor | None]:
        """Return the arguments of the texture's functions: parameters, both coordinates, area of the footprint."""
        assert point.uv is not None
        p = {  # in slots of numbers the three channels of a colour are equal: one is enough
            key: take(value[0] if key in self.colors and not coloured else value, nodes)
            for key, value in self.values.items()
        }
        x, y = point.uv[0], point.uv[1]
        if self.transform is not None:
            x, y = transform_uv(take(self.transform, nodes), point.uv)
        area = None
        if self.areas is not None and point.footprint is not None:
            area = take(self.areas, nodes) * point.footprint.clamp_max(_MAX_FOOTPRINT)
        return p, x, y, area

    def look_up(self, nodes: Tensor, point: TexturePoint, *, coloured: bool) -> Tensor:
        """See :meth:`Table.look_up`."""
        value = self.texture.value(*self._arguments(nodes, point, coloured=coloured))
        return value if self.factor is None else value * take(self.factor, nodes)

    def slope(self, nodes: Tensor, point: TexturePoint) -> tuple[Tensor, Tensor]:
        """See :meth:`Table.slope`."""
        along_x, along_y = self.texture.slope(*self._arguments(nodes, point, coloured=False))
        if self.factor is not None:
            factor = take(self.factor, nodes)
            along_x, along_y = along_x * factor, along_y * factor
        if self.transform is None:
            return along_x, along_y
        # Chain rule: x = m0 u + m1 v + m2, y = m3 u + m4 v + m5.
        m = take(self.transform, nodes)
        return along_x * m[0] + along_y * m[3], along_x * m[1] + along_y * m[4]
