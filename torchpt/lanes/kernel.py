"""A kernel: the loop over lanes around the nodes of a stage.

A kernel reads lanes of one arena (:mod:`~torchpt.lanes.arena`), all of them in order or those that a list of places names; its
sinks (:mod:`~torchpt.lanes.sinks`) say where results go, and its form (:mod:`~torchpt.lanes.form`) how many lanes a turn takes.
"""

from __future__ import annotations

from torchpt.lanes.bisection import search_functions
from torchpt.lanes.emission import Body, emit
from torchpt.lanes.form import Form
from torchpt.lanes.fusing import fused
from torchpt.lanes.graph import Unsupported
from torchpt.lanes.packet import packet_search
from torchpt.lanes.stage import TracedStage
from torchpt.lanes.stores import sink_lines

__all__ = ["HEAD", "text"]

#: What every call is given, in this order; then uniforms, lists, and input and output tensors with their row lengths.
HEAD = ("src", "dst", "list", "slots", "stride", "counters", "tables", "search")


def text(stage: TracedStage, form: Form) -> str:
    """Return the IR of ``void kernel(ptr arguments, i64 lanes)``.

    Raises:
        Unsupported: for an operation, or a table that is not there.
    """
    graph, sinks, needed = stage.graph, stage.sinks, stage.needed()
    products = fused(graph, needed, sinks.roots())
    body = Body(form, stage.listed, products)
    _enter(body, stage, needed)
    entry, body.lines, body.label = body.lines, [], "loop"
    _begin(body)
    names: dict[int, str] = {}
    within = set(products.values())
    for node in needed:
        if node not in within:
            names[node] = emit(body, graph, node, names)
    ends = sink_lines(body, graph, names, sinks)
    ends.write()
    inner = [search_functions(graph, needed, form)]
    if stage.searched is not None:
        inner.append(packet_search(stage.searched, form))
    declarations = set().union(*(block.declarations for block in (body, *inner)))
    lines = [
        *(line for block in inner for line in block.lines),
        *ends.functions,
        "define void @kernel(ptr noalias %arguments, i64 %n) #0 {",
        "entry:",
        *entry,
        "  %any = icmp slt i64 0, %n",
        "  br i1 %any, label %loop, label %exit",
        "loop:",
        f"  %i = phi i64 [ 0, %entry ], [ %next, %{body.label} ]",
        *ends.before,
        *body.lines,
        f"  %next = add i64 %i, {form.width}",
        "  %more = icmp slt i64 %next, %n",
        "  br i1 %more, label %loop, label %exit",
        "exit:",
        *ends.after,
        "  ret void",
        "}",
        *sorted(declarations),
        f"attributes #0 = {{ nounwind{_PREFERRED if form.width > 1 else ''} }}",
        "!0 = !{}",
        "",
    ]
    return "\n".join(lines)


_PREFERRED = ' "prefer-vector-width"="512" "min-legal-vector-width"="512"'


def _begin(body: Body) -> None:
    """Begin a turn of the loop: its lanes (``%mask``), and their places in the arena (``%place``)."""
    body.declarations.add("declare i64 @llvm.smin.i64(i64, i64)")
    left = body.op("sub i64 %n, %i")
    few = body.op(f"call i64 @llvm.smin.i64(i64 {left}, i64 {body.width})")
    few = body.splat("i", body.op(f"trunc i64 {few} to i32"))
    body.do(f"%mask = icmp sgt {body.each('i32')} {few}, {body.numbers()}")
    if body.listed:
        listed = body.at("%list", "i32", "%i")
        body.do(f"%place = load {body.each('i32')}, ptr {listed}, align 4")


def _enter(body: Body, stage: TracedStage, needed: list[int]) -> None:
    """Read the arguments before the loop."""
    graph, sinks = stage.graph, stage.sinks
    words = [(name, "i64" if name == "stride" else "ptr") for name in HEAD]
    words += [(f"uniform{k}", "ptr") for k in range(len(stage.uniforms))]
    words += [(f"list{k}", "ptr") for k in range(sinks.lists())]
    for name in [f"in{k}" for k in range(stage.tensors)] + [f"out{k}" for k in range(len(sinks.store))]:
        words += [(name, "ptr"), (f"{name}s", "i64")]
    for place, (name, ty) in enumerate(words):
        body.do(f"%{name} = load {ty}, ptr {body.at('%arguments', 'i64', place)}")
    found = [graph.nodes[node] for node in needed]
    for k in sorted({extra[0] for op, _, _, extra in found if op in ("gather", "element", "search")}):
        if k >= len(stage.tables):
            raise Unsupported("a table that is not there")
        body.do(f"%table{k} = load ptr, ptr {body.at('%tables', 'i64', 2 * k)}")
        body.do(f"%count{k} = load i64, ptr {body.at('%tables', 'i64', 2 * k + 1)}")
        last = body.op(f"sub i32 {body.op(f'trunc i64 %count{k} to i32')}, 1")
        body.let(f"last{k}", body.each("i32"), body.splat("i", last))
    for k in sorted({extra for op, _, _, extra in found if op == "arena"}):
        body.do(f"%row{k} = getelementptr i8, ptr %src, i64 {4 * body.form.row * k}")
    for k in range(sinks.counters()):
        body.do(f"%first{k} = load i64, ptr {body.at('%counters', 'i64', k)}")
