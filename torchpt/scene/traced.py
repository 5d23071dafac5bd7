"""Tensors of a dict as the scene's parameters: what is made of them is made again by torch, so that gradients reach them.

A parameter that a tensor is, to the type, shape and device, *is* that tensor; any other is made of what was written, with the
value that was read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchpt.cameras.opencv import angles
from torchpt.cameras.traced import angles_of, pose_of
from torchpt.errors import SceneError
from torchpt.format.description import Description
from torchpt.format.tensors import Key, Tensors
from torchpt.math.tensor_transforms import compose, tensor_of
from torchpt.shapes.base import Place, Size
from torchpt.spec import parameters_of
from torchpt.spec.declared import Described

__all__ = ["corners_in", "traced", "widened"]

_POSES = ("origin", "target", "up", "to_world", "R", "t")
#: A number of a pinhole that ``K`` says is left out where it is this one.
_PLAIN = {"principal_point_offset_x": 0.0, "principal_point_offset_y": 0.0, "pixel_aspect": 1.0}
_EXPECTED = (
    "numbers without gradients (detach() them): no parameter of the scene is made of them, or none with the value that they "
    "have; scene.params lists what is differentiable"
)

#: Of a mesh, what is a parameter only where its gradients are wanted.
_CORNERS = ("normals", "uvs")

Params = Mapping[str, Tensor]


def widened(description: Description, tensors: Tensors) -> Description:
    """The description with all that tensors may change: a ``K`` in the middle of its picture may be moved from there."""
    camera = description.camera
    if not any(key[0] == "K" for key in tensors.under("camera")):
        return description
    values = {**camera.values, **angles(camera["K"], camera["size"])}
    values |= {key: plain for key, plain in _PLAIN.items() if values[key] is None}
    return replace(description, camera=Described(camera.kind, values, camera.given))


def corners_in(tensors: Tensors) -> set[str]:
    """Names of meshes' normals and texture coordinates whose gradients are wanted: parameters of no other scene."""
    return {_dotted(("shapes", *key[:2])) for key in tensors.under("shapes") if len(key) > 1 and key[1] in _CORNERS}


def traced(tensors: Tensors, description: Description, params: Params) -> dict[str, Tensor]:
    """The parameters that tensors of the dict give, by name, on their tape.

    Args:
        tensors: what was written.
        description: what it was read as.
        params: of the scene made of that.

    Raises:
        SceneError: a tensor that requires gradients where nothing is differentiable.
    """
    device = next(iter(params.values())).device
    found: dict[str, Tensor] = {}
    for key in tensors.keys:
        made = dict(_made(key, tensors, description, params, device)) if not found.keys() >= {_dotted(key)} else None
        if made == {} and not _unread(key, description, params):
            raise SceneError(_dotted(key), "a tensor that requires gradients", _EXPECTED, description.file)
        found |= made or {}
    return {name: _fitting(value, params[name]) for name, value in found.items()}


def _dotted(key: Key) -> str:
    return ".".join(map(str, key))


def _unread(key: Key, description: Description, params: Params) -> bool:
    """Whether a key is of a texture that nothing in the scene reads."""
    return key[0] == "textures" and not any(re.match(rf"textures\.{re.escape(str(key[1]))}(\.|$)", n) for n in params)


def _fitting(value: Tensor, own: Tensor) -> Tensor:
    """A parameter made of tensors, in place of the one that was read."""
    if value.dtype == own.dtype and value.device == own.device and value.shape == own.shape:
        return value
    value = value.to(own.device, torch.promote_types(value.dtype, own.dtype))
    if value.dim() == own.dim() == 3 and value.shape[2] > own.shape[2]:  # alpha, of which no light has any
        value = value[..., : own.shape[2]]
    if value.dim() == 2 and own.dim() == 3:  # grey
        value = value[..., None]
    # Not a bit but what was read: rounding here is not rounding there.
    return own + (value - value.detach()).to(own.dtype).expand_as(own)


def _made(
    key: Key, tensors: Tensors, description: Description, params: Params, device: torch.device
) -> Iterator[tuple[str, Tensor]]:
    """Parameters that what stands at a key goes into, made of all that they are made of."""
    block = key[0]
    if block == "camera":
        yield from _camera(key, tensors, description, device)
    elif block == "shapes" and len(key) > 2:
        yield from _shape(str(key[1]), key, tensors, description, params, device)
    elif block == "lights" and len(key) > 2 and key[2] == "transform":
        yield f"lights.{key[1]}.to_world", compose(tensors.at(key[:3]), device)
    elif block == "lights" and len(key) > 2:
        yield from _named(key, tensors, params, lambda name: re.sub(r"\.data$", ".texels", name))
        yield from _following(key, tensors, description, params, device)
    elif block in ("materials", "textures"):
        yield from _named(key, tensors, params)


def _camera(key: Key, tensors: Tensors, description: Description, device: torch.device) -> Iterator[tuple[str, Tensor]]:
    camera, name = description.camera, str(key[1]) if len(key) > 1 else ""
    if name in _POSES:
        yield "camera.to_world", pose_of(tensors.raw["camera"], device)
    elif name == "K":
        for number, value in angles_of(tensor_of(tensors.at(("camera", "K")), device), camera["size"]).items():
            yield f"camera.{number}", value
    elif name in parameters_of(camera.kind) and parameters_of(camera.kind)[name].traced:
        yield f"camera.{name}", tensors.at(("camera", name))


def _shape(
    name: str, key: Key, tensors: Tensors, description: Description, params: Params, device: torch.device
) -> Iterator[tuple[str, Tensor]]:
    shape, part, stem = description.shapes[name], str(key[2]), f"shapes.{name}"
    spec = parameters_of(shape.kind).get(part)
    if part == "transform" or isinstance(spec, Size | Place):
        pose = _pose_of(name, shape, tensors, device)
        pieces = [n for n in params if n.startswith(f"{stem}.") and n.endswith(".to_world")]
        lights = [n for n in params if n.startswith(f"{stem}.lights.")]
        yield from ((piece, pose) for piece in pieces if piece not in lights)
        yield from _lights_of_file(lights, pose, params)
    elif part == "material":
        inner = _dotted(key[2:])
        pattern = re.compile(rf"{re.escape(stem)}(\.[^.]+)?\.material\.")
        stems = dict.fromkeys(found[0] for found in map(pattern.match, params) if found)
        for prefix in stems:
            yield from _named(key, tensors, params, lambda n, p=prefix: p + n.removeprefix(f"{stem}.material."))
        assert inner
    elif part in ("vertices", *_CORNERS) and shape["displacement"] is None:
        yield f"{stem}.{part}", _value(key[:3], tensors, device)
    elif part == "emission":
        yield from _named(key, tensors, params)


def _pose_of(name: str, shape: Described, tensors: Tensors, device: torch.device) -> Tensor:
    """A shape's pose: its own size and place, then its transform."""
    written = tensors.raw["shapes"][name]
    operations = written.get("transform")
    pose = torch.eye(4, dtype=torch.float64, device=device) if operations is None else compose(operations, device)
    specs = parameters_of(shape.kind)
    sizes = {key: tensor_of(shape[key], device) for key, spec in specs.items() if isinstance(spec, Size | Place)}
    sizes |= {key: tensor_of(written[key], device) for key in sizes if written.get(key) is not None}
    own = shape.kind.own({**shape.values, **sizes}) if sizes else None
    return pose if own is None else pose @ own


def _lights_of_file(names: list[str], pose: Tensor, params: Params) -> Iterator[tuple[str, Tensor]]:
    """What a mesh file's lights have of places, carried along with the mesh."""
    still = pose.detach()
    way = pose @ torch.linalg.inv(still)  # one now, and the way from here where the mesh moves
    for name in names:
        value = params[name].double()
        if name.endswith((".position", ".target")):
            yield name, way[:3, :3] @ value + way[:3, 3]
        elif name.endswith(".direction"):
            yield name, way[:3, :3] @ value


def _value(key: Key, tensors: Tensors, device: torch.device) -> Tensor:
    written = tensors.at(key)
    return written if isinstance(written, Tensor) else tensor_of(written, device)


def _named(
    key: Key, tensors: Tensors, params: Params, rename: Callable[[str], str] = lambda name: name
) -> Iterator[tuple[str, Tensor]]:
    """The parameter that has the key's own name, or that of the texture whose texels stand there."""
    whole = next((key[:n] for n in range(len(key)) if isinstance(key[n], int)), key)  # not a number of a list
    name = rename(_dotted(whole))
    for candidate in (name, name.removesuffix(".data")):
        if candidate in params:
            yield candidate, _value(whole, tensors, params[candidate].device)
            return


def _following(
    key: Key, tensors: Tensors, description: Description, params: Params, device: torch.device
) -> Iterator[tuple[str, Tensor]]:
    """Parameters of a light that follow from others where nobody says them."""
    light, stem = description.lights[str(key[1])], _dotted(key[:2])
    written = {k: v for k, v in tensors.raw["lights"][key[1]].items() if v is not None}
    for name, spec in parameters_of(light.kind).items():
        if callable(spec.default) and name not in light.given and f"{stem}.{name}" in params:
            numbers = {k: tensor_of(v, device) for k, v in written.items() if k != "type" and isinstance(v, Tensor)}
            value = spec.default({**light.values, **numbers})
            if isinstance(value, Tensor) and value.requires_grad:
                yield f"{stem}.{name}", value
