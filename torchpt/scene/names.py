"""Look up the scene file's names of shapes, materials and lights by their indices on lanes.

Diagnostics use them: printed paths, causes of NaN, missing light. A hit has two indices: ``prim`` of the geometry, shared by a
mesh and its instances, and ``slot`` of what each has of its own. Slots are the primitives of all parts, then one for each
instance.
"""

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
    """Names of a surface that was hit.

    Attributes:
        shape: name of the shape.
        kind: kind of the primitive, from ``geometry.KINDS``.
        primitive: index of the primitive in its part of the shape.
        material: name of the material.
        model: ``type`` of the material.
    """

    shape: str
    kind: str
    primitive: int
    material: str
    model: str


class Names:
    """The names of one scene.

    Args:
        built: the scene's parts, instances and lights.
        world: the scene's tensors.
    """

    def __init__(self, built: SceneBuild, world: World) -> None:
        self._parts, self._copies, self._sources = built.parts, built.copies, built.sources
        # First primitive of each part, and the number of all primitives.
        self._starts = [0, *accumulate(part.primitive_count for part in built.parts)]
        rows = None if world.lights is None else world.lights.row_of_prim
        # Primitive of each row of the light table that is a surface; these rows come first.
        self._emissive_prims: list[int] = []
        if rows is not None:
            prims = (rows >= 0).nonzero().squeeze(1)
            self._emissive_prims = prims[rows[prims].argsort()].tolist()

    def surface(self, slot: int, prim: int) -> SurfaceNames:
        """Return the names of a surface by the slot and primitive of an Interaction."""
        number = bisect_right(self._starts, prim) - 1  # index of the part
        part, first = self._parts[number], self._starts[number]
        owner = self._owner(slot)
        name = owner.material.name.removeprefix("materials.")
        return SurfaceNames(owner.shape, part.kind, prim - first, name, owner.material.model.name)

    def owner(self, slot: int) -> str:
        """Return a text with the shape and material of a surface, by its slot."""
        owner = self._owner(slot)
        return f"shape {owner.shape}, material {owner.material.name.removeprefix('materials.')}"

    def shape(self, slot: int) -> tuple[str, str]:
        """Return the shape's name and the material's ``type`` of a surface, by its slot."""
        owner = self._owner(slot)
        return owner.shape, owner.material.model.name

    def _owner(self, slot: int) -> Part | Copy:
        """Return the part or instance that a slot belongs to."""
        copied = slot >= self._starts[-1]
        return self._copies[slot - self._starts[-1]] if copied else self._parts[bisect_right(self._starts, slot) - 1]

    def light(self, row: int) -> str:
        """Return the name of a row of the light table: that of its shape, or of its light."""
        if row < len(self._emissive_prims):
            prim = self._emissive_prims[row]  # instances do not emit, so the slot is the primitive
            return self.surface(prim, prim).shape
        return self._sources[row - len(self._emissive_prims)].name.removeprefix("lights.")
