"""Read mesh files as plain arrays: OBJ with MTL, PLY, STL, glTF and `.serialized` by our own readers, others by trimesh.

Read ``mesh.py`` first: it has the records that all readers return. A file becomes *parts*, one for each of its materials.
:data:`FORMATS` is the table of formats; a reader is imported when a scene has a file for it.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np

from torchpt.core.errors import AssetError
from torchpt.core.files import read_regular
from torchpt.scene.meshes.mesh import FileCamera, FileLight, FileMaterial, MeshPart, checked, smooth_normals

__all__ = [
    "FORMATS", "PARSERS", "FileCamera", "FileLight", "FileMaterial", "MeshPart", "load_mesh", "smooth_normals",
]  # fmt: skip

#: Endings that trimesh reads, and the further packages that each of them needs (all in the extra ``formats``).
PARSERS: dict[str, tuple[str, ...]] = {
    ".off": (),
    ".3mf": ("lxml", "networkx"),
    ".dae": ("collada",),
    ".zae": ("collada",),
    ".xaml": ("lxml",),
    ".3dxml": ("lxml", "networkx"),
}
#: The format whose files have several meshes by number.
SERIALIZED = ".serialized"
#: File ending -> module of this package, whose ``load_<module>(path, data, materials)`` returns the parts.
FORMATS = {
    **{".obj": "obj", ".ply": "ply", ".stl": "stl", ".glb": "gltf", ".gltf": "gltf", SERIALIZED: "serialized"},
    **dict.fromkeys(PARSERS, "trimesh_formats"),
}


def load_mesh(path: Path, *, materials: bool = True, index: int | None = None, ending: str = "") -> list[MeshPart]:
    """Return the parts of a mesh file, one per material.

    Args:
        path: a file ending in one of ``FORMATS``, or a file of any name where ``ending`` is given.
        materials: True to read the file's own materials (MTL files, glTF materials).
        index: number of the one mesh to be read of a ``.serialized`` file; None: all.
        ending: the ending of the format that the file is read as; by default the file's own.

    Raises:
        AssetError: the file cannot be read or is malformed; the message names the element. Or an index for another format.
    """
    path = Path(path)
    ending = ending or path.suffix.lower()
    format_name = FORMATS.get(ending)
    if format_name is None:
        raise AssetError(path, f"expected a mesh file ending in {', '.join(FORMATS)}, got {ending or 'no ending'}")
    if index is not None and ending != SERIALIZED:
        raise AssetError(path, f"has no meshes by number, as {SERIALIZED} files have; shape_index {index} is asked for")
    try:
        if index is not None:
            from torchpt.scene.meshes.serialized import load_serialized_mesh

            return checked(load_serialized_mesh(path, index, materials), path)
        data = read_regular(path)
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror})") from None
    reader = getattr(import_module(f"{__name__}.{format_name}"), f"load_{format_name}")
    with np.errstate(all="ignore"):  # `checked` finds numbers that are not finite
        return checked(reader(path, data, materials), path)
