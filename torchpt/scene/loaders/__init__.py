"""Mesh files to plain arrays: OBJ with MTL, PLY, STL, glTF. One table of formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from torchpt.errors import AssetError
from torchpt.scene.loaders.cube import unit_cube
from torchpt.scene.loaders.gltf import load_gltf
from torchpt.scene.loaders.mesh_part import FileCamera, FileLight, FileMaterial, MeshPart, checked
from torchpt.scene.loaders.normals import smooth_normals
from torchpt.scene.loaders.obj import load_obj
from torchpt.scene.loaders.ply import load_ply
from torchpt.scene.loaders.stl import load_stl

__all__ = ["FORMATS", "FileCamera", "FileLight", "FileMaterial", "MeshPart", "load_mesh", "smooth_normals", "unit_cube"]

#: File ending -> reader ``(path, data, materials) -> parts``.
FORMATS: dict[str, Callable[[Path, bytes, bool], list[MeshPart]]] = {
    ".obj": load_obj,
    ".ply": load_ply,
    ".stl": load_stl,
    ".glb": load_gltf,
    ".gltf": load_gltf,
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
    reader = FORMATS.get(path.suffix.lower())
    if reader is None:
        raise AssetError(path, f"expected a mesh file ending in {', '.join(FORMATS)}, got {path.suffix or 'no ending'}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror})") from None
    with np.errstate(all="ignore"):  # what is not finite is found by the checks
        return checked(reader(path, data, materials), path)
