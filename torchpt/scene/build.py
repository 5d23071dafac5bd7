"""Build the parts and parameters of a description: read files, resolve names, drop faces without area.

:class:`~torchpt.scene.scene.Scene` calls :func:`build_parts` once, when it is loaded. All is in NumPy and float64. A *part* is
a set of primitives of one kind with one material, a *copy* an instance of a part, a *source* a light that is no surface
(:mod:`torchpt.physics.parts`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchpt.core.errors import SceneError
from torchpt.core.threads import ReadAhead, thread_count
from torchpt.physics.lights import sort_key
from torchpt.physics.parts import Copy, Parameters, Part, Source
from torchpt.physics.shapes.geometry import KINDS
from torchpt.scene.formats.description import Description
from torchpt.scene.materials import declare, resolved
from torchpt.scene.mesh_triangles import warn_of_coplanar_refraction
from torchpt.scene.shapes import ShapeBuilder, ShapeEntry
from torchpt.scene.sources import build_lights, check_coordinates, declare_vertex_attributes, read_light_files
from torchpt.scene.space import centre_and_unit
from torchpt.scene.texture_loader import TextureLoader

__all__ = ["SceneBuild", "build_parts"]


@dataclass(frozen=True)
class SceneBuild:
    """Parts, parameters and coordinates of a scene, before any tensor of a device.

    Attributes:
        parts: the surfaces, in the order of ``geometry.KINDS``.
        parameters: arrays by dotted name; they become ``scene.params``.
        centre: ``(3,)`` float64, subtracted from all positions (:mod:`torchpt.scene.space`).
        unit: the unit of length of a render in the scene's units, a power of two.
        sources: delta lights and environments, in the order of ``lights.sort_key``.
        copies: instances of parts.
    """

    parts: tuple[Part, ...]
    parameters: Parameters
    centre: np.ndarray
    unit: float
    sources: tuple[Source, ...] = ()
    copies: tuple[Copy, ...] = ()

    @cached_property
    def numbers(self) -> int:
        """Return how many numbers the parameters have."""
        return sum(np.size(value) for value in self.parameters.values())


def build_parts(description: Description, vertex_params: Collection[str] = ()) -> SceneBuild:
    """Build the parts and parameters of a description.

    Args:
        description: the scene's.
        vertex_params: dotted names of normals and texture coordinates that become parameters.

    Raises:
        SceneError: more than one environment, a shape without a finite position, or sizes too far apart for float32.
        AssetError: a missing or malformed mesh file.

    Warns:
        EnergyWarning: two refracting shapes touch.
        ImportedSceneWarning: meshes of an imported scene have no area.
    """
    try:
        with ReadAhead(thread_count(None)) as ahead:
            return _built(description, vertex_params, ahead)
    except SceneError as error:
        raise description.layers.blame(error) from None  # names the file that the key comes from


def _built(description: Description, vertex_params: Collection[str], ahead: ReadAhead) -> SceneBuild:
    parameters = Parameters()
    texture_loader = TextureLoader(description.textures, description, parameters)
    texture_loader.read_ahead(ahead)
    light_files = read_light_files(description, ahead)
    builder = ShapeBuilder(description, parameters, texture_loader)
    entries = [
        ShapeEntry(name=name, number=number, shape=shape)
        for number, (name, shape) in enumerate(description.shapes.items(), 1)
    ]
    # `copies` is True for the kind `instance`. Instances come after all meshes, which they may precede in the file.
    parts = [part for entry in entries if not entry.shape.kind.copies for part in builder.parts(entry)]
    copies = [copy for entry in entries if entry.shape.kind.copies for copy in builder.copies(entry, parts)]
    builder.warn_of_empty_meshes()
    for name, material in description.materials.items():  # those that no shape uses have parameters too
        declare(resolved(material, f"materials.{name}", description.materials, texture_loader), parameters)
    sources = build_lights(description, parameters, light_files)
    # `builder.sources` are the lights in mesh files.
    sources = sorted([*sources, *builder.sources], key=lambda source: sort_key(source.kind))
    parameters.declare_all("camera", description.camera.kind, description.camera.values)
    declare_vertex_attributes(parts, vertex_params, parameters)
    check_coordinates(parts, parameters.texels_in_scene, description.file)
    parts.sort(key=lambda part: KINDS.index(part.kind))
    centre, unit = centre_and_unit(parts, copies, sources, parameters, description.camera, description.file)
    warn_of_coplanar_refraction(parts, copies, description.file)
    return SceneBuild(
        parts=tuple(parts),
        parameters=parameters,
        centre=centre,
        unit=unit,
        sources=tuple(sources),
        copies=tuple(copies),
    )
