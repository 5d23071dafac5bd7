"""Cube maps: six faces +X -X +Y -Y +Z -Z, seen from inside with +Y +Y -Z +Z +Y +Y up; right is forward x up.

A cube is a tensor ``(6, S, S, 3)``: face, row from the top, column from the left, RGB. These functions convert between cubes
and equirectangular maps; the two conversions belong to the public :mod:`torchpt.ibl`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.physics.ibl.equirect import check_map, directions, look_up

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
    # Texel centres of the face of the cube [-1, 1]^3.
    centres = (torch.arange(-border, size + border, dtype=torch.float64) + 0.5) * (2.0 / size) - 1.0
    forward, up, right = _axes(torch.float64, centres.device)
    d = (
        forward[:, None, None]
        + centres[None, None, :, None] * right[:, None, None]
        - centres[None, :, None, None] * up[:, None, None]
    )
    return torch.nn.functional.normalize(d, dim=-1)


def equirect_to_cube(map: Tensor, size: int) -> Tensor:
    """Convert a map ``(H, W, 3)`` to faces ``(6, size, size, 3)``; differentiable.

    Where texels of a face are larger than those of the map, each is the mean of several look-ups.
    """
    check_map(map)
    if not isinstance(size, int) or size < 1:
        raise SceneError("size", size, "an integer, at least 1")
    # Look-ups a texel, along each axis. At the centre of a face a texel is 2 / size wide.
    refinement = max(1, math.ceil((2.0 / size) / min(math.pi / (map.shape[0] - 1), 2.0 * math.pi / map.shape[1])))
    faces = [
        look_up(map, d.to(map)).view(size, refinement, size, refinement, 3).mean((1, 3))
        for d in cube_directions(size * refinement)
    ]
    return torch.stack(faces)


def cube_to_equirect(cube: Tensor, height: int, width: int) -> Tensor:
    """Convert faces ``(6, S, S, 3)`` to a map ``(height, width, 3)``, interpolating across edges too; differentiable."""
    if not isinstance(cube, Tensor) or not cube.is_floating_point():
        raise SceneError("cube", type(cube).__name__, "a tensor of floats")
    if cube.dim() != 4 or cube.shape[0] != 6 or cube.shape[1] != cube.shape[2] or cube.shape[3] != 3:
        raise SceneError("cube", tuple(cube.shape), "the shape (6, S, S, 3)")
    for key, value, minimum in (("height", height, 2), ("width", width, 1)):
        if not isinstance(value, int) or value < minimum:
            raise SceneError(key, value, f"an integer, at least {minimum}")
    size = cube.shape[1]
    # The size of the map's texels in texels of the faces, of which 2 / size is one at the centre of a face.
    refinement = max(1, math.ceil(min(math.pi / (height - 1), 2.0 * math.pi / width) * 0.5 * size))
    if refinement == 1:
        return look_up_cube(cube, directions(height, width).permute(1, 2, 0).to(cube))
    # Texels larger than those of the faces: means over a lattice of O x O points, weighted by the texel's hat function (1 at
    # its centre, 0 at the neighbours') and, between rows, by the sine of the polar angle, as rows shrink toward the poles.
    offset = (torch.arange(1 - refinement, refinement, dtype=torch.float64)) / refinement  # (O,) in texels
    hat = (1.0 - offset.abs()).to(cube)
    theta = (torch.arange(height)[:, None] + offset) * (math.pi / (height - 1))  # (height, O) from +y
    phi = (torch.arange(width)[:, None] + 0.5 + offset) * (2.0 * math.pi / width)  # (width, O)
    row_weight = hat * theta.sin().clamp_min(0.0).to(cube)
    row_weight, column_weight = row_weight / row_weight.sum(1, keepdim=True), hat / hat.sum()
    sine, cosine = theta.sin()[:, :, None], theta.cos()[:, :, None]
    out = []
    for i in range(height):
        sin_i, cos_i = sine[i], cosine[i]
        d = torch.stack(
            (sin_i * phi.sin().view(1, -1), cos_i.expand(-1, phi.numel()), -sin_i * phi.cos().view(1, -1)), -1
        )
        value = look_up_cube(cube, d.to(cube)).view(len(offset), width, len(offset), 3)
        # a: offset between rows, w: column, b: offset between columns, c: channel.
        out.append(torch.einsum("awbc,a,b->wc", value, row_weight[i], column_weight))
    return torch.stack(out)


def look_up_cube(cube: Tensor, d: Tensor) -> Tensor:
    """Return radiance ``(..., 3)`` of faces ``(6, S, S, 3)`` in directions ``(..., 3)``, bilinear."""
    return _bilinear(_bordered(cube), d.reshape(-1, 3), border=1).view(d.shape)


def _axes(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return forward, up and right of the faces, each ``(6, 3)``."""
    forward = torch.tensor([face_forward for face_forward, _ in FACES], dtype=dtype, device=device)
    up = torch.tensor([face_up for _, face_up in FACES], dtype=dtype, device=device)
    return forward, up, torch.linalg.cross(forward, up)


def _bordered(cube: Tensor) -> Tensor:
    """Return the faces with a border of one texel, read from the neighbouring faces."""
    size = cube.shape[1]
    d = cube_directions(size, border=1).to(cube)
    inner = torch.zeros(size + 2, size + 2, dtype=torch.bool, device=cube.device)
    inner[1:-1, 1:-1] = True
    padded = torch.nn.functional.pad(cube, (0, 0, 1, 1, 1, 1))
    border_values = _bilinear(cube, d[:, ~inner].reshape(-1, 3), border=0)
    border_index = (~inner).expand(6, -1, -1).reshape(-1).nonzero()[:, 0]
    return padded.reshape(-1, 3).index_copy(0, border_index, border_values).view_as(padded)


def _bilinear(faces: Tensor, d: Tensor, border: int) -> Tensor:
    """Return values ``(N, 3)`` in directions ``(N, 3)`` of faces with ``border`` more texels on each side, clamped at edges."""
    rows = faces.shape[1]
    size = rows - 2 * border
    forward, up, right = _axes(d.dtype, d.device)
    face = (d @ forward.T).argmax(1)
    depth = (d * forward[face]).sum(1)  # d over this lies on the cube [-1, 1]^3
    x = ((d * right[face]).sum(1) / depth + 1.0) * (0.5 * size) - 0.5 + border
    y = (1.0 - (d * up[face]).sum(1) / depth) * (0.5 * size) - 0.5 + border
    x, y = x.clamp(0.0, rows - 1.0), y.clamp(0.0, rows - 1.0)
    i, j = (position.detach().floor().clamp_max(max(rows - 2.0, 0.0)) for position in (y, x))
    fy, fx = (y - i)[:, None], (x - j)[:, None]
    i, j = i.to(torch.int64), j.to(torch.int64)
    step = 1 if rows > 1 else 0  # a face of one texel has no neighbours to interpolate with
    flat, first = faces.reshape(-1, 3), face * (rows * rows)
    low, high = first + i * rows + j, first + (i + step) * rows + j
    upper_left, upper_right, lower_left, lower_right = (
        flat.index_select(0, index) for index in (low, low + step, high, high + step)
    )
    top, bottom = upper_left + (upper_right - upper_left) * fx, lower_left + (lower_right - lower_left) * fx
    return top + (bottom - top) * fy
