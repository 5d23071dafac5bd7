"""Meshes: triangles from a file, from arrays, or from objects of trimesh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from torchpt.physics.shapes.base import Shape, Triangles
from torchpt.spec import (
    REQUIRED,
    Block,
    Custom,
    Flag,
    Integer,
    Map,
    Path,
    Refused,
    Scalar,
    VertexColors,
    Vertices,
    reading,
)

__all__ = ["Displacement", "Mesh"]


#: Parameters of an inline mesh.
_ARRAYS = ("vertices", "faces", "normals", "uvs", "colors")


class Displacement:
    """Displacement of vertices along their normals, after subdivision of the triangles."""

    parameters: ClassVar = {
        "texture": Map(REQUIRED, doc="texture of one channel, or the name of one: the displacement over scale"),
        "scale": Scalar(1.0, low=None, length=True, doc="factor of the texture"),
        "subdivisions": Integer(0, high=12, doc="number of times that each triangle is first split in four"),
    }


def _object(value: Any) -> Any:
    """Return an object of trimesh, or a tuple of :class:`~torchpt.scene.meshes.MeshPart`, which the scene builder converts."""
    # `torchpt.scene` cannot be imported here, so mesh parts are known by their faces.
    if isinstance(value, tuple | list) and value and all(hasattr(part, "faces") for part in value):
        return tuple(value)
    if all(kind.__module__.partition(".")[0] != "trimesh" for kind in type(value).__mro__):
        raise Refused("a trimesh.Trimesh or trimesh.Scene (an object of Python; files have a path)")
    return value


class Mesh(Shape):
    """Triangles from a file, from inline ``vertices`` and ``faces``, or from an object of trimesh."""

    name = "mesh"
    parameters: ClassVar = {
        "path": Path(None, doc="the file: OBJ, PLY, STL, glTF, Mitsuba's .serialized, or one that trimesh reads"),
        "shape_index": Integer(
            None, also=(None,), doc="which mesh of a .serialized file is taken, from 0; by default all"
        ),
        "mesh": Custom(
            None,
            reader=_object,
            words="a trimesh.Trimesh or trimesh.Scene",
            doc="an object of Python, read when the scene is loaded",
        ),
        "vertices": Vertices(None, doc="points in object space"),
        "faces": Custom(
            None,
            reader=reading.faces,
            words="a list of faces, each three or more vertex indices (whole numbers >= 0)",
            doc="corners, counted from 0; polygons are split into fans",
        ),
        "normals": Custom(
            None,
            reader=lambda value: reading.rows(value, 3, "[x, y, z]"),
            words="a list of [x, y, z], finite numbers each",
            doc="one for each vertex; computed as smooth normals by default",
        ),
        "uvs": Custom(
            None,
            reader=lambda value: reading.rows(value, 2, "[u, v]"),
            words="a list of [u, v], finite numbers each",
            doc="texture coordinates, one for each vertex",
        ),
        "colors": VertexColors(None, doc="linear colours, one for each vertex, for textures of type `vertex_color`"),
        "face_normals": Flag(False, doc="whether to shade with face normals even if vertex normals exist"),
        "displacement": Block(None, kind=Displacement, doc="moves the vertices when the scene is loaded"),
    }
    meshed = True  # made of triangles, which instances may share

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :meth:`Shape.check`."""
        inline = {name: values[name] for name in _ARRAYS}
        vertices, faces = values["vertices"], values["faces"]
        if values["shape_index"] is not None:
            paths = values["path"] or ("",)
            if not all(path.lower().endswith(".serialized") for path in paths):
                raise Refused(
                    "no shape_index without a path of a .serialized file", values["shape_index"], ("shape_index",)
                )
        if values["path"] is not None and values["mesh"] is not None:
            raise Refused("either path or mesh, not both", "an object", ("mesh",))
        for whole in ("path", "mesh"):
            if values[whole] is not None:
                for name, value in inline.items():
                    if value is not None:
                        raise Refused(f"either {whole} or an inline mesh, not both", value.tolist(), (name,))
                return
        if vertices is None or faces is None:
            missing = "faces" if vertices is not None else "vertices" if faces is not None else "path"
            raise Refused("a path, or vertices and faces", None, (missing,))
        bad = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
        if len(bad):
            expected = f"vertex indices in 0..{len(vertices) - 1}"
            raise Refused(expected, faces[bad[0]].tolist(), ("faces", int(bad[0])))
        for name in ("normals", "uvs", "colors"):
            value = inline[name]
            if value is not None and len(value) != len(vertices):
                raise Refused(f"one row for each of the {len(vertices)} vertices", len(value), (name,))
        if values["face_normals"] and values["normals"] is not None:
            raise Refused("no normals where face_normals is true", len(values["normals"]), ("normals",))

    @classmethod
    def triangles(cls, values: Mapping[str, Any]) -> Triangles:
        """See :meth:`Shape.triangles`."""
        # Parameters that have the same name in both.
        same = {name: values[name] for name in ("path", "shape_index", *_ARRAYS)}
        return Triangles(
            **same, flat=values["face_normals"], displacement=values["displacement"], object=values["mesh"]
        )
