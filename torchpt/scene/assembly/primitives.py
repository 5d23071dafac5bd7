"""All primitives of a scene in one table, from the corners of its parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.math.vectors import cross, dot, normalize
from torchpt.records import KINDS, Geometry, Quadrics
from torchpt.scene.parts import Part
from torchpt.shapes.primitive import PRIMITIVES, Corners, Primitive
from torchpt.shapes.quadrics import quadrics_of, table_of

__all__ = ["Primitives", "primitives_of"]


@dataclass(frozen=True)
class Primitives:
    """The P primitives, ordered by kind; see :class:`~torchpt.records.World` for what has no comment."""

    kinds: tuple[type[Primitive], ...]  # those that there are
    sizes: list[int]  # how many each part has
    counts: tuple[int, int, int, int, int]
    p0: Tensor
    p1: Tensor
    p2: Tensor
    e1: Tensor
    e2: Tensor
    face: Tensor  # (3, P) cross product of the edges
    sign: Tensor  # (P,) -1 where a shape's normals are turned around
    normal: Tensor
    normals: tuple[Tensor, Tensor, Tensor] | None
    bound: Tensor
    frame: Tensor | None  # (12, Q) float64: p0 e1 e2 e3 of the quadrics
    quadrics: Quadrics | None

    def still(self) -> Primitives:
        """The same without derivatives."""
        own = {name: getattr(self, name) for name in ("p0", "p1", "p2", "e1", "e2", "face", "sign", "normal", "bound")}
        return replace(self, **{name: value.detach() for name, value in own.items()})

    def spread(self, values: Sequence[int]) -> Tensor:
        """One value a part, and where given one a copy, as rows ``(P,)`` or ``(P + I,)`` by primitive and copy."""
        device = self.p0.device
        spans = self.sizes + [1] * (len(values) - len(self.sizes))
        return torch.repeat_interleave(
            torch.tensor(values, dtype=torch.int64, device=device),
            torch.tensor(spans, dtype=torch.int64, device=device),
        )

    def geometry(self, copies: Tensor | None) -> Geometry:
        """What the search sees."""
        # The corners themselves: rebuilt from edges, neighbours would no longer share them to the bit.
        q0, q1, q2 = (x.detach().to(torch.float32).contiguous() for x in (self.p0, self.p1, self.p2))
        table = None
        if self.quadrics is not None and self.frame is not None:
            table = table_of(self.quadrics, self.frame)
        return Geometry(q0, q1, q2, self.counts, table, None if copies is None else copies.detach())


def primitives_of(
    parts: Sequence[Part], corners: Sequence[Corners], dtype: torch.dtype, device: torch.device
) -> Primitives:
    """The primitives of ``parts``, which are ordered by kind as ``records.KINDS``."""
    sizes = [c.p0.shape[1] for c in corners]
    numbers = [sum(n for n, part in zip(sizes, parts, strict=True) if part.kind == kind) for kind in KINDS]
    counts = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])

    def joined(pieces: list[Tensor]) -> Tensor:
        return torch.cat(pieces, -1) if pieces else torch.zeros(3, 0, dtype=dtype, device=device)

    kinds = tuple(PRIMITIVES[kind] for kind, count in zip(KINDS, counts, strict=True) if count)
    flat = sum(count for kind, count in zip(KINDS, counts, strict=True) if count and PRIMITIVES[kind].flat)
    p0, p1, p2 = (joined([getattr(c, name) for c in corners]) for name in ("p0", "p1", "p2"))
    planar = (torch.arange(p0.shape[1], device=device) < flat) if flat < sum(counts) else None
    e1 = p1 - p0 if planar is None else torch.where(planar, p1 - p0, p1)
    e2 = p2 - p0 if planar is None else torch.where(planar, p2 - p0, p2)
    signs = torch.tensor([-1.0 if part.flip else 1.0 for part in parts], dtype=dtype, device=device)
    sign = torch.repeat_interleave(signs, torch.tensor(sizes, dtype=torch.int64, device=device))
    face = cross(e1, e2)
    normal = normalize(face) * sign
    normals = None
    if any(c.normals is not None for c in corners):
        faces = normal.split(sizes, 1)
        triples = [c.normals or (n, n, n) for c, n in zip(corners, faces, strict=True)]
        flips = [-1.0 if part.flip and c.normals is not None else 1.0 for part, c in zip(parts, corners, strict=True)]
        n0, n1, n2 = (
            joined([t[k] if f == 1.0 else t[k] * f for t, f in zip(triples, flips, strict=True)]) for k in range(3)
        )
        normals = (n0, n1, n2)
        # The outside is where the shading normals point, whatever way a file winds its faces.
        against = dot(normal, n0 + n1 + n2).detach() < 0
        normal = torch.where(against, -normal, normal)
    # Largest coordinate magnitudes over each primitive, its whole parallelogram or ellipse included.
    largest = (p0.abs() + e1.abs() + e2.abs()).detach()
    bound = dot(normal.detach().abs(), largest)
    if planar is not None:
        bound = torch.where(planar, bound, (p0.abs().sum(0) + 2.0 * e1[0].abs()).detach())
    frames = [c.frame for c in corners if c.frame is not None]
    frame = torch.cat(frames, 1) if frames else None
    curved = None
    if frame is not None:
        bent = [part for part in parts if part.quadric is not None]
        curved = quadrics_of(
            [part.quadric for part in bent if part.quadric], [part.flip for part in bent], frame, dtype
        )
    return Primitives(kinds, sizes, counts, p0, p1, p2, e1, e2, face, sign, normal, normals, bound, frame, curved)
