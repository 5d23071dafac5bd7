"""Tapes inside of kernels: functions that go back along themselves, and sums over lanes taken apart."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.operators.derivatives import summand_of
from torchpt.math.vectors import cross, dot, normalize

RNG = torch.Generator().manual_seed(0)


def gradients(p: Tensor, q: Tensor) -> list[Tensor]:
    """Of what a stage may do: frames, choices, powers, and columns that are used alone."""
    with torch.enable_grad():
        a, b = p.detach().requires_grad_(), q.detach().requires_grad_()
        n = normalize(cross(a, b))
        value = torch.where(dot(a, b) > 0, n[0], n[2]) + torch.exp(-(dot(a, b) ** 2)) * a[1:].sum(0)
        value = value + torch.stack((a[0], b[1].abs(), b[2].clamp_min(0.1).sqrt())).amax(0)
        return list(torch.autograd.grad(value, (a, b), torch.ones_like(value)))


def test_a_tape_inside_of_a_kernel():
    p, q = torch.randn(3, 1000, generator=RNG), torch.randn(3, 1000, generator=RNG)
    for found, wanted in zip(compile_lanewise(gradients, (p, q))(p, q), gradients(p, q), strict=True):
        assert float(wanted.abs().max()) > 1
        assert torch.allclose(found, wanted, rtol=1e-3, atol=1e-3)


def test_sums_over_lanes_are_taken_apart():
    graph = Graph()
    graph.derivatives = True
    x, y = (graph.node("arena", "f", extra=k) for k in range(2))
    a, b = (graph.node("total", "f", node) for node in (x, y))
    shared, zero = graph.node("element", "f", extra=(0, 0)), graph.constant("f", 0)
    assert summand_of(graph, a) == x
    assert summand_of(graph, zero) is None
    assert summand_of(graph, graph.binary("add", "f", a, b)) == graph.binary("add", "f", x, y)
    assert summand_of(graph, graph.binary("mul", "f", a, shared)) == graph.binary("mul", "f", x, shared)
    assert summand_of(graph, graph.node("neg", "f", b)) == graph.node("neg", "f", y)
    for wrong in (shared, graph.binary("mul", "f", a, b), graph.node("sqrt", "f", a)):
        with pytest.raises(Unsupported, match="no sum over lanes"):
            summand_of(graph, wrong)
