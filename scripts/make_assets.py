"""Makes the meshes in `scenes/`: `python scripts/make_assets.py` writes them again, byte for byte.

`standin.ply` stands where the Stanford bunny would: a smooth closed figure (an icosphere pushed out along its own
directions: body, head, two ears, tail, feet) with the bunny's bounding box, pose and no vertex normals.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SCENES = Path(__file__).resolve().parents[1] / "scenes"
BUNNY_BOX = ((-0.0946899, 0.0329874, -0.0618736), (0.0610091, 0.187321, 0.0587997))

# direction of a lobe, how far it reaches, how narrow it is
LOBES = (
    ((-0.55, 0.75, 0.05), 0.75, 9.0),  # head
    ((-0.30, 1.00, 0.16), 0.95, 60.0),  # ears
    ((-0.30, 1.00, -0.16), 0.95, 60.0),
    ((1.00, -0.30, 0.00), 0.30, 30.0),  # tail
    ((-0.80, -0.75, 0.35), 0.35, 25.0),  # feet
    ((-0.80, -0.75, -0.35), 0.35, 25.0),
    ((0.45, -0.80, 0.45), 0.30, 12.0),
    ((0.45, -0.80, -0.45), 0.30, 12.0),
)


def icosphere(levels: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Unit directions ``(V, 3)`` and triangles ``(20 * 4^levels, 3)``, counter-clockwise from outside."""
    golden = (1.0 + 5.0**0.5) / 2.0
    corners = [(0.0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    points = np.array(corners + [(y, z, x) for x, y, z in corners] + [(z, x, y) for x, y, z in corners])
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    faces = np.array([t for t in triples if all(_near(points[t[a]], points[t[a - 1]]) for a in range(3))])
    inward = np.einsum("ij,ij->i", _cross(points, faces), points[faces[:, 0]]) < 0
    faces[inward] = faces[inward][:, ::-1]
    points /= np.linalg.norm(points, axis=1)[:, None]
    for _ in range(levels):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = points[unique].sum(axis=1)
        middle /= np.linalg.norm(middle, axis=1)[:, None]
        ab, bc, ca = (index.reshape(-1, 3) + len(points)).T
        points = np.concatenate([points, middle])
        a, b, c = faces.T
        faces = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1).reshape(-1, 3)
    return points, faces


def _near(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    return bool(np.linalg.norm(a - b) < 2.1)  # the edge of the icosahedron is 2


def _cross(points: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    a, b, c = points[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def standin() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices ``(10242, 3)`` and triangles ``(20480, 3)`` of the stand-in."""
    directions, faces = icosphere(5)
    radius = np.ones(len(directions))
    for axis, reach, narrow in LOBES:
        axis = np.array(axis) / np.linalg.norm(axis)
        radius += reach * np.exp(narrow * (directions @ axis - 1.0))
    points = directions * radius[:, None] * (1.0, 0.95, 0.8)
    floor = -0.85  # a soft plane to stand on
    points[:, 1] = floor + np.logaddexp(0.0, 12.0 * (points[:, 1] - floor)) / 12.0
    low, high = points.min(axis=0), points.max(axis=0)
    box_low, box_high = np.array(BUNNY_BOX)
    return (box_low + (points - low) / (high - low) * (box_high - box_low)).astype("<f4"), faces.astype("<i4")


def write_ply(path: Path, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
    """A binary little-endian PLY without normals."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment made by scripts/make_assets.py\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    records["count"], records["index"] = 3, faces
    path.write_bytes(header.encode() + vertices.tobytes() + records.tobytes())


def main() -> None:
    """Writes every asset."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=SCENES, help="folder to write to")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    write_ply(folder / "standin.ply", *standin())


if __name__ == "__main__":
    main()
