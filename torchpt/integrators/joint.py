"""Stages of the wavefront turned around: what a loss asks of what a vertex was given, from what it asks of what that hands on.

Each function runs a stage of :mod:`torchpt.integrators.stages` under a tape of its own and goes back along it at once. They are
tensor functions of single vertices, so that the lane compiler can make kernels of them as it does of the stages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.integrators import stages
from torchpt.integrators.plan import Plan
from torchpt.integrators.vertex import StageContext, VertexInput
from torchpt.records import Hit, PathState, Shadow

__all__ = ["Behind", "bounce", "emit", "escape"]


@dataclass(frozen=True)
class Behind:
    """What a loss asks of what n paths hand on: its derivatives, ``(3, n)`` each.

    Attributes:
        radiance: with respect to the radiance that they bring.
        throughput: of the rays that leave.
        o: of their origins; None where no geometry is differentiated.
        d: of their directions; likewise.
    """

    radiance: Tensor
    throughput: Tensor
    o: Tensor | None
    d: Tensor | None


@dataclass(frozen=True)
class Before:
    """Derivatives with respect to what a vertex was given; None where it does not depend on that.

    Attributes:
        throughput, o, d: of the rays that came ``(3, n)``.
        chance: of :attr:`torchpt.records.Hit.chance` ``(n,)``.
        others: of the tensors that were asked for.
    """

    throughput: Tensor | None
    o: Tensor | None
    d: Tensor | None
    chance: Tensor | None
    others: tuple[Tensor | None, ...]


Others = Callable[[], Sequence[Tensor]]


def bounce(
    context: StageContext,
    model: int,
    vertex: VertexInput,
    following: Hit | None,
    clear: Callable[[Shadow], Tensor],
    behind: Behind,
    others: Others,
) -> Before:
    """Go back through :func:`torchpt.integrators.stages.bounce`.

    Args:
        context: as of the stage, its world with leaves where derivatives are wanted.
        model: as of the stage.
        vertex: as of the stage.
        following: what the rays that leave met; None where geometry is not differentiated.
        clear: how much of the light of shadow rays gets through.
        behind: what is asked of what the vertex hands on.
        others: tensors whose derivatives are wanted too, asked for after the stage ran.
    """

    def found(_: PathState) -> Hit:
        assert following is not None
        return following

    with torch.enable_grad():
        vertex, given = _given(context.plan, vertex)
        output = stages.bounce(replace(context, search=found), model, vertex)
        after, shadow = output.leaving, output.shadow
        asked = [(after.throughput, behind.throughput)]
        if behind.o is not None and behind.d is not None:
            asked += [(after.o, behind.o), (after.d, behind.d)]
        if shadow is not None:
            passed = clear(shadow)
            if passed.requires_grad:
                asked.append((shadow.radiance * passed, behind.radiance))
            else:
                asked.append((shadow.radiance, behind.radiance * passed))
        return _back(asked, given, others)


def emit(context: StageContext, vertex: VertexInput, radiance: Tensor, others: Others) -> Before:
    """Go back through :func:`torchpt.integrators.stages.emit`; ``radiance``: what is asked of the samples' ``(3, n)``."""
    with torch.enable_grad():
        vertex, given = _given(context.plan, vertex)
        return _back([(stages.emit(context, vertex).brought, radiance)], given, others)


def escape(context: StageContext, vertex: VertexInput, radiance: Tensor, others: Others) -> Before:
    """Go back through :func:`torchpt.integrators.stages.escape`, likewise."""
    with torch.enable_grad():
        vertex, given = _given(context.plan, vertex)
        return _back([(stages.escape(context, vertex).brought, radiance)], given, others)


def _given(plan: Plan, vertex: VertexInput) -> tuple[VertexInput, list[Tensor | None]]:
    """Return the vertex with leaves for what may be differentiated, and these."""

    def leaf(x: Tensor) -> Tensor:
        return x.detach().requires_grad_()

    state, hit = vertex.state, vertex.hit
    throughput = leaf(state.throughput)
    o, d = (leaf(state.o), leaf(state.d)) if plan.attached else (None, None)
    state = replace(state, throughput=throughput, o=state.o if o is None else o, d=state.d if d is None else d)
    chance = None if hit.chance is None else leaf(hit.chance)
    return VertexInput(state, replace(hit, chance=chance)), [throughput, o, d, chance]


def _back(asked: list[tuple[Tensor, Tensor]], given: list[Tensor | None], others: Others) -> Before:
    asked = [(y, g) for y, g in asked if y.requires_grad]
    own = [x for x in given if x is not None]
    rest = list(others())
    grads: Sequence[Any] = [None] * (len(own) + len(rest))
    if asked:
        outputs, wanted = [y for y, _ in asked], [g for _, g in asked]
        grads = torch.autograd.grad(outputs, [*own, *rest], wanted, allow_unused=True)
    found = iter(grads)
    state = [None if x is None else next(found) for x in given]
    return Before(*state, others=tuple(found))
