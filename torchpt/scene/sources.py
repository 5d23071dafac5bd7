"""Build the lights that are not emissive surfaces; declare and check texture coordinates and normals of meshes.

:func:`torchpt.scene.build.build_parts` calls this module. To *declare* a parameter is to add it to ``scene.params`` by dotted
name. A *source* is a light without a surface: a delta light or an environment.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from torchpt.core.errors import AssetError, SceneError
from torchpt.core.threads import ReadAhead
from torchpt.math.transforms import apply_points
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.parts import Parameters, Part, Source
from torchpt.scene.formats.description import Description
from torchpt.scene.meshes import FileLight
from torchpt.spec import Refused, Spec, VertexAttribute, VertexColors, parameters_of
from torchpt.spec.schema import ParsedParams, scene_error

__all__ = [
    "build_file_lights",
    "build_lights",
    "check_coordinates",
    "check_light_params",
    "declare_vertex_attributes",
    "read_light_files",
    "unique_labels",
]


# ---- Texture coordinates and normals of meshes


def declare_vertex_attributes(parts: Sequence[Part], vertex_params: Collection[str], parameters: Parameters) -> None:
    """Declare vertex colours of parts as parameters, and the normals and texture coordinates named in ``vertex_params``.

    Colours that are at most 1 stay so, unless the part emits by a texture, which may read them.
    """
    for part in parts:
        if part.colors is not None:
            bounded = part.emission_texture is None and bool((part.colors <= 1.0).all())
            spec = VertexColors(high=1.0 if bounded else None)
            parameters.declare(f"{part.name}.colors", part.colors, spec)
        for key, value in (("normals", part.normals), ("uvs", part.uvs)):
            if value is not None and f"{part.name}.{key}" in vertex_params:
                parameters.declare(f"{part.name}.{key}", value, VertexAttribute())


def check_coordinates(parts: Sequence[Part], texels_in_scene: Collection[str], file: str | None) -> None:
    """Check that meshes with texels of the scene have texture coordinates.

    An image file would cover each triangle of such a mesh, as in Mitsuba, which is not what texels are written for.

    Args:
        parts: all parts of the scene.
        texels_in_scene: names of texels that the scene gives as arrays.
        file: scene file for the error.

    Raises:
        SceneError: a mesh without texture coordinates; names the texels.
    """
    if not texels_in_scene:
        return
    from torchpt.physics.textures.atlas import ImageNode

    for part in parts:
        if part.kind != "triangle" or part.uvs is not None:
            continue
        for node in part.material.textures():  # the uses of textures in the material
            if isinstance(node, ImageNode) and node.texels in texels_in_scene:
                expected = f"uvs (texture coordinates) for {part.name}, over which the texels lie"
                raise SceneError(node.texels, "texels on a mesh without uvs", expected, file)


# ---- Delta lights and environments, from the lights block and from mesh files


#: Arrays of a light's files by the name of the parameter, with their specs.
LightArrays = dict[str, tuple[Any, Spec]]


def read_light_files(description: Description, ahead: ReadAhead) -> dict[str, Callable[[], LightArrays]]:
    """Begin to read the files of the lights block; return a function for each light that returns their arrays.

    A kind of light that reads files (an environment map) returns their arrays, which become parameters.
    """

    def files(name: str, light: ParsedParams) -> LightArrays:
        with description.reading_files() as resolve:
            return light.kind.files(light.values, partial(_file_of, resolve, f"lights.{name}", light))

    return {name: ahead.add(partial(files, name, light)) for name, light in description.lights.items()}


def build_lights(
    description: Description, parameters: Parameters, files: Mapping[str, Callable[[], LightArrays]]
) -> list[Source]:
    """Return the lights of the lights block, and declare their parameters; ``files``: by :func:`read_light_files`."""
    lights = description.lights
    environments = [name for name, light in lights.items() if light.kind.environment]
    if len(environments) > 1:
        first, second = environments[:2]
        expected = f"one environment only ({first} is one)"
        raise SceneError(f"lights.{second}", lights[second].name, expected, description.file)
    for name, light in lights.items():
        key = f"lights.{name}"
        parameters.declare_all(key, light.kind, light.values)
        try:
            arrays = files[name]()
        except Refused as error:
            raise scene_error(error, key=key, value=None, file=description.file) from None
        for stem, (values, spec) in arrays.items():
            parameters.declare(f"{key}.{stem}", values, spec)
    return [Source(name=f"lights.{name}", kind=light.name, values=light.values) for name, light in lights.items()]


def _file_of(resolve: Callable[[Any, str], Path], key: str, light: ParsedParams, parameter: str) -> Path:
    """Return the file that a parameter of the light ``key`` names."""
    return resolve(light[parameter], f"{key}.{parameter}")


def check_light_params(sources: Sequence[Source], given: Collection[str], parameters: Mapping[str, Tensor]) -> None:
    """Check replaced parameters of lights against each other.

    Args:
        sources: the lights without a surface of the scene.
        given: names of the replaced parameters.
        parameters: all parameters, replaced ones included.

    Raises:
        SceneError: as the ``check`` of the light's kind.
    """
    for source in sources:
        kind = LIGHTS[source.kind]
        names = {key: f"{source.name}.{key}" for key in parameters_of(kind)}
        if not any(name in given for name in names.values()):
            continue
        numbers = {key: parameters[name].tolist() for key, name in names.items() if name in parameters}
        try:
            kind.check({**source.values, **numbers}, frozenset(numbers))
        except Refused as error:
            raise scene_error(error, key=f"params.{source.name}", value=None, file=None) from None


def build_file_lights(
    lights: list[FileLight], prefix: str, pose: np.ndarray, source: str, parameters: Parameters
) -> list[Source]:
    """Return the lights of a mesh file, transformed to the scene, and declare their parameters.

    Args:
        lights: the lights in the file's space.
        prefix: dotted key of the shape.
        pose: ``(4, 4)`` from the file's space to the scene.
        source: the file, for errors.
        parameters: gets the parameters, as ``PREFIX.lights.LABEL.*``.

    Raises:
        AssetError: a light whose position or direction is not finite in float32.
    """
    sources = []
    for light, label in zip(lights, unique_labels([light.name for light in lights]), strict=True):
        stem = f"{prefix}.lights.{label}"
        with np.errstate(over="ignore", invalid="ignore"):
            position, direction = apply_points(pose, light.position), pose[:3, :3] @ light.direction
            direction = direction / np.abs(direction).max()
            # A spot's target lies up to twice as far.
            is_finite = np.isfinite(np.array([2.0 * position, direction]).astype(np.float32)).all()
        if not is_finite:
            raise AssetError(source, f"light {light.name!r} has no finite place under the transform of {prefix}")
        direction = direction / np.linalg.norm(direction)
        # The target is as far as the light is from the origin, so that their difference keeps its precision.
        target = position + direction * max(1.0, np.abs(position).max())
        vectors = {"position": position, "direction": direction, "target": target}
        values = {key: vectors.get(key, light.numbers.get(key)) for key in parameters_of(LIGHTS[light.kind])}
        parameters.declare_all(stem, LIGHTS[light.kind], values)
        sources.append(Source(name=stem, kind=light.kind, values=values))
    return sources


def unique_labels(names: list[str]) -> list[str]:
    """Return distinct labels without dots, one a name: names of parts or lights of a file may be empty or alike."""
    labels: dict[str, None] = {}  # an ordered set
    for number, name in enumerate(names):
        base = name.replace(".", "_") or f"part{number}"
        label, suffix = base, number
        while label in labels:
            label, suffix = f"{base}_{suffix}", suffix + 1
        labels[label] = None
    return list(labels)
