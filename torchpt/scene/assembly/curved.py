"""Quadrics: what lanes need of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchpt.math.vectors import cross, dot
from torchpt.records import QUADRICS, Quadrics
from torchpt.scene.parts import Part

__all__ = ["quadrics_of"]


def quadrics_of(parts: Sequence[Part], frames: Tensor, dtype: torch.dtype) -> Quadrics:
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
