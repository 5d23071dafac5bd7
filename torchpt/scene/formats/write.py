"""Write a scene as a YAML file, with a folder beside it for the meshes that stand in no file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchpt.core.errors import OutputError
from torchpt.scene.formats.compose import PATHS
from torchpt.scene.formats.yaml import parse_yaml
from torchpt.scene.meshes import MeshPart

__all__ = ["write_scene"]


class _Dumper(yaml.CSafeDumper):
    """Dumper of text that this program reads back as the same values."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write equal parts twice, as they are read."""
        return True


def _text(dumper: _Dumper, value: str) -> yaml.Node:
    """Quote text that the reader would take for a number or a word of YAML."""
    style = None
    if value and value.isprintable() and value[0] in "+-.0123456789":
        style = "'"
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


_Dumper.add_representer(str, _text)


def write_scene(raw: Mapping[str, Any], base: Path, path: Path, heading: str = "") -> list[Path]:
    """Write a scene in the form of a YAML file.

    Args:
        raw: the scene; a shape may have parts of a mesh as ``mesh``, which are written as PLY files.
        base: the folder that its relative paths start from.
        path: the file to write; it is replaced only once all is written.
        heading: text of the comment that it begins with.

    Returns:
        The files, the scene last.

    Raises:
        OutputError: a file cannot be written.
    """
    target, written = path.resolve().parent, []
    folder = path.with_name(f"{path.stem}_meshes")
    scene = _rebased(raw, base.resolve(), target)
    for name, shape in scene.get("shapes", {}).items():
        if "mesh" not in shape:
            continue
        file = folder / f"{len(written)}_{''.join(c if c.isalnum() else '_' for c in name)}.ply"
        (part,) = shape.pop("mesh")
        _write(file, _ply(part))
        shape["path"] = os.path.relpath(file.resolve(), target)
        written.append(file)
    lines = "".join(f"# {line}\n" for line in heading.splitlines())
    text = lines + yaml.dump(
        scene, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True
    )
    assert parse_yaml(text) == scene  # else the file would be another scene
    _write(path, text.encode())
    return [*written, path]


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically, and its folder where there is none."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(exist_ok=True)
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise OutputError(path, f"cannot be written ({error.strerror})") from None


def _rebased(value: Any, base: Path, target: Path) -> Any:
    """Return a copy of nested blocks, with relative paths that start at another folder."""
    if isinstance(value, Mapping):
        return {
            key: _rebased_path(item, base, target) if key in PATHS else _rebased(item, base, target)
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [_rebased(item, base, target) for item in value]
    return value


def _rebased_path(path: Any, base: Path, target: Path) -> Any:
    if isinstance(path, list | tuple):
        return [_rebased_path(item, base, target) for item in path]
    if not isinstance(path, str) or path.startswith("$"):
        return path
    found = os.path.relpath(base / path, target)
    return f"./{found}" if found.startswith("$") else found


def _ply(part: MeshPart) -> bytes:
    """Return a mesh as a binary PLY file of doubles, so that it is read back to the bit."""
    columns, names = [part.vertices], ["x", "y", "z"]
    if part.normals is not None:
        columns, names = [*columns, part.normals], [*names, "nx", "ny", "nz"]
    if part.uvs is not None:
        columns, names = [*columns, part.uvs], [*names, "u", "v"]
    if part.colors is not None:
        columns, names = [*columns, part.colors], [*names, "red", "green", "blue"]
    properties = "".join(f"property double {name}\n" for name in names)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(part.vertices)}\n{properties}"
        f"element face {len(part.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(part.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, part.faces
    return header.encode() + np.concatenate(columns, 1).astype("<f8").tobytes() + faces.tobytes()
