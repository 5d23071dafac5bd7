"""The walker over nested records: leaves in order, records rebuilt, and fingerprints that miss nothing."""

from __future__ import annotations

import enum
import functools
import os
import subprocess
import sys
import threading
from collections import namedtuple
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchpt.core.tree import NOT_FINGERPRINTED, fingerprint, leaves, map_leaves, named_leaves, rebuild, signature

Pair = namedtuple("Pair", "x y")


@dataclass(frozen=True)
class Inner:
    x: Tensor
    name: str = "a"
    source: str = field(default="", metadata=NOT_FINGERPRINTED)


@dataclass(frozen=True)
class Record:
    a: Tensor
    parts: tuple[Inner, ...]
    by_name: dict[str, Any]
    none: Tensor | None = None
    kinds: tuple[type, ...] = (int,)


def record(**changed: Any) -> Record:
    numbers = torch.arange(8.0)
    values = {
        "a": numbers[0],
        "parts": (Inner(numbers[1]), Inner(numbers[2])),
        "by_name": {"z": [numbers[3], 5], "b": numbers[4]},
    }
    return Record(**{**values, **changed})


def test_leaves_come_in_the_order_of_fields() -> None:
    one = record()
    assert [int(x) for x in leaves(one)] == [0, 1, 2, 3, 4]
    assert [
        path for path, _ in named_leaves(one, "w")
    ] == "w.a w.parts.0.x w.parts.1.x w.by_name.z.0 w.by_name.b".split()
    assert [id(x) for x in leaves(one)] == [id(x) for _, x in named_leaves(one, "")]


def test_a_record_is_rebuilt_of_its_leaves() -> None:
    one = record()
    again = rebuild(one, [x + 1 for x in leaves(one)])
    assert [int(x) for x in leaves(again)] == [1, 2, 3, 4, 5]
    assert again.by_name["z"][1] == 5 and again.parts[0].name == "a" and again.kinds == (int,)
    with pytest.raises(ValueError, match="4 tensors for a record of 5"):
        rebuild(one, leaves(one)[1:])


def test_what_did_not_change_stays_itself() -> None:
    one = record()
    assert map_leaves(lambda x: x, one) is one
    moved = map_leaves(lambda x: x + 1 if int(x) == 1 else x, one)
    assert moved.parts[1] is one.parts[1] and moved.by_name is one.by_name and moved.parts[0] is not one.parts[0]
    assert map_leaves(lambda x: x + 1, Pair(torch.ones(()), 2)) == Pair(torch.tensor(2.0), 2)


def test_several_records_are_mapped_together() -> None:
    added = map_leaves(lambda *same: sum(same), record(), record(), record())
    assert [int(x) for x in leaves(added)] == [0, 3, 6, 9, 12]


def test_modules_are_one_thing_whole() -> None:
    layer = torch.nn.Linear(2, 2)
    assert leaves([layer]) == [] and map_leaves(lambda x: x + 1, (layer,)) == (layer,)
    assert signature((layer,)) == signature((layer,)) != signature((torch.nn.Linear(2, 2),))
    assert hash(signature(record())) == hash(signature(record()))


# -- fingerprints


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


class Thing:
    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)

    @functools.cached_property
    def kept(self) -> int:
        return 1


@dataclass
class Scaled:
    by: float

    def __call__(self, x: float) -> float:
        return self.by * x


def module(bias: float) -> torch.nn.Module:
    layer = torch.nn.Linear(2, 1)
    torch.nn.init.constant_(layer.weight, 1.0)
    torch.nn.init.constant_(layer.bias, bias)
    return torch.nn.Sequential(layer)


DIFFERENT: list[Any] = [
    None, True, False, 0, 1, 2, 0.0, -0.0, 1.0, float("nan"), "", "1", b"1", (), (1,), (1, 2), ((1, 2),), ((1,), 2), (2, 1),
    {"a": 1}, {"a": 2}, {"b": 1}, {"a": 1, "b": 2}, {1}, {1, 2}, int, float, Colour.RED, Colour.BLUE, torch.float32,
    torch.float64, Path("a"), Path("b"), slice(1), slice(2), np.float32(1), np.zeros(2), np.zeros(2, np.float32),
    np.zeros((2, 1)), np.array([0, 1e-30]), np.array(["a", 1], object), np.array(["b", 1], object), torch.zeros(2),
    torch.zeros(1, 2), torch.zeros(2, dtype=torch.float64), torch.tensor([0.0, 1e-30]), torch.zeros(2, dtype=torch.bfloat16),
    record(), record(none=torch.zeros(1)), record(kinds=(float,)), Inner(torch.zeros(1)), Inner(torch.zeros(1), "b"), Thing(),
    Thing(a=1), Thing(a=2), Thing(b=1), Pair(1, 2), Pair(2, 2), functools.partial(max, 1), functools.partial(max, 2),
    functools.partial(min, 1), max, module(0.0), module(1.0), Scaled(1.0).__call__, Scaled(2.0).__call__, lambda x: x + 1,
    lambda x: x + 2, lambda y, x=1: y + x,
]  # fmt: skip


def test_different_things_have_different_fingerprints() -> None:
    found = [fingerprint(value) for value in DIFFERENT]
    assert len(set(found)) == len(found)
    assert found == [fingerprint(value) for value in DIFFERENT]
    assert len({fingerprint({"in": value}) for value in DIFFERENT} | set(found)) == 2 * len(found)


def test_what_no_picture_depends_on_is_left_out() -> None:
    one, thing = Inner(torch.zeros(1)), Thing(a=1)
    assert fingerprint(replace(one, source="b.obj")) == fingerprint(one)
    before = fingerprint(thing)
    assert thing.kept and fingerprint(thing) == before
    assert fingerprint(torch.zeros(2).requires_grad_()) == fingerprint(torch.zeros(2))
    assert fingerprint(torch.arange(4.0)[::2]) == fingerprint(torch.tensor([0.0, 2.0]))
    assert fingerprint(np.arange(4, dtype=">f8")) == fingerprint(np.arange(4, dtype="<f8")), "of another byte order"
    assert fingerprint({2, 1}) == fingerprint({1, 2})


def test_objects_that_hold_each_other_end() -> None:
    def ring(number: int) -> Thing:
        one = Thing(number=number)
        one.__dict__["other"] = Thing(other=one)
        return one

    assert fingerprint(ring(1)) == fingerprint(ring(1)) != fingerprint(ring(2))


def test_what_cannot_be_known_is_refused() -> None:
    with pytest.raises(TypeError, match="lock"):
        fingerprint(Thing(lock=threading.Lock()))


def defined(code: str) -> dict[str, Any]:
    space: dict[str, Any] = {"__name__": "someone"}
    exec(code, space)
    return space


CODE = """
STRENGTH = 2.0
def helper(x): return x
class Model:
    table = (1.0, 2.0)
    @property
    def size(self): return 1
    @classmethod
    def made(cls): return cls()
    def eval(self, x, by=1.0): return helper(x) * STRENGTH * by * 3.0
"""


@pytest.mark.parametrize(
    "change",
    [
        ("2.0\ndef", "2.5\ndef"),
        ("return x", "return -x"),
        ("(1.0, 2.0)", "(1.0, 2.5)"),
        ("return 1", "return 2"),
        ("cls()", "None"),
        ("by=1.0", "by=1.5"),
        ("* 3.0", "* 3.5"),
        ("x, by", "x, other=0, by"),
    ],
)
def test_code_of_ones_own_counts_and_comments_do_not(change: tuple[str, str]) -> None:
    before = fingerprint(defined(CODE)["Model"]())
    assert fingerprint(defined(f"# a comment\n\n{CODE}  # another\n")["Model"]()) == before
    assert change[0] in CODE and fingerprint(defined(CODE.replace(*change))["Model"]()) != before


@pytest.mark.slow
def test_two_processes_agree() -> None:
    code = "import sys; sys.path.insert(0, sys.argv[1]); import test_tree as t; from torchpt.core.tree import fingerprint; "
    code += "print([fingerprint(x).hex() for x in t.DIFFERENT])"
    found = set()
    for seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}  # the order of sets follows from it
        words = [sys.executable, "-c", code, str(Path(__file__).parent)]
        found.add(subprocess.run(words, env=environment, check=True, capture_output=True, text=True).stdout)
    assert len(found) == 1
