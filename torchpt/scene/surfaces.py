"""What materials come to on the lanes: a model, its parameters, and the chance that a ray meets the surface.

Differentiable in the parameters, and done once a material. A blend with ``null`` is its other half, met more rarely.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.bsdfs import Blend, Bsdf, Null, Parameters
from torchpt.scene.parts import MaterialSlot

__all__ = ["Surface", "surface_of"]


@dataclass(frozen=True)
class Surface:
    """A material on the lanes.

    Attributes:
        model: in the variant it needs.
        values: what the model is given, ``(3, 1)`` or ``(1,)``; of a blend nested.
        opacity: ``(1,)``, or None where it is 1.
    """

    model: Bsdf
    values: Parameters
    opacity: Tensor | None


def surface_of(slot: MaterialSlot, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> Surface:
    """Resolve a material under ``parameters`` (every tensor by dotted name)."""
    values: Parameters = {key: parameters[f"{slot.name}.{key}"].to(dtype)[..., None] for key in slot.values}
    if slot.inner:
        a, b = (surface_of(inner, parameters, dtype) for inner in slot.inner)
        found = _blended(values["weight"], a, b)
    else:
        device = next(iter(parameters.values())).device
        nothing = torch.zeros(1, dtype=dtype, device=device) if isinstance(slot.model, Null) else None
        found = Surface(slot.model, values, nothing)
    opacity = found.opacity
    if slot.opacity != 1.0:
        own = parameters[f"{slot.name}.opacity"].to(dtype)[None]
        opacity = own if opacity is None else opacity * own
    if opacity is not None and slot.alpha_cutoff is not None:
        opacity = (opacity >= slot.alpha_cutoff).to(dtype)
    return Surface(found.model, found.values, opacity)


def _blended(weight: Tensor, a: Surface, b: Surface) -> Surface:
    """The blend of two surfaces, ``weight (1,)`` of the second: what is met of each, and how often either is."""
    opacity = None
    if a.opacity is not None or b.opacity is not None:
        first = (1.0 - weight) * (1.0 if a.opacity is None else a.opacity)
        second = weight * (1.0 if b.opacity is None else b.opacity)
        opacity = first + second
        weight = second / torch.where(opacity > 0, opacity, 1.0)
    if isinstance(a.model, Null):
        return Surface(b.model, b.values, opacity)
    if isinstance(b.model, Null):
        return Surface(a.model, a.values, opacity)
    return Surface(Blend(a.model, b.model), {"weight": weight, "a": a.values, "b": b.values}, opacity)
