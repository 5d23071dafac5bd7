"""What is said of a PLY file that cannot be read is true of it."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from torchpt.core.errors import AssetError
from torchpt.scene.meshes import load_mesh

VERTEX = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face 2\nproperty list uchar int vertex_indices\n"
ROWS = "0 0 0\n1 0 0\n0 1 0\n"
#: Header behind the format, rows, what is said.
CASES: dict[str, tuple[str, str, str]] = {
    # As trimesh's fuze_ascii.ply: the header declares four numbers, the rows hold a list of nine.
    "rows of another header": (
        f"{VERTEX}{FACE}property list uchar float texcoord\nproperty uchar red\nproperty uchar green\n",
        f"{ROWS}3 0 1 2 2 0.5 0.5 9 1 1 1 1 1 1 1 1 1\n3 0 1 2 2 0.5 0.5 9 1 1 1 1 1 1 1 1 1\n",
        "line 16: face 0 has 17 values, the properties in the header come to 9",
    ),
    "rows that come out even": (
        f"{VERTEX}{FACE}",
        f"{ROWS}3 0 1 2 3 0 1 2\n3 0 1 2\n",
        "line 13: face 0 has 8 values, the properties in the header come to 4",
    ),
    "a list of negative length": (
        f"{VERTEX}{FACE}",
        f"{ROWS}-3 0 1 2\n3 0 1 2\n",
        "line 13: face 0 has '-3' as the length of vertex_indices, expected a whole number >= 0",
    ),
    "a fraction as an index": (
        f"{VERTEX}{FACE}",
        f"{ROWS}3 0 1 2\n3 0 1 2.0\n",
        "element face holds '2.0', expected a whole number of at most 64 bits",
    ),
    "an index beyond all": (
        f"{VERTEX}{FACE}",
        f"{ROWS}3 0 1 2\n3 0 1 99999999999999999999\n",
        "element face holds '99999999999999999999', expected a whole number of at most 64 bits",
    ),
    "a row too few": (f"{VERTEX}{FACE}", f"{ROWS}3 0 1 2\n", "truncated: 2 of element face declared, 1 lines found"),
    "a list as a coordinate": (
        f"{VERTEX.replace('property float y', 'property list uchar float y')}{FACE}",
        "0 1 0 0\n1 1 0 0\n0 1 1 0\n3 0 1 2\n3 0 1 2\n",
        "element vertex has a list as its property y, expected a number",
    ),
    "no end": (f"{VERTEX}{FACE}" + "comment x\n" * 120_000, ROWS, "no end_header in its first 1048576 bytes"),
}


@pytest.mark.parametrize("name", CASES)
def test_refusals_are_true(tmp_path: Path, name: str) -> None:
    header, rows, said = CASES[name]
    file = tmp_path / "a.ply"
    file.write_text(f"ply\nformat ascii 1.0\n{header}end_header\n{rows}")
    with pytest.raises(AssetError) as caught:
        load_mesh(file)
    assert str(caught.value) == f"{file}: {said}"


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_lines_end_in_any_way(tmp_path: Path, newline: str) -> None:
    file = tmp_path / "a.ply"
    head = f"ply\nformat {{}} 1.0\ncomment end_header is said here\n{VERTEX}{FACE}end_header\n"
    file.write_bytes((head.format("ascii") + f"{ROWS}3 0 1 2\n\n3 2 1 0\n").replace("\n", newline).encode())
    (part,) = load_mesh(file)
    assert part.faces.tolist() == [[0, 1, 2], [2, 1, 0]]
    body = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<B3iB3i", 3, 0, 1, 2, 3, 2, 1, 0)
    file.write_bytes(head.format("binary_little_endian").replace("\n", newline).encode() + body)
    (part,) = load_mesh(file)
    assert part.faces.tolist() == [[0, 1, 2], [2, 1, 0]]
