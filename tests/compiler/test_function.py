"""Functions of whole tensors by lanes: compiled once a structure, over threads, refused where they are better left alone."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from torchpt.compiler import cache
from torchpt.compiler.function import Lanewise
from torchpt.core.dispatch import dispatched
from torchpt.native import compile_time
from torchpt.physics.samplers import points_of

G = torch.Generator().manual_seed(3)


@dataclass(frozen=True)
class Curve:
    """Tables with a plain number beside them."""

    gain: Tensor
    offset: Tensor
    degree: int


def curve(kind: Curve, row: Tensor | None, x: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    gain = kind.gain[0] if row is None else torch.index_select(kind.gain, 0, row)
    value = x * scale
    for _ in range(kind.degree):
        value = (value * gain - kind.offset).abs()
    return value, (value[0] > 0.5).to(torch.int32)


def tables(rows: int = 5, degree: int = 2) -> Curve:
    return Curve(torch.rand(rows, generator=G), torch.rand(3, 1, generator=G), degree)


@pytest.fixture
def traced(monkeypatch) -> list[int]:
    """Count how often a stage was compiled."""
    made, compiled = [0], cache.compile_stage

    def counting(*args: Any) -> Any:
        made[0] += 1
        return compiled(*args)

    monkeypatch.setattr(cache, "compile_stage", counting)
    return made


def given(n: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    return torch.randint(0, 5, (n,), generator=G), torch.rand(3, n, generator=G, dtype=dtype)


def close(found: Any, wanted: Any) -> bool:
    """Products that are added to something are rounded once in kernels."""
    return all(torch.allclose(a.double(), b.double(), rtol=1e-5, atol=1e-6) for a, b in zip(found, wanted, strict=True))


def test_a_structure_is_traced_once_whatever_the_numbers(traced):
    kernel, scale, before = Lanewise(curve, ("row", "x"), ("scale",)), torch.tensor(0.7), compile_time.seconds()
    for n in (1, 3, 1000, 70_001):
        kind, (row, x) = tables(), given(n)
        found = kernel(kind, row, x, scale * n)
        assert isinstance(found, tuple) and [(a.dtype, a.shape) for a in found] == [
            (torch.float32, (3, n)),
            (torch.int32, (n,)),
        ]
        assert close(found, curve(kind, row, x, scale * n))
        assert close(kernel(kind, scale=scale, row=row, x=x), curve(kind, row, x, scale))
    assert traced == [1] and compile_time.seconds() > before  # no time of a render's own
    row, x = given(100)
    for kind, index, y in [
        (tables(4), row % 4, x),
        (tables(5, 3), row, x),
        (tables(1), None, x),
        (tables(), row, x.double()),
    ]:
        assert close(kernel(kind, index, y, scale), curve(kind, index, y, scale))
    assert traced == [5] and not kernel.refused


def test_tables_that_are_written_into_are_read_again():
    kernel, scale, kind, (row, x) = Lanewise(curve, ("row", "x"), ("scale",)), torch.tensor(1.0), tables(), given(64)
    before = kernel(kind, row, x, scale)
    kind.gain.mul_(0.5)
    after = kernel(kind, row, x, scale)
    assert not torch.equal(before[0], after[0]) and close(after, curve(kind, row, x, scale))
    other = tables()
    assert close(kernel(other, row, x, scale), curve(other, row, x, scale))


def test_lanes_that_do_not_lie_in_order():
    kernel, scale, kind = Lanewise(curve, ("row", "x"), ("scale",)), torch.tensor([0.3, 2.0])[1], tables()
    row, x = given(200)
    for index, y in [(row[::2], x[:, ::2]), (row[:3].flip(0), x[:, 5:8]), (row[:7], x[:, :1].expand(3, 7))]:
        assert close(kernel(kind, index, y, scale), curve(kind, index, y, scale))


def test_place_and_threads_do_not_matter(monkeypatch):
    from torchpt.compiler import function

    monkeypatch.setattr(function, "GRAIN", 1000)  # so that few lanes repay a thread
    kernel, kind, (row, x), scale = Lanewise(curve, ("row", "x"), ("scale",)), tables(), given(5003), torch.tensor(0.9)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = kernel(kind, row, x, scale)
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            for first, size in ((0, 5003), (0, 1), (1, 3), (5, 1024), (11, 2049)):
                part = slice(first, first + size)
                found = kernel(kind, row[part], x[:, part], scale)
                assert torch.equal(found[0], whole[0][:, part]) and torch.equal(found[1], whole[1][part])
    finally:
        torch.set_num_threads(before)


def test_what_is_better_left_to_the_function():
    @dispatched
    def half(x: Tensor) -> Tensor:
        """Return half."""
        return x * 0.5

    kernel = Lanewise(lambda x: x * 0.5, ("x",))
    half.register(kernel)
    x = torch.rand(8, generator=G)
    assert torch.equal(kernel(x), x * 0.5) and torch.equal(half(x), x * 0.5)
    for other in (x[:0], x.clone().requires_grad_(), torch.empty(8, device="meta")):
        assert kernel(other) is NotImplemented and half(other).shape == other.shape
    (gradient,) = torch.autograd.grad(half(x.requires_grad_()).sum(), x)
    assert torch.equal(gradient, torch.full((8,), 0.5))

    inner: list[Any] = []
    outer = Lanewise(lambda x: inner.append(kernel(x)) or half(x) + 1, ("x",))
    assert torch.equal(outer(x.detach()), half(x.detach()) + 1)
    assert NotImplemented in inner  # while it was traced


def test_what_the_lane_compiler_does_not_know():
    sorting, counting = (
        Lanewise(lambda x: x.sort(0)[0], ("x",)),
        Lanewise(lambda x: x + torch.arange(x.shape[0]), ("x",)),
    )
    x = torch.rand(8, generator=G)
    for _ in range(2):
        assert sorting(x) is NotImplemented and counting(x) is NotImplemented
    assert list(sorting.refused.values()) == ["the operator sort"]
    assert list(counting.refused.values()) == ["a use of the lane's own number"]
    with pytest.raises(ValueError, match="no parameters y"):
        Lanewise(lambda x: x, ("y",))


def test_a_trace_of_classes_that_are_not_the_packages_is_not_kept():
    """Their code is no part of an entry's name."""
    assert cache.cache_key(("a", torch.float32, points_of("sobol").__class__, 2)) is not None
    assert cache.cache_key(("a", torch.float32, Curve, 2)) is None


def test_keys_of_long_structures_differ_where_the_structures_do():
    """The text of a long part is kept: equal parts have equal keys, and others have others, also at a memory address again."""
    keys = {}
    for _ in range(2):
        for k in range(40):
            for last in (1, True, 1.0):  # equal numbers of other types
                keys.setdefault((k, repr(last)), set()).add(cache.cache_key(("a", ("b",) * 500 + (k, last))))
    assert all(len(found) == 1 for found in keys.values())
    assert len(set.union(*keys.values())) == len(keys) == 120
    shared = ("b",) * 500
    assert len({cache.cache_key((name, shared)) for name in ("a", "b", ("a", "b"))}) == 3
    assert cache.cache_key(("a", shared)) == cache.cache_key(("a", ("b",) * 500))


SCRIPT = """
import torch
from torchpt.compiler import cache, cpu
from torchpt.compiler.function import Lanewise
from torchpt.math.hashing import mix
traced, kept = [0], cache.compile_stage
def counting(*args):
    traced[0] += 1
    return kept(*args)
cache.compile_stage = counting
x = torch.arange(1000, dtype=torch.int32)
assert torch.equal(Lanewise(mix, ("x",))(x), mix(x))
own = Lanewise(lambda x: x + 1, ("x",))
assert torch.equal(own(x), x + 1)
print(*cpu.counts(), *traced)
"""


@pytest.mark.slow
def test_another_process_traces_only_what_is_not_the_packages_own(tmp_path):
    environment = {**os.environ, "TORCHPT_CACHE": str(tmp_path / "kernels")}

    def run() -> list[int]:
        command = [sys.executable, "-c", SCRIPT]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100, check=True)
        return [int(word) for word in done.stdout.split()]

    assert run() == [2, 0, 2]
    assert run() == [0, 2, 1]  # machine code is found by what is in it, a trace by the name of the function
