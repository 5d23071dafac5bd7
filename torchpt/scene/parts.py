"""Parts: what the shapes of a description come to before they are tensors of one world. Static, float64, in numpy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["MaterialSlot", "Part"]


@dataclass(frozen=True)
class MaterialSlot:
    """One row of one BSDF model.

    Attributes:
        model: name of the model, from ``bsdfs.KINDS``.
        name: dotted prefix of its parameters, e.g. ``materials.red``.
        values: colours as three floats, by parameter name.
        two_sided: whether the back reflects as the front does.
    """

    model: str
    name: str
    values: dict[str, tuple[float, float, float]]
    two_sided: bool


@dataclass(frozen=True)
class Part:
    """Primitives of one kind that share a shape, a material and an emission.

    Attributes:
        name: dotted prefix of its parameters, e.g. ``shapes.bunny``.
        shape: name of the shape in the scene.
        object_id: order of the shape in the scene, from 1.
        kind: one of ``records.KINDS``.
        material: its material.
        emission: radiance, or None where it does not emit.
        emission_name: dotted name of that radiance.
        flip: whether the normals are turned around.
        to_world: ``(4, 4)`` float64.
        vertices: ``(V, 3)`` float64 in the file's own space; None for analytic shapes.
        faces: ``(F, 3)`` int64.
        normals: ``(V, 3)`` from the file, or None.
        smooth: whether shading normals are interpolated.
        dropped: faces without area, left out.
        source: the file it was read from, or "".
        ignored: what of the file is not used.
    """

    name: str
    shape: str
    object_id: int
    kind: str
    material: MaterialSlot
    emission: tuple[float, float, float] | None
    emission_name: str
    flip: bool
    to_world: np.ndarray
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    normals: np.ndarray | None = None
    smooth: bool = False
    dropped: int = 0
    source: str = ""
    ignored: tuple[str, ...] = field(default=())
