"""From parts and parameters to a :class:`~torchpt.records.World`: one differentiable function of the parameters.

Whatever the scene does not hold is left out here: no smooth normals, no lights, no spheres, no second BSDF, then no tensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.bsdfs import Bsdf, Diffuse, Parameters, stacked
from torchpt.errors import SceneError
from torchpt.math.distributions import Discrete
from torchpt.math.vectors import affine, cross, dot, luminance, normalize
from torchpt.records import KINDS, QUADRICS, Copies, Geometry, Lights, Quadrics, World
from torchpt.scene.parts import Copy, MaterialSlot, Part, VertexColors
from torchpt.scene.surfaces import Surface, surface_of
from torchpt.scene.texels import images_of
from torchpt.shapes import quadrics
from torchpt.shapes.normals import smooth_normals
from torchpt.textures import Look, Node, Pick, Veils, atlas_of

__all__ = ["Corners", "assemble", "corners_of"]


@dataclass(frozen=True)
class Corners:
    """The primitives of one part: ``(3, P)`` each, see :class:`~torchpt.records.Geometry`.

    Attributes:
        normals: at the corners, or None.
        faces: ``(P, 3)`` vertices at the corners; of meshes only.
        mirrored: whether a flat shape's two axes changed places.
    """

    p0: Tensor
    p1: Tensor
    p2: Tensor
    normals: tuple[Tensor, Tensor, Tensor] | None = None
    faces: Tensor | None = None
    mirrored: bool = False
    frame: Tensor | None = None  # (12, 1) float64: p0 e1 e2 e3 of a quadric


def corners_of(part: Part, parameters: Mapping[str, Tensor], centre: Tensor, dtype: torch.dtype) -> Corners:
    """Place a part in the world, moved by ``-centre (3,)`` (float64)."""
    # The move is folded into the pose in float64, before anything is rounded to the lanes' dtype.
    pose = parameters[f"{part.name}.to_world"].double()
    if part.local is not None:
        pose = pose @ torch.from_numpy(part.local).to(pose.device)
    linear, move = pose[:3, :3], pose[:3, 3:4] - centre[:, None]
    if part.kind == "sphere":
        radius = torch.linalg.det(linear).abs() ** (1.0 / 3.0)
        zero = torch.zeros_like(radius)
        p1 = torch.stack((radius, zero, zero))[:, None]
        return Corners(move.to(dtype), p1.to(dtype), torch.zeros_like(move).to(dtype))
    x, y = linear[:, 0:1], linear[:, 1:2]
    if part.kind == "quadric":
        frame = torch.cat((move, x, y, linear[:, 2:3]))
        return Corners(move.to(dtype), x.to(dtype), y.to(dtype), frame=frame)
    mirrored = bool(torch.linalg.det(linear.detach()) < 0)
    if mirrored:
        x, y = y, x  # mirrored, a flat shape still faces where its own +z goes, as in Mitsuba
    if part.kind == "rectangle":  # Mitsuba's unit shape [-1, 1]^2 from its lower corner
        x, y = 2.0 * x, 2.0 * y
        p0 = move - 0.5 * (x + y)
        return Corners(p0.to(dtype), (p0 + x).to(dtype), (p0 + y).to(dtype), mirrored=mirrored)
    if part.kind == "disk":
        p1, p2 = move + x, move + y
        return Corners(move.to(dtype), p1.to(dtype), p2.to(dtype), mirrored=mirrored)
    vertices = linear @ parameters[f"{part.name}.vertices"].T.double() + move
    device = vertices.device
    assert part.faces is not None
    faces = torch.from_numpy(part.faces).to(device)
    if mirrored:
        faces = faces[:, [0, 2, 1]]  # a mirrored mesh keeps its outside
    vertices = vertices.to(dtype)
    p0, p1, p2 = (vertices.index_select(1, faces[:, k]) for k in range(3))
    if not part.smooth:
        return Corners(p0, p1, p2, None, faces)
    if part.normals is None:
        normals = smooth_normals(vertices, faces)
    else:
        own = torch.from_numpy(part.normals).to(device)
        normals = normalize(torch.linalg.inv(linear).T @ own.T).to(dtype)
    flat = normalize(cross(p1 - p0, p2 - p0))
    n0, n1, n2 = (normals.index_select(1, faces[:, k]) for k in range(3))
    # A corner without a normal takes its face's.
    n0, n1, n2 = (torch.where(dot(n, n) > 0, n, flat) for n in (n0, n1, n2))
    return Corners(p0, p1, p2, (n0, n1, n2), faces)


def assemble(
    parts: Sequence[Part],
    parameters: Mapping[str, Tensor],
    environment: Tensor | None,
    centre: Tensor,
    dtype: torch.dtype,
    copies: Sequence[Copy] = (),
    uv: bool = False,
) -> tuple[World, Geometry]:
    """The world of ``parts`` under ``parameters``, and what the search sees of it.

    Args:
        parts: ordered by kind as ``records.KINDS``.
        parameters: every tensor by dotted name.
        environment: radiance ``(3,)`` of a constant environment, or None.
        centre: ``(3,)`` float64 that becomes the origin.
        dtype: of the lanes.
        copies: instances of parts.
        uv: whether texture coordinates are wanted even if no texture reads them.
    """
    device = centre.device
    corners = [corners_of(part, parameters, centre, dtype) for part in parts]
    sizes = [c.p0.shape[1] for c in corners]
    counts = tuple(sum(n for n, part in zip(sizes, parts, strict=True) if part.kind == kind) for kind in KINDS)

    def joined(pieces: list[Tensor]) -> Tensor:
        return torch.cat(pieces, -1) if pieces else torch.zeros(3, 0, dtype=dtype, device=device)

    def spread(values: list[int]) -> Tensor:
        """One value a part, and where given one a copy, as rows by primitive and copy."""
        spans = sizes + [1] * (len(values) - len(sizes))
        return torch.repeat_interleave(
            torch.tensor(values, dtype=torch.int64, device=device),
            torch.tensor(spans, dtype=torch.int64, device=device),
        )

    owners: list[Part | Copy] = [*parts, *copies]

    ball = counts[3] + counts[4] > 0
    first_sphere = sum(counts[:3])
    p0, p1, p2 = (joined([getattr(c, name) for c in corners]) for name in ("p0", "p1", "p2"))
    planar = (torch.arange(p0.shape[1], device=device) < first_sphere) if ball else None
    e1 = p1 - p0 if planar is None else torch.where(planar, p1 - p0, p1)
    e2 = p2 - p0 if planar is None else torch.where(planar, p2 - p0, p2)
    sign = torch.where(spread([int(part.flip) for part in parts]) > 0, -1.0, 1.0).to(dtype)
    face = cross(e1, e2)
    normal = normalize(face) * sign
    normals = None
    if any(c.normals is not None for c in corners):
        flat = normal.split(sizes, 1)
        triples = [c.normals or (n, n, n) for c, n in zip(corners, flat, strict=True)]
        flips = [-1.0 if part.flip and c.normals is not None else 1.0 for part, c in zip(parts, corners, strict=True)]
        n0, n1, n2 = (joined([t[k] * f for t, f in zip(triples, flips, strict=True)]) for k in range(3))
        normals = (n0, n1, n2)
        # The outside is where the shading normals point, whatever way a file winds its faces.
        against = dot(normal, n0 + n1 + n2).detach() < 0
        normal = torch.where(against, -normal, normal)
    bound = dot(normal.detach().abs(), _largest(p0, e1, e2).detach())
    if planar is not None:
        bound = torch.where(planar, bound, (p0.abs().sum(0) + 2.0 * e1[0].abs()).detach())
    frames = [c.frame for c in corners if c.frame is not None]
    frame = torch.cat(frames, 1) if frames else None
    curved = None if frame is None else _quadrics([part for part in parts if part.kind == "quadric"], frame, dtype)

    slots = {owner.material.name: owner.material for owner in owners}
    surfaces = {name: surface_of(slot, parameters, dtype) for name, slot in slots.items()}
    nodes = _nodes(slots.values())
    kinds, rows, tables, looks, two_sided = _materials(slots, surfaces, nodes, parameters, dtype, device)
    models = tuple(model for model, _ in kinds)
    wide = sizes + [1] * len(copies)
    opacity = _opacity(owners, surfaces, wide, dtype, device)
    emissive = spread([int(part.emission is None) for part in parts] + [1] * len(copies))  # 0 where it emits
    keys = emissive * len(models) + spread([rows[owner.material.name][0] for owner in owners])
    key = torch.cat((torch.full((1,), 2 * len(models), device=device), keys)).to(torch.uint8)
    lights = _lights(
        parts,
        sizes,
        parameters,
        environment,
        p0,
        e1,
        e2,
        normal,
        bound,
        sign,
        face,
        opacity,
        emissive,
        frame,
        curved,
        dtype,
    )
    shown = [part for part in parts if part.emission is not None]
    if lights is not None and any(part.glow or surfaces[part.material.name].cover for part in shown):
        prim = (emissive == 0).nonzero().squeeze(1)
        rest = prim.new_zeros(len(lights.area) - len(prim))  # the environment's
        lights = replace(lights, prim=torch.cat((prim, rest)))
    glows = None
    if any(part.glow is not None for part in parts):
        glows = spread([-1 if part.glow is None else nodes[part.glow] for part in parts] + [-1] * len(copies))
    maps = _copy_maps(parts, sizes, copies, parameters, centre) if copies else None
    # The search gets the corners themselves: rebuilt from edges, neighbours would no longer share them to the bit.
    q0, q1, q2 = (x.detach().to(torch.float32).contiguous() for x in (p0, p1, p2))
    size = (counts[0], counts[1], counts[2], counts[3], counts[4])
    table = None
    if curved is not None and frame is not None:
        table = torch.cat((frame, curved.code[None].double())).detach()
    world = World(
        counts=size,
        p0=p0,
        e1=e1,
        e2=e2,
        normal=normal,
        bound=bound,
        flip=sign if counts[3] else None,
        normals=normals,
        **_charts(parts, corners, sizes, parameters, slots, models, uv),
        opacity=opacity,
        material=spread([rows[owner.material.name][1] for owner in owners]),
        key=key,
        models=models,
        bsdfs=tables,
        looks=looks,
        textures=atlas_of(list(nodes), images_of(list(nodes), parameters), dtype, device) if nodes else None,
        veils=_veils(owners, surfaces, nodes, wide, dtype, device),
        glows=glows,
        two_sided=two_sided,
        object_id=spread([owner.object_id for owner in owners]),
        lights=lights,
        quadrics=curved,
        copies=None if maps is None else _copies(maps, copies, dtype),
    )
    return world, Geometry(q0, q1, q2, size, table, None if maps is None else maps.detach())


#: Ids of primitives are int32 in the searches.
MOST_PRIMITIVES = 2**31 - 1


def _copy_maps(
    parts: Sequence[Part], sizes: list[int], copies: Sequence[Copy], parameters: Mapping[str, Tensor], centre: Tensor
) -> Tensor:
    """Where copies lie relative to their meshes: ``(15, I)`` float64, see :class:`~torchpt.records.Geometry`."""
    first, at = {}, 0
    for part, n in zip(parts, sizes, strict=True):
        first[part.name], at = (at, n), at + n
    if at + sum(first[copy.of][1] for copy in copies) > MOST_PRIMITIVES:
        raise SceneError(
            "shapes", at + sum(first[c.of][1] for c in copies), "at most 2^31 - 1 primitives, copies included"
        )
    back = {name: torch.linalg.inv(parameters[f"{name}.to_world"].double()) for name in {copy.of for copy in copies}}
    shift = torch.eye(4, dtype=torch.float64, device=centre.device)
    shift[:3, 3] = centre
    columns = []
    for copy in copies:
        start, n = first[copy.of]
        pose = parameters[f"{copy.name}.to_world"].double()
        matrix = (torch.linalg.inv(shift) @ pose @ back[copy.of] @ shift)[:3]
        columns.append(torch.cat((matrix.reshape(-1), matrix.new_tensor([start, n, at]))))
        at += n
    return torch.stack(columns, 1)


def _copies(maps: Tensor, copies: Sequence[Copy], dtype: torch.dtype) -> Copies:
    """What lanes need of copies, the identity first."""
    same = torch.eye(3, 4, dtype=torch.float64, device=maps.device).reshape(-1)
    maps = torch.cat((torch.cat((same, same.new_zeros(3)))[:, None], maps), 1)
    x, y, z, move = (maps[k:12:4] for k in range(4))
    faces = [cross(y, z), cross(z, x), cross(x, y)]
    front = torch.tensor([1.0] + [-1.0 if copy.flip else 1.0 for copy in copies], dtype=x.dtype, device=x.device)
    front = front * torch.sign(dot(x, faces[0]).detach())
    scale = torch.stack(faces).detach().abs().amax((0, 1))
    nx, ny, nz = ((n * (front / scale)).to(dtype) for n in faces)
    first, start = maps[12].detach().to(torch.int64), maps[14].detach().to(torch.int64)
    return Copies(start, first, x.to(dtype), y.to(dtype), z.to(dtype), move.to(dtype), nx, ny, nz)


def _quadrics(parts: Sequence[Part], frames: Tensor, dtype: torch.dtype) -> Quadrics:
    """What lanes need of quadrics, from frames ``(12, Q)``; in float64 until it is their normals' directions."""
    p0, e1, e2, e3 = frames[0:3], frames[3:6], frames[6:9], frames[9:12]
    faces = [cross(e2, e3), cross(e3, e1), cross(e1, e2)]
    front = torch.tensor([-1.0 if part.flip else 1.0 for part in parts], dtype=p0.dtype, device=p0.device)
    front = front * torch.sign(dot(e1, faces[0]).detach())
    scale = torch.stack(faces).detach().abs().amax((0, 1))
    n1, n2, n3 = ((n * (front / scale)).to(dtype) for n in faces)
    reach = (p0.abs() + e1.abs() + e2.abs() + e3.abs()).detach().to(dtype)
    code = torch.tensor([QUADRICS.index(part.quadric) for part in parts], dtype=torch.int64, device=p0.device)
    return Quadrics(code, e3.to(dtype), n1, n2, n3, reach)


def _quadric_area(code: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Areas ``(Q,)`` float64 of quadrics: their own space's times ``|det|``, and (by quadrature, detached) the world's."""
    e1, e2, e3 = frames[3:6], frames[6:9], frames[9:12]
    own = torch.tensor(quadrics.AREAS, dtype=torch.float64, device=e1.device)[code]
    det = dot(e1, cross(e2, e3)).abs()
    faces = [n.detach() for n in (cross(e2, e3), cross(e3, e1), cross(e1, e2))]
    grid = (torch.arange(16, dtype=torch.float64, device=e1.device) + 0.5) / 16
    spots = torch.cartesian_prod(grid, grid)
    total = torch.zeros_like(own)
    for spot in spots:
        n = quadrics.normal(code, quadrics.sample(code, spot[:, None].expand(2, len(own))))
        grown = affine(faces[0] * n[0], faces[1], n[1], faces[2], n[2])
        total += (dot(grown, grown) / dot(n, n)).sqrt()
    return own * det, own * total / len(spots)


def _largest(p0: Tensor, e1: Tensor, e2: Tensor) -> Tensor:
    """Largest coordinate magnitudes over each primitive, its whole parallelogram or ellipse included."""
    return p0.abs() + e1.abs() + e2.abs()


#: Lanes are sorted by keys of 8 bits, two for each model.
MOST_MODELS = 120


def _nodes(slots: Iterable[MaterialSlot]) -> dict[Node, int]:
    """Every way in which images are read, numbered."""
    readings = [reading for slot in slots for reading in slot.readings()]
    return {node: k for k, node in enumerate(dict.fromkeys(r for r in readings if isinstance(r, Node)))}


#: What the lanes of a group have in common: a model, and which of its parameters are read from what.
Kind = tuple[Bsdf, Any]


def _materials(
    slots: Mapping[str, MaterialSlot],
    surfaces: Mapping[str, Surface],
    nodes: Mapping[Node, int],
    parameters: Mapping[str, Tensor],
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[
    tuple[Kind, ...],
    dict[str, tuple[int, int]],
    tuple[Parameters, ...],
    tuple[Look | None, ...],
    tuple[Tensor | None, ...],
]:
    """Groups of materials, the group and row of each, stacked parameters, textures, and which rows are two-sided."""
    groups: dict[Kind, list[str]] = {}
    for name, surface in surfaces.items():
        groups.setdefault(_kind(slots[name], surface), []).append(name)
    if not groups:
        groups[Diffuse(), None] = []
    if len(groups) > MOST_MODELS:
        expected = f"at most {MOST_MODELS} models, blends and textured ones counted by what they are made of"
        raise SceneError("materials", len(groups), expected)
    rows, tables, looks, sides = {}, [], [], []
    for number, ((model, form), names) in enumerate(groups.items()):
        rows |= {name: (number, row) for row, name in enumerate(names)}
        if form is None:
            tables.append(stacked([model.prepare(surfaces[name].values) for name in names]))
            looks.append(None)
        else:
            tables.append(stacked([_tabulated(model, surfaces[name].values) for name in names]))
            look = _look([slots[name] for name in names], [surfaces[name] for name in names], nodes, device)
            strong = [f"{name}.normal_strength" for name in names]
            if any(name in parameters for name in strong):
                one = torch.ones((), dtype=dtype, device=device)
                strengths = [parameters[name].to(one) if name in parameters else one for name in strong]
                look = replace(look, strength=torch.stack(strengths))
            looks.append(look)
        both = [slots[name].two_sided for name in names]
        sides.append(None if all(both) else torch.tensor(both, device=device))
    return tuple(groups), rows, tuple(tables), tuple(looks), tuple(sides)


def _tabulated(model: Bsdf, values: Parameters) -> Parameters:
    """Values with what the model tabulates of them."""

    def merged(a: Parameters, b: Parameters) -> Parameters:
        inner = {key: merged(a[key], value) for key, value in b.items() if isinstance(value, dict)}
        return {**a, **b, **inner}

    return merged(values, model.tabulate(values))


def _kind(slot: MaterialSlot, surface: Surface) -> Kind:
    """The group of a material; materials without textures share that of their model."""
    if not surface.readings and slot.normal_map is None and slot.bump_map is None:
        return surface.model, None

    def form(value: Any) -> Any:
        if isinstance(value, dict):
            return tuple(sorted((key, form(item)) for key, item in value.items()))
        if isinstance(value, VertexColors):
            return ("vertices", str(value.channel))
        return ("image", str(value.channel is None)) if isinstance(value, Node) else "number"

    maps = slot.normal_map is not None, slot.bump_map is not None
    return surface.model, (form(surface.values), form(surface.readings), maps)


def _look(
    slots: Sequence[MaterialSlot], surfaces: Sequence[Surface], nodes: Mapping[Node, int], device: torch.device
) -> Look:
    """The textures of materials of one form."""

    def image(column: Sequence[Node]) -> Pick:
        numbers = torch.tensor([nodes[node] for node in column], device=device)
        return Pick(numbers, column[0].channel, any(node.filtered for node in column))

    def relief(column: list[Node | None]) -> Pick | None:
        found = [node for node in column if node is not None]
        return image(found) if found else None

    def pick(column: list[Any]) -> Any:
        first = column[0]
        if isinstance(first, dict):
            return {key: pick([item[key] for item in column]) for key in first}
        if isinstance(first, VertexColors):
            return Pick(None, first.channel)
        return image(column)

    readings = pick([surface.readings for surface in surfaces])
    return Look(
        readings,
        relief([slot.normal_map for slot in slots]),
        relief([slot.bump_map for slot in slots]),
        filtered=any(isinstance(r, Node) and r.filtered for slot in slots for r in slot.readings()),
    )


def _veils(
    parts: Sequence[Part | Copy],
    surfaces: Mapping[str, Surface],
    nodes: Mapping[Node, int],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> Veils | None:
    """Textures of opacity by primitive; None where there are none."""
    covers = [surfaces[part.material.name].cover for part in parts]
    if all(cover is None for cover in covers):
        return None
    size = torch.tensor(sizes, dtype=torch.int64, device=device)

    def spread(values: list[Any], kind: torch.dtype) -> Tensor:
        return torch.repeat_interleave(torch.tensor(values, dtype=kind, device=device), size)

    cutoffs = [
        -1.0 if cover is None or part.material.alpha_cutoff is None else part.material.alpha_cutoff
        for cover, part in zip(covers, parts, strict=True)
    ]
    return Veils(
        spread([-1 if cover is None else nodes[cover.node] for cover in covers], torch.int64),
        spread([0.0 if cover is None else cover.bias for cover in covers], dtype),
        spread([1.0 if cover is None else cover.factor for cover in covers], dtype),
        spread(cutoffs, dtype) if any(cutoff >= 0 for cutoff in cutoffs) else None,
    )


def _opacity(
    parts: Sequence[Part | Copy],
    surfaces: Mapping[str, Surface],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor | None:
    """The chance ``(P,)`` that a ray meets a primitive; None where it always does."""
    if all(surface.opacity is None and surface.cover is None for surface in surfaces.values()):
        return None
    whole = torch.ones(1, dtype=dtype, device=device)
    found = [surfaces[part.material.name].opacity for part in parts]
    return torch.cat([(whole if x is None else x).expand(n) for x, n in zip(found, sizes, strict=True)])


def _charts(
    parts: Sequence[Part],
    corners: Sequence[Corners],
    sizes: list[int],
    parameters: Mapping[str, Tensor],
    slots: Mapping[str, MaterialSlot],
    models: Sequence[Bsdf],
    uv: bool,
) -> dict[str, Any]:
    """What of :class:`World` says where a point lies on its surface, each thing only where something reads it."""
    readings = [reading for slot in slots.values() for reading in slot.readings()]
    # Filtered look-ups ask how large a surface's texels are.
    bumpy = any(slot.bump_map is not None for slot in slots.values())
    bumpy = bumpy or any(isinstance(reading, Node) and reading.filtered for reading in readings)
    framed = bumpy or any(slot.normal_map is not None for slot in slots.values()) or any(m.anisotropic for m in models)
    imaged = uv or any(isinstance(reading, Node) for reading in readings)
    coloured = any(isinstance(reading, VertexColors) for reading in readings)
    pairs = list(zip(parts, corners, strict=True))
    uvs = [_uvs(part, c) for part, c in pairs] if imaged or framed else []
    found: dict[str, Any] = dict.fromkeys(("tangents", "bitangents", "uvs", "axes", "mirrored", "colors"))
    if framed:
        moves = [_moves(part, c, corner, parameters) for (part, c), corner in zip(pairs, uvs, strict=True)]
        found["tangents"] = torch.cat([move[0] for move in moves], 1)
        found["bitangents"] = torch.cat([move[1] for move in moves], 1) if bumpy else None
    if imaged:
        found["uvs"] = tuple(torch.cat([corner[k] for corner in uvs], 1) for k in range(3))
        balls = [parameters[f"{part.name}.to_world"][:3, :3] for part in parts if part.kind == "sphere"]
        if balls:
            dtype = corners[0].p0.dtype
            found["axes"] = tuple(normalize(torch.stack([b[:, k] for b in balls], 1).to(dtype)) for k in range(3))
    if (imaged or bumpy) and any(c.mirrored and part.kind == "disk" for part, c in pairs):
        flags = torch.tensor([c.mirrored for c in corners], device=corners[0].p0.device)
        found["mirrored"] = torch.repeat_interleave(flags, torch.tensor(sizes, device=flags.device))
    if coloured:
        colors = [_colors(part, c) for part, c in pairs]
        found["colors"] = tuple(torch.cat([triple[k] for triple in colors], 1) for k in range(3))
    return found


def _uvs(part: Part, c: Corners) -> tuple[Tensor, Tensor, Tensor]:
    """Texture coordinates ``(2, P)`` at the corners; zero for shapes that have others, see ``shapes.uv``."""
    like = c.p0[:2]
    if part.kind not in ("triangle", "rectangle"):
        nothing = torch.zeros_like(like)
        return nothing, nothing, nothing
    if part.uvs is None:
        origin, u, v = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
        if c.mirrored:
            u, v = v, u
        first, second, third = (like.new_tensor(corner)[:, None].expand_as(like) for corner in (origin, u, v))
        return first, second, third
    assert c.faces is not None
    uv = torch.from_numpy(part.uvs).to(like).T
    first, second, third = (uv.index_select(1, c.faces[:, k]) for k in range(3))
    return first, second, third


def _moves(
    part: Part, c: Corners, uvs: tuple[Tensor, Tensor, Tensor], parameters: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor]:
    """How points move with ``u`` and with ``v``, ``(3, P)`` each; of spheres, disks and quadrics see ``shapes.interaction``."""
    if part.kind in ("disk", "quadric"):
        return torch.zeros_like(c.p0), torch.zeros_like(c.p0)
    if part.kind == "sphere":
        linear = parameters[f"{part.name}.to_world"][:3, :3].to(c.p0)
        radius, zero = c.p1[0].abs(), torch.zeros_like(c.p1[0])
        turned = -1.0 if part.flip else 1.0  # the normal is
        handed = torch.sign(torch.linalg.det(linear.detach())) * turned
        around = normalize(linear[:, 2:3]) * (2.0 * math.pi * radius * handed)
        return around, torch.stack((math.pi * radius * handed, zero, zero))
    if part.kind == "triangle" and part.uvs is None:
        return torch.zeros_like(c.p0), torch.zeros_like(c.p0)
    e1, e2 = c.p1 - c.p0, c.p2 - c.p0
    a, b = uvs[1] - uvs[0], uvs[2] - uvs[0]
    det = a[0] * b[1] - a[1] * b[0]
    some = det != 0
    inverse = torch.where(some, 1.0, 0.0) / torch.where(some, det, 1.0)
    return (e1 * b[1] - e2 * a[1]) * inverse, (e2 * a[0] - e1 * b[0]) * inverse


def _colors(part: Part, c: Corners) -> tuple[Tensor, Tensor, Tensor]:
    """Colours ``(3, P)`` at the corners; 1 where a shape has none."""
    if part.colors is None:
        white = torch.ones_like(c.p0)
        return white, white, white
    assert c.faces is not None
    colors = torch.from_numpy(part.colors).to(c.p0).T
    first, second, third = (colors.index_select(1, c.faces[:, k]) for k in range(3))
    return first, second, third


def _emission(part: Part, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> Tensor:
    """Radiance ``(3,)`` of a part that emits."""
    radiance, *strength = (parameters[name].to(dtype) for name in part.emission_names)
    if part.glow is not None:
        return radiance.expand(3)  # the strength alone: the texture's share is looked up
    return radiance if not strength else radiance * strength[0]


def _mean_glow(part: Part, parameters: Mapping[str, Tensor]) -> float:
    """Mean luminance of the texture that a part shines by; 1 without."""
    if part.glow is None:
        return 1.0
    image = images_of([part.glow], parameters)[part.glow.texels].detach().double()
    color = image[..., :3].mean((0, 1)) if image.shape[2] >= 3 else image[..., 0].mean().expand(3)
    return float(luminance((color * color.new_tensor(part.glow.scale)).abs()))


def _lights(
    parts: Sequence[Part],
    sizes: list[int],
    parameters: Mapping[str, Tensor],
    environment: Tensor | None,
    p0: Tensor,
    e1: Tensor,
    e2: Tensor,
    normal: Tensor,
    bound: Tensor,
    sign: Tensor,
    face: Tensor,
    opacity: Tensor | None,
    emissive: Tensor,
    frame: Tensor | None,
    curved: Quadrics | None,
    dtype: torch.dtype,
) -> Lights | None:
    rows = (emissive == 0).nonzero().squeeze(1)
    if not len(rows) and environment is None:
        return None
    device = p0.device
    glowing = [(part, n) for part, n in zip(parts, sizes, strict=True) if part.emission is not None]
    kinds = tuple(kind for kind in KINDS if any(part.kind == kind and n for part, n in glowing))
    scale = {"triangle": 0.5, "rectangle": 1.0, "disk": math.pi, "sphere": 0.0, "quadric": 0.0}
    counts = torch.tensor([n for _, n in glowing], dtype=torch.int64, device=device)
    of_kind = torch.tensor([KINDS.index(part.kind) for part, _ in glowing], dtype=torch.int64, device=device)
    of_kind = torch.repeat_interleave(of_kind, counts)
    share = torch.tensor([scale[kind] for kind in KINDS], dtype=dtype, device=device)[of_kind]
    raw = face.index_select(1, rows)
    area = dot(raw, raw).clamp_min(torch.finfo(dtype).tiny).sqrt() * share
    q0, q1, q2, qn = (x.index_select(1, rows) for x in (p0, e1, e2, normal))
    area = torch.where(of_kind == KINDS.index("sphere"), (4.0 * math.pi) * q1[0] * q1[0], area)
    radiance = [_emission(part, parameters, dtype)[:, None].expand(3, n) for part, n in glowing]
    radiance = torch.cat(radiance, 1) if radiance else torch.zeros(3, 0, dtype=dtype, device=device)
    seen = None if opacity is None else opacity.index_select(0, rows)
    whole, column = area.detach().double(), None
    if frame is not None and curved is not None and "quadric" in kinds:
        bent = of_kind == KINDS.index("quadric")
        first = len(p0[0]) - len(curved.code)
        column = torch.where(bent, rows - first, 0)
        own, world_area = _quadric_area(curved.code, frame)
        area = torch.where(bent, own.to(dtype).index_select(0, column), area)
        whole = torch.where(bent, world_area.index_select(0, column), whole)
    if any(part.glow is not None for part, _ in glowing):
        shares = [_mean_glow(part, parameters) for part, _ in glowing]
        share_of = torch.repeat_interleave(torch.tensor(shares, dtype=torch.float64, device=device), counts)
    else:
        share_of = 1.0
    power = (share_of * luminance(radiance.detach().double().abs()) * whole) * math.pi
    if seen is not None:
        power = power * seen.detach().double()
    kind = torch.tensor([kinds.index(k) if k in kinds else 0 for k in KINDS], device=device)[of_kind]
    extra = [bound.index_select(0, rows), sign.index_select(0, rows)]
    if environment is not None:
        # A row of its own, whose surface is never read; its flux through the sphere about the scene, 4 pi^2 R^2 L.
        half = e1.abs() + e2.abs()
        if curved is not None:
            half = torch.cat((half[:, : -len(curved.code)], half[:, -len(curved.code) :] + curved.e3.abs()), 1)
        low, high = (p0 - half).double(), (p0 + half).double()
        reach = (high.amax(1) - low.amin(1)).norm() * 0.5 if p0.shape[1] else torch.ones((), device=device)
        flux = 4.0 * math.pi**2 * reach.detach() ** 2 * luminance(environment.detach().double().abs())
        power = torch.cat((power, flux.reshape(1)))
        kinds = (*kinds, "constant")
        kind = torch.cat((kind, torch.tensor([len(kinds) - 1], device=device)))
        blank = torch.zeros(3, 1, dtype=dtype, device=device)
        q0, q1, q2, qn = (torch.cat((x, blank), 1) for x in (q0, q1, q2, qn))
        area, *extra = (torch.cat((x, torch.ones(1, dtype=dtype, device=device))) for x in (area, *extra))
        column = None if column is None else torch.cat((column, torch.zeros_like(column[:1])))
        radiance = torch.cat((radiance, environment.to(dtype)[:, None]), 1)
        seen = None if seen is None else torch.cat((seen, torch.ones_like(area[:1])))
    index = None
    if len(rows):
        index = torch.full((len(emissive),), -1, dtype=torch.int64, device=device)
        index[rows] = torch.arange(len(rows), device=device)
    many = len(area) > 1
    return Lights(
        choice=Discrete.of(power, dtype) if many else None,
        kinds=kinds,
        kind=kind if many else None,
        p0=q0,
        e1=q1,
        e2=q2,
        normal=qn,
        flip=extra[1],
        area=area,
        bound=extra[0],
        radiance=radiance,
        opacity=seen,
        environment=None if environment is None else environment.to(dtype),
        row_of_prim=index,
        quadric=column,
        quadrics=None if column is None else curved,
    )
