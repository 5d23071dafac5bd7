"""Where a point lies on its surface: texture coordinates, tangents, vertex colours; each only where something reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchpt.bsdfs import Bsdf
from torchpt.bsdfs.resolved import ResolvedMaterial
from torchpt.scene.parts import Part
from torchpt.shapes.primitive import PRIMITIVES, Corners

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
    kinds = [PRIMITIVES[part.kind] for part in parts]
    uvs = [kind.uvs(part, c) for kind, (part, c) in zip(kinds, pairs, strict=True)] if imaged or framed else []
    found: dict[str, Any] = dict.fromkeys(("tangents", "bitangents", "uvs", "axes", "mirrored", "colors"))
    if framed:
        moves = [
            kind.moves(part, c, corner, parameters[f"{part.name}.to_world"][:3, :3])
            for kind, (part, c), corner in zip(kinds, pairs, uvs, strict=True)
        ]
        found["tangents"] = torch.cat([move[0] for move in moves], 1)
        found["bitangents"] = torch.cat([move[1] for move in moves], 1) if bumpy else None
    if imaged:
        found["uvs"] = tuple(torch.cat([corner[k] for corner in uvs], 1) for k in range(3))
        balls = [parameters[f"{part.name}.to_world"] for part in parts if part.kind == "sphere"]
        if balls:
            from torchpt.shapes.primitives.sphere import axes

            found["axes"] = axes(balls, corners[0].p0.dtype)
    if (imaged or bumpy) and any(c.mirrored and part.kind == "disk" for part, c in pairs):
        flags = torch.tensor([c.mirrored for c in corners], device=corners[0].p0.device)
        found["mirrored"] = torch.repeat_interleave(flags, torch.tensor(sizes, device=flags.device))
    if coloured:
        colors = [_colors(part, c) for part, c in pairs]
        found["colors"] = tuple(torch.cat([triple[k] for triple in colors], 1) for k in range(3))
    return found


def _colors(part: Part, c: Corners) -> tuple[Tensor, Tensor, Tensor]:
    """Colours ``(3, P)`` at the corners; 1 where a shape has none."""
    if part.colors is None:
        white = torch.ones_like(c.p0)
        return white, white, white
    assert c.faces is not None
    colors = torch.from_numpy(part.colors).to(c.p0).T
    first, second, third = (colors.index_select(1, c.faces[:, k]) for k in range(3))
    return first, second, third
