"""Stages of the wavefront turned around: what a loss asks of what a vertex was given, from what it asks of what that hands on.

Each function runs a stage of :mod:`torchpt.paths.vertex` under a tape of its own and goes back along it at once. They are
tensor functions of single vertices, so that the lane compiler can make kernels of them as it does of the stages.
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
    """A wave and what is differentiated in it.

    Attributes:
        wave: with plain tensors.
        taped: the same with leaves in place of those tensors that are differentiated.
        leaves: these leaves.
        primals: the tensors that they stand for.
        captured: tensors that stages use by themselves and that are differentiated too, such as weights of modules.
    """

    wave: Wave
    taped: Wave
    leaves: list[Tensor]
    primals: list[Tensor]
    captured: tuple[Tensor, ...]

    @property
    def tables(self) -> tuple[Tensor, ...]:
        """Return all tensors that derivatives are summed for, in the order of their sums."""
        return (*self.leaves, *self.captured)

    @property
    def differentiates_opacity(self) -> bool:
        """Return True where it is differentiated by what lets rays pass surfaces."""
        world = self.taped.context.world
        opacity, maps = world.materials.opacity, world.textures.opacity
        if opacity is None:
            return False
        read = [] if maps is None else [x for k in maps.tables for x in leaves(world.textures.tables[k])]
        return any(x.requires_grad for x in (opacity, *read))


@dataclass(frozen=True)
class VertexCotangents:
    """Derivatives of a loss by what n paths hand on, ``(3, n)`` each.

    Attributes:
        radiance: with respect to the radiance that they bring.
        throughput: of the rays that leave.
        o: of their origins; None where no geometry is differentiated.
        d: of their directions; likewise.
        extra: of what the integrator carries along, by name.
    """

    radiance: Tensor
    throughput: Tensor
    o: Tensor | None
    d: Tensor | None
    extra: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class InputCotangents:
    """Derivatives with respect to what a vertex was given; None where it does not depend on that.

    Attributes:
        throughput, o, d: of the rays that came ``(3, n)``.
        chance: of :attr:`torchpt.physics.shapes.geometry.Hit.chance` ``(n,)``.
        extra_leaves: of the tensors that were asked for.
        extra: of what the integrator carries along, by name.
    """

    throughput: Tensor | None
    o: Tensor | None
    d: Tensor | None
    chance: Tensor | None
    extra_leaves: tuple[Tensor | None, ...]
    extra: Mapping[str, Tensor | None] = field(default_factory=dict)

    def of_rays(self, state: PathState, attached: bool) -> Iterator[tuple[str, Tensor | None, Tensor]]:
        """Yield what is asked of the rays that came: its name, derivatives (None: nothing), and a tensor of their shape.

        ``attached``: whether geometry is differentiated.
        """
        for name in ("throughput", "o", "d") if attached else ("throughput",):
            yield name, getattr(self, name), state.throughput
        for name, found in self.extra.items():
            yield EXTRA + name, found, state.extra[name]


LeafSource = Callable[[], Sequence[Tensor]]


def bounce(
    stage: Bounce,
    context: StageContext,
    model: int,
    vertex: VertexInput,
    next_hit: Hit | None,
    clear: Callable[[Shadow], Tensor],
    cotangents: VertexCotangents,
    extra_leaves: LeafSource,
    splat: Callable[[Splat], tuple[Tensor, Tensor]] | None = None,
) -> InputCotangents:
    """Go back through what happens at surfaces.

    Args:
        stage: what happens, such as :func:`torchpt.paths.vertex.bounce`.
        context: as of the stage, its world with leaves where derivatives are wanted.
        model: as of the stage.
        vertex: as of the stage.
        next_hit: what the rays that leave met; None where geometry is not differentiated.
        clear: how much of the light of shadow rays gets through.
        cotangents: what is asked of what the vertex hands on.
        extra_leaves: tensors whose derivatives are wanted too, asked for after the stage ran.
        splat: says what splats bring to other pixels ``(3, n)``, differentiable, and the cotangents of these.
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
            passed = clear(shadow)
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
    """Go back through light that was met by chance.

    Args:
        stage: what was met, such as :func:`torchpt.paths.vertex.emit` or :func:`torchpt.paths.vertex.escape`.
        context: as for :func:`bounce`.
        vertex: as of the stage.
        radiance: what is asked of the samples' ``(3, n)``.
        extra_leaves: as for :func:`bounce`.
    """
    with torch.enable_grad():
        vertex, input_leaves = _with_leaves(context.plan, vertex)
        return _vjp([(stage(context, vertex).brought, radiance)], input_leaves, extra_leaves)


def splatted(clamp: float | None, cotangent: Tensor, splat: Splat, clear: Tensor) -> tuple[Tensor, Tensor]:
    """Return what splats bring to pixels ``(3, n)``, differentiable, and its cotangents.

    Args:
        clamp: bound on what one brings.
        cotangent: ``(3, H W)`` of the picture, over the samples of a pixel.
        splat: of n lanes.
        clear: ``(n,)`` how much of its light gets through.
    """
    value = splat.light.radiance * clear
    with torch.no_grad():
        counts = (splat.pixel >= 0) & (value.abs() < LARGEST).all(0)
        pairs = torch.where(counts, take(cotangent, splat.pixel.clamp_min(0)), 0.0)
    return value if clamp is None else value * clamp_scale(value, clamp), pairs


@dataclass(frozen=True)
class _InputLeaves:
    """Leaves in the place of what a vertex was given; None where nothing is asked of it."""

    throughput: Tensor
    o: Tensor | None
    d: Tensor | None
    chance: Tensor | None
    extra: Mapping[str, Tensor]


def _with_leaves(plan: Plan, vertex: VertexInput) -> tuple[VertexInput, _InputLeaves]:
    """Return the vertex with leaves for what may be differentiated, and these."""

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
