"""Accept texels as ``params`` where a material has a number or a colour: build and cache a scene with a texture there.

A request of a render calls :func:`with_texel_params` when it is made, and :func:`update_texels` before each use. *Texels*
are a floating tensor ``(H, W, C)``. Everything else about the two scenes is the same; the one with textures is the *textured
scene* here.
"""

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


#: Most textured scenes that are cached for one scene: one for each choice of textured parameters and sizes in use.
MAX_TEXTURED_SCENES = 4


def with_texel_params(scene: Scene, params: Mapping[str, Tensor] | None) -> Scene:
    """Return the scene itself, or, where texels are given for numbers or colours of materials, one with textures there.

    The second shares parameters, meshes and images with the first, but not search structures.

    Args:
        scene: the scene as loaded.
        params: tensors in place of the scene's.

    Raises:
        SceneError: texels for a parameter that takes no texture, out of range, or on a mesh without uvs.
        NotBuiltError: texels for a parameter that the BSDF tabulates.
    """
    with outside_transforms():
        texels = _texels(scene, params or {})
        return _textured_scene(scene, texels) if texels else scene


def update_texels(textured: Scene, scene: Scene, params: Mapping[str, Tensor]) -> None:
    """Put a render's tensors into the scene that :func:`with_texel_params` returned, which other renders may share.

    Args:
        textured: the scene with texels, or the scene itself.
        scene: the scene as loaded.
        params: the render's tensors.
    """
    if textured is not scene:
        with outside_transforms():
            _copy_params(textured, scene, _texels(scene, params))


def _texels(scene: Scene, params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the detached texels given for parameters that were loaded as numbers or colours."""
    loaded = scene.built.parameters
    return {
        name: _detached(value, loaded[name])
        for name, value in {**scene.raw_params, **params}.items()
        if name in loaded and _is_texels(value, loaded[name].ndim)
    }


def _textured_scene(scene: Scene, texels: Mapping[str, Tensor]) -> Scene:
    """Return the cached scene with textures in place of the parameters that ``texels`` names, or build it."""
    # Keyed by size too: threads that render with texels of different sizes must not share a scene.
    key = tuple(sorted((name, tuple(value.shape)) for name, value in texels.items()))
    textured = scene.textured.get(key)
    if textured is None:
        textured = copy.copy(scene)
        textured.replace_build(_build_with_texels(scene, texels))
        # Dicts keep the order of insertion: the first entries are the oldest.
        for oldest in list(scene.textured)[: max(0, len(scene.textured) + 1 - MAX_TEXTURED_SCENES)]:
            scene.textured.pop(oldest, None)
        scene.textured[key] = textured
    _copy_params(textured, scene, texels)
    return textured


def _copy_params(textured: Scene, scene: Scene, texels: Mapping[str, Tensor]) -> None:
    """Copy a scene's tensors, with texels in place of some, to the scene with textures."""
    for name, value in scene.params.items():
        new = texels.get(name, value)
        # The tensor stays where it is the same memory, so that it does not count as changed.
        if name not in texels or not _same_memory(textured.params[name], new):
            textured.params[name] = new
    textured.mark_checked(scene)  # tensors that `scene` has checked for their ranges are not checked again


def _same_memory(one: Tensor, other: Tensor) -> bool:
    """Return True where two tensors are the same memory; one may be detached."""
    layout = one.dtype, one.shape, one.stride()
    return one.data_ptr() == other.data_ptr() and layout == (other.dtype, other.shape, other.stride())


def _is_texels(value: object, dimensions: int) -> bool:
    """Return True for texels given for a parameter of fewer than two dimensions: a number or a colour."""
    if not isinstance(value, Tensor) or value.layout is not torch.strided:
        return False
    return dimensions < 2 and value.dim() == 3 and value.is_floating_point()


def _detached(value: Tensor, loaded: np.ndarray) -> Tensor:
    """Return detached texels; under transforms of ``torch.func``, which hide values, texels of the mean of what was loaded."""
    if is_transformed(value):
        return torch.full(value.shape, float(loaded.mean()), dtype=value.dtype, device=value.device)
    return value.detach()


def _build_with_texels(scene: Scene, texels: Mapping[str, Tensor]) -> SceneBuild:
    """Return the scene's build with texture nodes in place of numbers."""
    before, file = scene.built, scene.description.file
    parameters = Parameters()
    parameters |= before.parameters
    parameters.specs |= before.parameters.specs
    # Names of parameters whose texels are tensors of the scene, not of image files.
    parameters.texels_in_scene |= before.parameters.texels_in_scene | texels.keys()
    texture_loader = TextureLoader({}, scene.description, parameters)
    materials = {
        material.name: material for owner in (*before.parts, *before.copies) for material in owner.material.with_inner()
    }
    nodes: dict[str, dict[str, Node]] = {}  # texture nodes by name of the material and of the parameter
    for name, value in texels.items():
        stem, _, slot = name.rpartition(".")
        material, spec = materials.get(stem), before.parameters.specs[name]
        if material is None or slot not in material.values or not spec.texture:
            expected = f"a floating tensor of shape {before.parameters[name].shape}, not texels"
            raise SceneError(f"params.{name}", f"shape {tuple(value.shape)}", expected)
        if slot in material.model.tabulated:  # the model computes tables from its number
            expected = f"a number, as {material.model.name} tabulates what depends on it"
            raise NotBuiltError(f"params.{name}", "a texture", expected)
        # `sheer`: rays pass the model as if it were not there.
        if slot == "weight" and any(inner.model.sheer or inner.opacity != 1.0 for inner in material.inner):
            raise NotBuiltError(f"params.{name}", "a texture", "a number where light passes one of the two by chance")
        del parameters[name], parameters.specs[name]  # the texture declares texels of the same name
        array = value.to("cpu", torch.float32).numpy()
        try:
            texture = texture_of({"type": "image", "data": array}, spec)
        except Refused as error:
            raise SceneError(f"params.{name}", error.value, error.expected) from None
        nodes.setdefault(stem, {})[slot] = texture_loader(texture, name)
    parts = tuple(replace(part, material=_material_with_nodes(part.material, nodes)) for part in before.parts)
    copies = tuple(replace(copied, material=_material_with_nodes(copied.material, nodes)) for copied in before.copies)
    check_coordinates([*parts], texels, file)
    return replace(before, parts=parts, copies=copies, parameters=parameters)


def _material_with_nodes(material: ResolvedMaterial, nodes: Mapping[str, Mapping[str, Node]]) -> ResolvedMaterial:
    """Return a material with the texture nodes of its name, by slot; also inside blends."""
    inner = tuple(_material_with_nodes(one, nodes) for one in material.inner)
    return replace(material, values={**material.values, **nodes.get(material.name, {})}, inner=inner)
