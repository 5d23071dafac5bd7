"""Materials resolved: textures opened, blends of models, and their numbers among the scene's parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from torchpt.bsdfs.base import made
from torchpt.bsdfs.resolved import ResolvedMaterial
from torchpt.format.materials import POINTS, inner_of
from torchpt.format.textures import TextureInput
from torchpt.scene.parameters import Parameters
from torchpt.spec import Color, Scalar, Spec, Texels, parameters_of
from torchpt.spec.declared import Described
from torchpt.spec.reading import LARGEST
from torchpt.textures import Node, Reading

__all__ = ["declare", "resolved"]

#: What makes the texture of a slot, by its dotted key, one that can be read.
Resolve = Callable[[TextureInput, str], Reading]


def resolved(
    material: Described, name: str, materials: Mapping[str, Described], resolve: Resolve | None = None
) -> ResolvedMaterial:
    """What a material comes to: a model and what it is given.

    Args:
        material: the material.
        name: its dotted name, e.g. ``materials.red``.
        materials: all materials by name, for blends.
        resolve: opens textures; without it only the model and the numbers can be asked for.
    """
    inner = {
        side: resolved(materials[item], f"materials.{item}", materials, resolve)
        if isinstance(item, str)
        else resolved(item, f"{name}.{side}", materials, resolve)
        for side, item in inner_of(material).items()
    }
    model, given = made(material.kind, {**material.values, **{side: slot.model for side, slot in inner.items()}})

    def opened(key: str, value: Any) -> Any:
        if resolve is None or not isinstance(value, TextureInput):
            return value
        reading = resolve(value, f"{name}.{key}")
        return replace(reading, filtered=False) if key in POINTS and isinstance(reading, Node) else reading

    def common(key: str) -> Any:
        return opened(key, material[key])

    return ResolvedMaterial(
        model=model,
        name=name,
        values={key: opened(key, value) for key, value in given.items()},
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
    """Add a material's numbers to the parameters, and what its slots accept to the texels that they read."""
    specs = parameters_of(material.model)
    for key, value in material.own().items():
        if isinstance(value, float | tuple):
            parameters.declare(f"{material.name}.{key}", value, specs[key])
        elif isinstance(value, Node):
            _declare_texels(value, specs[key], parameters)
    for inner in material.inner:
        declare(inner, parameters)


def _declare_texels(node: Node, slot: Spec, parameters: Parameters) -> None:
    """What a slot accepts of the texels that give it, which other slots may read as well."""
    assert isinstance(slot, Scalar | Color)
    low, high = slot.bounds
    texels = node.texels
    for name in [texels] if texels in parameters else [key for key in parameters if key.startswith(f"{texels}.")]:
        spec = parameters.specs.get(name, Texels(low=None))
        if isinstance(spec, Texels | Color):
            for factor in set(node.scale) - {0.0}:
                ends = sorted((low / factor, high / factor))
                least, most = max(ends[0], spec.bounds[0]), min(ends[1], spec.bounds[1])
                spec = replace(spec, low=least if least > -LARGEST else None, high=most if most < LARGEST else None)
            parameters.specs[name] = spec
