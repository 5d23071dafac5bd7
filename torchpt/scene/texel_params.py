"""Texels where a scene has a number or a colour: the scene with a texture in that place, made once and kept beside it."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed, outside_transforms
from torchpt.core.errors import NotBuiltError, SceneError
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.parts import Parameters
from torchpt.physics.textures import Node
from torchpt.scene.build import SceneBuild
from torchpt.scene.formats.textures import texture_of
from torchpt.scene.scene import Scene
from torchpt.scene.sources import check_coordinates
from torchpt.scene.texture_loader import TextureLoader
from torchpt.spec import Refused

__all__ = ["update_texels", "with_texel_params"]


#: Scenes with texels that are kept beside one, the latest.
KEPT = 4


def with_texel_params(scene: Scene, params: Mapping[str, Tensor] | None) -> Scene:
    """The scene itself, or where texels are given for numbers and colours of its materials one that reads them there.

    The second one shares the tensors, meshes and pictures of the first; its search structures are its own.

    Args:
        scene: as it was loaded.
        params: tensors in place of its own.

    Raises:
        SceneError: texels where the scene's materials cannot read any, that are out of range, or on a mesh without uvs.
        NotBuiltError: texels for what a material tabulates.
    """
    with outside_transforms():
        texels = _texels(scene, params or {})
        return _reading(scene, texels) if texels else scene


def update_texels(made: Scene, scene: Scene, params: Mapping[str, Tensor]) -> None:
    """Bring what :func:`with_texel_params` made of a scene up to date, as other renders may have put their texels in since.

    Args:
        made: it, or the scene itself where no texels were given.
        scene: as it was loaded.
        params: of the render.
    """
    if made is not scene:
        with outside_transforms():
            _copy_params(made, scene, _texels(scene, params))


def _texels(scene: Scene, params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Texels that stand where a scene was loaded with numbers, apart from their tape."""
    loaded = scene.built.parameters
    return {
        name: _plain(value, loaded[name])
        for name, value in {**scene.params, **params}.items()
        if name in loaded and _is_texels(value, loaded[name].ndim)
    }


def _reading(scene: Scene, texels: Mapping[str, Tensor]) -> Scene:
    # By size, so that threads that render with different ones at a time do not share a scene.
    key = tuple(sorted((name, tuple(value.shape)) for name, value in texels.items()))
    made = scene.textured.get(key)
    if made is None:
        made = copy.copy(scene)
        made.replace_build(_built(scene, texels))
        for oldest in list(scene.textured)[: max(0, len(scene.textured) + 1 - KEPT)]:
            scene.textured.pop(oldest, None)
        scene.textured[key] = made
    _copy_params(made, scene, texels)
    return made


def _copy_params(made: Scene, scene: Scene, texels: Mapping[str, Tensor]) -> None:
    """Put the tensors of a scene, and texels in place of some, into the one that reads texels."""
    for name, value in scene.params.items():
        new = texels.get(name, value)
        if name not in texels or not _same_memory(made.params[name], new):
            made.params[name] = new
    made.mark_checked(scene)


def _same_memory(one: Tensor, other: Tensor) -> bool:
    """Whether two tensors are one, of which one is apart from its tape maybe."""
    layout = one.dtype, one.shape, one.stride()
    return one.data_ptr() == other.data_ptr() and layout == (other.dtype, other.shape, other.stride())


def _is_texels(value: object, dimensions: int) -> bool:
    if not isinstance(value, Tensor) or value.layout is not torch.strided:
        return False
    return dimensions < 2 and value.dim() == 3 and value.is_floating_point()


def _plain(value: Tensor, loaded: np.ndarray) -> Tensor:
    """Texels apart from their tape; where transforms of ``torch.func`` hide them, others of their shape stand for them."""
    if is_transformed(value):
        return torch.full(value.shape, float(loaded.mean()), dtype=value.dtype, device=value.device)
    return value.detach()


def _built(scene: Scene, texels: Mapping[str, Tensor]) -> SceneBuild:
    """What the scene came to, with nodes in place of numbers."""
    before, file = scene.built, scene.description.file
    parameters = Parameters()
    parameters |= before.parameters
    parameters.specs |= before.parameters.specs
    parameters.stated |= before.parameters.stated | texels.keys()
    texture_loader = TextureLoader({}, scene.description.resolve, parameters, file)
    materials = {m.name: m for owner in (*before.parts, *before.copies) for m in owner.material.all()}
    nodes: dict[str, dict[str, Node]] = {}
    for name, value in texels.items():
        stem, _, slot = name.rpartition(".")
        material, spec = materials.get(stem), before.parameters.specs[name]
        if material is None or slot not in material.values or not spec.texture:
            expected = f"a floating tensor of shape {before.parameters[name].shape}, not texels"
            raise SceneError(f"params.{name}", f"shape {tuple(value.shape)}", expected)
        if slot in material.model.tabulated:
            expected = f"a number, as {material.model.name} tabulates what depends on it"
            raise NotBuiltError(f"params.{name}", "a texture", expected)
        if slot == "weight" and any(inner.model.sheer or inner.opacity != 1.0 for inner in material.inner):
            raise NotBuiltError(f"params.{name}", "a texture", "a number where light passes one of the two by chance")
        del parameters[name], parameters.specs[name]
        array = value.to("cpu", torch.float32).numpy()
        try:
            texture = texture_of({"type": "image", "data": array}, spec)
        except Refused as error:
            raise SceneError(f"params.{name}", error.value, error.expected) from None
        nodes.setdefault(stem, {})[slot] = texture_loader(texture, name)
    parts = tuple(replace(part, material=_material(part.material, nodes)) for part in before.parts)
    copies = tuple(replace(copied, material=_material(copied.material, nodes)) for copied in before.copies)
    check_coordinates([*parts], texels, file)
    return replace(before, parts=parts, copies=copies, parameters=parameters)


def _material(material: ResolvedMaterial, nodes: Mapping[str, Mapping[str, Node]]) -> ResolvedMaterial:
    """A material that reads nodes, by its name and their slots; so do those that it blends."""
    inner = tuple(_material(one, nodes) for one in material.inner)
    return replace(material, values={**material.values, **nodes.get(material.name, {})}, inner=inner)
