"""Make the textures in `scenes/` and a textured mesh: `python scripts/make_textures.py` writes them again.

- `bricks.png`, `bricks_normal.png`: a brick wall's colours and normals, 4 bricks by 8 courses, tiling.
- `dents_normal.png`: normals of a hammered sheet, tiling.
- `weave.png`: heights of a plain weave in grey, tiling.
- `leaf.png`: a coloured leaf on a transparent background.
- `sky.exr`: an evening sky with a low sun over brown ground, an environment map of half floats.
- `cushion.ply`: a square cushion of half-width 1 with texture coordinates.
"""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

SCENES = Path(__file__).resolve().parents[1] / "scenes"

Grid = NDArray[np.float64]


def _pixels(size: int) -> tuple[Grid, Grid]:
    """Return texture coordinates of texel centres, rows first."""
    centres = (np.arange(size) + 0.5) / size
    v, u = np.meshgrid(centres, centres, indexing="ij")
    return u, v


def _noise(size: int, cells: int, seed: int) -> Grid:
    """Return smooth tiling noise in 0..1: random values on a lattice, interpolated with cosines."""
    lattice = np.random.default_rng(seed).random((cells, cells))
    u, v = _pixels(size)
    x, y = u * cells, v * cells
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (0.5 - 0.5 * np.cos(np.pi * (t - np.floor(t))) for t in (x, y))
    at = [[lattice[(j + dy) % cells, (i + dx) % cells] for dx in (0, 1)] for dy in (0, 1)]
    return (at[0][0] * (1 - a) + at[0][1] * a) * (1 - b) + (at[1][0] * (1 - a) + at[1][1] * a) * b


def _normals(height: Grid, steep: float) -> NDArray[np.uint8]:
    """Convert tiling heights to normals as 8-bit colours; ``steep`` scales the slope."""
    du = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * 0.5 * steep
    dv = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) * 0.5 * steep
    n = np.stack([-du, -dv, np.ones_like(du)], -1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return np.round((n * 0.5 + 0.5) * 255).astype(np.uint8)


def bricks(size: int = 256) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return colours and normals of a brick wall."""
    u, v = _pixels(size)
    course = np.floor(v * 8).astype(int)
    x = (u * 4 + 0.5 * (course % 2)) % 4
    brick = np.floor(x).astype(int)
    edge = np.minimum(np.minimum(x % 1, 1 - x % 1) * 2, np.minimum(v * 8 % 1, 1 - v * 8 % 1))
    raised = np.clip((edge - 0.06) / 0.1, 0, 1)
    raised = raised * raised * (3 - 2 * raised)
    rough = _noise(size, 64, 1) * 0.6 + _noise(size, 16, 2) * 0.4
    shade = np.random.default_rng(3).random((8, 4))[course, brick % 4]
    face = np.stack([150 + 50 * shade, 70 + 35 * shade, 52 + 22 * shade], -1) * (0.8 + 0.3 * rough[..., None])
    mortar = np.array([176.0, 168.0, 156.0]) * (0.85 + 0.2 * rough[..., None])
    colour = mortar + (face - mortar) * raised[..., None]
    return np.clip(np.round(colour), 0, 255).astype(np.uint8), _normals(raised + 0.25 * rough, 8.0)


def dents(size: int = 128) -> NDArray[np.uint8]:
    """Return normals of round dents, like those of a hammer."""
    rng = np.random.default_rng(5)
    u, v = _pixels(size)
    height = np.zeros((size, size))
    for x, y, r in rng.random((60, 3)):
        radius = 0.06 + 0.06 * r
        dx, dy = (np.abs(a - b) for a, b in ((u, x), (v, y)))
        square = np.minimum(dx, 1 - dx) ** 2 + np.minimum(dy, 1 - dy) ** 2
        height = np.minimum(height, np.minimum(square / radius**2 - 1, 0))
    return _normals(height, 2.5)


def weave(size: int = 128, threads: int = 8) -> NDArray[np.uint8]:
    """Return heights of threads that go over and under each other."""
    u, v = _pixels(size)
    x, y = u * threads, v * threads
    over = np.where((np.floor(x) + np.floor(y)) % 2 == 0, 1.0, -1.0)
    bulge_x, bulge_y = np.sin(np.pi * (x % 1)), np.sin(np.pi * (y % 1))
    height = np.where(over > 0, np.sqrt(bulge_x) * (0.5 + 0.5 * bulge_y), np.sqrt(bulge_y) * (0.5 + 0.5 * bulge_x))
    return np.round(height * 255).astype(np.uint8)


def leaf(size: int = 256) -> NDArray[np.uint8]:
    """Return an upright leaf in the middle: colour and alpha."""
    u, v = _pixels(size)
    x, y = 2 * u - 1, 1 - v  # row 0 is the tip
    half = 0.62 * np.sin(np.pi * np.clip(y, 0, 1) ** 0.8) ** 0.9 * (1 - 0.05 * np.abs(np.sin(34 * y)))
    inside = np.clip((half - np.abs(x)) * size / 6, 0, 1)
    stalk = np.clip((0.02 - np.abs(x)) * size / 4, 0, 1) * (y < 0.2)
    vein = np.exp(-((x / 0.02) ** 2)) + 0.6 * np.exp(-((((np.abs(x) * 0.9 + y * 1.0) % 0.12 - 0.06) / 0.006) ** 2))
    tone = 0.75 + 0.35 * _noise(size, 12, 7)
    colour = np.stack([60 * tone, 130 * tone, 36 * tone], -1) + np.clip(vein, 0, 1)[..., None] * np.array(
        [60.0, 60.0, 30.0]
    )
    alpha = np.maximum(inside, stalk)[..., None] * 255
    return np.clip(np.round(np.concatenate([colour, alpha], -1)), 0, 255).astype(np.uint8)


def sky(height: int = 128) -> NDArray[np.float16]:
    """Return an environment map: zenith at the top, rows at the poles and columns at half texels, as the format defines."""
    width = 2 * height
    theta = np.linspace(0, np.pi, height)[:, None]
    phi = (np.arange(width) + 0.5)[None] * (2 * np.pi / width)
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)], -1)
    toward = np.array([0.62, 0.36, 0.70])
    toward /= np.linalg.norm(toward)
    away = np.arccos(np.clip(d @ toward, -1, 1))[..., None]
    up = d[..., 1:2]
    haze = np.exp(-np.clip(up, 0, 1) / 0.18)
    blue, warm = np.array([0.16, 0.30, 0.62]), np.array([0.95, 0.72, 0.50])
    above = blue + (warm - blue) * haze + np.array([1.6, 1.05, 0.55]) * np.exp(-away / 0.35)
    streaks = _noise(width, 24, 11)[:height, :, None] * _noise(width, 6, 12)[:height, :, None]
    above = above + np.array([0.9, 0.8, 0.75]) * streaks**2 * np.exp(-(((up - 0.28) / 0.2) ** 2))
    below = np.array([0.16, 0.12, 0.085]) * (0.7 + 0.6 * _noise(width, 32, 13)[:height, :, None])
    edge = np.clip(0.5 + up * 40, 0, 1)
    disk = np.clip((0.045 - away) / 0.015, 0, 1) * np.array([900.0, 700.0, 430.0])
    return (below + (above - below) * edge + disk).astype(np.float16)


def write_exr(path: Path, texels: NDArray[np.float16]) -> None:
    """Write half floats, compressed without loss."""
    import OpenImageIO as oiio

    height, width, _ = texels.shape
    spec = oiio.ImageSpec(width, height, 3, "half")
    spec.attribute("compression", "zip")
    out = oiio.ImageOutput.create(str(path))
    if out is None or not out.open(str(path), spec) or not out.write_image(texels):
        raise OSError(f"{path}: {oiio.geterror() if out is None else out.geterror()}")
    out.close()


def write_cushion(path: Path, cells: int = 24) -> None:
    """Write two bulging squares that share their rim, with the same texture on both."""
    side = np.linspace(-1, 1, cells + 1)
    y, x = np.meshgrid(side, side, indexing="ij")
    bulge = np.clip((1 - x**2) * (1 - y**2), 0, None) ** 0.45
    pinch = 1 - 0.08 * (1 - bulge) * (x**2 + y**2 < 4)
    rows = []
    for sign in (1.0, -1.0):
        columns = [x * pinch, y * pinch, sign * 0.42 * bulge, (x + 1) / 2, (y + 1) / 2]
        rows.append(np.stack([c.reshape(-1) for c in columns], 1))
    vertices = np.concatenate(rows).astype("<f4")
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).reshape(-1)
    right, up, both = corner + 1, corner + cells + 1, corner + cells + 2
    top = np.concatenate([np.stack([corner, right, both], 1), np.stack([corner, both, up], 1)])
    faces = np.concatenate([top, top[:, ::-1] + (cells + 1) ** 2])
    table = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    table["n"], table["v"] = 3, faces
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "u", "v"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}element face {len(faces)}\n"
    path.write_bytes(
        f"{header}property list uchar int vertex_indices\nend_header\n".encode() + vertices.tobytes() + table.tobytes()
    )


def main() -> None:
    """Write all files."""
    colour, normals = bricks()
    for name, image in {
        "bricks": colour,
        "bricks_normal": normals,
        "dents_normal": dents(),
        "weave": weave(),
        "leaf": leaf(),
    }.items():
        iio.imwrite(SCENES / f"{name}.png", image)
    write_exr(SCENES / "sky.exr", sky())
    write_cushion(SCENES / "cushion.ply")


if __name__ == "__main__":
    main()
