"""Tensors of a dict as the scene's parameters: what is made of them is made again by torch, so that gradients reach them.

A parameter that a tensor is, to the type, shape and device, *is* that tensor; any other is made of what was written, with the
value that was read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.transforms import tensor_of
from torchpt.physics.cameras.opencv import USUAL, angles, numbers_of
from torchpt.physics.cameras.poses import POSES, posed
from torchpt.physics.shapes.base import Place, Size
from torchpt.scene.build import SceneBuild
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.tensors import DictTensors, Key
from torchpt.spec import parameters_of
from torchpt.spec.reading import transform
from torchpt.spec.schema import ParsedParams

__all__ = ["traced", "vertex_attributes_in", "with_all_intrinsics"]

_EXPECTED = (
    "numbers without gradients (detach() them): no parameter of the scene is made of them, or none with the value that they "
    "have; scene.params lists what is differentiable"
)

#: Of a mesh, what is a parameter only where its gradients are wanted.
_CORNERS = ("normals", "uvs")

Params = Mapping[str, Tensor]


def with_all_intrinsics(description: Description, tensors: DictTensors) -> Description:
    """The description with all that tensors may change: a ``K`` in the middle of its picture may be moved from there."""
    camera = description.camera
    if not any(key[0] == "K" for key in tensors.under("camera")):
        return description
    values = {**camera.values, **angles(camera["K"], camera["size"])}
    values |= {key: usual for key, usual in USUAL.items() if values[key] is None}
    return replace(description, camera=ParsedParams(camera.kind, values, camera.given))


def vertex_attributes_in(tensors: DictTensors) -> set[str]:
    """Names of meshes' normals and texture coordinates whose gradients are wanted: parameters of no other scene."""
    return {_dotted(("shapes", *key[:2])) for key in tensors.under("shapes") if len(key) > 1 and key[1] in _CORNERS}


def traced(tensors: DictTensors, description: Description, built: SceneBuild, params: Params) -> dict[str, Tensor]:
    """The parameters that tensors of the dict give, by name, on their tape.

    Args:
        tensors: what was written.
        description: what it was read as.
        built: what that came to.
        params: the parameters as they were read.

    Raises:
        SceneError: a tensor that requires gradients where nothing is differentiable.
    """
    read = _Reading(tensors, description, built, params, next(iter(params.values())).device)
    found: dict[str, Tensor] = {}
    for key in dict.fromkeys(map(_whole, tensors.keys)):
        made = dict(_made(key, read))
        if not made and not _unread(key, params):
            raise SceneError(_dotted(key), "a tensor that requires gradients", _EXPECTED, description.file)
        found |= made
    return {name: _fitting(value, params[name]) for name, value in found.items()}


@dataclass(frozen=True)
class _Reading:
    """What was written, and what it came to."""

    tensors: DictTensors
    description: Description
    built: SceneBuild
    params: Params
    device: torch.device

    def at(self, key: Key) -> Tensor:
        """What stands at a key: a tensor itself, anything else as one."""
        written = self.tensors.at(key)
        return written if isinstance(written, Tensor) else tensor_of(written, self.device)


def _whole(key: Key) -> Key:
    """The key of what a number, a row or a step of a list belongs to."""
    return next((key[:n] for n, part in enumerate(key) if isinstance(part, int)), key)


def _dotted(key: Key) -> str:
    return ".".join(map(str, key))


def _unread(key: Key, params: Params) -> bool:
    """Whether a key is of a texture that nothing in the scene reads."""
    return key[0] == "textures" and not any(re.match(rf"textures\.{re.escape(str(key[1]))}(\.|$)", n) for n in params)


def _fitting(value: Tensor, own: Tensor) -> Tensor:
    """A parameter made of tensors, in place of the one that was read."""
    if value.dtype == own.dtype and value.device == own.device and value.shape == own.shape:
        return value
    value = value.to(own.device, torch.promote_types(value.dtype, own.dtype))
    if value.dim() == 2 and own.dim() == 3:  # grey
        value = value[..., None]
    if value.dim() == 3 and value.shape[2] != own.shape[2]:  # a light's: no alpha, and grey in all channels
        value = value[..., :3] if value.shape[2] > 3 else value[..., :1]
    # Not a bit but what was read: rounding here is not rounding there.
    return own + (value - value.detach()).to(own.dtype).expand_as(own)


def _made(key: Key, read: _Reading) -> Iterator[tuple[str, Tensor]]:
    """Parameters that what stands at a key goes into, made of all that they are made of."""
    block = key[0]
    if block == "camera" and len(key) > 1:
        yield from _camera(str(key[1]), read)
    elif block == "shapes" and len(key) > 2:
        yield from _shape(str(key[1]), key, read)
    elif block == "lights" and len(key) > 2 and key[2] == "transform":
        yield f"lights.{key[1]}.to_world", transform(read.tensors.at(key), read.device)
    elif block == "lights" and len(key) > 2:
        name = _dotted(key)
        yield from _named(key, f"{name.removesuffix('.data')}.texels" if key[2] == "data" else name, read)
        yield from _following(str(key[1]), read)
    elif block in ("materials", "textures"):
        yield from _named(key, _dotted(key), read)


def _named(key: Key, name: str, read: _Reading) -> Iterator[tuple[str, Tensor]]:
    """The parameter of a name, or that of the texture whose ``data`` has it."""
    for candidate in (name, name.removesuffix(".data")):
        if candidate in read.params:
            yield candidate, read.at(key)
            return


def _camera(name: str, read: _Reading) -> Iterator[tuple[str, Tensor]]:
    camera = read.description.camera
    specs = parameters_of(camera.kind)
    if name in POSES:
        yield "camera.to_world", posed(read.tensors.raw["camera"], read.device)
    elif name == "K":
        inner = tensor_of(read.tensors.at(("camera", "K")), read.device)
        yield from ((f"camera.{number}", value) for number, value in numbers_of(inner, camera["size"]).items())
    elif name in specs and specs[name].traced:
        yield f"camera.{name}", read.at(("camera", name))


def _shape(name: str, key: Key, read: _Reading) -> Iterator[tuple[str, Tensor]]:
    shape, part, stem = read.description.shapes[name], str(key[2]), f"shapes.{name}"
    owners = [owner for owner in (*read.built.parts, *read.built.copies) if owner.shape == name]
    if part == "transform" or isinstance(parameters_of(shape.kind).get(part), Size | Place):
        pose = _pose_of(name, shape, read)
        yield from ((f"{owner.name}.to_world", pose) for owner in owners)
        yield from _lights_of_file(stem, pose, read)
    elif part == "material":
        rest = _dotted(key[3:])
        for own in dict.fromkeys(owner.material.name for owner in owners):
            yield from _named(key, f"{own}.{rest}", read)
    elif part in ("vertices", *_CORNERS) and shape["displacement"] is None:
        yield f"{stem}.{part}", read.at(key)
    elif part == "emission":
        yield from _named(key, _dotted(key), read)


def _pose_of(name: str, shape: ParsedParams, read: _Reading) -> Tensor:
    """A shape's pose: its own size and place, then its transform."""
    written, device = read.tensors.raw["shapes"][name], read.device
    operations, specs = written.get("transform"), parameters_of(shape.kind)
    pose = transform([] if operations is None else operations, device)
    sizes = {key: tensor_of(shape[key], device) for key, spec in specs.items() if isinstance(spec, Size | Place)}
    sizes |= {key: tensor_of(written[key], device) for key in sizes if written.get(key) is not None}
    return pose @ shape.kind.own({**shape.values, **sizes}) if sizes else pose


def _lights_of_file(stem: str, pose: Tensor, read: _Reading) -> Iterator[tuple[str, Tensor]]:
    """What a mesh file's lights have of places, carried along with the mesh."""
    way = pose @ torch.linalg.inv(pose.detach())  # one now, and the way from here where the mesh moves
    for source in read.built.sources:
        if not source.name.startswith(f"{stem}.lights."):
            continue
        for key in ("position", "target", "direction"):
            name = f"{source.name}.{key}"
            if name in read.params:
                value = read.params[name].double()
                yield name, way[:3, :3] @ value + (0.0 if key == "direction" else way[:3, 3])


def _following(name: str, read: _Reading) -> Iterator[tuple[str, Tensor]]:
    """Parameters of a light that follow from others where nobody says them."""
    light, written = read.description.lights[name], read.tensors.raw["lights"][name]
    numbers = {key: value.to(read.device) for key, value in written.items() if isinstance(value, Tensor)}
    for key, spec in parameters_of(light.kind).items():
        if callable(spec.default) and key not in light.given and f"lights.{name}.{key}" in read.params:
            value = spec.default({**light.values, **numbers})
            if isinstance(value, Tensor) and value.requires_grad:
                yield f"lights.{name}.{key}", value
