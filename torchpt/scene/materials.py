"""Resolve materials: open textures, build BSDFs and blends of them, and declare their parameters.

A *slot* is a parameter that may have a texture in place of a number or colour; an opened texture is a *node*. A blend has two
inner materials, written in place or named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torchpt.physics.bsdfs.base import model_and_values
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.parts import Parameters
from torchpt.physics.textures import Node
from torchpt.scene.formats.materials import POINTS, inner_of
from torchpt.scene.formats.textures import TextureInput
from torchpt.spec import parameters_of
from torchpt.spec.schema import ParsedParams

__all__ = ["declare", "resolved"]

#: Opens the texture of a slot, by the slot's dotted key.
Resolve = Callable[[TextureInput, str], Node]


def resolved(
    material: ParsedParams, name: str, materials: Mapping[str, ParsedParams], resolve: Resolve | None = None
) -> ResolvedMaterial:
    """Build a material: its BSDF, its values and its opened textures.

    Args:
        material: the material.
        name: its dotted name, e.g. ``materials.red``.
        materials: all materials by name, for blends.
        resolve: opens textures; None: they stay unopened, so only the model and its numbers can be used.
    """
    inner = {
        side: resolved(materials[item], f"materials.{item}", materials, resolve)
        if isinstance(item, str)
        else resolved(item, f"{name}.{side}", materials, resolve)
        for side, item in inner_of(material).items()
    }
    # A blend takes the models of its inner materials in place of their names.
    inner_models = {side: resolved_inner.model for side, resolved_inner in inner.items()}
    model, model_values = model_and_values(material.kind, {**material.values, **inner_models})

    def opened(key: str, value: Any) -> Any:
        """Return a value of the model, with a node in place of a texture; opacity and emission are not filtered."""
        if resolve is None or not isinstance(value, TextureInput):
            return value
        node = resolve(value, f"{name}.{key}")
        return node.unfiltered() if key in POINTS else node

    def common(key: str) -> Any:
        """Return the value of a parameter that all materials have."""
        return opened(key, material[key])

    return ResolvedMaterial(
        model=model,
        name=name,
        values={key: opened(key, value) for key, value in model_values.items()},
        two_sided=common("two_sided"),
        opacity=common("opacity"),
        alpha_cutoff=common("alpha_cutoff"),
        emission=common("emission"),
        emission_strength=common("emission_strength"),
        normal_map=common("normal_map"),
        normal_strength=common("normal_strength"),
        bump_map=common("bump_map"),
        inner=tuple(inner.values()),
    )


def declare(material: ResolvedMaterial, parameters: Parameters) -> None:
    """Add a material's numbers and colours to the parameters; those of its textures were added when they were opened."""
    specs = parameters_of(material.model)
    for key, value in material.own_values().items():
        if isinstance(value, float | tuple):
            parameters.declare(f"{material.name}.{key}", value, specs[key])
    for inner in material.inner:
        declare(inner, parameters)
