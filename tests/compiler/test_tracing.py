"""What becomes of a function: what is refused and by which name, what may be other tables' kernel, where nodes come from."""

from __future__ import annotations

import ctypes
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterable

import pytest
import torch
from torch import Tensor, nn

from torchpt.compiler import cpu, function
from torchpt.compiler.form import VECTORS
from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.kernel import kernel_ir
from torchpt.compiler.program import Program, TracedStage, bind_tables, guards_hold, lay_out_table, run_prologue
from torchpt.compiler.sinks import Sinks, Store
from torchpt.compiler.tracing import LANES, Tracer, tracing
from torchpt.math import vectors

X = torch.randn(3, 50, generator=torch.Generator().manual_seed(1))


def trace(stage: Callable[..., Iterable[Tensor]], *given: Tensor, **tables: Tensor) -> tuple[Tracer, str]:
    """A function of lanes and tables: the tracer, and the IR that stores its results."""
    tracer = Tracer(LANES[0], {id(x): (name, x) for name, x in tables.items()})
    lanes = [torch.zeros(*x.shape[:-1], LANES[0], dtype=x.dtype) for x in given]
    for slot, x in enumerate(lanes):
        tracer.lane(x, lambda k, slot=slot: tracer.graph.node("tensor", "f", extra=(slot, k)))
    with torch.no_grad(), tracer:
        results = list(stage(*lanes, **tables))
    stores = [Store(tuple(tracer.nodes(x)), tracer.graph.type(tracer.nodes(x)[0])) for x in results]
    return tracer, kernel_ir(TracedStage(tracer.graph, Sinks(store=stores), tracer.tables, tensors=len(given)), VECTORS)


def gradient_of_squares(x: Tensor) -> list[Tensor]:
    with torch.enable_grad():
        leaf = x.detach().requires_grad_()
        return list(torch.autograd.grad(leaf.square(), leaf, torch.ones_like(x)))


def test_anomaly_detection_is_off_within_and_comes_back() -> None:
    x = torch.zeros(3, 1)
    _, plain = trace(gradient_of_squares, x)
    for check_nan in (True, False):
        with torch.autograd.set_detect_anomaly(True, check_nan):
            assert trace(gradient_of_squares, x)[1] == plain
            with Tracer(LANES[0], {}), Tracer(LANES[0], {}):
                assert not torch.is_anomaly_enabled()
            assert torch.is_anomaly_enabled() and torch.is_anomaly_check_nan_enabled() is check_nan
    assert not torch.is_anomaly_enabled()


REFUSED: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
    "sum over lanes": ("a reduction over lanes", lambda x: x - x.sum(1, keepdim=True)),
    "maximum of all": ("a reduction over lanes", lambda x: x - x.amax()),
    "cumulative": ("a sum over lanes", lambda x: x.cumsum(1)),
    "product over lanes": ("a sum over lanes", lambda x: (x @ x.T) @ x),
    "other lanes": ("a look-up in other lanes", lambda x: x[:, torch.arange(x.shape[1]) + 1]),
    "gather from lanes": ("a look-up in other lanes", lambda x: torch.gather(x, 1, (x * 0).long())),
    "rows by lanes": ("a look-up in a tensor that depends on lanes", lambda x: x[torch.tensor([0, 2])]),
    "flip": ("a flip of the lanes' axis", lambda x: x.flip(1)),
    "roll": ("a roll along the lanes' axis", lambda x: x.roll(1, 1)),
    "one lane": ("the selection of one lane", lambda x: x - x[:, 0][:, None]),
    "part": ("a slice of the lanes' axis", lambda x: x[:, 1:]),
    "joined": ("a concatenation along the lanes' axis", lambda x: torch.cat([x, x], 1)),
    "two axes": ("lanes on two axes", lambda x: (x[0][:, None] * x[0]).sum(0)),
    "mixed": ("mixed into shape", lambda x: x.T.reshape(3, -1)),
    "flattened": ("along its lanes' axis", lambda x: x.reshape(-1)),
    "transposed": ("last axis is not the lanes'", lambda x: x.T),
    "mask": ("a look-up by a boolean mask", lambda x: x[:, x[0] > 0]),
    "item": ("a lane's value read", lambda x: x * torch.ops.aten._local_scalar_dense(x)),
    "list": ("read by Python", lambda x: x * x.tolist()[0][0]),
    "numpy": ("read by Python", lambda x: x * float(x.numpy()[0, 0])),
    "sort": ("the operator sort", lambda x: x.sort(0)[0]),
    "in place": ("the operator add_", lambda x: x.clone().add_(1)),
    "written": ("the operator copy_", lambda x: torch.zeros_like(x).copy_(x)),
    "random": ("the operator rand_like", lambda x: torch.rand_like(x)),
    "random lanes": ("lanes made by rand", lambda x: x * torch.rand(x.shape[1])),
    "spaced": ("does not start at 0 with step 1", lambda x: x * torch.arange(1, x.shape[1] + 1)),
    "half": ("torch.float16", lambda x: x.half().float()),
    "decimals": ("aten.round.decimals", lambda x: x.round(decimals=2)),
    "integer power": ("a power of integers", lambda x: x.long() ** x.long().abs()),
    "large table": ("read whole in every lane", lambda x: x[0] + torch.zeros(5000)[:, None]),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    says, stage = REFUSED[name]
    with pytest.raises(Unsupported, match=says):
        compile_lanewise(lambda x: [stage(x)], [X])


def test_operator_of_another_library_is_refused():
    library = torch.library.Library("lanetest", "FRAGMENT")
    library.define("add(Tensor x, Tensor y) -> Tensor")
    library.impl("add", lambda x, y: x - y, "CPU")
    with pytest.raises(Unsupported, match="the operator add"):
        compile_lanewise(lambda x: [torch.ops.lanetest.add(x, x)], [X])


def test_tracing_ends():
    seen = []
    with pytest.raises(Unsupported):
        compile_lanewise(lambda x: [seen.append(tracing()) or x.sort(0)[0]], [X])
    assert seen == [True] and not tracing()


# -- other tables


def stage(x: Tensor, table: Tensor, gain: Tensor) -> list[Tensor]:
    """Arithmetic on tables alone (the prologue), look-ups, whole tables, a number."""
    total = table.cumsum(0)
    row = torch.searchsorted(total / total[-1], x[0])
    return [torch.index_select(table * gain, 0, row), x[1] * gain + total[0]]


def program(tracer: Tracer, ir: str) -> Program:
    made = cpu.compile_ir(ir)
    parts = tuple(tracer.tables), tuple(tracer.steps), tuple(tracer.constants), tuple(tracer.guards)
    return Program(made, *parts, (), 0, 0, 1, 2, 0, {})


def call(made: Program, x: Tensor, results: int, leaves: dict[str, Tensor]) -> list[Tensor]:
    tables = bind_tables(made.tables, made.steps, made.constants, leaves)
    outputs = [torch.full((x.shape[1],), math.nan) for _ in range(results)]
    words = [0] * len(function.HEAD)
    words[function.HEAD.index("tables")] = tables.address
    for tensor in (x, *outputs):
        words += [tensor.data_ptr(), x.shape[1]]
    block = (ctypes.c_int64 * len(words))(*words)
    made.call(ctypes.addressof(block), x.shape[1])
    return outputs


@pytest.mark.parametrize("size", [5, 64, 77])
def test_replay(size):
    """One kernel serves tables of other numbers and sizes, as a fresh one would."""
    rng = torch.Generator().manual_seed(size)
    x = torch.rand(2, 50, generator=rng)
    made = program(*trace(stage, x, table=torch.rand(9) + 0.1, gain=torch.tensor(2.0)))
    before = cpu.counts()
    table, gain = torch.rand(size, generator=rng) + 0.1, torch.tensor(0.7)
    fresh = program(*trace(stage, x, table=table, gain=gain))
    assert cpu.counts() == before and fresh.call is made.call  # the very same code
    leaves = {"table": table, "gain": gain}
    found, again = call(made, x, 2, leaves), call(fresh, x, 2, leaves)
    assert made.leaves() == {"table", "gain"}
    for a, b, wanted in zip(found, again, stage(x, table, gain), strict=True):
        assert torch.equal(a, b)
        torch.testing.assert_close(a, wanted, rtol=1e-6, atol=1e-6)


def test_any_size_of_table_is_one_kernel():
    tables = [torch.arange(float(n)) for n in (1, 2, 77, 100_000)]
    irs = {trace(lambda x, t: [t[(x[0] * 1e9).long()], torch.searchsorted(t, x[1]) + x[0]], X, t=t)[1] for t in tables}
    assert len(irs) == 1


def test_guards():
    """A number that Python asked a table for holds for the trace alone."""

    def branching(x: Tensor, table: Tensor) -> list[Tensor]:
        return [x[0] * 2 if table.amax().item() > 1 else x[0], x[1] * float(torch.equal(table, table * 1))]

    tracer, ir = trace(branching, X, table=torch.tensor([0.5, 2.0]))
    made = program(tracer, ir)
    assert len(made.guards) == 2
    assert guards_hold(made, {"table": torch.tensor([2.0, 0.1])})
    assert not guards_hold(made, {"table": torch.tensor([0.5, 3.0])})  # another number, on which the trace may rely
    assert not guards_hold(made, {"table": torch.tensor([2.0, math.nan])})


def test_numbers_of_the_program_are_read_not_frozen():
    """A network's weight without axes is memory like others: training may change it in place."""
    gain = torch.tensor(2.0)
    kernel = compile_lanewise(lambda x: [x * gain], [X])
    assert torch.equal(kernel(X)[0], X * 2)
    gain.fill_(3.0)
    assert torch.equal(kernel(X)[0], X * 3)


def test_steps_are_replayed_in_order():
    """Writing into a table of the stage's own is part of the prologue."""

    def writing(x: Tensor, table: Tensor) -> list[Tensor]:
        own = torch.zeros(4)
        own[1] = table[0]
        own += 1
        return [own[(x[0].abs() * 2).long()]]

    tracer, ir = trace(writing, X, table=torch.tensor([5.0]))
    x = torch.rand(3, 50)
    found = call(program(tracer, ir), x, 1, {"table": torch.tensor([8.0])})[0]
    assert torch.equal(found, writing(x, torch.tensor([8.0]))[0]) and found.max() == 9
    tensor = run_prologue(tracer.steps, tracer.constants, {"table": torch.tensor([8.0])})
    assert tensor(tracer.tables[0].source).tolist() == [1, 9, 1, 1]


def test_tables_beyond_32_bits_are_refused():
    with pytest.raises(Unsupported, match="beyond 32 bits"):
        lay_out_table(torch.tensor([1 << 40]), None)
    with pytest.raises(Unsupported, match="2147483648 numbers"):
        lay_out_table(torch.zeros(1).expand(1 << 31), None)


# -- safety of look-ups


@pytest.mark.parametrize("wrong", [-5.0, 1e9, -1e9, 3e38, math.inf, -math.inf, math.nan])
def test_indices_out_of_range_read_the_table(wrong):
    """Whatever the index: some entry of the table, and none beyond it."""
    grid = torch.arange(24.0).reshape(4, 3, 2) + 1
    network = nn.Embedding(4, 2)
    forms = [
        lambda x: torch.index_select(grid[:, 0, 0], 0, x.long()),
        lambda x: torch.index_select(grid[:, :, 0], 1, x.int()),
        lambda x: grid[x.long()].permute(1, 2, 0),
        lambda x: grid[x.long(), x.int()].T,
        lambda x: grid[x.long(), x.long() * x.long(), x.int()],
        lambda x: torch.take(grid, x.long() * 65537),
        lambda x: torch.gather(torch.stack([x * 0 + 1, x * 0 + 2]), 0, x.long()[None]),
        lambda x: torch.index_select(network.weight + 100, 0, x.long()).T,
    ]
    like = torch.zeros(50)
    kernel = compile_lanewise(lambda x: [form(x) for form in forms], [like])
    for n in (1, 16, 50):
        for k, found in enumerate(kernel(torch.full((n,), wrong))):
            if k == 6 and not math.isfinite(wrong):
                continue  # its entries are made of the lane itself
            low, high = (1, 24) if k < 7 else (90, 110)
            assert ((found >= low) & (found <= high)).all(), (k, found)


def test_indices_in_range_beside_others():
    table = torch.arange(10.0)
    x = torch.tensor([0.0, 9.0, -5.0, 1e9, math.nan, 3.0] * 3)
    found = compile_lanewise(lambda x: [table[x.long()]], [x])(x)[0]
    assert found.tolist() == [0, 9, 9, 9, 9, 3] * 3


# -- networks


def test_networks():
    """As a user's own model has them: rows of features, one a lane."""
    torch.manual_seed(3)
    net = nn.Sequential(
        nn.Linear(5, 16), nn.ReLU(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 8, bias=False), nn.Sigmoid(),
        nn.Linear(8, 3), nn.Softplus(),
    )  # fmt: skip
    x = torch.randn(5, 333)
    found = compile_lanewise(lambda x: [net(x.T).T], [x])(x)[0]
    torch.testing.assert_close(found, net(x.T).T.detach(), rtol=1e-5, atol=1e-6)  # sums of 16 terms in another order
    double = net.double()
    found = compile_lanewise(lambda x: [double(x.T).T], [x.double()])(x.double())[0]
    torch.testing.assert_close(found, double(x.T.double()).T.detach(), rtol=1e-13, atol=1e-14)


# -- determinism, origins


def many(x: Tensor, table: Tensor) -> list[Tensor]:
    return [
        torch.sin(x[0]) * table[(x[1] * 3).long()] + torch.searchsorted(table, x[2]),
        x[0] % 0.3,
        x[1].exp() + x[2].clamp(0, 1),
    ]


_HASHED = """
import sys, hashlib
sys.path.insert(0, {folder!r})
import test_tracing, torch
print(hashlib.sha256(test_tracing.trace(test_tracing.many, test_tracing.X, table=torch.arange(9.0))[1].encode()).hexdigest())
"""


@pytest.mark.slow
def test_ir_is_the_same_in_every_process():
    folder = os.path.dirname(__file__)
    found = set()
    for seed in ("0", "1"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", _HASHED.format(folder=folder)]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        found.add(run.stdout.strip())
    assert len(found) == 1 and len(found.pop()) == 64


def test_identical_functions_share_a_kernel():
    def twin(x: Tensor, table: Tensor) -> list[Tensor]:
        return many(x, table)

    table = torch.arange(9.0)
    assert trace(many, X, table=table)[1] == trace(twin, X, table=table.clone())[1]
    other = trace(lambda x, table: many(x * 2, table), X, table=table)[1]
    assert other != trace(many, X, table=table)[1]


def test_equal_nodes_are_kept_once():
    graph = Graph()
    assert graph.constant("f", 0.0) != graph.constant("f", -0.0)
    assert graph.constant("f", math.nan) == graph.constant("f", math.nan)
    assert graph.constant("i", 0xFFFFFFFF) == graph.constant("i", -1)
    assert graph.cast(graph.constant("l", 300), "u") == graph.constant("u", 44)
    assert graph.value(graph.cast(graph.constant("d", 1e300), "f")) == math.inf
    x = graph.node("tensor", "f", extra=(0, 0))
    assert graph.binary("div", "f", x, graph.constant("f", 4.0)) == graph.binary(
        "mul", "f", x, graph.constant("f", 0.25)
    )
    tiny = graph.binary("div", "f", x, graph.constant("f", 2.0**-140))  # 2^140 is no float32
    assert graph.nodes[tiny][0] == "div"


def test_origins_name_the_file_that_asked():
    tracer, _ = trace(lambda x: [vectors.normalize(x), x[0] * 2], X)
    graph = tracer.graph
    by_op = {graph.nodes[k][0]: graph.origins[k] for k in range(len(graph.nodes))}
    assert by_op["sqrt"][0] == os.path.join("math", "vectors.py")
    assert all(not name.startswith("lanes") for origin in graph.origins for name in origin)
    two = next(k for k in range(len(graph.nodes)) if graph.value(k) == 2.0)
    assert graph.origins[two] == ()  # asked for by this test, which is no file of the package
