"""Read further mesh formats by trimesh: OFF, 3MF, COLLADA, XAML, 3DXML.

:data:`torchpt.scene.meshes.FORMATS` sends their files here. Files are untrusted: archives are limited in size, COLLADA may not
declare a document type, and images are read only from the file's folder and below; nothing is executed or fetched.
"""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchpt.core.errors import AssetError
from torchpt.core.files import MAX_BYTES, check_regular
from torchpt.scene.meshes import PARSERS
from torchpt.scene.meshes.gltf import MOST_PLACED
from torchpt.scene.meshes.mesh import MAX_UNPACKED, MeshPart
from torchpt.scene.meshes.trimesh_objects import Notes, mesh_parts_of

__all__ = ["load_trimesh_formats"]

#: The start of XML: a byte order mark of UTF-8 or UTF-16 or none, blanks, and a tag.
_BEGINS = re.compile(rb"(?:\xef\xbb\xbf|\xff\xfe|\xfe\xff)?\s*<")
#: The encoding in an XML declaration.
_ENCODING = re.compile(rb"<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)")
#: Encodings in which ASCII bytes stand for themselves, once the zeros of UTF-16 are gone.
_ENCODINGS = (
    b"utf-8",
    b"utf8",
    b"utf-16",
    b"us-ascii",
    b"ascii",
    b"iso-8859-1",
    b"latin-1",
    b"latin1",
    b"windows-1252",
)


def load_trimesh_formats(path: Path, data: bytes, materials: bool) -> list[MeshPart]:
    """Return the meshes of a file as trimesh reads it, in world space.

    Raises:
        AssetError: a package that is not installed, a malformed file, a missing image.
    """
    kind = path.suffix.lower()
    missing = [name for name in PARSERS[kind] if find_spec(name) is None]
    if missing:
        needs = "the package " if len(missing) == 1 else "the packages "
        how = "pip install '.[formats]' in the checkout of torchpt"
        raise AssetError(path, f"reading {kind} needs {needs}{' and '.join(missing)}: {how}")
    try:
        _check_safe(path, data)
        with Notes() as notes, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's, and deprecations of the parsers
            scene, missing_files = _read(path, data)
    except (AssetError, MemoryError):
        raise
    except Exception as error:
        # Parsers of other packages raise anything for a malformed file: the first line is shown.
        reason = (str(error).strip().splitlines() or [""])[0][:120]
        raise AssetError(path, f"malformed {kind} ({type(error).__name__}: {reason})") from None
    if missing_files and materials:
        raise AssetError(path, f"the file {missing_files[0][:80]!r} is missing")
    parts = mesh_parts_of(scene, str(path), materials=materials, most=max(MOST_PLACED, len(data)))
    ignored = tuple(dict.fromkeys((*parts[0].ignored, *notes.texts)))
    return [replace(parts[0], ignored=ignored), *parts[1:]]


def _read(path: Path, data: bytes) -> tuple[Any, list[str]]:
    """Return the ``trimesh.Scene`` of a file, and the names of missing files that it refers to."""
    import trimesh
    from trimesh.resolvers import FilePathResolver

    missing_files: list[str] = []

    class Beside(FilePathResolver):
        """Reader of the files that a file names, from its folder and below; notes those that are missing."""

        def absolute(self, name: str) -> Path:
            path = super().absolute(name)
            if path.exists():
                check_regular(path, MAX_BYTES)
            return path

        def get(self, name: str) -> bytes:
            try:
                return super().get(name)
            except Exception:
                missing_files.append(name)
                raise

    kind = path.suffix.lower().removeprefix(".")
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=Beside(str(path)), process=False)
    return scene, missing_files


def _check_safe(path: Path, data: bytes) -> None:
    """Raise for archives that decompress to too many bytes, and for XML that declares entities."""
    # The COLLADA documents, which trimesh's parser would expand entities of.
    texts = [data] if path.suffix.lower() == ".dae" else []
    if data.startswith(b"PK"):  # a ZIP archive
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > MAX_UNPACKED:
                raise AssetError(path, f"unfolds to {size} bytes, more than {MAX_UNPACKED} are not read")
            texts += [archive.read(info) for info in archive.infolist() if info.filename.lower().endswith(".dae")]
    for text in texts:
        plain = text.replace(b"\0", b"")  # of UTF-16
        declared = _ENCODING.search(plain[:200])
        if not _BEGINS.match(plain) or (declared and declared[1].lower() not in _ENCODINGS):
            # Other encodings could hide a DOCTYPE.
            raise AssetError(path, "is no XML in UTF-8, UTF-16, ASCII or Latin-1")
        if b"<!DOCTYPE" in plain or b"<!ENTITY" in plain:
            raise AssetError(path, "declares a document type, which is not read")
