"""What materials come to on the lanes: a model, its parameters, and the chance that a ray meets the surface.

Differentiable in the parameters, and done once a material. A blend with ``null`` is its other half, met more rarely.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchpt.bsdfs import Bsdf, Parameters
from torchpt.bsdfs.resolved import ResolvedMaterial
from torchpt.textures import Node

__all__ = ["LaneMaterial", "OpacityTexture", "lane_material"]


@dataclass(frozen=True)
class OpacityTexture:
    """A texture of opacity: ``bias + factor * value`` is a factor of the chance that a ray meets the surface."""

    node: Node
    bias: float = 0.0
    factor: float = 1.0


@dataclass(frozen=True)
class LaneMaterial:
    """A material on the lanes.

    Attributes:
        model: in the variant it needs.
        values: what the model is given, ``(3, 1)`` or ``(1,)``; of a blend nested. Without those that textures give.
        readings: the textures, nested alike.
        opacity: ``(1,)``, or None where it is 1.
        opacity_texture: the texture that opacity is multiplied by, or None.
    """

    model: Bsdf
    values: Parameters
    opacity: Tensor | None
    readings: dict[str, Any] = field(default_factory=dict)
    opacity_texture: OpacityTexture | None = None


def lane_material(material: ResolvedMaterial, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> LaneMaterial:
    """Resolve a material under ``parameters`` (every tensor by dotted name)."""
    readings = {key: value for key, value in material.values.items() if isinstance(value, Node)}
    values: Parameters = {
        key: parameters[f"{material.name}.{key}"].to(dtype)[..., None] for key in material.values if key not in readings
    }
    if material.inner:
        a, b = (lane_material(inner, parameters, dtype) for inner in material.inner)
        found = _blended(type(material.model), values.get("weight"), readings.get("weight"), a, b)
    else:
        device = next(iter(parameters.values())).device
        nothing = torch.zeros(1, dtype=dtype, device=device) if material.model.sheer else None
        found = LaneMaterial(material.model, values, nothing, readings)
    opacity, opacity_texture = found.opacity, found.opacity_texture
    if isinstance(material.opacity, Node):
        opacity_texture = OpacityTexture(material.opacity)
    elif material.opacity != 1.0:  # a number
        own = parameters[f"{material.name}.opacity"].to(dtype)[None]
        opacity = own if opacity is None else opacity * own
    if opacity is not None and material.alpha_cutoff is not None and opacity_texture is None:
        opacity = (opacity >= material.alpha_cutoff).to(dtype)
    return LaneMaterial(found.model, found.values, opacity, found.readings, opacity_texture)


def _blended(
    kind: Callable[[Bsdf, Bsdf], Bsdf], weight: Tensor | None, reading: Node | None, a: LaneMaterial, b: LaneMaterial
) -> LaneMaterial:
    """The blend of two materials, ``weight (1,)`` of the second: what is met of each, and how often either is."""
    opacity = None
    if weight is None:  # a texture, beside which nothing but null lets rays pass
        assert reading is not None
        if a.model.sheer:
            return LaneMaterial(b.model, b.values, None, b.readings, OpacityTexture(reading))
        if b.model.sheer:
            return LaneMaterial(a.model, a.values, None, a.readings, OpacityTexture(reading, 1.0, -1.0))
    elif a.opacity is not None or b.opacity is not None:
        first = (1.0 - weight) * (1.0 if a.opacity is None else a.opacity)
        second = weight * (1.0 if b.opacity is None else b.opacity)
        opacity = first + second
        weight = second / torch.where(opacity > 0, opacity, 1.0)
    if a.model.sheer:
        return LaneMaterial(b.model, b.values, opacity, b.readings)
    if b.model.sheer:
        return LaneMaterial(a.model, a.values, opacity, a.readings)
    values: Parameters = {"a": a.values, "b": b.values}
    readings = {side: s.readings for side, s in (("a", a), ("b", b)) if s.readings}
    if weight is None:
        readings["weight"] = reading  # type: ignore[assignment]
    else:
        values["weight"] = weight
    return LaneMaterial(kind(a.model, b.model), values, opacity, readings)
