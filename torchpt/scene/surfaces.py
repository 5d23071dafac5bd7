"""What materials come to on the lanes: a model, its parameters, and the chance that a ray meets the surface.

Differentiable in the parameters, and done once a material. A blend with ``null`` is its other half, met more rarely.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchpt.bsdfs import Blend, Bsdf, Null, Parameters
from torchpt.scene.parts import MaterialSlot, Reading, VertexColors
from torchpt.textures import Node

__all__ = ["Cover", "Surface", "surface_of"]


@dataclass(frozen=True)
class Cover:
    """A texture of opacity: ``bias + factor * value`` is a factor of the chance that a ray meets the surface."""

    node: Node
    bias: float = 0.0
    factor: float = 1.0


@dataclass(frozen=True)
class Surface:
    """A material on the lanes.

    Attributes:
        model: in the variant it needs.
        values: what the model is given, ``(3, 1)`` or ``(1,)``; of a blend nested. Without those that textures give.
        readings: the textures, nested alike.
        opacity: ``(1,)``, or None where it is 1.
        cover: the texture that opacity is multiplied by, or None.
    """

    model: Bsdf
    values: Parameters
    opacity: Tensor | None
    readings: dict[str, Any] = field(default_factory=dict)
    cover: Cover | None = None


def surface_of(slot: MaterialSlot, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> Surface:
    """Resolve a material under ``parameters`` (every tensor by dotted name)."""
    readings = {key: value for key, value in slot.values.items() if isinstance(value, Node | VertexColors)}
    values: Parameters = {
        key: parameters[f"{slot.name}.{key}"].to(dtype)[..., None] for key in slot.values if key not in readings
    }
    if slot.inner:
        a, b = (surface_of(inner, parameters, dtype) for inner in slot.inner)
        found = _blended(values.get("weight"), readings.get("weight"), a, b)
    else:
        device = next(iter(parameters.values())).device
        nothing = torch.zeros(1, dtype=dtype, device=device) if isinstance(slot.model, Null) else None
        found = Surface(slot.model, values, nothing, readings)
    opacity, cover = found.opacity, found.cover
    if isinstance(slot.opacity, Node):
        cover = Cover(slot.opacity)
    elif slot.opacity != 1.0:  # a number
        own = parameters[f"{slot.name}.opacity"].to(dtype)[None]
        opacity = own if opacity is None else opacity * own
    if opacity is not None and slot.alpha_cutoff is not None and cover is None:
        opacity = (opacity >= slot.alpha_cutoff).to(dtype)
    return Surface(found.model, found.values, opacity, found.readings, cover)


def _blended(weight: Tensor | None, reading: Reading | None, a: Surface, b: Surface) -> Surface:
    """The blend of two surfaces, ``weight (1,)`` of the second: what is met of each, and how often either is."""
    opacity = None
    if weight is None:  # a texture, beside which nothing but null lets rays pass
        assert reading is not None
        if isinstance(reading, Node) and isinstance(a.model, Null):
            return Surface(b.model, b.values, None, b.readings, Cover(reading))
        if isinstance(reading, Node) and isinstance(b.model, Null):
            return Surface(a.model, a.values, None, a.readings, Cover(reading, 1.0, -1.0))
    elif a.opacity is not None or b.opacity is not None:
        first = (1.0 - weight) * (1.0 if a.opacity is None else a.opacity)
        second = weight * (1.0 if b.opacity is None else b.opacity)
        opacity = first + second
        weight = second / torch.where(opacity > 0, opacity, 1.0)
    if isinstance(a.model, Null):
        return Surface(b.model, b.values, opacity, b.readings)
    if isinstance(b.model, Null):
        return Surface(a.model, a.values, opacity, a.readings)
    values: Parameters = {"a": a.values, "b": b.values}
    readings = {side: s.readings for side, s in (("a", a), ("b", b)) if s.readings}
    if weight is None:
        readings["weight"] = reading  # type: ignore[assignment]
    else:
        values["weight"] = weight
    return Surface(Blend(a.model, b.model), values, opacity, readings)
