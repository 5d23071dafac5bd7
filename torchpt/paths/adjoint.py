"""Vector-Jacobian products of the path stages: cotangents of a stage's outputs in, cotangents of its inputs out.

Each function runs a stage of :mod:`torchpt.paths.vertex` on an autograd tape of its own and differentiates it at once. Path
replay (:mod:`torchpt.gradients.replay`) calls them vertex by vertex, from the last vertex to the first. They are tensor
functions of single vertices, so the lane compiler makes kernels of them as it does of the stages. n is the number of lanes of a
call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchpt.core.autograd import gradients_of
from torchpt.core.tree import leaves
from torchpt.math.vectors import take
from torchpt.paths.state import EXTRA, Emission, PathState, Plan, Shadow, Splat, StageContext, VertexInput
from torchpt.paths.wave import Bounce, Wave, clamp_scale
from torchpt.physics.film.splats import LARGEST
from torchpt.physics.shapes.geometry import Hit

__all__ = [
    "InputCotangents",
    "Tape",
    "VertexCotangents",
    "bounce_vjp",
    "emission_vjp",
    "rays_vjp",
    "splat_contributions",
]


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
        """Return True if a gradient by opacity or an opacity texture is wanted, or one by geometry where there is a texture."""
        world = self.taped.context.world
        opacity, maps = world.materials.opacity, world.textures.opacity
        if opacity is None:
            return False
        if maps is not None and self.taped.context.plan.attached:
            return True
        # maps.tables: indices of the texture tables that opacities are read from.
        tables = [] if maps is None else [world.textures.tables[k] for k in maps.tables]
        texels = [tensor for table in tables for tensor in leaves(table)]
        return any(tensor.requires_grad for tensor in (opacity, *texels))


@dataclass(frozen=True)
class VertexCotangents:
    """Cotangents of the outputs of a vertex on n paths, ``(3, n)`` each.

    Attributes:
        radiance: of the radiance of the samples.
        throughput: of the throughput of the rays that leave.
        o: of their origins; None where geometry is not differentiated.
        d: of their directions; None where geometry is not differentiated.
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
        chance: of :attr:`torchpt.physics.shapes.geometry.Hit.chance` ``(n,)``, by which opacity gets its gradient.
        extra_leaves: of the tensors of the :data:`LeafSource`, in its order.
        extra: of the integrator's own fields, by name.
    """

    throughput: Tensor | None
    o: Tensor | None
    d: Tensor | None
    chance: Tensor | None
    extra_leaves: tuple[Tensor | None, ...]
    extra: Mapping[str, Tensor | None] = field(default_factory=dict)

    def of_rays(self, state: PathState, *, attached: bool) -> Iterator[tuple[str, Tensor | None, Tensor]]:
        """Yield name, cotangent (None: zero) and a tensor of the cotangent's shape, for each field of the incoming rays.

        ``attached``: True where geometry is differentiated, so that origins and directions have cotangents.
        """
        for name in ("throughput", "o", "d") if attached else ("throughput",):
            yield name, getattr(self, name), state.throughput
        for name, cotangent in self.extra.items():
            yield EXTRA + name, cotangent, state.extra[name]


#: Returns further tensors that gradients are wanted for, called after the stage ran: recorded gathers, tables, weights.
LeafSource = Callable[[], Sequence[Tensor]]


def bounce_vjp(
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

    def search(_: PathState) -> Hit:
        """Return the hits of the forward pass, in place of a search."""
        assert next_hit is not None
        return next_hit

    with torch.enable_grad():
        vertex, input_leaves = _with_leaves(context.plan, vertex)
        output = stage(replace(context, search=search), model, vertex)
        leaving, shadow = output.leaving, output.shadow
        pairs = [(leaving.throughput, cotangents.throughput), (leaving.radiance, cotangents.radiance)]
        if cotangents.o is not None and cotangents.d is not None:
            pairs += [(leaving.o, cotangents.o), (leaving.d, cotangents.d)]
        pairs += [(leaving.extra[name], cotangent) for name, cotangent in cotangents.extra.items()]
        if shadow is not None:
            # A transmittance without a derivative weighs the cotangent, off the tape.
            arriving = transmittance(shadow)
            if arriving.requires_grad:
                pairs.append((shadow.radiance * arriving, cotangents.radiance))
            else:
                pairs.append((shadow.radiance, cotangents.radiance * arriving))
        if output.splat is not None and splat is not None:
            pairs.append(splat(output.splat))
        return _vjp(pairs, input_leaves, extra_leaves)


def emission_vjp(
    stage: Callable[[StageContext, VertexInput], Emission],
    context: StageContext,
    vertex: VertexInput,
    radiance: Tensor,
    extra_leaves: LeafSource,
) -> InputCotangents:
    """Return the VJP of a stage that adds emission to paths.

    Args:
        stage: such as :func:`torchpt.paths.vertex.emit` or :func:`torchpt.paths.vertex.escape`.
        context: as for :func:`bounce_vjp`.
        vertex: as for the stage.
        radiance: cotangent of the radiance of the samples ``(3, n)``.
        extra_leaves: as for :func:`bounce_vjp`.
    """
    with torch.enable_grad():
        vertex, input_leaves = _with_leaves(context.plan, vertex)
        contribution = stage(context, vertex).brought
        return _vjp([(contribution, radiance)], input_leaves, extra_leaves)


def rays_vjp(
    rays: Callable[[], PathState], o: Tensor, d: Tensor, extra_leaves: LeafSource
) -> tuple[Tensor | None, ...]:
    """Return the VJP of camera rays: cotangents of the extra leaves, in their order; None where rays do not depend on one.

    Args:
        rays: returns the rays, differentiable.
        o: cotangent of their origins ``(3, n)``.
        d: of their directions.
        extra_leaves: as for :func:`bounce_vjp`.
    """
    with torch.enable_grad():
        state = rays()
        return _gradients([(state.o, o), (state.d, d)], list(extra_leaves()))


def splat_contributions(
    clamp: float | None, cotangent: Tensor, splat: Splat, transmittance: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the contributions of splats to their pixels ``(3, n)``, differentiable, and their cotangents.

    Args:
        clamp: upper bound of a contribution; None: unbounded.
        cotangent: ``(3, H W)`` of the picture, divided by the number of samples a pixel.
        splat: splats of n lanes.
        transmittance: ``(n,)`` of their shadow rays.
    """
    value = splat.light.radiance * transmittance
    with torch.no_grad():
        counted = (splat.pixel >= 0) & (value.abs() < LARGEST).all(0)  # the splats that the film adds
        pixel_cotangents = torch.where(counted, take(cotangent, splat.pixel.clamp_min(0)), 0.0)
    return value if clamp is None else value * clamp_scale(value, clamp), pixel_cotangents


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
    input_leaves = _InputLeaves(throughput=throughput, o=o, d=d, chance=chance, extra=extra)
    return VertexInput(state, replace(hit, chance=chance)), input_leaves


def _gradients(pairs: Sequence[tuple[Tensor, Tensor]], inputs: Sequence[Tensor]) -> tuple[Tensor | None, ...]:
    """Differentiate (output, cotangent) pairs with respect to inputs; None for one that no output depends on."""
    pairs = [(output, cotangent) for output, cotangent in pairs if output.requires_grad]
    if not pairs:
        return (None,) * len(inputs)
    outputs, cotangents = [output for output, _ in pairs], [cotangent for _, cotangent in pairs]
    return gradients_of(outputs, inputs, cotangents)


def _vjp(pairs: list[tuple[Tensor, Tensor]], input_leaves: _InputLeaves, extra_leaves: LeafSource) -> InputCotangents:
    """Differentiate (output, cotangent) pairs with respect to the inputs of a vertex and the extra leaves."""
    inputs = leaves(input_leaves)
    grads = _gradients(pairs, [*inputs, *extra_leaves()])
    # Those of the inputs come first; the extra leaves follow.
    gradients = {id(leaf): gradient for leaf, gradient in zip(inputs, grads, strict=False)}

    def gradient_of(leaf: Tensor | None) -> Tensor | None:
        return None if leaf is None else gradients[id(leaf)]

    return InputCotangents(
        throughput=gradient_of(input_leaves.throughput),
        o=gradient_of(input_leaves.o),
        d=gradient_of(input_leaves.d),
        chance=gradient_of(input_leaves.chance),
        extra_leaves=grads[len(inputs) :],
        extra={name: gradient_of(leaf) for name, leaf in input_leaves.extra.items()},
    )
