"""Lights that are no surfaces: those of the scene's block, and those that mesh files bring."""

from __future__ import annotations

import numpy as np

from torchpt.errors import AssetError, SceneError
from torchpt.format.description import Description
from torchpt.lights import KINDS as LIGHTS
from torchpt.math.transforms import apply_points
from torchpt.meshes import FileLight
from torchpt.scene.parameters import Parameters
from torchpt.scene.parts import Source
from torchpt.scene.texels import radiance_of
from torchpt.spec import Texels

__all__ = ["file_lights", "labels_of", "sources_of"]


def sources_of(description: Description, parameters: Parameters) -> list[Source]:
    """The lights block; its numbers become parameters."""
    lights = description.lights
    around = [name for name, light in lights.items() if light.kind.environment]
    if len(around) > 1:
        first, second = around[:2]
        expected = f"one environment only ({first} is one)"
        raise SceneError(f"lights.{second}", lights[second].name, expected, description.file)
    for name, light in lights.items():
        parameters.declare_all(f"lights.{name}", light.kind, light.values)
        if light.name == "envmap":
            key = f"lights.{name}.path"
            source = description.resolve(light["path"], key)
            parameters.declare(f"lights.{name}.texels", radiance_of(source, key, description.file), Texels())
    return [Source(f"lights.{name}", light.name) for name, light in lights.items()]


def file_lights(
    lights: list[FileLight], prefix: str, pose: np.ndarray, source: str, parameters: Parameters
) -> list[Source]:
    """The lights of a mesh file, placed in the scene; their numbers become parameters."""
    found = []
    for light, label in zip(lights, labels_of([light.name for light in lights]), strict=True):
        stem = f"{prefix}.lights.{label}"
        with np.errstate(over="ignore", invalid="ignore"):
            position, direction = apply_points(pose, light.position), pose[:3, :3] @ light.direction
            direction = direction / np.abs(direction).max()
            # Twice as far lies what a spot aims at.
            held = np.isfinite(np.array([2.0 * position, direction]).astype(np.float32)).all()
        if not held:
            raise AssetError(source, f"light {light.name!r} has no finite place under the transform of {prefix}")
        direction = direction / np.linalg.norm(direction)
        place = {"direction": direction} if light.kind == "directional" else {"position": position}
        if light.kind == "spot":
            # As far off as the origin, so that the difference of the two is as exact as they are.
            place["target"] = position + direction * max(1.0, np.abs(position).max())
        parameters.declare_all(stem, LIGHTS[light.kind], {**place, **light.numbers})
        found.append(Source(stem, light.kind))
    return found


def labels_of(names: list[str]) -> list[str]:
    """Distinct labels without dots for the pieces of a mesh."""
    labels: dict[str, None] = {}  # in order, and quick to textures up
    for number, name in enumerate(names):
        base = name.replace(".", "_") or f"part{number}"
        label, again = base, number
        while label in labels:
            label, again = f"{base}_{again}", again + 1
        labels[label] = None
    return list(labels)
