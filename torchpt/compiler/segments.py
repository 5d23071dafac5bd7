"""Sums of segments of a row, one term after the other, as LLVM IR: functions that kernels of single lanes call.

A *segment* is what lies from one place to another in a list that orders the elements of a row. Its sum is made by one lane, in
the order of the list, so it has the same bits on any machine. The rows are those of the *slots*, memory outside of the arenas
that several kernels share (:mod:`torchpt.compiler.sinks`).
"""

from __future__ import annotations

from torchpt.compiler.block import ELEMENTS, Block
from torchpt.compiler.form import Form
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.program import TracedStage
from torchpt.compiler.sinks import Sinks, Store

__all__ = ["segment_functions", "segment_sums"]


def segment_sums(rows: int, ty: str) -> TracedStage:
    """Return the stage that adds segments of rows of the slots, the same segment of each row in a lane.

    Its inputs are the tensors first ``(n,)`` and end ``(n,)``, int32, and start ``(rows, n)`` of the result's type. The uniform
    ``order`` is the list, int32. Its result ``(rows, n)`` is ``start[r] + slots[r, order[first]] + ... +
    slots[r, order[end - 1]]``, added from left to right; for an empty segment, ``end <= first``, it is ``start[r]``.

    Args:
        rows: number of rows, of float32.
        ty: node type of the result, ``f`` or ``d``, in which terms are added.
    """
    graph = Graph()
    first, end = (graph.node("tensor", "i", extra=(number, 0)) for number in range(2))
    starts = [graph.node("tensor", ty, extra=(2, row)) for row in range(rows)]
    sums = [graph.node("segment", ty, first, end, start, extra=row) for row, start in enumerate(starts)]
    return TracedStage(graph, Sinks(store=[Store(tuple(sums), ty)]), uniforms=("order",), tensors=3)


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
    conversion = "fpext float %term to double" if real == "double" else "bitcast float %term to float"
    arguments = f"ptr %row, ptr %order, i32 %first, i32 %end, {real} %start"
    return f"""define internal {real} @segment_{real[0]}({arguments}) alwaysinline #0 {{
entry:
  %some = icmp slt i32 %first, %end
  br i1 %some, label %loop, label %exit
loop:
  %k = phi i32 [ %first, %entry ], [ %next, %loop ]
  %before = phi {real} [ %start, %entry ], [ %after, %loop ]
  %listed = getelementptr i32, ptr %order, i32 %k
  %place = load i32, ptr %listed
  %element = getelementptr float, ptr %row, i32 %place
  %term = load float, ptr %element
  %wide = {conversion}
  %after = fadd {real} %before, %wide
  %next = add i32 %k, 1
  %more = icmp slt i32 %next, %end
  br i1 %more, label %loop, label %exit
exit:
  %sum = phi {real} [ %start, %entry ], [ %after, %loop ]
  ret {real} %sum
}}"""
