"""Meshes: triangles of a file, of an object of trimesh, or written out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from torchpt.shapes.base import Shape, Triangles
from torchpt.spec import REQUIRED, Block, Flag, Map, Other, Path, Refused, Scalar, Vertices, Whole, reading

__all__ = ["Displacement", "Mesh"]


class Displacement:
    """How far vertices move along their normals, after cutting triangles in four."""

    parameters: ClassVar = {
        "texture": Map(REQUIRED, doc="a number texture, or the name of one: how far, in units of scale"),
        "scale": Scalar(1.0, low=None, length=True, doc="factor of the texture"),
        "subdivisions": Whole(0, high=12, doc="how often each triangle is cut in four before"),
    }


def _object(value: Any) -> Any:
    """An object of Python, which whoever builds the scene reads; or parts of a mesh that has been read."""
    several = value if isinstance(value, list | tuple) else [value]
    if not several or any(
        isinstance(one, str | bool | int | float | Mapping | Sequence | np.ndarray) for one in several
    ):
        raise Refused("a trimesh.Trimesh or trimesh.Scene (an object of Python; a file has a path)")
    return value


class Mesh(Shape):
    """Triangles from a file, from an object of trimesh, or from inline ``vertices`` and ``faces``."""

    name = "mesh"
    parameters: ClassVar = {
        "path": Path(None, doc="the file: OBJ, PLY, STL, glTF, or what trimesh reads"),
        "mesh": Other(
            None,
            reader=_object,
            words="a trimesh.Trimesh or trimesh.Scene",
            doc="in place of a file, an object of Python: with its materials, and its lights",
        ),
        "vertices": Vertices(None, doc="points in its own space"),
        "faces": Other(
            None,
            reader=reading.faces,
            words="a list of faces, each three or more vertex indices (whole numbers >= 0)",
            doc="corners, counted from 0; polygons are split into fans",
        ),
        "normals": Other(
            None,
            reader=lambda value: reading.rows(value, 3, "[x, y, z]"),
            words="a list of [x, y, z], finite numbers each",
            doc="one a vertex; none: computed, smooth",
        ),
        "uvs": Other(
            None,
            reader=lambda value: reading.rows(value, 2, "[u, v]"),
            words="a list of [u, v], finite numbers each",
            doc="texture coordinates, one a vertex",
        ),
        "face_normals": Flag(False, doc="shade flat, whatever normals there are"),
        "displacement": Block(None, kind=Displacement, doc="moves the vertices when the scene is loaded"),
    }
    meshed = True

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :class:`Shape`."""
        inline = {name: values[name] for name in ("vertices", "faces", "normals", "uvs")}
        vertices, faces = values["vertices"], values["faces"]
        outside = [name for name in ("path", "mesh") if values[name] is not None]
        if len(outside) == 2:
            raise Refused("either path or mesh, not both", "an object", ("mesh",))
        if outside:
            for name, value in inline.items():
                if value is not None:
                    raise Refused(f"either {outside[0]} or an inline mesh, not both", value.tolist(), (name,))
            return
        if vertices is None or faces is None:
            missing = "faces" if vertices is not None else "vertices" if faces is not None else "path"
            raise Refused("a path, or vertices and faces", None, (missing,))
        bad = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
        if len(bad):
            expected = f"vertex indices in 0..{len(vertices) - 1}"
            raise Refused(expected, faces[bad[0]].tolist(), ("faces", int(bad[0])))
        for name in ("normals", "uvs"):
            value = inline[name]
            if value is not None and len(value) != len(vertices):
                raise Refused(f"one row for each of the {len(vertices)} vertices", len(value), (name,))
        if values["face_normals"] and values["normals"] is not None:
            raise Refused("no normals where face_normals is true", len(values["normals"]), ("normals",))

    @classmethod
    def triangles(cls, values: Mapping[str, Any]) -> Triangles:
        """See :class:`Shape`."""
        arrays = (values[name] for name in ("path", "vertices", "faces", "normals", "uvs"))
        own = {"flat": values["face_normals"], "displacement": values["displacement"], "read": values["mesh"]}
        return Triangles(*arrays, **own)
