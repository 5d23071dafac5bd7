"""Random damage, by seed, to bytes and to JSON and YAML documents."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

WORDS = [
    "nan",
    "-1",
    "0",
    "1e39",
    "-1e400",
    "99999999999999",
    "4294967295",
    "x",
    "",
    "1/2/3/4",
    "//",
    "\\",
    "\0",
    "#",
    "inf",
]
VALUES: list[Any] = [
    None, True, -1, 0, 3, 2**31, 2**53, 10**30, 1e308, -0.5, float("nan"), "x", "", "data:,", "data:;base64,%", [], {}, [[]],
    [0] * 17, {"index": 0}, {"count": 10**12},
]  # fmt: skip


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """Damage bytes in one random way."""
    data, size = bytearray(whole), len(whole)
    kind = rng.integers(0, 6)
    if kind == 0:
        for at in rng.integers(0, size, rng.integers(1, 8)):
            data[at] = rng.integers(0, 256)
    elif kind == 1:
        del data[rng.integers(0, size) :]
    elif kind == 2:  # a count, or an offset
        at = int(rng.integers(0, size))
        data[at : at + 4] = struct.pack(rng.choice(["<I", ">I"]), int(rng.choice([0, 1, 2**16, 2**31 - 1, 2**32 - 1])))
    elif kind == 3:
        a, b = sorted(rng.integers(0, size, 2))
        data[a:b] = bytes(b - a)
    elif kind == 4:
        a, b = sorted(rng.integers(0, size, 2))
        data[a:a] = data[a:b]
    else:  # a word of text
        words = bytes(data).split(b" ")
        words[rng.integers(0, len(words))] = str(rng.choice(WORDS)).encode()
        data = bytearray(b" ".join(words))
    return bytes(data)


def damaged_json(document: Any, rng: np.random.Generator) -> Any:
    """Replace, remove or repeat one random value of a document."""
    document = json.loads(json.dumps(document))
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])

    walk(document)
    node, key = places[rng.integers(0, len(places))]
    if rng.random() < 0.15:
        del node[key]
    else:
        node[key] = VALUES[rng.integers(0, len(VALUES))]
    return document
