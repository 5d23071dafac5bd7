"""OBJ text by machine code: what reading line by line gives, or nothing."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from torchpt.core.errors import AssetError
from torchpt.scene.meshes.obj import _by_lines
from torchpt.scene.meshes.obj_text import Statements, parse_plain

PLAIN = {
    "positions": "v 0 0 0\nv 1 0 0\nv 0 1.5e-3 0\nf 1 2 3\nf 3 2 1\n",
    "uvs of three": "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0 0\nvt 1 0.25 0\nf 1/1 2/2 3/1\n",
    "normals": "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1",
    "all": (
        "# a comment\nmtllib a b.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvn 0 0 1\ng x\n"
        "f 1/1/1 2/2/1 3/1/1 4/1/1\nusemtl red paint\ns off\nf 1/1/1 2/2/1 3/1/1\nf 3/1/1\t2/2/1  4/1/1\nusemtl blue\n"
        "f 1/1/1 3/1/1 4/1/1\nusemtl red paint\nl 1 2\nf 1/1/1 2/2/1 4/1/1\n"
    ),
    "returns": "v 0 0 0\r\nv 1 0 0\r\nv 0 1 0\r\nusemtl m\r\nf 1 2 3\r\n\r\n",
    "counted back": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 1 1 0\nf -1 -2 1\n",
    "mixed corners": "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 1\nvn 0 0 1\nf 1 2/1/1 3//1\nf 1 3//1 2/2\n",
    "widths": "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0 0\nvt 1 0.25\nf 1/1 2/2 3/1\n",
    "no faces": "v 0 0 0\nv 1 0 0\n",
}
ODD = {
    "colours": "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n",
    "joined lines": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 \\\n3\n",
    "comment behind": "v 0 0 0 # origin\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "indented": "v 0 0 0\n v 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "before the first": "v 0 0 0\nv 1 0 0\nf -3 -2 -1\nv 0 1 0\n",
    "empty index": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/ 2/ 3/\n",
    "absent": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 3/1\n",
    "beyond": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
    "two corners": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n",
    "no number": "v 0 0 0\nv 1 x 0\nv 0 1 0\nf 1 2 3\n",
    "other letters": "# Größe\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
}


def same(a: Statements, b: Statements) -> bool:
    arrays = ("positions", "uvs", "normals", "corners", "corner_of_word", "counts", "face_groups")
    if not all(np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True) for name in arrays):
        return False
    return (list(a.groups.items()), a.libraries, a.ignored) == (list(b.groups.items()), b.libraries, b.ignored)


@pytest.mark.parametrize("name", PLAIN)
def test_usual_text_is_read_at_once(name: str) -> None:
    data = PLAIN[name].encode()
    found = parse_plain(data)
    assert found is not None and same(found, _by_lines(data, Path("a.obj")))


@pytest.mark.parametrize("name", ODD)
def test_other_text_is_left_to_lines(name: str) -> None:
    assert parse_plain(ODD[name].encode()) is None


def test_what_is_read_of_damaged_text_is_what_lines_say() -> None:
    rng, read = random.Random(1), 0
    texts = [*PLAIN.values(), *ODD.values()]
    for _ in range(3000):
        text = rng.choice(texts)
        for _ in range(rng.choice((1, 1, 2))):
            at = rng.randrange(len(text))
            text = (
                text[:at]
                + rng.choice(("", "/", " ", "\n", "1", "-", "e", ".", "#", "v", "f", "\t", "nan"))
                + text[at + 1 :]
            )
        found = parse_plain(text.encode())
        if found is None:
            continue
        read += 1
        try:
            assert same(found, _by_lines(text.encode(), Path("a.obj"))), text
        except AssetError as error:
            raise AssertionError(f"{error}: {text}") from None
    assert 300 < read < 2900


def test_numbers_are_rounded_as_python_rounds_them() -> None:
    rng = random.Random(2)
    words = [
        "0",
        "-0.0",
        "+1.5",
        ".5",
        "5.",
        "1e22",
        "1e23",
        "-1E-22",
        "9007199254740993",
        "1e400",
        "1e-400",
        "0e999999999999",
    ]
    for _ in range(2000):
        digits = "".join(rng.choice("0123456789") for _ in range(rng.randrange(1, 26)))
        point = rng.randrange(len(digits) + 1)
        exponent = f"e{rng.randrange(-330, 330)}" if rng.random() < 0.3 else ""
        words.append(f"{rng.choice(('', '-'))}{digits[:point]}.{digits[point:]}{exponent}")
    words += ["0"] * (-len(words) % 3)
    text = "".join(f"v {' '.join(words[k : k + 3])}\n" for k in range(0, len(words), 3))
    found = parse_plain(text.encode())
    assert found is not None
    np.testing.assert_array_equal(found.positions.reshape(-1), np.array([float(word) for word in words]))


def test_distinct_corners_of_a_large_file_are_those_of_unique() -> None:
    rng = np.random.default_rng(3)
    indices = rng.integers(1, 41, (20000, 3))
    faces = ["f " + " ".join("/".join(map(str, corner)) for corner in indices[k : k + 4]) for k in range(0, 20000, 4)]
    lines = [line for k in range(40) for line in (f"v {k} 0 0", f"vt {k} 0", f"vn {k} 0 1")]
    found = parse_plain("\n".join([*lines, *faces]).encode())
    assert found is not None and found.counts.tolist() == [4] * 5000
    np.testing.assert_array_equal(found.corners[found.corner_of_word], indices - 1)
    _, first = np.unique(indices, axis=0, return_index=True)
    np.testing.assert_array_equal(found.corners, indices[np.sort(first)] - 1)
