"""What renders of a scene leave for the next one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from torchpt.cameras import Camera
from torchpt.engines.kernels.kernels import Kernels
from torchpt.integrators.base import Integrator
from torchpt.records import World
from torchpt.scene import Scene

if TYPE_CHECKING:
    from torchpt.integrators.first_surface import FirstSurface

__all__ = ["Kept", "kept"]


@dataclass
class Kept:
    """Of one scene.

    Attributes:
        kernels: of its latest render by the compiled loop.
        first: the integrator and the world that this was made of, and what happens at first surfaces.
        dark: a world, and the same without lights.
        camera: the latest one on a film, with what it was made of.
        outlines: the edges of its meshes, as :mod:`torchpt.edges.topology` finds them.
    """

    kernels: Kernels | None = None
    first: tuple[Integrator, World, FirstSurface] | None = None
    dark: tuple[World, World] | None = None
    camera: tuple[Any, Camera] | None = None
    outlines: dict[str, Any] = field(default_factory=dict)


_scenes: WeakKeyDictionary[Scene, Kept] = WeakKeyDictionary()


def kept(scene: Scene) -> Kept:
    """Return what is kept for a scene, as long as the scene is; views of it share it."""
    return _scenes.setdefault(scene.origin, Kept())
