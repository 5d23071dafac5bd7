"""What lanes know by number as the scene file calls it: shapes, primitives, materials, lights."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import accumulate

from torchpt.physics.parts import Copy, Part
from torchpt.physics.world import World
from torchpt.scene.build import SceneBuild

__all__ = ["Names", "SurfaceNames"]


@dataclass(frozen=True)
class SurfaceNames:
    """A primitive.

    Attributes:
        shape: its shape's name in the scene.
        kind: of the primitive, from ``records.KINDS``.
        primitive: its number within its part of the shape, from 0.
        material: its material's name.
        model: the material's ``type``.
    """

    shape: str
    kind: str
    primitive: int
    material: str
    model: str


class Names:
    """The names of one scene.

    Args:
        built: what the scene came to.
        world: its tensors.
    """

    def __init__(self, built: SceneBuild, world: World) -> None:
        self._parts, self._copies, self._sources = built.parts, built.copies, built.sources
        self._ends = [0, *accumulate(1 if part.faces is None else len(part.faces) for part in built.parts)]
        rows = None if world.lights is None else world.lights.row_of_prim
        self._shining: list[int] = []  # slots of the rows of lights that are surfaces
        if rows is not None:
            slots = (rows >= 0).nonzero().squeeze(1)
            self._shining = slots[rows[slots].argsort()].tolist()

    def surface(self, slot: int, prim: int) -> SurfaceNames:
        """A surface by its :class:`~torchpt.physics.shapes.geometry.Interaction`'s slot and primitive."""
        number = bisect_right(self._ends, prim) - 1
        part, first = self._parts[number], self._ends[number]
        copied = slot >= self._ends[-1]
        owner: Part | Copy = self._copies[slot - self._ends[-1]] if copied else part
        name = owner.material.name.removeprefix("materials.")
        return SurfaceNames(owner.shape, part.kind, prim - first, name, owner.material.model.name)

    def owner(self, slot: int) -> str:
        """The shape and material of a surface by its slot alone."""
        owner = self._owner(slot)
        return f"shape {owner.shape}, material {owner.material.name.removeprefix('materials.')}"

    def shape(self, slot: int) -> tuple[str, str]:
        """Return the names of the shape and of the material's ``type`` of a surface, by its slot alone."""
        owner = self._owner(slot)
        return owner.shape, owner.material.model.name

    def _owner(self, slot: int) -> Part | Copy:
        copied = slot >= self._ends[-1]
        return self._copies[slot - self._ends[-1]] if copied else self._parts[bisect_right(self._ends, slot) - 1]

    def light(self, row: int) -> str:
        """A row of the table of lights: the name of its shape, or of the light."""
        if row < len(self._shining):
            return self.surface(self._shining[row], self._shining[row]).shape
        return self._sources[row - len(self._shining)].name.removeprefix("lights.")
