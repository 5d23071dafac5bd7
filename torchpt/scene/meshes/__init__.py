"""Mesh files to plain arrays: OBJ with MTL, PLY, STL, glTF by our own readers, others through trimesh.

One table of formats; a scene imports those that it reads.
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

#: Endings that trimesh reads, and the packages beside it that each of them takes (all in the extra ``formats``).
PARSERS: dict[str, tuple[str, ...]] = {
    ".off": (),
    ".3mf": ("lxml", "networkx"),
    ".dae": ("collada",),
    ".zae": ("collada",),
    ".xaml": ("lxml",),
    ".3dxml": ("lxml", "networkx"),
}
#: File ending -> module here, whose ``load_<module>(path, data, materials)`` gives the parts.
FORMATS = {
    **{".obj": "obj", ".ply": "ply", ".stl": "stl", ".glb": "gltf", ".gltf": "gltf"},
    **dict.fromkeys(PARSERS, "trimesh_formats"),
}


def load_mesh(path: Path, *, materials: bool = True) -> list[MeshPart]:
    """The parts of a mesh file, one per material.

    Args:
        path: a file ending in one of ``FORMATS``.
        materials: whether to read the file's own materials (MTL files, glTF materials); without, none is looked for.

    Raises:
        AssetError: the file cannot be read or is malformed; the message names the element.
    """
    path = Path(path)
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise AssetError(path, f"expected a mesh file ending in {', '.join(FORMATS)}, got {path.suffix or 'no ending'}")
    try:
        data = read_regular(path)
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror})") from None
    reader = getattr(import_module(f"{__name__}.{kind}"), f"load_{kind}")
    with np.errstate(all="ignore"):  # what is not finite is found by the checks
        return checked(reader(path, data, materials), path)
