"""Damaged scene documents from a seed: those that ship, and one of each kind that the specs declare."""

from __future__ import annotations

import copy
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from damage import damaged

from torchpt.core.files import configs
from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.physics.bsdfs import KINDS as MATERIALS
from torchpt.physics.cameras import KINDS as CAMERAS
from torchpt.physics.film import FILTERS
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.samplers import KINDS as SAMPLERS
from torchpt.physics.shapes import KINDS as SHAPES
from torchpt.physics.textures import KINDS as TEXTURES
from torchpt.scene.formats.compose import compose
from torchpt.scene.formats.yaml import read_yaml
from torchpt.scene.settings import UNTYPED_BLOCKS
from torchpt.spec import REQUIRED, parameters_of

#: What a document names as meshes and pictures: files that lie beside it.
MESHES, PICTURES = ("a.obj", "a.ply", "a.glb", "a.stl", "a.off"), ("a.png", "a.exr", "a.jpg", "a.hdr")
#: Shapes that are kept of a scene that ships: a hundred more of the same would only take time.
MOST_SHAPES = 10

NUMBERS: list[Any] = [
    0, -0.0, -1, 1, 2, 3, 7, 255, 256, 65536, 65537, 2**31 - 1, 2**31, 2**32, 2**53, 2**63, 2**64, 10**30, 10**400,
    -(2**31), 1e-45, 1e-40, 1e-30, 1e-20, 1e-12, 1e-7, 0.5, 0.999999, 1.0000001, 1e6, 1e12, 1e18, 1e20, 1e30, 3.4e38,
    3.5e38, 1e39, 1e150, 1e300, 1.7e308, math.inf, -math.inf, math.nan, -1e30, -1e-30, True, False,
]  # fmt: skip
TEXTS: list[Any] = [
    "", " ", "x", "red", "auto", "null", "none", "off", "1e400", "0x10", "é", "\u202e", "𝔘", "a\nb", "\t", "\0",
    "{}", "..", "a" * 5000, "\ud800", "/dev/zero", "/dev/stdin", "/", ".", "~", "$HOME/x", "$TORCHPT_ASSETS/x",
    "http://x/y.png", "*", "%s%n", "{0}",    "a.obj", "a.png", "a.yaml", "_target_", "__class__", "os.system",
    "!!python/name:os.system", "mesh", "sphere", "diffuse",
]  # fmt: skip
LISTS: list[Any] = [
    None, [], {}, [[]], [None], [0, 0, 0], [1, 1], [1e38, 1e38, 1e38], [1, 2, 3, 4], [math.nan] * 3, {"type": "x"},
    {"type": "diffuse"}, {"type": "image", "path": "a.png"}, {"type": "checkerboard"}, {"type": "noise"},
    {"texture": "x"}, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], [[0, 0, 0]] * 3, [[0, 1, 2]],
    [{"scale": 1e30}], [{"translate": [1e30, 0, 0]}], [{"scale": [1, 1, 1e-20]}, {"rotate": {"axis": [1, 1, 0],
    "angle": 45}}], {"type": "blend", "first": {"type": "diffuse"}, "second": {"type": "blend"}, "weight": 0.5},
    ["x"] * 300, {"type": None},
]  # fmt: skip


class Liar:
    """An object that cannot even be shown."""

    def __repr__(self) -> str:
        raise RuntimeError("not to be shown")


def strange() -> list[Any]:
    """What only a dict of Python can hold."""
    return [
        10**5000, b"bytes", {1, 2}, (1, 2, 3), range(3), 1j, Liar(), object, np.float64("nan"), np.int64(3), np.zeros((3, 3)),
        np.array(["a"]), np.array([1, None], dtype=object), torch.zeros(3), torch.tensor(1.0), Path("a.png"), iter([1]), print,
        {1: 2}, {None: 1}, {("a",): 1}, {b"k": 1}, np.bool_(True), np.zeros(0), np.ones((2, 2, 2, 2)), frozenset(),
    ]  # fmt: skip


@cache
def whole_documents() -> list[dict[str, Any]]:
    """Sound documents: the scenes that ship, and a small one of each kind of everything."""
    found = []
    for file in sorted((configs() / "scene").glob("*.yaml")):
        raw, _ = compose(read_yaml(file, str(file)), str(file), file.parent)
        names = list(raw.get("shapes", {}))
        kept = set(names[:MOST_SHAPES]) | {
            s["of"] for s in raw.get("shapes", {}).values() if s.get("type") == "instance"
        }
        if names:
            raw["shapes"] = {name: shape for name, shape in raw["shapes"].items() if name in kept}
        found.append(_beside(raw, len(found)))
    base: dict[str, Any] = {
        "camera": {"origin": [0, 1, 4], "target": [0, 0, 0], "fov": 50},
        "film": {"width": 4, "height": 4},
        "lights": {"sky": {"type": "constant", "radiance": [0.5, 0.6, 0.7]}},
        "materials": {"m": {"type": "diffuse", "reflectance": [0.2, 0.5, 0.7]}},
        "shapes": {"ball": {"type": "sphere", "material": "m"}, "floor": {"type": "rectangle", "emission": [1, 1, 1]}},
    }
    grammar = [
        *({**base, "materials": {"m": _entry(MATERIALS, name)}} for name in MATERIALS),
        *({**base, "shapes": {**base["shapes"], "c": {"type": "cube"}, "s": _entry(SHAPES, name)}} for name in SHAPES),
        *({**base, "lights": {"l": _entry(LIGHTS, name)}} for name in LIGHTS),
        *({**base, "camera": {"origin": [0, 1, 4], "target": [0, 0, 0], **_entry(CAMERAS, name)}} for name in CAMERAS),
        *({**base, "sampler": _entry(SAMPLERS, name)} for name in SAMPLERS),
        *({**base, "integrator": _entry(INTEGRATORS, name)} for name in INTEGRATORS),
        *({**base, "film": {"width": 4, "height": 4, "filter": _entry(FILTERS, name)}} for name in FILTERS),
        *(
            {
                **base,
                "textures": {"t": _entry(TEXTURES, name)},
                "materials": {
                    "m": {"type": "principled", "base_color": {"texture": "t"}, "roughness": _entry(TEXTURES, name)}
                },
            }
            for name in TEXTURES
        ),
    ]
    return found + [_beside(document, number) for number, document in enumerate(grammar)]


def _beside(document: dict[str, Any], number: int) -> dict[str, Any]:
    """The same with files that lie beside it."""

    def named(node: Any, mesh: bool) -> Any:
        if isinstance(node, dict):
            kind = node.get("type")
            return {key: _file(kind, number) if key == "path" else named(value, mesh) for key, value in node.items()}
        return [named(item, mesh) for item in node] if isinstance(node, list) else node

    return named(document, False)


def _file(kind: Any, number: int) -> str:
    return MESHES[number % len(MESHES)] if kind == "mesh" else PICTURES[number % len(PICTURES)]


def _entry(table: Any, name: str) -> dict[str, Any]:
    """A kind with what it must be given."""
    known: dict[str, Any] = {
        "path": "a.png", "of": "c", "a": {"type": "diffuse"}, "b": {"type": "conductor"}, "aperture_radius": 0.1, "weight": 0.5,
        "center": [0, 0, 0], "position": [0, 4, 0], "direction": [0, -1, 0], "target": [0, 0, 0],
    }  # fmt: skip
    entry: dict[str, Any] = {"type": name}
    for key, spec in parameters_of(table[name]).items():
        if spec.default is REQUIRED or key in ("path", "position", "target"):
            entry[key] = known.get(key, 1.0)
    return entry


@cache
def keys() -> list[str]:
    """Every key that some kind reads."""
    tables = (MATERIALS, SHAPES, LIGHTS, CAMERAS, SAMPLERS, INTEGRATORS, FILTERS, TEXTURES, UNTYPED_BLOCKS)
    found = {key for table in tables for name in table for key in parameters_of(table[name])}
    return sorted(
        found | {"type", "transform", "translate", "scale", "rotate", "matrix", "look_at", "axis", "angle", "version"}
    )


def hostile(rng: np.random.Generator, python: bool) -> Any:
    """A value that does not belong where it is put."""
    tables = [NUMBERS, NUMBERS, TEXTS, LISTS] + ([strange()] if python else [])
    table = tables[rng.integers(len(tables))]
    return copy.deepcopy(table[rng.integers(len(table))]) if table is LISTS else table[rng.integers(len(table))]


def places(document: Any) -> list[tuple[Any, Any]]:
    """Every container of a document with each of its keys."""
    found: list[tuple[Any, Any]] = []
    stack = [document]
    while stack:
        node = stack.pop()
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            found.append((node, key))
            if isinstance(node[key], dict | list):
                stack.append(node[key])
    return found


def damage(document: Any, rng: np.random.Generator, python: bool) -> None:
    """One thing wrong, in place."""
    every = places(document)
    if not every:
        return
    node, key = every[rng.integers(len(every))]
    kind = rng.integers(16)
    if kind == 0:
        node[key] = hostile(rng, python)
    elif kind <= 5 or kind > 11:  # a number that is one, by many powers of ten off
        numbers = [(n, k) for n, k in every if type(n[k]) in (int, float)]
        node, key = numbers[rng.integers(len(numbers))] if numbers else (node, key)
        if type(node[key]) in (int, float):
            node[key] = NUMBERS[rng.integers(len(NUMBERS))] if rng.random() < 0.5 else _scaled(node[key], rng)
    elif kind == 6:
        del node[key]
    elif kind == 7:  # a part of the document somewhere else
        other, there = every[rng.integers(len(every))]
        node[key] = copy.deepcopy(other[there])
    elif kind == 8 and isinstance(node, dict):  # a key that some kind reads, or none does
        name = keys()[rng.integers(len(keys()))] if rng.random() < 0.8 else str(TEXTS[rng.integers(len(TEXTS))])
        node[name] = hostile(rng, python)
    elif kind == 9 and isinstance(node, dict):
        name = str(TEXTS[rng.integers(len(TEXTS))])
        node[name] = node.pop(key)
    elif kind == 10:
        value = node[key]
        for _ in range(int(rng.choice([1, 2, 99, 150]))):
            value = [value] if rng.random() < 0.5 else {str(key): value}
        node[key] = value
    elif isinstance(node, list) and len(node) < 1000:
        node.extend(copy.deepcopy(node[key]) for _ in range(int(rng.choice([1, 2, 50]))))


def _scaled(value: float, rng: np.random.Generator) -> float:
    try:
        return (
            float(value)
            * 10.0 ** float(rng.choice([-38, -20, -8, -3, 3, 8, 20, 38]))
            * float(rng.choice([1, 1, 1, -1]))
        )
    except OverflowError:
        return value


def damaged_document(seed: int) -> dict[str, Any] | bytes:
    """A document as a dict, or as the bytes of its YAML text."""
    rng = np.random.default_rng([seed, 20])
    whole = whole_documents()
    document = copy.deepcopy(whole[rng.integers(len(whole))])
    python = bool(rng.random() < 0.3)
    for _ in range(int(rng.choice([0, 1, 1, 1, 1, 2, 4]))):
        damage(document, rng, python)
    if python:
        return document
    text = written(document)
    for _ in range(int(rng.choice([0, 0, 0, 0, 1, 2]))):
        text = damaged_text(text, rng)
    return text


def written(document: Any) -> bytes:
    """A document as YAML text."""
    try:
        return yaml.dump(document, Dumper=yaml.CSafeDumper, allow_unicode=True, sort_keys=False).encode()
    except UnicodeEncodeError:  # half a surrogate pair, which no text can hold
        return b"camera: '\xed\xa0\x80'"


SNIPPETS = [
    b"&a ", b"*a", b"<<: *a\n", b"---\n", b"...\n", b"!!python/object/apply:os.system [ls]\n", b"!env X\n", b"? ",
    b"%YAML 9.9\n",    b"\t", b"\xff\xfe", b"\xef\xbb\xbf", b"\xe2\x80\xa8", b"- - - -\n", b"[[[[", b"}", b"{",
    b": ", b"|\n", b">-\n", b"'", b'"', b"\0",    b"1e400", b"-.inf", b".nan", b"0x" + b"f" * 300, b"9" * 500,
    b"1_0", b"_target_: os.system\n", b"\r", b"#", b"\x85", b"'\\ud800'",    b"a: &x [*x]\n", b"0o7",
    b"? [a]\n: b\n", b"!!binary aGk=", b"!!set {a}", b"2001-01-01", b"@", b"`", b"!<x>",
]  # fmt: skip


def damaged_text(text: bytes, rng: np.random.Generator) -> bytes:
    """YAML text with other bytes in it."""
    if not text or rng.random() < 0.4:
        return damaged(text, rng) if text else text
    lines = text.split(b"\n")
    kind = rng.integers(4)
    at = int(rng.integers(len(lines)))
    if kind == 0:
        snippet, row = SNIPPETS[rng.integers(len(SNIPPETS))], lines[at]
        column = int(rng.integers(len(row) + 1))
        lines[at] = row[:column] + snippet + row[column:]
    elif kind == 1:
        lines[at] = b" " * int(rng.integers(1, 9)) + lines[at]
    elif kind == 2:
        lines.insert(at, lines[rng.integers(len(lines))])
    else:
        key, _, _ = lines[at].partition(b":")
        lines[at] = key + b": " + SNIPPETS[rng.integers(len(SNIPPETS))]
    return b"\n".join(lines)
