"""Mitsuba's shapes: what each becomes here. A shape becomes a mapping of the block ``shapes``, without its material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.math.transforms import affine, apply_points, is_usable, similarity_scale
from torchpt.math.vectors import Frame
from torchpt.physics.shapes import KINDS
from torchpt.scene.formats.mitsuba.elements import Element
from torchpt.scene.formats.mitsuba.plugins import Plugin, exact, left_out
from torchpt.scene.formats.mitsuba.properties import Properties
from torchpt.scene.formats.mitsuba.versions import plugin_name, property_name
from torchpt.scene.meshes import MeshPart, load_mesh
from torchpt.scene.meshes.ply import load_ply_attribute

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer

__all__ = ["SHAPES", "bounds", "posed", "with_attribute"]

Shape = dict[str, Any]
Matrix = NDArray[np.float64]

_THIN = 1e-5  # of the largest scale: that across a solid or a mesh whose to_world flattens it


def posed(shape: Shape, matrix: Matrix) -> Shape:
    """Return a shape with a transform ``(4, 4)`` after its own."""
    total = matrix @ _pose_of(shape)
    kept = {key: value for key, value in shape.items() if key != "transform"}
    if np.array_equal(total, np.eye(4)):
        return kept
    return kept | {"transform": [{"matrix": [[float(x) for x in row] for row in total]}]}


def _shape(p: Properties, type: str, pose: Matrix, *, flip: bool = False, **keys: Any) -> Shape | None:
    """Return a shape with its pose and the flag that all of Mitsuba's have, None where it has no area.

    Args:
        p: its properties.
        type: its type here.
        pose: ``(4, 4)``.
        flip: True to turn its normals round once more.
        keys: other keys; those of None are left out.
    """
    found = {"type": type, **{key: value for key, value in keys.items() if value is not None}}
    if p.flag("flip_normals") != flip:
        found["flip_normals"] = True
    if not is_usable(pose):
        pose = _with_normal(pose) if type in ("rectangle", "disk") else _thin(p, pose)
    if not is_usable(pose):
        p.note("it is left out: its to_world leaves it no area")
        return None
    return posed(found, pose)


def _with_normal(pose: Matrix) -> Matrix:
    """Return a pose of a flat shape with a third axis, which does not matter."""
    across = np.cross(pose[:3, 0], pose[:3, 1])
    length = np.linalg.norm(across)
    if length > 0.0:
        pose = pose.copy()
        pose[:3, 2] = across / np.sqrt(length)
    return pose


def _thin(p: Properties, pose: Matrix) -> Matrix:
    """Return a pose that flattens a solid or a mesh to a plane as one that leaves it some thickness."""
    u, values, v = np.linalg.svd(pose[:3, :3])
    if not values[1] > _THIN * values[0]:
        return pose
    p.note("a to_world that flattens it leaves it a little thickness")
    pose = pose.copy()
    pose[:3, :3] += _THIN * values[0] * np.outer(u[:, 2], v[2])
    return pose


def _mesh(p: Properties, importer: Importer) -> Shape | None:
    p.ignore("max_smooth_angle", "collapse", "optimize")
    if p.has("max_smooth_angle"):
        p.note("max_smooth_angle is left out: normals are smooth, or those of the faces")
    index = p.integer("shape_index", 0)
    if p.plugin != "serialized":
        if p.has("shape_index"):
            p.note("shape_index is left out: all of the file is taken")
        index = None
    elif index < 0:
        raise p.element.error(index, "a shape_index >= 0")
    path = p.file()
    upright = p.plugin == "obj" and p.element.version >= (0, 3)  # whether v is flipped where nothing is said
    flips = p.flag("flip_tex_coords", upright)
    flat = p.flag("face_normals") or None
    pose = p.transform()
    if path is None:
        return None
    flip = np.linalg.det(pose[:3, :3]) < 0.0 and _turned_by_mirrors(p, path, index)
    if flips == upright and path.suffix.lower() == _ending(p):
        return _shape(p, "mesh", pose, flip=flip, path=importer.path(path), shape_index=index, face_normals=flat)
    part = _joined(_parts(p, path, index), flips=flips != upright)
    return _shape(p, "mesh", pose, flip=flip, mesh=(part,), face_normals=flat or part.flat or None)


def _turned_by_mirrors(p: Properties, path: Path, index: int | None) -> bool:
    """Return True where Mitsuba takes the normals of a mesh from its faces, whose winding a mirror turns round.

    Ours keep their fronts. Mitsuba's normals of a file do so too, and its reader of serialized meshes before version 2.
    """
    if p.plugin == "serialized" and not p.modern:
        return False
    return p.flag("face_normals") or all(part.normals is None or part.flat for part in _parts(p, path, index))


def _ending(p: Properties) -> str:
    """Return the ending of the files that a plugin reads, whatever they are called."""
    return f".{p.plugin}"


def _parts(p: Properties, path: Path, index: int | None) -> Sequence[MeshPart]:
    """Return the parts of a mesh file."""
    try:
        return load_mesh(path, materials=False, index=index, ending=_ending(p))
    except AssetError as error:
        raise p.element.error(str(path), f"a mesh that can be read ({error.problem})") from None


def _joined(parts: Sequence[MeshPart], *, flips: bool) -> MeshPart:
    """Return the parts of a mesh file, joined to one; ``flips``: with flipped texture coordinates."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    normals = [part.normals for part in parts if part.normals is not None]
    uvs = [part.uvs for part in parts if part.uvs is not None]
    colors = [part.colors for part in parts if part.colors is not None]
    joined = np.concatenate(uvs) if len(uvs) == len(parts) else None
    return MeshPart(
        "",
        np.concatenate([part.vertices for part in parts]),
        faces,
        normals=np.concatenate(normals) if len(normals) == len(parts) else None,
        uvs=_upside_down(joined) if flips and joined is not None else joined,
        colors=np.concatenate(colors) if len(colors) == len(parts) else None,
        flat=all(part.flat for part in parts),
    )


def _upside_down(uvs: Matrix) -> Matrix:
    """Return texture coordinates ``(n, 2)`` with v counted from the other end."""
    return uvs * [1.0, -1.0] + [0.0, 1.0]


def with_attribute(shape: Shape, names: Sequence[str], element: Element, importer: Importer) -> Shape:
    """Return a shape with the mesh attribute that its material reads as vertex colours; note what it cannot have.

    Args:
        shape: the shape.
        names: the attributes that its material reads, such as ``vertex_color`` or ``face_NAME``.
        element: the shape's.
        importer: the importer.
    """
    name, *others = names
    if others:
        importer.notes.add(
            element,
            f"{element.label}: a mesh carries one attribute, {name}, which is taken for {', '.join(others)} as well",
        )
    plugin = plugin_name(element.tag, element.type)
    flipped = any(
        property_name("shape", plugin, x.attributes.get("name", "")) == "flip_tex_coords"
        and x.attributes.get("value", "").strip().lower() == "true"
        for x in element.children
    )
    given = next(
        (x.attributes.get("value", "") for x in element.children if x.attributes.get("name") == "filename"), ""
    )
    path = importer.find(element, given.strip()) if given else None
    part = None
    if path is not None and plugin == "ply":
        try:
            if name == "vertex_color" and load_mesh(path, materials=False, ending=".ply")[0].colors is not None:
                return shape  # as the file is read anyway
            part = load_ply_attribute(path, name)
            if part is not None and part.uvs is not None and flipped:
                part = replace(part, uvs=_upside_down(part.uvs))
        except OSError as error:
            raise element.error(str(path), f"a file that can be read ({error.strerror})") from None
        except AssetError as error:
            raise element.error(str(path), f"a mesh that can be read ({error.problem})") from None
    if part is not None:
        return {**{key: value for key, value in shape.items() if key != "path"}, "mesh": (part,)}
    if name != "vertex_color" or (path is not None and plugin == "ply"):
        importer.notes.add(element, f"{element.label}: the attribute {name} is not in its file, white takes its place")
    return shape


def _sphere(p: Properties, importer: Importer) -> Shape | None:
    """Return a sphere. One that ``to_world`` stretches stays a sphere of its size along x, as in Mitsuba.

    Since version 2 a mirror, or a negative radius, turns its normals round.
    """
    radius, center, pose = p.number("radius", 1.0), p.point("center"), p.transform()
    flip = p.modern and (np.linalg.det(pose[:3, :3]) < 0.0) != (radius < 0.0)
    if radius == 0.0 or (radius < 0.0 and not p.modern):
        p.note("it is left out: its radius is not above 0")
        return None
    if similarity_scale(pose) is None:
        p.note("a stretched sphere stays one, of its size along x")
        u, _, v = np.linalg.svd(pose[:3, :3])
        middle = apply_points(pose, np.array([center or [0.0] * 3]))[0]
        pose, center = affine(u @ v * np.linalg.norm(pose[:3, 0]), middle), None
    radius = abs(radius)
    return _shape(p, "sphere", pose, flip=flip, center=center, radius=None if radius == 1.0 else radius)


def _cylinder(p: Properties, importer: Importer) -> Shape | None:
    """Return the side of a cylinder between two points. Mitsuba's axis is z, from 0 to 1; ours is y, about 0."""
    radius, low, high = p.number("radius", 1.0), p.point("p0") or [0.0] * 3, p.point("p1") or [0.0, 0.0, 1.0]
    along = np.subtract(high, low)
    length = float(np.linalg.norm(along))
    if not (length > 0.0 and radius > 0.0):
        p.note("it is left out: its length or its radius is not above 0")
        return None
    matrix = np.eye(4)
    frame = Frame.about(torch.from_numpy(along / length)[:, None])  # the one that Mitsuba takes
    matrix[:3, 0], matrix[:3, 1] = radius * frame.s[:, 0].numpy(), radius * frame.t[:, 0].numpy()
    matrix[:3, 2], matrix[:3, 3] = along, low
    ours = KINDS["cylinder"].own({"center": (0.0, 0.0, 0.0), "radius": 1.0, "height": 1.0})
    return _shape(p, "cylinder", p.transform() @ matrix @ np.linalg.inv(ours), capped=False)


def _simple(type: str) -> Any:
    return lambda p, importer: _shape(p, type, p.transform())


def bounds(shapes: Mapping[str, Shape], base: Path) -> Matrix | None:
    """Return the least and the greatest coordinates ``(2, 3)`` of shapes; None without any.

    Args:
        shapes: shapes by name.
        base: the folder where their relative paths start.
    """
    box = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T
    points: list[Matrix] = []
    for shape in shapes.values():
        solid = shapes[shape["of"]] if shape["type"] == "instance" else shape  # an instance has the whole pose itself
        own = box * solid.get("radius", 1.0) + (solid.get("center") or [0.0] * 3)
        if solid["type"] in ("rectangle", "disk"):
            own = box * [1.0, 1.0, 0.0]
        elif solid["type"] == "mesh":
            parts: Sequence[MeshPart] = solid.get("mesh") or load_mesh(
                base / solid["path"], materials=False, index=solid.get("shape_index")
            )
            own = np.concatenate([part.vertices for part in parts])
        points.append(apply_points(_pose_of(shape), own))
    found = np.concatenate(points or [np.zeros((0, 3))])
    return np.stack((found.min(0), found.max(0))) if len(found) else None


def _pose_of(shape: Shape) -> Matrix:
    return np.array(shape["transform"][0]["matrix"]) if "transform" in shape else np.eye(4)


#: Plugins of the tag ``shape``; ``shapegroup`` and ``instance`` are taken apart by the importer.
SHAPES: dict[str, Plugin] = {
    "obj": exact("mesh", _mesh),
    "ply": exact("mesh", _mesh),
    "serialized": exact("mesh", _mesh, "versions 3 and 4 of the format"),
    "sphere": exact("sphere", _sphere),
    "cylinder": exact("cylinder", _cylinder, "without caps"),
    "rectangle": exact("rectangle", _simple("rectangle")),
    "disk": exact("disk", _simple("disk")),
    "cube": exact("cube", _simple("cube")),
    "shapegroup": exact("shapes", _simple("shapes"), "its first instance, and instances of that"),
    "instance": exact("instance", _simple("instance"), "other shapes than meshes are copied"),
    "merge": exact("shapes", _simple("shapes"), "its shapes, each by itself"),
    "hair": left_out("there are no curves"),
    "bsplinecurve": left_out("there are no curves"),
    "linearcurve": left_out("there are no curves"),
    "heightfield": left_out("there are no heightfields; displacement of a mesh is like it"),
    "deformable": left_out("meshes do not move"),
    "sdfgrid": left_out("there are no distance fields"),
    "ellipsoids": left_out("there are no ellipsoids of volumes"),
    "ellipsoidsmesh": left_out("there are no ellipsoids of volumes"),
}
