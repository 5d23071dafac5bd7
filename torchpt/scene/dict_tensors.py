"""Connect tensors in a scene dict to the scene's parameters, so that gradients flow from one to the other.

:func:`torchpt.load` calls :func:`params_from_tensors` once the scene is built from plain numbers. A *key* is the path of a
tensor in the nested dict, as a tuple of names and list indices: ``("materials", "red", "reflectance")``.

A tensor that has the dtype, shape and device of its parameter becomes the parameter itself. Other parameters are computed
from the tensors by torch; they keep the values that were read, so only their gradients come from the tensors.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.transforms import tensor_of
from torchpt.physics.cameras.opencv import DEFAULTS, numbers_of_k, parameters_of_k
from torchpt.physics.cameras.poses import POSES, posed
from torchpt.physics.shapes.base import Place, Size
from torchpt.scene.build import SceneBuild
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.tensors import DictTensors, Key
from torchpt.spec import parameters_of
from torchpt.spec.reading import transform
from torchpt.spec.schema import ParsedParams

__all__ = ["params_from_tensors", "vertex_attributes_in", "with_all_intrinsics"]

_EXPECTED = (
    "numbers without gradients (detach() them): no parameter of the scene is made of them, or none with the value that they "
    "have; scene.params lists what is differentiable"
)

#: Arrays of a mesh that are parameters only where they require gradients.
_VERTEX_ATTRIBUTES = ("normals", "uvs")

Params = Mapping[str, Tensor]


def with_all_intrinsics(description: Description, tensors: DictTensors) -> Description:
    """Return the description with all parameters of ``K`` where it is a tensor, also those that have their usual values."""
    camera = description.camera
    if not any(key[0] == "K" for key in tensors.under("camera")):
        return description
    # `parameters_of_k` leaves out the parameters that `K` gives their default values, which are None then and no parameters.
    values = {**camera.values, **parameters_of_k(camera["K"], camera["size"])}
    values |= {key: default for key, default in DEFAULTS.items() if values[key] is None}
    return replace(description, camera=ParsedParams(camera.kind, values, camera.given))


def vertex_attributes_in(tensors: DictTensors) -> set[str]:
    """Return the dotted names of meshes' normals and texture coordinates that require gradients."""
    return {
        _dotted(("shapes", *key[:2]))
        for key in tensors.under("shapes")
        if len(key) > 1 and key[1] in _VERTEX_ATTRIBUTES
    }


def params_from_tensors(
    tensors: DictTensors, description: Description, built: SceneBuild, params: Params
) -> dict[str, Tensor]:
    """Return the parameters that depend on tensors of the dict, by name, attached to their autograd graph.

    Args:
        tensors: the dict and its tensors.
        description: the description read from it.
        built: the build of the description.
        params: the scene's parameters as read.

    Raises:
        SceneError: a tensor that requires gradients where no parameter depends on it.
    """
    device = next(iter(params.values())).device
    scene = _BuiltDict(tensors=tensors, description=description, built=built, params=params, device=device)
    found: dict[str, Tensor] = {}
    for key in dict.fromkeys(map(_up_to_index, tensors.keys)):  # once for a list with several tensors
        dependent = dict(_dependent_params(key, scene))
        if not dependent and not _is_unused_texture(key, params):
            raise SceneError(_dotted(key), "a tensor that requires gradients", _EXPECTED, description.file)
        found |= dependent
    return {name: _cast_like(value, params[name]) for name, value in found.items()}


@dataclass(frozen=True)
class _BuiltDict:
    """The dict with its tensors, and the scene built from it."""

    tensors: DictTensors
    description: Description
    built: SceneBuild
    params: Params
    device: torch.device

    def at(self, key: Key) -> Tensor:
        """Return the value at a key of the dict as a tensor."""
        written = self.tensors.at(key)
        return written if isinstance(written, Tensor) else tensor_of(written, self.device)


def _up_to_index(key: Key) -> Key:
    """Return a key up to its first list index."""
    return next((key[:n] for n, part in enumerate(key) if isinstance(part, int)), key)


def _dotted(key: Key) -> str:
    return ".".join(map(str, key))


def _is_unused_texture(key: Key, params: Params) -> bool:
    """Return True for a key of a texture that no material uses."""
    return key[0] == "textures" and not any(re.match(rf"textures\.{re.escape(str(key[1]))}(\.|$)", n) for n in params)


def _cast_like(value: Tensor, own: Tensor) -> Tensor:
    """Return a parameter computed from tensors, with dtype, device, shape and value of the one that was read."""
    if value.dtype == own.dtype and value.device == own.device and value.shape == own.shape:
        return value
    value = value.to(own.device, torch.promote_types(value.dtype, own.dtype))
    if value.dim() == 2 and own.dim() == 3:  # grey
        value = value[..., None]
    if value.dim() == 3 and value.shape[2] != own.shape[2]:  # texels of a light: drop alpha, repeat grey
        value = value[..., :3] if value.shape[2] > 3 else value[..., :1]
    # Keep the bits of the value that was read: it was rounded differently.
    return own + (value - value.detach()).to(own.dtype).expand_as(own)


def _dependent_params(key: Key, scene: _BuiltDict) -> Iterator[tuple[str, Tensor]]:
    """Yield the parameters that depend on the value at a key, by name.

    A key leads to the block, in most blocks to the name of an entry, and to its parameter: ``("lights", "sun", "radiance")``.
    """
    block = key[0]
    if block == "camera" and len(key) > 1:
        yield from _camera_params(str(key[1]), scene)
    elif block == "shapes" and len(key) > 2:
        yield from _shape_params(str(key[1]), key, scene)
    elif block == "lights" and len(key) > 2 and key[2] == "transform":
        yield f"lights.{key[1]}.to_world", transform(scene.tensors.at(key), scene.device)
    elif block == "lights" and len(key) > 2:
        name = _dotted(key)
        yield from _param_named(key, f"{name.removesuffix('.data')}.texels" if key[2] == "data" else name, scene)
        yield from _params_from_defaults(str(key[1]), scene)
    elif block in ("materials", "textures"):
        yield from _param_named(key, _dotted(key), scene)


def _param_named(key: Key, name: str, scene: _BuiltDict) -> Iterator[tuple[str, Tensor]]:
    """Yield the parameter of a name, or that of the texture whose ``data`` has the name."""
    for candidate in (name, name.removesuffix(".data")):
        if candidate in scene.params:
            yield candidate, scene.at(key)
            return


def _camera_params(name: str, scene: _BuiltDict) -> Iterator[tuple[str, Tensor]]:
    """Yield the parameters that depend on the camera's key ``name``."""
    camera = scene.description.camera
    specs = parameters_of(camera.kind)
    if name in POSES:
        yield "camera.to_world", posed(scene.tensors.raw["camera"], scene.device)
    elif name == "K":
        intrinsics = tensor_of(scene.tensors.at(("camera", "K")), scene.device)
        yield from (
            (f"camera.{parameter}", value) for parameter, value in numbers_of_k(intrinsics, camera["size"]).items()
        )
    elif name in specs and specs[name].differentiable:
        yield f"camera.{name}", scene.at(("camera", name))


def _shape_params(name: str, key: Key, scene: _BuiltDict) -> Iterator[tuple[str, Tensor]]:
    """Yield the parameters that depend on a key of the shape ``name``; a shape of several parts has several poses."""
    shape, part, stem = scene.description.shapes[name], str(key[2]), f"shapes.{name}"
    owners = [owner for owner in (*scene.built.parts, *scene.built.copies) if owner.shape == name]
    if part == "transform" or isinstance(parameters_of(shape.kind).get(part), Size | Place):
        pose = _pose_of(name, shape, scene)
        yield from ((f"{owner.name}.to_world", pose) for owner in owners)
        yield from _file_light_params(stem, pose, scene)
    elif part == "material":
        parameter = _dotted(key[3:])
        for material in dict.fromkeys(owner.material.name for owner in owners):
            yield from _param_named(key, f"{material}.{parameter}", scene)
    elif part in ("vertices", "colors", *_VERTEX_ATTRIBUTES) and shape["displacement"] is None:
        yield f"{stem}.{part}", scene.at(key)
    elif part == "emission":
        yield from _param_named(key, _dotted(key), scene)


def _pose_of(name: str, shape: ParsedParams, scene: _BuiltDict) -> Tensor:
    """Return a shape's pose: its own size and position, then its transform."""
    written, device = scene.tensors.raw["shapes"][name], scene.device
    operations, specs = written.get("transform"), parameters_of(shape.kind)
    pose = transform([] if operations is None else operations, device)
    sizes = {key: tensor_of(shape[key], device) for key, spec in specs.items() if isinstance(spec, Size | Place)}
    sizes |= {key: tensor_of(written[key], device) for key in sizes if written.get(key) is not None}
    return pose @ shape.kind.own({**shape.values, **sizes}) if sizes else pose


def _file_light_params(stem: str, pose: Tensor, scene: _BuiltDict) -> Iterator[tuple[str, Tensor]]:
    """Yield positions and directions of a mesh file's lights, which move with the mesh."""
    motion = pose @ torch.linalg.inv(pose.detach())  # the identity, with the derivative of the pose
    for source in scene.built.sources:
        if not source.name.startswith(f"{stem}.lights."):
            continue
        for key in ("position", "target", "direction"):
            name = f"{source.name}.{key}"
            if name in scene.params:
                value = scene.params[name].double()
                yield name, motion[:3, :3] @ value + (0.0 if key == "direction" else motion[:3, 3])


def _params_from_defaults(name: str, scene: _BuiltDict) -> Iterator[tuple[str, Tensor]]:
    """Yield parameters of a light whose defaults are functions of other parameters."""
    light, written = scene.description.lights[name], scene.tensors.raw["lights"][name]
    numbers = {key: value.to(scene.device) for key, value in written.items() if isinstance(value, Tensor)}
    for key, spec in parameters_of(light.kind).items():
        if callable(spec.default) and key not in light.given and f"lights.{name}.{key}" in scene.params:
            value = spec.default({**light.values, **numbers})
            if isinstance(value, Tensor) and value.requires_grad:
                yield f"lights.{name}.{key}", value
