"""Vector-Jacobian products of the path stages: cotangents of a stage's outputs in, cotangents of its inputs out.

Each function runs a stage of :mod:`torchpt.paths.vertex` on an autograd tape of its own and differentiates it at once. They are
tensor functions of single vertices, so the lane compiler makes kernels of them as it does of the stages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.core.tree import leaves
from torchpt.math.vectors import take
from torchpt.paths.state import EXTRA, Emission, PathState, Plan, Shadow, Splat, StageContext, VertexInput
from torchpt.paths.wave import Bounce, Wave, clamp_scale
from torchpt.physics.film.splats import LARGEST
from torchpt.physics.shapes.geometry import Hit

__all__ = ["InputCotangents", "Tape", "VertexCotangents", "bounce", "gather", "splatted"]


@dataclass
class Tape:
    """A wave with and without gradients, and the tensors that gradients are computed for.

    Attributes:
        wave: the primal wave, all tensors detached.
        taped: the same wave with autograd leaves in place of differentiated tensors.
        leaves: these leaves.
        primals: the detached tensor of each leaf.
        captured: differentiated tensors that stages hold by themselves, such as weights of modules.
    """

    wave: Wave
    taped: Wave
    leaves: list[Tensor]
    primals: list[Tensor]
    captured: tuple[Tensor, ...]

    @property
    def tables(self) -> tuple[Tensor, ...]:
        """Return all tensors with gradient sums, in the order of the sums."""
        return (*self.leaves, *self.captured)

    @property
    def differentiates_opacity(self) -> bool:
        """Return True if a gradient with respect to opacity, or an opacity texture, is wanted."""
        world = self.taped.context.world
        opacity, maps = world.materials.opacity, world.textures.opacity
        if opacity is None:
            return False
        read = [] if maps is None else [x for k in maps.tables for x in leaves(world.textures.tables[k])]
        return any(x.requires_grad for x in (opacity, *read))


@dataclass(frozen=True)
class VertexCotangents:
    """Cotangents of the outputs of a vertex on n paths, ``(3, n)`` each.

    Attributes:
        radiance: of the radiance of the samples.
        throughput: of the throughput of the rays that leave.
        o: of their origins; None where geometry is not differentiated.
        d: of their directions; likewise.
        extra: of the integrator's own fields, by name.
    """

    radiance: Tensor
    throughput: Tensor
    o: Tensor | None
    d: Tensor | None
    extra: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class InputCotangents:
    """Cotangents of the inputs of a vertex; None where the outputs do not depend on an input.

    Attributes:
        throughput, o, d: of the incoming rays ``(3, n)``.
        chance: of :attr:`torchpt.physics.shapes.geometry.Hit.chance` ``(n,)``.
        extra_leaves: of the tensors of the :data:`LeafSource`, in its order.
        extra: of the integrator's own fields, by name.
    """

    throughput: Tensor | None
    o: Tensor | None
    d: Tensor | None
    chance: Tensor | None
    extra_leaves: tuple[Tensor | None, ...]
    extra: Mapping[str, Tensor | None] = field(default_factory=dict)

    def of_rays(self, state: PathState, attached: bool) -> Iterator[tuple[str, Tensor | None, Tensor]]:
        """Yield name, cotangent (None: zero) and a tensor of its shape, for each field of the incoming rays.

        ``attached``: True where geometry is differentiated, so that origins and directions have cotangents.
        """
        for name in ("throughput", "o", "d") if attached else ("throughput",):
            yield name, getattr(self, name), state.throughput
        for name, found in self.extra.items():
            yield EXTRA + name, found, state.extra[name]


#: Returns further tensors that gradients are wanted for, called after the stage ran: recorded gathers, tables, weights.
LeafSource = Callable[[], Sequence[Tensor]]


def bounce(
    stage: Bounce,
    context: StageContext,
    model: int,
    vertex: VertexInput,
    next_hit: Hit | None,
    transmittance: Callable[[Shadow], Tensor],
    cotangents: VertexCotangents,
    extra_leaves: LeafSource,
    splat: Callable[[Splat], tuple[Tensor, Tensor]] | None = None,
) -> InputCotangents:
    """Return the VJP of the stage of surfaces.

    Args:
        stage: such as :func:`torchpt.paths.vertex.bounce`.
        context: as for the stage; its world has autograd leaves where gradients are wanted.
        model: as for the stage.
        vertex: as for the stage.
        next_hit: hits of the rays that leave; None where geometry is not differentiated.
        transmittance: returns the transmittance ``(n,)`` of shadow rays.
        cotangents: of the outputs of the vertex.
        extra_leaves: see :data:`LeafSource`.
        splat: returns the contributions of splats to their pixels ``(3, n)``, differentiable, and their cotangents.
    """

    def found(_: PathState) -> Hit:
        assert next_hit is not None
        return next_hit

    with torch.enable_grad():
        vertex, input_leaves = _with_leaves(context.plan, vertex)
        output = stage(replace(context, search=found), model, vertex)
        after, shadow = output.leaving, output.shadow
        pairs = [(after.throughput, cotangents.throughput), (after.radiance, cotangents.radiance)]
        if cotangents.o is not None and cotangents.d is not None:
            pairs += [(after.o, cotangents.o), (after.d, cotangents.d)]
        pairs += [(after.extra[name], cotangent) for name, cotangent in cotangents.extra.items()]
        if shadow is not None:
            passed = transmittance(shadow)
            if passed.requires_grad:
                pairs.append((shadow.radiance * passed, cotangents.radiance))
            else:
                pairs.append((shadow.radiance, cotangents.radiance * passed))
        if output.splat is not None and splat is not None:
            pairs.append(splat(output.splat))
        return _vjp(pairs, input_leaves, extra_leaves)


def gather(
    stage: Callable[[StageContext, VertexInput], Emission],
    context: StageContext,
    vertex: VertexInput,
    radiance: Tensor,
    extra_leaves: LeafSource,
) -> InputCotangents:
    """Return the VJP of a stage that adds emission to paths.

    Args:
        stage: such as :func:`torchpt.paths.vertex.emit` or :func:`torchpt.paths.vertex.escape`.
        context: as for :func:`bounce`.
        vertex: as for the stage.
        radiance: cotangent of the radiance of the samples ``(3, n)``.
        extra_leaves: as for :func:`bounce`.
    """
    with torch.enable_grad():
        vertex, input_leaves = _with_leaves(context.plan, vertex)
        return _vjp([(stage(context, vertex).brought, radiance)], input_leaves, extra_leaves)


def splatted(clamp: float | None, cotangent: Tensor, splat: Splat, transmittance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the contributions of splats to their pixels ``(3, n)``, differentiable, and their cotangents.

    Args:
        clamp: upper bound of a contribution; None: unbounded.
        cotangent: ``(3, H W)`` of the picture, divided by the samples a pixel.
        splat: splats of n lanes.
        transmittance: ``(n,)`` of their shadow rays.
    """
    value = splat.light.radiance * transmittance
    with torch.no_grad():
        counts = (splat.pixel >= 0) & (value.abs() < LARGEST).all(0)
        own = torch.where(counts, take(cotangent, splat.pixel.clamp_min(0)), 0.0)
    return value if clamp is None else value * clamp_scale(value, clamp), own


@dataclass(frozen=True)
class _InputLeaves:
    """Autograd leaves in place of the inputs of a vertex; None where no cotangent is wanted."""

    throughput: Tensor
    o: Tensor | None
    d: Tensor | None
    chance: Tensor | None
    extra: Mapping[str, Tensor]


def _with_leaves(plan: Plan, vertex: VertexInput) -> tuple[VertexInput, _InputLeaves]:
    """Return the vertex with autograd leaves in place of its differentiable inputs, and these leaves."""

    def leaf(x: Tensor) -> Tensor:
        return x.detach().requires_grad_()

    state, hit = vertex.state, vertex.hit
    throughput = leaf(state.throughput)
    o, d = (leaf(state.o), leaf(state.d)) if plan.attached else (None, None)
    extra = {name: leaf(value) for name, value in state.extra.items() if value.is_floating_point()}
    state = replace(
        state,
        throughput=throughput,
        o=state.o if o is None else o,
        d=state.d if d is None else d,
        extra={**state.extra, **extra},
    )
    chance = None if hit.chance is None else leaf(hit.chance)
    return VertexInput(state, replace(hit, chance=chance)), _InputLeaves(throughput, o, d, chance, extra)


def _vjp(pairs: list[tuple[Tensor, Tensor]], input_leaves: _InputLeaves, extra_leaves: LeafSource) -> InputCotangents:
    """Differentiate (output, cotangent) pairs with respect to the inputs of a vertex and the extra leaves."""
    pairs = [(y, g) for y, g in pairs if y.requires_grad]
    own, rest = leaves(input_leaves), list(extra_leaves())
    grads: Sequence[Any] = [None] * (len(own) + len(rest))
    if pairs:
        outputs, wanted = [y for y, _ in pairs], [g for _, g in pairs]
        grads = torch.autograd.grad(outputs, [*own, *rest], wanted, allow_unused=True)
    found = {id(leaf): gradient for leaf, gradient in zip(own, grads, strict=False)}

    def of(leaf: Tensor | None) -> Tensor | None:
        return None if leaf is None else found[id(leaf)]

    extra = {name: of(leaf) for name, leaf in input_leaves.extra.items()}
    return InputCotangents(
        of(input_leaves.throughput),
        of(input_leaves.o),
        of(input_leaves.d),
        of(input_leaves.chance),
        tuple(grads[len(own) :]),
        extra,
    )
