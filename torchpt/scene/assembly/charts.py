"""Where a point lies on its surface: texture coordinates, tangents, vertex colours; each only where something reads it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchpt.bsdfs import Bsdf
from torchpt.bsdfs.resolved import ResolvedMaterial
from torchpt.math.vectors import normalize
from torchpt.scene.assembly.corners import Corners
from torchpt.scene.parts import Part

__all__ = ["charts_of"]


def charts_of(
    parts: Sequence[Part],
    corners: Sequence[Corners],
    sizes: list[int],
    parameters: Mapping[str, Tensor],
    materials: Mapping[str, ResolvedMaterial],
    models: Sequence[Bsdf],
    uv: bool,
) -> dict[str, Any]:
    """What of :class:`World` says where a point lies on its surface, each thing only where something reads it."""
    readings = [reading for material in materials.values() for reading in material.readings()]
    # Filtered look-ups ask how large a surface's texels are.
    bumpy = any(material.bump_map is not None for material in materials.values())
    bumpy = bumpy or any(reading.filtered for reading in readings)
    framed = (
        bumpy
        or any(material.normal_map is not None for material in materials.values())
        or any(m.anisotropic for m in models)
    )
    imaged = uv or any(reading.reads == "uv" for reading in readings)
    coloured = any(reading.reads == "colors" for reading in readings)
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
        handed = torch.sign(torch.linalg.det(linear.detach().double())).to(c.p0) * turned
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
