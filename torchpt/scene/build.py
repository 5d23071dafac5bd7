"""From a description to parts and parameters: files are read, names resolved, what cannot be hit is dropped and counted."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from torchpt.core.errors import SceneError
from torchpt.physics.lights import sort_key
from torchpt.physics.parts import Copy, Parameters, Part, Source
from torchpt.physics.shapes.geometry import KINDS
from torchpt.scene.formats.description import Description
from torchpt.scene.materials import declare, resolved
from torchpt.scene.mesh_shapes import warn_of_touching
from torchpt.scene.shapes import Owner, ShapeBuilder
from torchpt.scene.sources import check_coordinates, declare_corners, sources_of
from torchpt.scene.space import centre_and_unit
from torchpt.scene.texels import Opener

__all__ = ["Built", "build_parts"]


@dataclass(frozen=True)
class Built:
    """Parts in the order of ``records.KINDS``, their parameters, and the lanes' own coordinates (:mod:`torchpt.scene.space`).

    Attributes:
        parts: what can be hit.
        parameters: arrays by dotted name.
        centre: ``(3,)`` float64, subtracted from all positions.
        unit: what all lengths are divided by.
        sources: lights that are no surfaces, in the order of ``lights.sort_key``.
        copies: instances of parts.
    """

    parts: tuple[Part, ...]
    parameters: Parameters
    centre: np.ndarray
    unit: float
    sources: tuple[Source, ...] = ()
    copies: tuple[Copy, ...] = ()


def build_parts(description: Description, traced: Collection[str] = ()) -> Built:
    """Resolve a description.

    Args:
        description: of the scene.
        traced: dotted names of normals and texture coordinates that are to be parameters.

    Raises:
        SceneError: more than one environment, a shape that cannot be placed, or sizes too far apart for float32.
        AssetError: a mesh file that is missing or malformed.

    Warns:
        EnergyWarning: two refracting shapes touch.
    """
    try:
        return _built(description, traced)
    except SceneError as error:
        raise description.layers.blame(error) from None


def _built(description: Description, traced: Collection[str]) -> Built:
    parameters = Parameters()
    opener = Opener(description.textures, description.resolve, parameters, description.file)
    builder = ShapeBuilder(description, parameters, opener)
    owners = [Owner(name, number, shape) for number, (name, shape) in enumerate(description.shapes.items(), 1)]
    parts = [part for owner in owners if not owner.shape.kind.copies for part in builder.parts(owner)]
    copies = [copy for owner in owners if owner.shape.kind.copies for copy in builder.copies(owner, parts)]
    for name, material in description.materials.items():
        declare(resolved(material, f"materials.{name}", description.materials, opener), parameters)
    sources = sources_of(description, parameters)
    sources = sorted([*sources, *builder.sources], key=lambda source: sort_key(source.kind))
    parameters.declare_all("camera", description.camera.kind, description.camera.values)
    declare_corners(parts, traced, parameters)
    check_coordinates(parts, parameters.stated, description.file)
    parts.sort(key=lambda part: KINDS.index(part.kind))
    centre, unit = centre_and_unit(parts, copies, sources, parameters, description.camera, description.file)
    warn_of_touching(parts, copies, description.file)
    return Built(tuple(parts), parameters, centre, unit, tuple(sources), tuple(copies))
