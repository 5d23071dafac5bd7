"""Convert the lights and cameras of glTF nodes; ``docs/reference/assets.md`` has the reader.

Khronos glTF 2.0 extension ``KHR_lights_punctual`` and specification 3.10 (cameras). Both look along their node's -z.
:mod:`.gltf` calls this module for the nodes of a file, :mod:`.trimesh_objects` for lights of trimesh, which has those of glTF.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.scene.meshes.gltf_document import Document, NumberReader
from torchpt.scene.meshes.mesh import FileCamera, FileLight
from torchpt.spec import parameters_of

__all__ = ["PUNCTUAL", "camera_at", "light_at"]

PUNCTUAL = "KHR_lights_punctual"
#: Keys of a light that are read, or have no effect.
_KEYS = ("name", "type", "color", "intensity", "spot", "extras")
#: Types of lights in the extension, which have the same names here.
_TYPES = ("point", "spot", "directional")
#: Larger intensities and lengths are errors.
_LARGEST = 1e30
#: Smallest `beam_width` in degrees: stands for an innerConeAngle of 0.
_NARROWEST = 1e-3


def light_at(document: Document, node: dict[str, Any], matrix: NDArray[np.float64], left_out: list[str]) -> FileLight:
    """Return the light of a node that has the extension.

    Args:
        document: the file.
        node: the node's object.
        matrix: ``(4, 4)`` from the node to the file's space.
        left_out: gets the names of unsupported keys.

    Raises:
        AssetError: a light that does not exist, or numbers out of range.
    """
    index = node["extensions"][PUNCTUAL].get("light")
    lights = document.json.get("extensions", {}).get(PUNCTUAL, {}).get("lights", [])
    if type(index) is not int or not isinstance(lights, list) or not 0 <= index < len(lights):
        count = len(lights) if isinstance(lights, list) else 0
        raise AssetError(document.path, f"{PUNCTUAL}: light {str(index)[:40]} does not exist ({count} are declared)")
    reader = _LightReader(document, index, lights[index])
    left_out += [f"{PUNCTUAL}.{str(key)[:40]}" for key in lights[index] if key not in _KEYS]
    name = str(lights[index].get("name") or node.get("name") or f"light{index}")[:80]
    position, direction = matrix[:3, 3], -matrix[:3, 2]
    if not (np.abs(position) <= _LARGEST).all():
        raise reader.wrong("its node places it nowhere (a position that is not finite)")
    length = np.abs(direction).max()  # the largest component: squares could overflow
    if not 0 < length < np.inf:
        raise reader.wrong("its node leaves it no direction (scaled to nothing, or not finite)")
    direction = direction / length
    return FileLight(
        name=name,
        kind=reader.kind,
        position=position,
        direction=direction / np.linalg.norm(direction),
        numbers=reader.values(),
    )


class _LightReader(NumberReader):
    """Reader of one light."""

    def __init__(self, document: Document, index: int, block: dict[str, Any]) -> None:
        super().__init__(document, f"{PUNCTUAL}: light {index}")
        self.block = block
        self.kind = str(block.get("type"))
        if self.kind not in _TYPES:
            raise self.wrong(f"type {self.kind[:40]!r}, expected point, spot or directional")
        self.parameters = parameters_of(LIGHTS[self.kind])

    def values(self) -> dict[str, float | tuple[float, ...]]:
        """Return the light's parameters in a scene file, without position and direction."""
        color = self.numbers(self.block, "color", (1.0, 1.0, 1.0), _LARGEST)
        intensity = self.number(self.block, "intensity", 1.0, _LARGEST)
        amount = tuple(value * intensity for value in color)
        if max(amount) > _LARGEST:
            raise self.wrong(f"color times intensity is above {_LARGEST:g}")
        # A directional light has an irradiance here, and the extension's intensity in lux is just that.
        key = "intensity" if "intensity" in self.parameters else "irradiance"
        return {key: amount, **(self.cone() if "cutoff_angle" in self.parameters else {})}

    def cone(self) -> dict[str, float]:
        """Return the angles of a spot in degrees: where its light ends, and within which it has full intensity."""
        cone = self.block.get("spot", {})
        # Radians from the axis, as the extension has them.
        inner = self.number(cone, "innerConeAngle", 0.0, _LARGEST)
        outer = self.number(cone, "outerConeAngle", math.pi / 4.0, _LARGEST)
        if not 0.0 < outer <= 0.5 * math.pi + 1e-6:  # a right angle in float32 is a little more than one
            raise self.wrong(f"outerConeAngle {outer:g} is not above 0 and at most pi / 2")
        if inner >= outer:
            raise self.wrong(f"innerConeAngle {inner:g} is not below outerConeAngle {outer:g}")
        cutoff = math.degrees(outer)
        beam = min(max(math.degrees(inner), _NARROWEST), cutoff)
        return {"cutoff_angle": cutoff, "beam_width": beam}


def camera_at(document: Document, node: dict[str, Any], matrix: NDArray[np.float64]) -> FileCamera | None:
    """Return the camera of a node; None for an invalid one, which is no error, since cameras of files are only reported."""
    # `cameras` is not in the schema that raises errors, so all is checked here.
    index, cameras = node["camera"], document.json.get("cameras")
    if type(index) is not int or not isinstance(cameras, list) or not 0 <= index < len(cameras):
        return None
    block = cameras[index]
    if not isinstance(block, dict):
        return None
    kind = block.get("type")
    lens = block.get(kind) if kind in ("perspective", "orthographic") else None
    # The angle along y in radians, or half the width of the view.
    size = lens.get("yfov" if kind == "perspective" else "xmag") if isinstance(lens, dict) else None
    if isinstance(size, bool) or not isinstance(size, int | float):
        return None
    if not 0.0 < size < (math.pi if kind == "perspective" else _LARGEST) or not (np.abs(matrix) <= _LARGEST).all():
        return None
    name = str(block.get("name") or node.get("name") or f"camera{index}")[:80]
    film = f"fov: {math.degrees(size):.6g}, fov_axis: y" if kind == "perspective" else f"width: {2.0 * size:.6g}"
    return FileCamera(name=name, kind=str(kind), matrix=matrix, film_text=film)
