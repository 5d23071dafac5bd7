"""A ``trimesh.Scene`` as a scene: its meshes, materials, instances, lights and camera."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpt.core.errors import AssetError
from torchpt.math.transforms import is_usable
from torchpt.scene.loading import load
from torchpt.scene.meshes import FileLight, MeshPart
from torchpt.scene.meshes.mesh import checked
from torchpt.scene.meshes.trimesh_objects import MaterialConverter, lights_of, parts_of, placed_in
from torchpt.scene.scene import Scene
from torchpt.scene.settings import keep_aspect
from torchpt.scene.sources import unique_labels

__all__ = ["description_of", "from_trimesh"]

_LABEL = "trimesh"
#: From trimesh's camera, which looks along -z with +x to the right, to ours, which looks along +z with +x to the left.
_CAMERA_AXES = np.diag([-1.0, 1.0, -1.0, 1.0])
#: Degrees of view of a scene without a camera, along the film's shorter side.
_FOV = 45.0


def from_trimesh(
    source: Any,
    *,
    camera: Mapping[str, Any] | None = None,
    lights: Mapping[str, Any] | None = None,
    film: Mapping[str, Any] | None = None,
    integrator: Mapping[str, Any] | None = None,
    sampler: Mapping[str, Any] | None = None,
    render: Mapping[str, Any] | None = None,
    device: str | torch.device | None = None,
) -> Scene:
    """A scene of a ``trimesh.Trimesh`` or ``trimesh.Scene`` (docs/reference/assets.md says what becomes of it).

    Args:
        source: the object, which stays as it is.
        camera: block of a scene file in place of the object's own camera. Where there is neither, one looks at all of it
            along -z.
        lights: block in place of the object's own lights. Where nothing shines, a sky of radiance 1 does.
        film: block beside the size that the object's camera says.
        integrator: block.
        sampler: block.
        render: block.
        device: as for :func:`torchpt.load`.

    Raises:
        AssetError: nothing with a face, numbers that are not finite, a picture that cannot be used.
        SceneError: a block that is wrong, a node's transform that has no inverse.
    """
    blocks = {"film": film, "integrator": integrator, "sampler": sampler, "render": render}
    description = description_of(source)
    if camera is not None:
        description["camera"] = camera
        description.pop("film", None)
    if lights is not None:
        description["lights"] = lights
    for name, block in blocks.items():
        if block is not None:
            below = description.get(name, {})
            description[name] = below | (keep_aspect(below, block) if name == "film" else dict(block))
    return load(description, device)


def description_of(source: Any) -> dict[str, Any]:
    """The mapping that :func:`torchpt.load` takes: shapes, camera, film and lights of a trimesh object."""
    import trimesh

    if isinstance(source, trimesh.Trimesh):
        source = trimesh.Scene({"mesh": source})
    if not isinstance(source, trimesh.Scene):
        raise AssetError(_LABEL, f"expected a trimesh.Trimesh or trimesh.Scene, got {type(source).__name__}")
    shapes, glows = _shapes(source)
    if not shapes:
        raise AssetError(_LABEL, "the scene is empty (no mesh with a face)")
    description: dict[str, Any] = {"shapes": shapes, **_view(source)}
    lights, _ = lights_of(source, _LABEL)
    if lights:
        names = unique_labels([light.name for light in lights])
        description["lights"] = {name: _light(light) for name, light in zip(names, lights, strict=True)}
    elif not glows:
        description["lights"] = {"sky": {"type": "constant", "radiance": 1.0}}
    return description


def _shapes(source: Any) -> tuple[dict[str, Any], bool]:
    """A ``mesh`` where a geometry comes first and ``instance``s of it after; whether any of them emits."""
    converter, shapes, glows = MaterialConverter(_LABEL), {}, False
    nodes = list(placed_in(source))
    first: dict[str, str] = {}
    known: dict[str, list[MeshPart]] = {}
    labels = unique_labels(["".join(c if c.isprintable() else "_" for c in node).strip() for node, _, _ in nodes])
    for label, (_, name, matrix) in zip(labels, nodes, strict=True):
        if name not in known:
            known[name] = checked(parts_of(source.geometry[name], str(name)[:80], converter), Path(_LABEL))
        emits = any("emission" in part.material.material for part in known[name] if part.material is not None)
        glows |= emits
        if name in first and not emits and is_usable(matrix):
            shapes[label] = {"type": "instance", "of": first[name], "transform": [{"matrix": matrix.tolist()}]}
        else:
            first.setdefault(name, label)
            shapes[label] = {"type": "mesh", "mesh": known[name], "transform": [{"matrix": matrix.tolist()}]}
    return shapes, glows


def _view(source: Any) -> dict[str, Any]:
    """The camera, and the film that it has."""
    from trimesh.scene.cameras import look_at

    if source.has_camera:
        camera = source.camera
        width, height = (int(size) for size in camera.resolution)
        matrix = np.array(source.camera_transform, np.float64)
        # A graph may scale its camera, which means nothing.
        matrix[:3, :3] /= np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-300)
        across, down = (float(length) for length in camera.focal)
        pose: dict[str, Any] = {"type": "perspective", "fov": float(camera.fov[0]), "fov_axis": "x"}
        if abs(down / across - 1.0) > 1e-9:
            pose["pixel_aspect"] = down / across
        return {
            "camera": {**pose, "to_world": (matrix @ _CAMERA_AXES).tolist()},
            "film": {"width": width, "height": height},
        }
    corners = source.bounds
    if corners is None or not np.isfinite(corners).all():
        corners = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    matrix = look_at(np.array(corners, np.float64), fov=np.array([_FOV, _FOV]), pad=1.1)
    pose = {"type": "perspective", "fov": _FOV, "fov_axis": "smaller"}
    return {"camera": {**pose, "to_world": (matrix @ _CAMERA_AXES).tolist()}}


def _light(light: FileLight) -> dict[str, Any]:
    """A light as a scene file has it."""
    if light.kind == "directional":
        place = {"direction": light.direction.tolist()}
    else:
        place = {"position": light.position.tolist()}
    if light.kind == "spot":
        far = max(1.0, math.sqrt(float(light.position @ light.position)))
        place["target"] = (light.position + light.direction * far).tolist()
    return {"type": light.kind, **place, **light.numbers}
