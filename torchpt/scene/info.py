"""Describe a scene for ``torchpt info``: contents, data structures, and features that it does not use.

:meth:`torchpt.scene.scene.Scene.info` calls :func:`describe`. In a *world*, the tensors that stages read, None stands for a
feature that the scene does not use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchpt.core.tree import leaves
from torchpt.physics import bsdfs
from torchpt.physics.film import FILTERS
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.lights import SURFACES, Environment
from torchpt.physics.lights.choice import TreeSampler
from torchpt.physics.lights.records import Lights
from torchpt.physics.shapes.geometry import KINDS
from torchpt.physics.world import World
from torchpt.scene.settings import Settings
from torchpt.search import Accel

if TYPE_CHECKING:
    from torchpt.scene.build import SceneBuild
    from torchpt.scene.formats.description import Description

__all__ = ["describe"]


def describe(
    description: Description, built: SceneBuild, world: World, accel: Accel, settings: Settings
) -> dict[str, Any]:
    """Return a nested dict of plain values: ``scene``, ``shapes``, ``built``, ``left_out``, ``settings``.

    Args:
        description: the validated scene file.
        built: parts, instances and lights built from it.
        world: the world built from those.
        accel: the search structure.
        settings: complete settings.
    """
    lights = world.lights
    shapes: dict[str, Any] = {}
    file_lights: dict[str, dict[str, str]] = {}  # kinds of the lights of mesh files by name, by shape
    for source in built.sources:
        owner, _, label = source.name.rpartition(
            ".lights."
        )  # lights of mesh files are named `shapes.NAME.lights.LABEL`
        if owner:
            file_lights.setdefault(owner.removeprefix("shapes."), {})[label] = source.kind
    for part in built.parts:
        count = part.primitive_count
        kind = part.kind if part.quadric is None else part.quadric.name
        row: dict[str, Any] = {"kind": kind, "primitives": count, "material": part.material.name}
        if part.emission is not None:
            row["emission"] = list(part.emission) if part.emission_texture is None else "a texture"
        if part.source:
            row["file"] = part.source
        if part.dropped:
            row["degenerate_faces_dropped"] = part.dropped
        if part.shape in file_lights:
            row["lights"] = file_lights.pop(part.shape)  # once for a shape of several parts
        if part.ignored:
            row["ignored_in_file"] = list(part.ignored)
        if part.faces is not None:
            row["normals"] = (
                "face" if not part.smooth else "computed, smooth" if part.normals is None else "from the file"
            )
        shapes[part.name.removeprefix("shapes.") + (f".{part.piece}" if part.piece else "")] = row
    for copy in built.copies:
        shapes[copy.name.removeprefix("shapes.")] = {
            "kind": "instance",
            "of": copy.of.removeprefix("shapes."),
            "material": copy.material.name,
        }
    built_rows: dict[str, Any] = {
        "accel": accel.describe(),
        "bsdfs": _groups(world),
        "lights": {} if lights is None else _lights(lights),
        "scene_bytes": _bytes(world),
    }
    reads = sum(table.count for table in world.textures.tables)
    if reads:
        built_rows["textures"] = {"reads": reads, "bytes": _bytes(world.textures.tables)}
    if built.centre.any():
        built_rows["origin_moved_to"] = built.centre.tolist()
    if built.unit != 1.0:
        built_rows["unit_of_length"] = built.unit
    if settings.integrator.merges:
        built_rows["merges"] = "consistent, not unbiased: bias falls with the radius, from sample to sample"
    return {
        "scene": {
            "file": description.file,
            "camera": description.camera.name,
            "primitives": {kind: n for kind, n in zip(KINDS, world.geometry.counts, strict=True) if n},
            **({"instances": len(built.copies)} if built.copies else {}),
            "parameters": len(built.parameters),
        },
        "shapes": shapes,
        "built": built_rows,
        "left_out": _left_out(description, world, settings),
        "settings": settings.plain(),
    }


def _bytes(record: Any) -> int:
    """Return the bytes of all tensors in nested records."""
    return sum(tensor.numel() * tensor.element_size() for tensor in leaves(record))


def _lights(lights: Lights) -> dict[str, Any]:
    """Describe the light table; an environment, which has its last row, may have details of its own."""
    found: dict[str, Any] = {"rows": len(lights.area), "kinds": list(lights.kinds)}
    if isinstance(lights.choice, TreeSampler):
        tree = lights.choice.tree
        found["choice"] = {"tree": {"nodes": len(tree.nodes), "levels": tree.levels}}
    elif lights.choice is not None:
        found["choice"] = "a fixed chance for each"
    last = LIGHTS.get(lights.kinds[-1])
    if last is not None and issubclass(last, Environment) and (details := last.info(lights.environment)):
        found[last.name] = details
    return found


def _left_out(description: Description, world: World, settings: Settings) -> list[str]:
    """Return the features that this scene does not use, for which nothing is built, stored or executed."""
    lights = world.lights
    absent = [f"{kind} primitives" for kind, n in zip(KINDS, world.geometry.counts, strict=True) if not n]
    present = {model.name for model in world.materials.models}
    absent += [f"{name} bsdf" for name in bsdfs.KINDS if name not in present]
    if len(world.materials.models) == 1:
        absent.append("sorting by bsdf (one model)")
    if world.geometry.normals is None:
        absent.append("shading normals (all flat)")
    if all(flags is None for flags in world.materials.two_sided):  # of each group: None where all are two-sided
        absent.append("one-sided materials")
    if world.materials.opacity is None:
        absent.append("opacity (every surface is met)")
    if world.geometry.tangents is None:
        absent.append("tangents (nothing is anisotropic)")
    if not any(model.refracts for model in world.materials.models):
        absent.append("refraction (no index along paths)")
    if not any(model.lobed for model in world.materials.models):  # of several lobes, of which a sample chooses one
        absent.append("choice among lobes")
    if world.geometry.copies is None:
        absent.append("instances")
    if lights is None:
        absent.append("light sampling and MIS (nothing emits)")
    else:
        if lights.choice is None:
            absent.append("choice among lights (one light)")
        elif not isinstance(lights.choice, TreeSampler):
            absent.append("light tree (few lights)")
        if lights.environment is None:
            absent.append("environment")
        if lights.row_of_prim is None:
            absent.append("area lights")
        absent += [f"sampling of {kind} lights" for kind in SURFACES if kind not in lights.kinds]
    if not FILTERS[settings.film.filter.name].tabulated:
        absent.append(f"filter table ({settings.film.filter.name})")
    if not description.camera.kind.lens:
        absent.append("places on a lens (all is in focus)")
    integrator = settings.integrator
    if integrator.clamp is None:
        absent.append("clamp")
    if 0 <= integrator.limits.max_depth <= integrator.limits.rr_depth:
        absent.append("Russian roulette (paths end before rr_depth)")
    if not settings.film.aovs and not settings.film.denoise:
        absent.append("aov layers")
    if not any(table.count for table in world.textures.tables):
        absent.append("textures (no image is read, none is computed)")
    if world.geometry.colors is None:
        absent.append("vertex colours")
    if all(
        textures is None or (textures.normal is None and textures.bump is None) for textures in world.materials.textures
    ):
        absent.append("normal and bump maps")
    absent += ["volumes", "derivative tape (until a parameter requires gradients)"]
    return absent


def _groups(world: World) -> dict[str, int]:
    """Return the number of materials of each group, by BSDF name with the names of textured parameters."""
    found: dict[str, int] = {}
    for model, table, textures in zip(
        world.materials.models, world.materials.parameters, world.materials.textures, strict=True
    ):
        name, rows = str(model), _rows(table)
        if textures is not None:
            maps = ["normal_map"] if textures.normal is not None else []
            maps += ["bump_map"] if textures.bump is not None else []
            name = f"{name}, textured: {', '.join([*_keys(textures.bindings), *maps])}"
            bindings = leaves(textures)
            rows = max([rows, *(len(binding) for binding in bindings)])
        while name in found:  # groups of different kinds of textures may have one name
            name += ", again"
        found[name] = rows
    return found


def _keys(readings: dict[str, Any]) -> list[str]:
    """Return the dotted names of textured parameters; those of a blend are nested."""
    found = []
    for key, value in readings.items():
        found += [f"{key}.{inner}" for inner in _keys(value)] if isinstance(value, dict) else [key]
    return found


def _rows(table: bsdfs.Parameters) -> int:
    """Return the number of materials in a model's stacked parameters."""
    found = leaves(table)
    # Numbers and colours are (M,) or (3, M) for M materials, tables of a BSDF (M, ...).
    return max((value.shape[-1] if value.dim() < 2 or len(value) == 3 else len(value) for value in found), default=1)
