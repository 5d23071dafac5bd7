"""Which products are rounded together with a sum: by numbers of which the product, rounded alone, loses its last part."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from forms import one_lane
from torch import Tensor

from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.fusing import fused_products
from torchpt.compiler.graph import Graph

#: (1 + STEP)^2 is 1 + 2 STEP + STEP^2, of which float32 keeps no STEP^2.
STEP = 2.0**-12
X = torch.full((20,), 1 + STEP)
LAST = STEP * STEP
CASES: dict[str, tuple[Callable[[Tensor], list[Tensor]], list[float]]] = {
    "product and constant": (lambda x: [x * x - 1], [2 * STEP + LAST]),
    "constant and product": (lambda x: [1 - x * x], [-2 * STEP - LAST]),
    "sum": (lambda x: [x * x + -1.0], [2 * STEP + LAST]),
    "asked for as well": (lambda x: [x * x, x * x - 1], [1 + 2 * STEP, 2 * STEP]),
    "in two sums": (lambda x: [x * x - 1, x * x - 2], [2 * STEP, 2 * STEP - 1]),
    "of itself": (lambda x: [x * x - x * x], [0.0]),
    "the first of two": (lambda x: [x * x - (x + STEP) * (x - STEP)], [LAST]),
    "behind a choice": (lambda x: [torch.where(x > 0, x * x, x) - 1], [2 * STEP]),
}


@pytest.mark.parametrize("form", ["vectors", "one lane"])
@pytest.mark.parametrize("name", CASES)
def test_rounded_once(name, form):
    function, wanted = CASES[name]
    kernel = compile_lanewise(function, [X], one_lane() if form == "one lane" else None)
    for found, value in zip(kernel(X), wanted, strict=True):
        assert (found == value).all(), (found[0].item(), value)


def test_what_counts_as_asking():
    """A result asks for its node, as each term does; whole numbers are never rounded."""
    graph = Graph()
    x, y = (graph.node("tensor", "f", extra=(0, k)) for k in range(2))
    product = graph.node("mul", "f", x, y)
    total, less = graph.node("add", "f", y, product), graph.node("sub", "f", product, x)
    twice = graph.node("add", "f", product, product)
    whole = graph.node("tensor", "i", extra=(1, 0))
    count = graph.node("add", "i", graph.node("mul", "i", whole, whole), whole)
    assert fused_products(graph, graph.needed([total]), [total]) == {total: product}
    assert fused_products(graph, graph.needed([total]), [total, product]) == {}
    assert fused_products(graph, graph.needed([total, less]), [total, less]) == {}
    assert fused_products(graph, graph.needed([twice]), [twice]) == {}
    assert fused_products(graph, graph.needed([count]), [count]) == {}
