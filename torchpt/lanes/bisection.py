"""Binary searches in sorted tables, as LLVM IR: functions that kernels call."""

from __future__ import annotations

from torchpt.lanes.block import Block
from torchpt.lanes.emission import MEMORY
from torchpt.lanes.form import Form
from torchpt.lanes.graph import Graph

__all__ = ["search_functions"]


def search_functions(graph: Graph, needed: list[int], form: Form) -> Block:
    """Binary searches: all lanes take as many steps, which are as many as the table's length asks for."""
    asked = {extra[1:] for op, _, _, extra in map(graph.nodes.__getitem__, needed) if op == "search"}
    whole = Block(form)
    for ty, right in sorted(asked):
        block, element = Block(form), MEMORY[ty]
        vector, places = block.vector(ty), block.each("i32")
        block.lines += [
            f"define internal {places} @sorted_{ty}_{'right' if right else 'left'}"
            f"(ptr %table, i64 %count, {vector} %value) #0 {{",
            "entry:",
            "  %count32 = trunc i64 %count to i32",
            "  %last = sub i32 %count32, 1",
        ]
        last, most = block.splat("i", "%last"), block.splat("i", "%count32")
        block.lines += [
            "  %none = icmp eq i32 %count32, 0",
            "  br i1 %none, label %exit, label %loop",
            "loop:",
            f"  %base = phi {places} [ zeroinitializer, %entry ], [ %better, %loop ]",
            "  %length = phi i32 [ %count32, %entry ], [ %rest, %loop ]",
            "  %more = add i32 %length, 1",
            "  %half = lshr i32 %more, 1",
            "  %step = sub i32 %half, 1",
        ]
        middle = block.call("llvm.umin", "i", block.add("i", "%base", block.splat("i", "%step")), last)
        entry = block.gather(element, "%table", middle)
        below = block.compare(
            ("ule" if right else "ult") if ty in "fd" else ("sle" if right else "slt"), ty, entry, "%value"
        )
        further = block.add("i", "%base", block.splat("i", "%half"))
        block.lines += [
            f"  %better = select {block.each('i1')} {below}, {places} {further}, {places} %base",
            "  %rest = lshr i32 %length, 1",
            "  %done = icmp eq i32 %rest, 0",
            "  br i1 %done, label %exit, label %loop",
            "exit:",
            f"  %found = phi {places} [ zeroinitializer, %entry ], [ %better, %loop ]",
        ]
        block.do(f"ret {places} {block.call('llvm.umin', 'i', '%found', most)}")
        block.lines.append("}")
        whole.lines += block.lines
        whole.declarations |= block.declarations
    return whole
