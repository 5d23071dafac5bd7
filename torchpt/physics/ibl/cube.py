"""Cube maps: six faces +X -X +Y -Y +Z -Z, seen from inside with +Y +Y -Z +Z +Y +Y up; right is forward x up."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.physics.ibl.equirect import checked, directions, look_up

__all__ = ["FACES", "cube_directions", "cube_to_equirect", "equirect_to_cube", "look_up_cube"]

#: (forward, up) of each face.
FACES = (
    ((1, 0, 0), (0, 1, 0)),
    ((-1, 0, 0), (0, 1, 0)),
    ((0, 1, 0), (0, 0, -1)),
    ((0, -1, 0), (0, 0, 1)),
    ((0, 0, 1), (0, 1, 0)),
    ((0, 0, -1), (0, 1, 0)),
)


def cube_directions(size: int, border: int = 0) -> Tensor:
    """Return unit directions ``(6, S, S, 3)`` float64 of the texel centres, with a border of ``border`` texels around faces."""
    s = (torch.arange(-border, size + border, dtype=torch.float64) + 0.5) * (2.0 / size) - 1.0
    forward, up, right = _axes(torch.float64, s.device)
    d = (
        forward[:, None, None]
        + s[None, None, :, None] * right[:, None, None]
        - s[None, :, None, None] * up[:, None, None]
    )
    return torch.nn.functional.normalize(d, dim=-1)


def equirect_to_cube(map: Tensor, size: int) -> Tensor:
    """Convert a map ``(H, W, 3)`` to faces ``(6, size, size, 3)``; differentiable.

    Where texels of a face are larger than those of the map, each is the mean of several look-ups.
    """
    checked(map)
    if not isinstance(size, int) or size < 1:
        raise SceneError("size", size, "an integer, at least 1")
    # At the centre of a face a texel is 2 / size wide.
    times = max(1, math.ceil((2.0 / size) / min(math.pi / (map.shape[0] - 1), 2.0 * math.pi / map.shape[1])))
    faces = [
        look_up(map, d.to(map)).view(size, times, size, times, 3).mean((1, 3)) for d in cube_directions(size * times)
    ]
    return torch.stack(faces)


def cube_to_equirect(cube: Tensor, height: int, width: int) -> Tensor:
    """Convert faces ``(6, S, S, 3)`` to a map ``(height, width, 3)``, interpolating across edges too; differentiable."""
    if not isinstance(cube, Tensor) or not cube.is_floating_point():
        raise SceneError("cube", type(cube).__name__, "a tensor of floats")
    if cube.dim() != 4 or cube.shape[0] != 6 or cube.shape[1] != cube.shape[2] or cube.shape[3] != 3:
        raise SceneError("cube", tuple(cube.shape), "the shape (6, S, S, 3)")
    for key, value, least in (("height", height, 2), ("width", width, 1)):
        if not isinstance(value, int) or value < least:
            raise SceneError(key, value, f"an integer, at least {least}")
    size = cube.shape[1]
    times = max(1, math.ceil(min(math.pi / (height - 1), 2.0 * math.pi / width) * 0.5 * size))
    if times == 1:
        return look_up_cube(cube, directions(height, width).permute(1, 2, 0).to(cube))
    # Texels larger than those of the faces: means over a lattice, weighted by their hat functions.
    offset = (torch.arange(1 - times, times, dtype=torch.float64)) / times
    hat = (1.0 - offset.abs()).to(cube)
    theta = (torch.arange(height)[:, None] + offset) * (math.pi / (height - 1))
    phi = (torch.arange(width)[:, None] + 0.5 + offset) * (2.0 * math.pi / width)
    tall = hat * theta.sin().clamp_min(0.0).to(cube)
    tall, wide = tall / tall.sum(1, keepdim=True), hat / hat.sum()
    sine, cosine = theta.sin()[:, :, None], theta.cos()[:, :, None]
    out = []
    for i in range(height):
        s, c = sine[i], cosine[i]
        d = torch.stack((s * phi.sin().view(1, -1), c.expand(-1, phi.numel()), -s * phi.cos().view(1, -1)), -1)
        value = look_up_cube(cube, d.to(cube)).view(len(offset), width, len(offset), 3)
        out.append(torch.einsum("awbc,a,b->wc", value, tall[i], wide))
    return torch.stack(out)


def look_up_cube(cube: Tensor, d: Tensor) -> Tensor:
    """Return radiance ``(..., 3)`` of faces ``(6, S, S, 3)`` in directions ``(..., 3)``, bilinear."""
    return _bilinear(_bordered(cube), d.reshape(-1, 3), 1).view(d.shape)


def _axes(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    forward = torch.tensor([f for f, _ in FACES], dtype=dtype, device=device)
    up = torch.tensor([u for _, u in FACES], dtype=dtype, device=device)
    return forward, up, torch.linalg.cross(forward, up)


def _bordered(cube: Tensor) -> Tensor:
    """Return the faces with a border of one texel, read from the neighbouring faces."""
    size = cube.shape[1]
    d = cube_directions(size, 1).to(cube)
    inner = torch.zeros(size + 2, size + 2, dtype=torch.bool, device=cube.device)
    inner[1:-1, 1:-1] = True
    padded = torch.nn.functional.pad(cube, (0, 0, 1, 1, 1, 1))
    edge = _bilinear(cube, d[:, ~inner].reshape(-1, 3), 0)
    place = (~inner).expand(6, -1, -1).reshape(-1).nonzero()[:, 0]
    return padded.reshape(-1, 3).index_copy(0, place, edge).view_as(padded)


def _bilinear(faces: Tensor, d: Tensor, border: int) -> Tensor:
    """Return values ``(N, 3)`` in directions ``(N, 3)`` of faces with a border, clamped at their edges."""
    rows = faces.shape[1]
    size = rows - 2 * border
    forward, up, right = _axes(d.dtype, d.device)
    face = (d @ forward.T).argmax(1)
    depth = (d * forward[face]).sum(1)
    x = ((d * right[face]).sum(1) / depth + 1.0) * (0.5 * size) - 0.5 + border
    y = (1.0 - (d * up[face]).sum(1) / depth) * (0.5 * size) - 0.5 + border
    x, y = x.clamp(0.0, rows - 1.0), y.clamp(0.0, rows - 1.0)
    i, j = (a.detach().floor().clamp_max(max(rows - 2.0, 0.0)) for a in (y, x))
    fy, fx = (y - i)[:, None], (x - j)[:, None]
    i, j = i.to(torch.int64), j.to(torch.int64)
    step = 1 if rows > 1 else 0
    flat, first = faces.reshape(-1, 3), face * (rows * rows)
    low, high = first + i * rows + j, first + (i + step) * rows + j
    a, b, c, e = (flat.index_select(0, k) for k in (low, low + step, high, high + step))
    top, bottom = a + (b - a) * fx, c + (e - c) * fx
    return top + (bottom - top) * fy
