"""The coordinates of lanes, in which a scene is rendered: their origin in the scene, and their unit of length.

Searches, areas and densities compute squares and cubes of lengths, and float32 holds cubes of 1e-12 to 1e12 only. So a scene
whose lengths are far from 1 is rendered in another unit. It is a power of two, so that scaling rounds nothing. A *lane* is one
path of those that are traced together; the tensors of stages hold points in these coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.parts import Copy, Part, Source
from torchpt.spec.schema import ParsedParams

__all__ = ["MAX_COORDINATE", "Space", "bounds_center", "bounds_extent", "centre_and_unit"]

#: The centre of a scene becomes the origin if its distance from the scene's own origin is more than this many times its size.
RECENTRE_DISTANCE = 8.0
#: Scenes with all lengths between 1 / UNSCALED_RANGE and UNSCALED_RANGE keep their unit.
UNSCALED_RANGE = 2.0**30  # about 1e9: its cube, 1e27, leaves room for products with other numbers
#: Largest ratio of the longest length to the smallest shape: with their geometric mean as unit, float32 holds both cubes.
MAX_RATIO = 2.0**80
#: Largest coordinate in units: float32 does not hold cubes of larger ones.
MAX_COORDINATE = 2.0**42

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Space:
    """Transform from the scene's coordinates to those of lanes: ``(p - centre) / unit``.

    Attributes:
        centre: ``(3,)`` float64, the origin of the lanes' coordinates in the scene's.
        unit: the lanes' unit of length in the scene's units; a power of two.
    """

    centre: Tensor
    unit: float

    def point(self, p: Tensor) -> Tensor:
        """Return a point ``(3,)`` of the scene in the coordinates of lanes, float64."""
        return (p.double() - self.centre) / self.unit

    def pose(self, to_world: Tensor) -> Tensor:
        """Convert object-to-scene transforms ``(..., 4, 4)`` to object-to-lanes transforms ``(..., 3, 4)``, in float64."""
        pose = to_world.double()
        return torch.cat((pose[..., :3, :3], pose[..., :3, 3:4] - self.centre[:, None]), -1) / self.unit

    def matrix(self) -> Tensor:
        """Return the transform ``(4, 4)`` from these coordinates to the scene's, float64."""
        matrix = torch.eye(4, dtype=torch.float64, device=self.centre.device)
        matrix[:3, :3] *= self.unit
        matrix[:3, 3] = self.centre
        return matrix

    @property
    def shift(self) -> Tensor:
        """Return :attr:`centre` in units of these coordinates ``(3,)``."""
        return self.centre * (1.0 / self.unit)  # exact, as the unit is a power of two


def centre_and_unit(
    parts: Sequence[Part],
    copies: Sequence[Copy],
    sources: Sequence[Source],
    parameters: Mapping[str, Array],
    camera: ParsedParams,
    file: str | None,
) -> tuple[Array, float]:
    """Choose the origin ``(3,)`` and the unit of the coordinates of lanes.

    Args:
        parts: the parts of shapes.
        copies: instances of meshes.
        sources: lights without a surface.
        parameters: the scene's parameters by dotted name; read for the positions of camera and lights.
        camera: the camera's settings.
        file: scene file, for errors.

    Raises:
        SceneError: a shape beyond the range of float32, or lengths too far apart for it.
    """
    names, boxes, sizes = _boxes(parts, copies)
    centre = np.zeros(3)
    if not names:
        return centre, 1.0
    farthest = np.abs(boxes).max((1, 2))
    if not farthest.max() <= np.finfo(np.float32).max:  # True for NaN too
        worst = int(farthest.argmax())
        expected = "a place that is finite in float32 (up to 3.4e38)"
        raise SceneError(names[worst], [boxes[worst].min(0).tolist(), boxes[worst].max(0).tolist()], expected, file)
    low, high = boxes.min((0, 1)), boxes.max((0, 1))
    middle = 0.5 * (low + high)
    if np.abs(middle).max() > RECENTRE_DISTANCE * (high - low).max():
        centre = middle
    reaches = np.abs(boxes - centre).max((1, 2))  # (N,) largest coordinate of each part
    farthest_part, smallest = int(reaches.argmax()), int(sizes.argmin())
    lengths = [(names[farthest_part], float(reaches[farthest_part]))]
    lengths += _reaches(sources, parameters, camera, centre)
    return centre, _unit(lengths, (names[smallest], float(sizes[smallest])), file)


def bounds_center(parts: Sequence[Part], copies: Sequence[Copy]) -> Array:
    """Return the centre ``(3,)`` of the bounding box of all surfaces; the origin where there are none."""
    names, boxes, _ = _boxes(parts, copies)
    return 0.5 * (boxes.min((0, 1)) + boxes.max((0, 1))) if names else np.zeros(3)


def bounds_extent(parts: Sequence[Part], copies: Sequence[Copy]) -> float:
    """Return the longest side of the bounding box of all surfaces; 1 where there are none."""
    names, boxes, _ = _boxes(parts, copies)
    return float((boxes.max((0, 1)) - boxes.min((0, 1))).max()) if names else 1.0


def _boxes(parts: Sequence[Part], copies: Sequence[Copy]) -> tuple[list[str], Array, Array]:
    """Return names of all parts and copies, the corners ``(N, 8, 3)`` of their bounding boxes, and longest sides ``(N,)``.

    Corners and sides are in the scene's coordinates. The boxes of shapes other than meshes are those of the cube ``[-1, 1]^3``
    in object space.
    """
    cube = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    mesh_corners: dict[str, Array] = {}  # (8, 3) in the mesh's own space, by name of the part
    found = []  # name, corners in its own space, and pose of each part and copy
    for part in parts:
        corners = cube
        if part.vertices is not None and part.faces is not None:
            used = np.zeros(len(part.vertices), bool)
            used[part.faces.reshape(-1)] = True
            points = part.vertices[used]  # vertices without a face do not count
            if not len(points):
                continue
            corners = mesh_corners[part.name] = 0.5 * (points.max(0) + points.min(0)) + cube * (
                0.5 * np.ptp(points, axis=0)
            )
        found.append((part.name, corners, part.to_world))
    found += [(copy.name, mesh_corners[copy.of], copy.to_world) for copy in copies if copy.of in mesh_corners]
    if not found:
        return [], np.zeros((0, 8, 3)), np.zeros(0)
    poses = np.stack([pose for _, _, pose in found])
    untranslated = np.stack([corners for _, corners, _ in found]) @ poses[:, :3, :3].transpose(0, 2, 1)
    # Sizes are taken before the translation: far from the origin, differences of corners would lose precision.
    names = [name for name, _, _ in found]
    return names, untranslated + poses[:, None, :3, 3], np.ptp(untranslated, axis=1).max(1)


def _reaches(
    sources: Sequence[Source], parameters: Mapping[str, Array], camera: ParsedParams, centre: Array
) -> list[tuple[str, float]]:
    """Return the lengths of camera and lights that enter the computation in float32, as pairs of key and length.

    They are the largest coordinates of their positions, relative to ``centre``, and parameters of the camera such as the
    aperture radius (``reaches`` of its kind).
    """
    found = [("camera", float(np.abs(parameters["camera.to_world"][:3, 3] - centre).max()))]
    found += [(f"camera.{key}", float(camera[key])) for key in camera.kind.reaches]
    for source in sources:
        for parameter in LIGHTS[source.kind].places:  # those of the kind that are positions
            name = f"{source.name}.{parameter}"
            found.append((name, float(np.abs(parameters[name] - centre).max())))
    return found


def _unit(lengths: Sequence[tuple[str, float]], smallest: tuple[str, float], file: str | None) -> float:
    """Return 1, or a power of two near the geometric mean of the longest length and the smallest shape.

    Args:
        lengths: pairs of key and length.
        smallest: name and size of the smallest shape.
        file: scene file, for errors.

    Raises:
        SceneError: the lengths are too far apart for float32.
    """
    (longest_name, longest), (smallest_name, size) = max(lengths, key=lambda item: item[1]), smallest
    longest = max(longest, size)
    if longest > MAX_RATIO * size:
        least = longest / MAX_RATIO
        expected = (
            f"a size of at least {least:.3g} beside a length of {longest:.3g} ({longest_name}): float32 holds no more"
        )
        raise SceneError(smallest_name, float(f"{size:.3g}"), expected, file)
    if longest <= UNSCALED_RANGE and size * UNSCALED_RANGE >= 1.0:
        return 1.0
    return 2.0 ** round(0.5 * (math.log2(longest) + math.log2(size)))
