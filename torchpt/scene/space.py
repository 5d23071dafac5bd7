"""The lanes' own coordinates: where their origin lies in the scene, and which length they count as one.

Searches, areas and densities square lengths and multiply three of them, and float32 holds cubes of 1e-12 to 1e12 only. So a
scene whose lengths lie far from one is rendered in a unit of its own. That is a power of two: nothing is rounded by it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.errors import SceneError
from torchpt.math.transforms import apply_points
from torchpt.scene.parts import Copy, Part, Source
from torchpt.scene.schema import Camera, Orthographic, ThinLens

__all__ = ["FARTHEST", "Space", "centre_and_unit"]

#: A scene is moved to the origin where it lies further away than this many times its own size.
RECENTRE = 8.0
#: Lengths from one over this to this are left as they are.
ORDINARY = 2.0**30
#: The longest length over the smallest shape, at most: about their geometric mean the cubes of both are within float32.
RANGE = 2.0**80
#: Units from the origin beyond which float32 loses cubes of coordinates.
FARTHEST = 2.0**42

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Space:
    """The lanes' coordinates.

    Attributes:
        centre: ``(3,)`` float64, where their origin lies in the scene's.
        unit: how long their unit is in the scene's; a power of two.
    """

    centre: Tensor
    unit: float

    def point(self, p: Tensor) -> Tensor:
        """A point ``(3,)`` of the scene, in float64."""
        return (p.double() - self.centre) / self.unit

    def pose(self, to_world: Tensor) -> Tensor:
        """The map ``(3, 4)`` into these coordinates, from one ``(4, 4)`` into the scene's; in float64."""
        pose = to_world.double()
        return torch.cat((pose[:3, :3], pose[:3, 3:4] - self.centre[:, None]), 1) / self.unit

    def matrix(self) -> Tensor:
        """From these coordinates to the scene's, ``(4, 4)`` float64."""
        matrix = torch.eye(4, dtype=torch.float64, device=self.centre.device)
        matrix[:3, :3] *= self.unit
        matrix[:3, 3] = self.centre
        return matrix

    @property
    def shift(self) -> Tensor:
        """The scene's own origin seen from this one ``(3,)``, turned around, in units of this space."""
        return self.centre / self.unit


def centre_and_unit(
    parts: Sequence[Part],
    copies: Sequence[Copy],
    sources: Sequence[Source],
    parameters: Mapping[str, Array],
    camera: Camera,
    file: str | None,
) -> tuple[Array, float]:
    """Where the origin of the lanes' coordinates is put ``(3,)``, and their unit.

    Raises:
        SceneError: a shape that lies beyond float32, or lengths too far apart for it.
    """
    boxes = _boxes(parts, copies)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for name, box, _ in boxes:
        low, high = np.minimum(low, box.min(0)), np.maximum(high, box.max(0))
        if not np.abs(box).max() <= np.finfo(np.float32).max:
            expected = "a place that is finite in float32 (up to 3.4e38)"
            raise SceneError(name, [box.min(0).tolist(), box.max(0).tolist()], expected, file)
    centre = np.zeros(3)
    if boxes:
        middle = 0.5 * (low + high)
        if np.abs(middle).max() > RECENTRE * (high - low).max():
            centre = middle
    return centre, _unit(boxes, centre, _reaches(sources, parameters, camera, centre), file)


def _boxes(parts: Sequence[Part], copies: Sequence[Copy]) -> list[tuple[str, Array, float]]:
    """Name, corners ``(8, 3)`` of a box about it in the scene, and largest extent, of all that can be hit."""
    cube = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    own: dict[str, Array] = {}
    found = []
    for part in parts:
        corners = cube
        if part.vertices is not None and part.faces is not None:
            used = np.zeros(len(part.vertices), bool)
            used[part.faces.reshape(-1)] = True
            points = part.vertices[used]  # vertices of no face have no say
            if not len(points):
                continue
            corners = own[part.name] = 0.5 * (points.max(0) + points.min(0)) + cube * (0.5 * np.ptp(points, axis=0))
        found.append((part.name, corners, part.to_world))
    found += [(copy.name, own[copy.of], copy.to_world) for copy in copies if copy.of in own]
    # A size is told from the linear part alone: far off, the difference of two corners would lose it.
    return [
        (name, apply_points(pose, corners), float(np.ptp(corners @ pose[:3, :3].T, axis=0).max()))
        for name, corners, pose in found
    ]


def _reaches(
    sources: Sequence[Source], parameters: Mapping[str, Array], camera: Camera, centre: Array
) -> list[tuple[str, float]]:
    """Other lengths that lanes hold, by key."""
    found = [("camera", float(np.abs(parameters["camera.to_world"][:3, 3] - centre).max()))]
    if isinstance(camera, ThinLens):
        found.append(("camera.aperture_radius", camera.aperture_radius))
    if isinstance(camera, Orthographic):
        found.append(("camera.width", camera.width))
    for source in sources:
        position = parameters.get(f"{source.name}.position")
        if position is not None:
            found.append((f"{source.name}.position", float(np.abs(position - centre).max())))
    return found


def _unit(
    boxes: Sequence[tuple[str, Array, float]], centre: Array, others: Sequence[tuple[str, float]], file: str | None
) -> float:
    """One, or a power of two near the geometric mean of the longest length and the smallest shape."""
    if not boxes:
        return 1.0
    far, longest = max(others, key=lambda item: item[1])
    for name, box, _ in boxes:
        reach = float(np.abs(box - centre).max())
        if reach > longest:
            far, longest = name, reach
    near, _, smallest = min(boxes, key=lambda item: item[2])
    longest = max(longest, smallest)
    if longest > RANGE * smallest:
        expected = (
            f"a size of at least {longest / RANGE:.3g} beside a length of {longest:.3g} ({far}): float32 holds no more"
        )
        raise SceneError(near, float(f"{smallest:.3g}"), expected, file)
    if longest <= ORDINARY and smallest * ORDINARY >= 1.0:
        return 1.0
    return 2.0 ** round(0.5 * (math.log2(longest) + math.log2(smallest)))
