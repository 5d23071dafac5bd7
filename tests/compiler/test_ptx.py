"""PTX of kernels: what the text may hold, and its place in the caches. What it computes: ``tests/device``."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from torchpt.compiler import cache, cpu
from torchpt.compiler.form import Form
from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.kernel import argument_words, kernel_ir
from torchpt.compiler.program import Program, TracedStage
from torchpt.compiler.ptx import ptx_target
from torchpt.compiler.sinks import Compact, Sinks
from torchpt.native import cache as files

TABLE = torch.linspace(0.0, 1.0, 50)


def tables(x: Tensor) -> list[Tensor]:
    """A look-up, a binary search, arithmetic that could be fused, a quotient and a root."""
    row = torch.searchsorted(TABLE, x)
    return [torch.index_select(TABLE, 0, row), x * x + 1.0, (x / 3.0).sqrt()]


@pytest.fixture
def programs(monkeypatch) -> list[Program]:
    """The programs that are compiled, in order."""
    found, compiled = [], cache.compile_stage

    def noted(*given: Any) -> Program:
        found.append(compiled(*given))
        return found[-1]

    monkeypatch.setattr(cache, "compile_stage", noted)
    return found


def compaction(shift: int | None = None) -> TracedStage:
    """A stage that appends row 3 of an arena to row 2 of another where it is positive."""
    graph = Graph()
    value = graph.node("arena", "f", extra=3)
    mask = graph.node("gt", "b", value, graph.constant("f", 0.0))
    return TracedStage(graph, Sinks(compact=[Compact(mask, ((2, value),), counter=0)], shift=shift))


def test_text(programs):
    compile_lanewise(tables, [torch.rand(9)], ptx_target())
    text = programs[0].function.code.decode()
    assert programs[0].call is None
    assert ".version 7.0" in text and ".target sm_75" in text
    # All memory is global or the arguments, tables are read by the cache that nothing writes to, and nothing is called.
    accesses = set(re.findall(r"\b((?:ld|st)\.[\w.]+)", text))
    assert {name.split(".")[1] for name in accesses} == {"global", "param"}
    assert "ld.global.nc.b32" in accesses and "call" not in text
    # ptxas may fuse a plain product and sum, and the approximate quotient and root have other bits.
    assert "fma.rn.f32" in text and "div.rn.f32" in text and "sqrt.rn.f32" in text
    assert not re.search(r"\b(add|sub|mul|fma|div|sqrt|rcp)\.(approx|full|ftz|f32|f64)", text)


def test_argument_block():
    """The entry takes the block of words by value and the address of the number of lanes."""
    stage = replace(compaction(), uniforms=["salts"], tensors=1)
    text = cache.compile_stage(stage, ptx_target()).function.code.decode()
    words = argument_words(stage)
    assert [name for name, _ in words] == "src dst list slots stride counters tables search uniform0 in0 in0s".split()
    assert f".param .align 8 .b8 kernel_param_0[{8 * len(words)}]" in text
    assert ".param .u64 .ptr .global .align 1 kernel_param_1" in text


def test_rows_of_an_arena():
    """The length of rows is the form's."""
    short, long = (kernel_ir(compaction(), ptx_target(row).form) for row in (32, 1 << 20))
    assert "i64 384" in short and "i64 12582912" in long
    assert ptx_target().form == Form(width=1, threads=True)


def test_counter_that_shifts_results():
    with pytest.raises(Unsupported, match="a counter that shifts"):
        kernel_ir(compaction(shift=0), ptx_target().form)
    kernel_ir(compaction(shift=1), ptx_target().form)


def test_cached(monkeypatch, tmp_path, programs):
    """PTX is kept on disk like machine code, and a program of another target is another one."""
    folder = tmp_path / "kernels"
    monkeypatch.setenv("TORCHPT_CACHE", str(folder))
    files._folder.cache_clear()
    monkeypatch.setattr(cpu, "_functions", {})
    try:
        stage = compaction()
        structure = ("a stage for test_cached",)
        made = cache.program_of(structure, {}, lambda: stage, ptx_target())
        assert cache.program_of(structure, {}, lambda: stage) is not made
        assert sorted(x.suffix for x in folder.iterdir() if x.suffix != ".json") == [".o", ".ptx"]
        cache.clear_programs()
        cpu._functions.clear()
        again = cache.program_of(structure, {}, lambda: stage, ptx_target())
        assert again.function.code == made.function.code and again.code == made.code and again.counters == 1
        assert len(programs) == 2  # the third was read
    finally:
        files._folder.cache_clear()
        cache.clear_programs()
