"""Sums of segments of a row, one term after the other, as LLVM IR: functions that kernels of single lanes call.

A *segment* is what lies from one element of a row to another. Its sum is made by one lane, from left to right, so it has the
same bits on any machine. The row is the first of the *slots*, memory outside of the arenas that several kernels
share (:mod:`torchpt.compiler.sinks`).
"""

from __future__ import annotations

from torchpt.compiler.block import ELEMENTS, Block
from torchpt.compiler.form import Form
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.program import TracedStage
from torchpt.compiler.sinks import Sinks, Store

__all__ = ["UNROLLED", "segment_functions", "segment_sums"]

#: Terms whose loads overlap.
UNROLLED = 16


def segment_sums(ty: str) -> TracedStage:
    """Return the stage that adds segments of the first row of the slots, one in a lane.

    Its inputs are the tensors first and end, int32, and start of the result's type, ``(n,)`` each. Its result ``(n,)`` is
    ``start + slots[first] + ... + slots[end - 1]``, added from left to right; for an empty segment, ``end <= first``, it is
    ``start``.

    Args:
        ty: node type of the result, ``f`` or ``d``, in which terms are added; the slots are float32.
    """
    graph = Graph()
    first, end = (graph.node("tensor", "i", extra=(number, 0)) for number in range(2))
    total = graph.node("segment", ty, first, end, graph.node("tensor", ty, extra=(2, 0)))
    return TracedStage(graph, Sinks(store=[Store((total,), ty)]), tensors=3)


def segment_functions(graph: Graph, needed: list[int], form: Form) -> Block:
    """Write the functions ``segment_f`` and ``segment_d`` that a graph needs.

    Args:
        graph: the graph of a stage.
        needed: nodes that are computed.
        form: layout of lanes.

    Raises:
        Unsupported: the form has vectors.
    """
    block = Block(form)
    for ty in sorted({graph.type(k) for k in needed if graph.nodes[k][0] == "segment"}):
        if form.width > 1:
            raise Unsupported("sums of segments by vectors")
        block.lines += _text(ELEMENTS[ty]).splitlines()
    return block


def _text(real: str) -> str:
    """Return the definition of the function for results of an LLVM type."""

    def added(terms: int, start: str, place: str, name: str) -> str:
        """Return code that adds consecutive terms from ``place`` on to ``start``; all loads come first, as they can overlap."""
        loads, adds = [], []
        for n in range(terms):
            loads += [
                f"%{name}at{n} = add i32 {place}, {n}",
                f"%{name}p{n} = getelementptr float, ptr %row, i32 %{name}at{n}",
            ]
            loads += [f"%{name}t{n} = load float, ptr %{name}p{n}"]
            wide = f"%{name}t{n}"
            if real == "double":
                wide = f"%{name}w{n}"
                loads.append(f"{wide} = fpext float %{name}t{n} to double")
            adds.append(f"%{name}s{n} = fadd {real} {f'%{name}s{n - 1}' if n else start}, {wide}")
        return "\n  ".join(loads + adds)

    return f"""define internal {real} @segment_{real[0]}(ptr %row, i32 %first, i32 %end, {real} %start) alwaysinline #0 {{
entry:
  br label %head
head:
  %k = phi i32 [ %first, %entry ], [ %later, %many ]
  %before = phi {real} [ %start, %entry ], [ %ms{UNROLLED - 1}, %many ]
  %later = add i32 %k, {UNROLLED}
  %fits = icmp sle i32 %later, %end
  br i1 %fits, label %many, label %rest
many:
  {added(UNROLLED, "%before", "%k", "m")}
  br label %head
rest:
  %j = phi i32 [ %k, %head ], [ %next, %one ]
  %sum = phi {real} [ %before, %head ], [ %os0, %one ]
  %more = icmp slt i32 %j, %end
  br i1 %more, label %one, label %exit
one:
  {added(1, "%sum", "%j", "o")}
  %next = add i32 %j, 1
  br label %rest
exit:
  ret {real} %sum
}}"""
