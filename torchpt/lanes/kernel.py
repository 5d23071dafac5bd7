"""A kernel: the loop over lanes around the nodes of a stage.

A kernel reads lanes of one arena (:mod:`~torchpt.lanes.arena`), all of them in order or those that a list of places names; its
sinks (:mod:`~torchpt.lanes.sinks`) say where results go.
"""

from __future__ import annotations

from torchpt.lanes.arena import CAPACITY
from torchpt.lanes.bisection import search_functions
from torchpt.lanes.block import WIDTH, Block
from torchpt.lanes.emission import emit
from torchpt.lanes.graph import Graph, Unsupported
from torchpt.lanes.sinks import Sinks
from torchpt.lanes.stores import SinkLines

__all__ = ["HEAD", "text"]

_UMIN = f"declare <{WIDTH} x i32> @llvm.umin.v{WIDTH}i32(<{WIDTH} x i32>, <{WIDTH} x i32>)"
#: What every call is given, in this order; then uniforms, lists, and input and output tensors with their row lengths.
HEAD = ("src", "dst", "list", "slots", "stride", "counters", "tables", "search")


class _Body(Block):
    """A block that knows whether lanes are read in order or by a list."""

    def __init__(self, listed: bool) -> None:
        super().__init__()
        self.listed = listed


def text(
    graph: Graph, sinks: Sinks, tables: int, uniforms: int, tensors: int, listed: bool, search: Block | None = None
) -> tuple[str, list[int]]:
    """The IR of ``void kernel(ptr arguments, i64 lanes)``, and the nodes in it.

    Args:
        graph: the stage.
        sinks: what becomes of its results.
        tables: how many it may read.
        uniforms: how many inputs are shared by all lanes.
        tensors: how many inputs are tensors.
        listed: whether lanes are those that a list names.
        search: the functions ``nearest`` and ``occluded``, where the stage calls them.
    """
    body, needed = _Body(listed), graph.needed(sinks.roots())
    names: dict[int, str] = {}
    if listed:
        body.lines.append(
            f"  %listed = getelementptr i32, ptr %list, i64 %i\n  %place = load <{WIDTH} x i32>, ptr %listed, align 4"
        )
    for node in needed:
        names[node] = emit(body, graph, node, names)
    ends = SinkLines(body, graph, names, sinks)
    ends.write()
    entry = _entry(graph, needed, sinks, tables, uniforms, tensors, listed)
    counters = range(sinks.counters())
    phis = [f"  %c{k} = phi i64 [ %first{k}, %entry ], [ {ends.after[k]}, %loop ]" for k in counters]
    after = [f"  %end{k} = phi i64 [ %first{k}, %entry ], [ {ends.after[k]}, %loop ]" for k in counters]
    for k in counters:
        after += [f"  %slot{k} = getelementptr i64, ptr %counters, i64 {k}", f"  store i64 %end{k}, ptr %slot{k}"]
    numbers = ", ".join(f"i32 {k}" for k in range(WIDTH))
    inner = search_functions(graph, needed)
    declarations = {_UMIN, *body.declarations, *inner.declarations}
    if search is not None:
        declarations |= search.declarations
    lines = [
        *(() if search is None else search.lines),
        *inner.lines,
        "define void @kernel(ptr noalias %arguments, i64 %n) #0 {",
        "entry:",
        *entry,
        "  %any = icmp slt i64 0, %n",
        "  br i1 %any, label %loop, label %exit",
        "loop:",
        "  %i = phi i64 [ 0, %entry ], [ %next, %loop ]",
        *phis,
        "  %left = sub i64 %n, %i",
        f"  %few = call i64 @llvm.smin.i64(i64 %left, i64 {WIDTH})",
        "  %few32 = trunc i64 %few to i32",
        f"  %few1 = insertelement <{WIDTH} x i32> poison, i32 %few32, i64 0",
        f"  %fews = shufflevector <{WIDTH} x i32> %few1, <{WIDTH} x i32> poison, <{WIDTH} x i32> zeroinitializer",
        f"  %mask = icmp sgt <{WIDTH} x i32> %fews, <{numbers}>",
        "  %i32 = trunc i64 %i to i32",
        f"  %i321 = insertelement <{WIDTH} x i32> poison, i32 %i32, i64 0",
        f"  %i32s = shufflevector <{WIDTH} x i32> %i321, <{WIDTH} x i32> poison, <{WIDTH} x i32> zeroinitializer",
        *body.lines,
        f"  %next = add i64 %i, {WIDTH}",
        "  %more = icmp slt i64 %next, %n",
        "  br i1 %more, label %loop, label %exit",
        "exit:",
        *after,
        "  ret void",
        "}",
        "declare i64 @llvm.smin.i64(i64, i64)",
        *sorted(declarations),
        'attributes #0 = { nounwind "prefer-vector-width"="512" "min-legal-vector-width"="512" }',
        "!0 = !{}",
        "",
    ]
    return "\n".join(lines), needed


def _entry(
    graph: Graph, needed: list[int], sinks: Sinks, tables: int, uniforms: int, tensors: int, listed: bool
) -> list[str]:
    """What is read of the arguments before the loop."""
    lines: list[str] = []
    place = 0

    def argument(name: str, ty: str = "ptr") -> None:
        nonlocal place
        lines.append(f"  %a{place} = getelementptr i64, ptr %arguments, i64 {place}")
        lines.append(f"  %{name} = load {ty}, ptr %a{place}")
        place += 1

    for name in HEAD:
        argument(name, "i64" if name == "stride" else "ptr")
    for k in range(uniforms):
        argument(f"uniform{k}")
    for k in range(sinks.lists()):
        argument(f"list{k}")
    for k in range(tensors):
        argument(f"in{k}")
        argument(f"in{k}s", "i64")
    for k in range(len(sinks.store)):
        argument(f"out{k}")
        argument(f"out{k}s", "i64")
    read = {
        extra[0] for op, _, _, extra in map(graph.nodes.__getitem__, needed) if op in ("gather", "element", "search")
    }
    for k in sorted(read):
        if k >= tables:
            raise Unsupported("a table that is not there")
        lines += [
            f"  %t{k}p = getelementptr i64, ptr %tables, i64 {2 * k}",
            f"  %table{k} = load ptr, ptr %t{k}p",
            f"  %t{k}c = getelementptr i64, ptr %tables, i64 {2 * k + 1}",
            f"  %count{k} = load i64, ptr %t{k}c",
            f"  %last{k}w = sub i64 %count{k}, 1",
            f"  %last{k}n = trunc i64 %last{k}w to i32",
            f"  %last{k}o = insertelement <{WIDTH} x i32> poison, i32 %last{k}n, i64 0",
            f"  %last{k} = shufflevector <{WIDTH} x i32> %last{k}o, <{WIDTH} x i32> poison, "
            f"<{WIDTH} x i32> zeroinitializer",
        ]
    rows = {extra for op, _, _, extra in map(graph.nodes.__getitem__, needed) if op == "arena"}
    lines += [f"  %row{k} = getelementptr i8, ptr %src, i64 {4 * CAPACITY * k}" for k in sorted(rows)]
    for k in range(sinks.counters()):
        lines += [f"  %c{k}p = getelementptr i64, ptr %counters, i64 {k}", f"  %first{k} = load i64, ptr %c{k}p"]
    return lines
