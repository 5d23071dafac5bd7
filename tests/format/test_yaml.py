"""YAML: strict, bounded, errors with file and line."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from torchpt.core.errors import SceneError
from torchpt.scene.formats.description import read_description
from torchpt.scene.formats.yaml import parse_yaml, plain

CAMERA = "camera: {origin: [0, 0, 1], target: [0, 0, 0]}\n"


def problem(text: str | bytes) -> SceneError:
    with pytest.raises(SceneError) as caught:
        plain(parse_yaml(text, "s.yaml"), "s.yaml")
    assert "\n" not in str(caught.value) and str(caught.value).startswith("s.yaml: ")
    return caught.value


def test_numbers_words_and_text() -> None:
    text = "{a: 1e-3, b: 1.5, c: -2, d: on, e: ~, f: 'on', g: 1.2.3, h: 0x10, i: .inf, on: 1_000, 7: x, j: +.5e+2}"
    assert parse_yaml(text) == {
        **{"a": 1e-3, "b": 1.5, "c": -2, "d": True, "e": None, "f": "on", "g": "1.2.3", "h": 16},
        **{"i": float("inf"), "on": 1000, "7": "x", "j": 50.0},
    }


def test_anchors_and_merges() -> None:
    text = "a: &x {p: 1, q: 2}\nb: {<<: *x, q: 3}\nc: &n 5\nd: [*n, *x]\ne: {<<: [{p: 9}, *x], r: 1}\n"
    found = parse_yaml(text)
    assert found["b"] == {"p": 1, "q": 3}
    assert found["d"] == [5, {"p": 1, "q": 2}]
    assert found["e"] == {"p": 9, "q": 2, "r": 1}


@pytest.mark.parametrize(
    ("text", "key", "part"),
    [
        ("a:\n  b: 1\n  c: 2\n  b: 3\n", "a.b", "lines 2 and 4"),
        ("a: [1\nb: 2\n", "line 2, column 2", "valid YAML"),
        ("a: b: c\n", "line 1, column 5", "mapping values"),
        ("a: *x\n", "line 1", "anchor"),
        ("a: &x [*x]\n", "line 1", "anchor"),
        ("a: &x {<<: *x}\n", "line 1", "anchor"),
        ("a: {<<: 3}\n", "line 1", "to merge"),
        ("a: !!python/object/apply:os.system [ls]\n", "a", "tags"),
        ("a: !env HOME\n", "a", "tags"),
        ("[a, b]: 1\n", "line 1", "text as a key"),
        ("a: 1\n---\nb: 2\n", "line 2", "one YAML document"),
        ("- 1\n", "scene", "mapping"),
        ("just text\n", "scene", "mapping"),
        ("", "scene", "mapping"),
        ("a: {b: {_target_: x}}\n", "a.b._target_", "Python"),
        (b"a: \xff\xfe\n", "text", "valid YAML"),
        ("a: \x07\n", "text", "valid YAML"),
        ("[" * 200_000, "line 1", "levels of nesting"),
        ("- " * 100_000, "line 1", "levels of nesting"),
    ],
)
def test_bad_yaml(text: str | bytes, key: str, part: str) -> None:
    error = problem(text)
    assert error.key == key
    assert part in str(error)


def test_billion_laughs() -> None:
    text = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
    text += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 30))
    assert "once aliases are expanded" in str(problem(text))


def test_merged_laughs() -> None:
    text = f"a: &a {{{', '.join(f'k{i}: 1' for i in range(2000))}}}\n"
    text += "".join(f"b{i}: {{<<: *a}}\n" for i in range(2000))
    assert "merges" in str(problem(text))


def test_a_mapping_that_holds_itself() -> None:
    loop: dict[str, Any] = {}
    loop["a"] = [loop, loop]
    with pytest.raises(SceneError, match="contain itself"):
        read_description(loop)


def test_error_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "my [scene].yaml"
    file.write_text(CAMERA + "shapes: {s: {type: sphere, radius: -1}}\n")
    with pytest.raises(SceneError) as caught:
        read_description(file)
    assert str(caught.value) == f"{file}: shapes.s.radius: expected a finite number > 0, got -1"


@pytest.mark.slow
def test_a_thousand_shapes_and_a_large_inline_mesh_are_quick(tmp_path: Path) -> None:
    shapes = "".join(
        f"  s{i}: {{type: sphere, center: [{i}, 0, 0], transform: [{{scale: 2}}, {{translate: [0, 1, 2]}}]}}\n"
        for i in range(1000)
    )
    rows = "".join(f"    - [{i * 0.1:.6g}, {i * 0.2:.6g}, {i * 0.3:.6g}]\n" for i in range(33_334))
    file = tmp_path / "large.yaml"
    file.write_text(f"{CAMERA}shapes:\n{shapes}  m:\n    type: mesh\n    faces: [[0, 1, 2]]\n    vertices:\n{rows}")
    start = time.process_time()
    found = read_description(file)
    assert time.process_time() - start < 4.0  # about 1 s on a quiet core
    assert len(found.shapes) == 1001
