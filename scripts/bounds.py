"""Build the table of limits on scenes and files in docs/guides/stability.md from the constants in the code.

``python scripts/make_tables.py`` writes it.
"""

from __future__ import annotations

from importlib import import_module

__all__ = ["BOUNDS", "table"]

#: Subject of the limit, where its constant is, its unit.
BOUNDS: list[tuple[str, str, str]] = [
    ("a scene file", "torchpt.scene.formats.yaml:MAX_BYTES", "bytes"),
    ("levels of nesting in it", "torchpt.scene.formats.yaml:MAX_DEPTH", ""),
    ("values in it, and once aliases are expanded", "torchpt.scene.formats.yaml:MAX_VALUES", ""),
    ("keys that its `<<` merges copy", "torchpt.scene.formats.yaml:MAX_MERGED", ""),
    ("a key", "torchpt.scene.formats.yaml:MAX_KEY", "characters"),
    (
        "textures, materials, shapes with instances, lights: of each",
        "torchpt.scene.formats.description:MAX_ENTRIES",
        "",
    ),
    ("levels of blends within blends", "torchpt.scene.formats.materials:MAX_BLENDS", ""),
    ("models of materials, told apart by what they are made of", "torchpt.scene.world.materials:MOST_MODELS", ""),
    ("primitives, those of instances counted again", "torchpt.scene.world.primitives:MOST_PRIMITIVES", ""),
    ("faces of a displaced mesh", "torchpt.scene.mesh_triangles:MOST_FACES", ""),
    ("a side of the film", "torchpt.scene.settings:MAX_SIDE", "pixels"),
    ("the film", "torchpt.scene.settings:MAX_PIXELS", "pixels"),
    ("a number", "torchpt.spec.reading:LARGEST", ""),
    ("a mesh or picture file", "torchpt.core.files:MAX_BYTES", "bytes"),
    ("parts of a mesh file", "torchpt.scene.meshes.mesh:MOST_PARTS", ""),
    (
        "vertices or faces once its nodes are placed, in a file of fewer bytes",
        "torchpt.scene.meshes.gltf:MOST_PLACED",
        "",
    ),
    (
        "what an archive of meshes, or a `.serialized` file, unfolds to",
        "torchpt.scene.meshes.trimesh_formats:MAX_UNPACKED",
        "bytes",
    ),
    ("a picture", "torchpt.images.decode:MAX_PIXELS", "pixels"),
    ("a picture by the texture's `max_pixels`", "torchpt.physics.textures.kinds.image:MOST_PIXELS", "pixels"),
]


def table() -> str:
    """Return the bounds as a Markdown table."""
    rows = [f"| {what} | {_shown(place, unit)} |\n" for what, place, unit in BOUNDS]
    return "| what | at most |\n|---|---|\n" + "".join(rows)


def _shown(place: str, unit: str) -> str:
    module, _, name = place.partition(":")
    value = getattr(import_module(module), name)
    if isinstance(value, float):
        return f"{value:.2g}"
    for size, prefix in ((2**30, "Gi"), (2**20, "Mi")):
        if unit == "bytes" and value % size == 0:
            return f"{value // size} {prefix}B"
    return f"{value:,} {unit}".strip()
