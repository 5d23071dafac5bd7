"""Convert ``trimesh.Scene`` objects: meshes, materials, instances, lights and camera.

:func:`from_trimesh` (``torchpt.from_trimesh``) makes a scene dict, as a scene file would have it, and loads that. Trimesh's
graph places each geometry at one or more nodes: the first becomes a mesh, further ones instances of it.
"""

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

#: Stands for the file in errors.
_LABEL = "trimesh"
#: From trimesh's camera space (looks along -z, +x right) to that of scenes (looks along +z, +x left).
_CAMERA_AXES = np.diag([-1.0, 1.0, -1.0, 1.0])
#: Field of view in degrees along the film's shorter side, for a source without a camera.
_FOV = 45.0
#: Margin about the object in that view, as a factor of its size.
_MARGIN = 1.1


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
    """Load a scene from a ``trimesh.Trimesh`` or ``trimesh.Scene`` (docs/reference/assets.md has the rules).

    Args:
        source: the object; it is not changed.
        camera: camera block of a scene file, in place of the object's camera. Without either, a camera looks at the whole
            object along -z.
        lights: lights block, in place of the object's lights. Where nothing emits, a sky of radiance 1 is added.
        film: film block; its keys override the size of the object's camera.
        integrator: integrator block.
        sampler: sampler block.
        render: render block.
        device: as for :func:`torchpt.load`.

    Raises:
        AssetError: no face, numbers that are not finite, an unsupported image.
        SceneError: a wrong block, or a node's transform without an inverse.
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
    """Return the scene dict of a trimesh object for :func:`torchpt.load`: shapes, camera, film and lights."""
    import trimesh

    if isinstance(source, trimesh.Trimesh):
        source = trimesh.Scene({"mesh": source})
    if not isinstance(source, trimesh.Scene):
        raise AssetError(_LABEL, f"expected a trimesh.Trimesh or trimesh.Scene, got {type(source).__name__}")
    shapes, emits = _shapes(source)
    if not shapes:
        raise AssetError(_LABEL, "the scene is empty (no mesh with a face)")
    description: dict[str, Any] = {"shapes": shapes, **_view(source)}
    lights, _unsupported = lights_of(source, _LABEL)
    if lights:
        names = unique_labels([light.name for light in lights])
        description["lights"] = {name: _light(light) for name, light in zip(names, lights, strict=True)}
    elif not emits:
        description["lights"] = {"sky": {"type": "constant", "radiance": 1.0}}
    return description


def _shapes(source: Any) -> tuple[dict[str, Any], bool]:
    """Return the shapes block, a ``mesh`` for a geometry's first node and ``instance`` for others; True if any emits."""
    converter, shapes, any_emits = MaterialConverter(_LABEL), {}, False
    nodes = list(placed_in(source))  # (name of the node, name of its geometry, its transform)
    first_label: dict[str, str] = {}  # by name of the geometry
    parts: dict[str, list[MeshPart]] = {}  # by name of the geometry
    labels = unique_labels(
        ["".join(char if char.isprintable() else "_" for char in node).strip() for node, _, _ in nodes]
    )
    for label, (_, name, matrix) in zip(labels, nodes, strict=True):
        if name not in parts:
            parts[name] = checked(parts_of(source.geometry[name], str(name)[:80], converter), Path(_LABEL))
        # `part.material.material`: the block of a scene file that the file's material becomes.
        emits = any("emission" in part.material.material for part in parts[name] if part.material is not None)
        any_emits |= emits
        # Instances cannot emit, and need a transform that has an inverse.
        if name in first_label and not emits and is_usable(matrix):
            shapes[label] = {"type": "instance", "of": first_label[name], "transform": [{"matrix": matrix.tolist()}]}
        else:
            first_label.setdefault(name, label)
            shapes[label] = {"type": "mesh", "mesh": parts[name], "transform": [{"matrix": matrix.tolist()}]}
    return shapes, any_emits


def _view(source: Any) -> dict[str, Any]:
    """Return the camera block and its film block."""
    from trimesh.scene.cameras import look_at

    if source.has_camera:
        camera = source.camera
        width, height = (int(size) for size in camera.resolution)
        matrix = np.array(source.camera_transform, np.float64)
        # A scale in the graph has no effect on a camera.
        matrix[:3, :3] /= np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-300)  # no 0
        focal_x, focal_y = (float(length) for length in camera.focal)  # in pixels
        pose: dict[str, Any] = {"type": "perspective", "fov": float(camera.fov[0]), "fov_axis": "x"}
        if abs(focal_y / focal_x - 1.0) > 1e-9:  # more than rounding
            pose["pixel_aspect"] = focal_y / focal_x
        return {
            "camera": {**pose, "to_world": (matrix @ _CAMERA_AXES).tolist()},
            "film": {"width": width, "height": height},
        }
    corners = source.bounds
    if corners is None or not np.isfinite(corners).all():
        corners = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    matrix = look_at(np.array(corners, np.float64), fov=np.array([_FOV, _FOV]), pad=_MARGIN)
    pose = {"type": "perspective", "fov": _FOV, "fov_axis": "smaller"}
    return {"camera": {**pose, "to_world": (matrix @ _CAMERA_AXES).tolist()}}


def _light(light: FileLight) -> dict[str, Any]:
    """Return a light as a block of a scene file."""
    if light.kind == "directional":
        place = {"direction": light.direction.tolist()}
    else:
        place = {"position": light.position.tolist()}
    if light.kind == "spot":
        # As far as the light is from the origin, so that the difference of both points keeps the direction's precision.
        distance = max(1.0, math.sqrt(float(light.position @ light.position)))
        place["target"] = (light.position + light.direction * distance).tolist()
    return {"type": light.kind, **place, **light.numbers}
