"""What parameters move: decided once, from their specs, so that a derivative by a colour costs nothing for geometry."""

from __future__ import annotations

from collections.abc import Iterable

from torchpt.scene import Scene
from torchpt.spec import Moves

__all__ = ["attached"]


def attached(scene: Scene, names: Iterable[str]) -> bool:
    """Whether any of the parameters moves surfaces or the camera, or bends rays that a delta lobe sends on."""
    owners = [*scene.built.parts, *scene.built.copies]
    bending = {material.name for owner in owners for material in owner.material.all() if material.bends}

    def moves(name: str) -> bool:
        moved = scene.spec(name).moves
        if moved is Moves.RAYS:  # by the material's name, or by a texture that any of them may read
            return any(name.startswith(f"{own}.") for own in bending) or bool(bending and "textures." in name)
        return moved is Moves.SURFACES

    return any(map(moves, names))
