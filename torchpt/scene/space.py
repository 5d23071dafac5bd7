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

from torchpt.core.errors import SceneError
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.parts import Copy, Part, Source
from torchpt.spec.schema import ParsedParams

__all__ = ["MAX_COORDINATE", "Space", "bounds_center", "bounds_extent", "centre_and_unit"]

#: A scene is moved to the origin where it lies further away than this many times its own size.
RECENTRE_DISTANCE = 8.0
#: Lengths from one over this to this are left as they are.
UNSCALED_RANGE = 2.0**30
#: The longest length over the smallest shape, at most: about their geometric mean the cubes of both are within float32.
MAX_RATIO = 2.0**80
#: Units from the origin beyond which float32 loses cubes of coordinates.
MAX_COORDINATE = 2.0**42

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
        """The map ``(..., 3, 4)`` into these coordinates, from one ``(..., 4, 4)`` into the scene's; in float64."""
        pose = to_world.double()
        return torch.cat((pose[..., :3, :3], pose[..., :3, 3:4] - self.centre[:, None]), -1) / self.unit

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
    camera: ParsedParams,
    file: str | None,
) -> tuple[Array, float]:
    """Where the origin of the lanes' coordinates is put ``(3,)``, and their unit.

    Raises:
        SceneError: a shape that lies beyond float32, or lengths too far apart for it.
    """
    names, boxes, sizes = _boxes(parts, copies)
    centre = np.zeros(3)
    if not names:
        return centre, 1.0
    farthest = np.abs(boxes).max((1, 2))
    if not farthest.max() <= np.finfo(np.float32).max:
        worst = int(farthest.argmax())
        expected = "a place that is finite in float32 (up to 3.4e38)"
        raise SceneError(names[worst], [boxes[worst].min(0).tolist(), boxes[worst].max(0).tolist()], expected, file)
    low, high = boxes.min((0, 1)), boxes.max((0, 1))
    middle = 0.5 * (low + high)
    if np.abs(middle).max() > RECENTRE_DISTANCE * (high - low).max():
        centre = middle
    reaches = np.abs(boxes - centre).max((1, 2))
    far, near = int(reaches.argmax()), int(sizes.argmin())
    lengths = [(names[far], float(reaches[far])), *_reaches(sources, parameters, camera, centre)]
    return centre, _unit(lengths, (names[near], float(sizes[near])), file)


def bounds_center(parts: Sequence[Part], copies: Sequence[Copy]) -> Array:
    """The middle of the box around all that can be hit, ``(3,)``; the origin where nothing can."""
    names, boxes, _ = _boxes(parts, copies)
    return 0.5 * (boxes.min((0, 1)) + boxes.max((0, 1))) if names else np.zeros(3)


def bounds_extent(parts: Sequence[Part], copies: Sequence[Copy]) -> float:
    """The longest side of the box around all that can be hit; 1 where nothing can."""
    names, boxes, _ = _boxes(parts, copies)
    return float((boxes.max((0, 1)) - boxes.min((0, 1))).max()) if names else 1.0


def _boxes(parts: Sequence[Part], copies: Sequence[Copy]) -> tuple[list[str], Array, Array]:
    """Names ``N``, corners ``(N, 8, 3)`` of boxes in the scene, and largest extents ``(N,)`` of all that can be hit."""
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
    if not found:
        return [], np.zeros((0, 8, 3)), np.zeros(0)
    poses = np.stack([pose for _, _, pose in found])
    turned = np.stack([corners for _, corners, _ in found]) @ poses[:, :3, :3].transpose(0, 2, 1)
    # A size is told before the move: far off, the difference of two corners would lose it.
    return [name for name, _, _ in found], turned + poses[:, None, :3, 3], np.ptp(turned, axis=1).max(1)


def _reaches(
    sources: Sequence[Source], parameters: Mapping[str, Array], camera: ParsedParams, centre: Array
) -> list[tuple[str, float]]:
    """Other lengths that lanes hold, by key."""
    found = [("camera", float(np.abs(parameters["camera.to_world"][:3, 3] - centre).max()))]
    found += [(f"camera.{key}", float(camera[key])) for key in camera.kind.reaches]
    for source in sources:
        for place in LIGHTS[source.kind].places:
            name = f"{source.name}.{place}"
            found.append((name, float(np.abs(parameters[name] - centre).max())))
    return found


def _unit(lengths: Sequence[tuple[str, float]], smallest: tuple[str, float], file: str | None) -> float:
    """One, or a power of two near the geometric mean of the longest length and the smallest shape."""
    (far, longest), (near, size) = max(lengths, key=lambda item: item[1]), smallest
    longest = max(longest, size)
    if longest > MAX_RATIO * size:
        expected = f"a size of at least {longest / MAX_RATIO:.3g} beside a length of {longest:.3g} ({far}): float32 holds no more"
        raise SceneError(near, float(f"{size:.3g}"), expected, file)
    if longest <= UNSCALED_RANGE and size * UNSCALED_RANGE >= 1.0:
        return 1.0
    return 2.0 ** round(0.5 * (math.log2(longest) + math.log2(size)))
