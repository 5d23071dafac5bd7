"""The stages of path tracing at a vertex, and the sampling routines that they are made of.

A stage is a pure function of lanes, one path a lane; :mod:`torchpt.paths.state` has its input and output records. A Python
``if`` depends on the scene and the settings only, never on lane values, so a stage compiles to one graph whatever the number
of lanes. Engines call the four stages at the end of this file; ``model`` is an index into ``world.materials.models``, and all
n lanes of a call hit surfaces of this BSDF model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.math.sampling import power_heuristic, uniform_hemisphere, uniform_sphere
from torchpt.math.vectors import dot, largest
from torchpt.paths.roulette import russian_roulette, survival_probability
from torchpt.paths.state import (
    STRATEGIES,
    T_MAX,
    DirectLight,
    Drawn,
    Emission,
    PathState,
    Plan,
    Shadow,
    StageContext,
    VertexInput,
    VertexOutput,
)
from torchpt.paths.surface import Surface, emission_map, opacity_map, surface_at
from torchpt.physics import lights
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.cameras import Camera
from torchpt.physics.film import Filter
from torchpt.physics.lights.emission import LightRay
from torchpt.physics.lights.records import LightSample
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes import interact, offset_origin, reattach
from torchpt.physics.shapes.geometry import Hit, Interaction
from torchpt.physics.shapes.interaction import OFFSET
from torchpt.physics.world import World

__all__ = [
    "STRATEGIES",
    "Continuation",
    "Plan",
    "attach",
    "bounce",
    "continue_paths",
    "emission_at",
    "emit",
    "escape",
    "generate",
    "has_shading_normals",
    "light_radiance",
    "next_ray",
    "same_hemisphere",
    "sample_bsdf",
    "sample_light",
    "scatter",
    "scattered",
    "shade",
    "shading_weight",
]


# ---- Next event estimation: a light sample for each surface point, and its contribution
#
# :func:`shade` = surface -> light sample -> shadow ray. The engine traces the shadow ray after the stage.


#: Fraction of its length by which a shadow ray ends before the light, beside the offset from the light's surface: rounding of
#: its length must not let it hit the light itself. pbrt's ``ShadowEpsilon`` has the same value.
SHORTEN = 1e-4


def shade(
    context: StageContext, model: int, state: PathState, at: Interaction
) -> tuple[Surface, DirectLight | None, Shadow | None]:
    """Resolve the material at surface points of one BSDF model and sample a light for each.

    Returns:
        The surface; the light samples and their shadow rays (None where no light is sampled).
    """
    plan, world = context.plan, context.world
    surface = surface_at(world, model, state.d, at, context.pixel, dark_rims=plan.dark_rims)
    kind = world.materials.models[model]
    # Light samples never hit a delta lobe, and a `smooth` model has no others.
    if world.lights is None or plan.strategy in ("bsdf", "uniform") or kind.smooth:
        return surface, None, None
    light = sample_light(context, model, state, at, surface)
    wi = surface.frame.to_local(light.wi)
    weight, pdf, heuristic = light.weight, None, None
    if plan.strategy == "mis":
        reflected, pdf = kind.eval_pdf(surface.parameters, surface.wo, wi)
        heuristic = power_heuristic(light.pdf, pdf).detach()
        weight = weight * heuristic
    else:
        reflected = kind.eval(surface.parameters, surface.wo, wi)
    share = shading_weight(world, model, at, surface, light.wi, wi)
    weight = weight if share is None else weight * share
    emitted = light_radiance(world, light)
    radiance = state.throughput * reflected * emitted * weight
    direct = DirectLight(sample=light, radiance=emitted, reflected=reflected, share=share, pdf=pdf, weight=heuristic)
    return surface, direct, _shadow_ray(plan, world, at, light, radiance, weight)


def shading_weight(
    world: World, model: int, at: Interaction, surface: Surface, world_wi: Tensor, wi: Tensor
) -> Tensor | None:
    """Return the factor ``(n,)`` on light from a direction, beside the BSDF: shading normals and one-sided surfaces.

    It is 0 where the direction lies on different sides of the geometric and the shading normal, and on the back of a one-sided
    surface; perturbed normals shadow in part. None: 1 everywhere.

    Args:
        world: the scene's tensors.
        model: index of the BSDF model.
        at: the surface points.
        surface: the points with their material.
        world_wi: ``(3, n)`` unit direction to the light in the world.
        wi: the same direction in the surface's frame.
    """
    share: Tensor | None = None
    if has_shading_normals(world, model):
        share = (same_hemisphere(at, surface, world_wi, wi) > 0).to(wi.dtype)
    if surface.front_mask is not None:
        share = surface.front_mask if share is None else share * surface.front_mask
    if surface.perturbed_normal is not None:
        shadowing = surface.perturbed_normal.shadowing(world_wi)
        share = shadowing if share is None else share * shadowing
    return share


def sample_light(context: StageContext, model: int, state: PathState, at: Interaction, surface: Surface) -> LightSample:
    """Sample a point on the lights for each surface point."""
    plan, world = context.plan, context.world
    table = world.lights
    assert table is not None
    draws = Draws(plan.sampler, state.key, context.salts)
    # The pdf of an emitter that a ray hits is evaluated at the ray's origin. So lights are sampled from the origin of a
    # reflected ray, unless paths keep the vertex itself (PathState.p), or no emitter can be hit.
    from_vertex = lights.depends_on_point(table) or table.row_of_prim is None
    x = at.p if from_vertex else offset_origin(world, at, -state.d)
    n = None if world.materials.models[model].transmits else surface.frame.n
    u, which = draws.two(Dimension.LIGHT), None  # (2, n)
    if table.choice is not None:  # more than one light
        # The number that chooses the light is used again for the point on it, so that both are stratified together. It has
        # 24 bits, and the other number appends 24 more.
        which = lights.from_digits(u[0], draws.one(Dimension.LIGHT_DIGITS))
    return lights.sample(table, x, which, u.to(plan.dtype), offset=OFFSET, n=n, mis=plan.strategy == "mis")


def light_radiance(world: World, light: LightSample | LightRay) -> Tensor:
    """Return the radiance ``(3, N)`` of light samples or of rays that leave lights, with textures of emission and opacity."""
    if light.at is None:  # no emissive surface has a texture
        return light.radiance
    factor = torch.ones_like(light.radiance)
    if world.textures.emission is not None:
        factor = factor * emission_map(world, light.at)
    if world.textures.opacity is not None:
        factor = factor * opacity_map(world, light.at)
    # light.bare: (N,) bool, True for lights without a surface, whose factor is meaningless; None: all have one.
    return light.radiance * (factor if light.bare is None else torch.where(light.bare, 1.0, factor))


def _shadow_ray(
    plan: Plan, world: World, at: Interaction, light: LightSample, radiance: Tensor, weight: Tensor
) -> Shadow:
    """Return the shadow rays of light samples with contributions ``radiance``; of length 0 where the contribution is 0.

    Under differentiation they have length 0 where ``weight (n,)`` is 0 instead, the MIS weight over the pdf with the factor of
    the shading normal: a contribution that is 0 for a reflectance of 0 has a derivative.
    """
    o = offset_origin(world, at, light.wi)
    d = light.target - o
    lit = (weight.detach() if plan.tape else largest(radiance.detach().abs())) > 0
    t_max = lit.to(plan.dtype) * (1.0 - SHORTEN)
    if light.distant is not None:
        d = torch.where(light.distant, light.wi, d)
        t_max = torch.where(light.distant & lit, math.inf, t_max)
    return Shadow(o=o, d=d, t_max=t_max, radiance=radiance)


def has_shading_normals(world: World, model: int) -> bool:
    """Return True where the shading normals of a model's surfaces may differ from the geometric ones."""
    textures = world.materials.textures[model]
    return world.geometry.normals is not None or (
        textures is not None and (textures.normal is not None or textures.bump is not None)
    )


def same_hemisphere(at: Interaction, surface: Surface, world_wi: Tensor, wi: Tensor) -> Tensor:
    """Return values that are positive where a direction lies on the same side of the geometric and the shading normal.

    Elsewhere the shading normal would let light through the surface.

    Args:
        at: the surface points, with the geometric normal on the shape's outside.
        surface: the points with their material; ``side`` is -1 where its frame is flipped, on the back.
        world_wi: ``(3, n)`` direction in the world.
        wi: the same direction in the surface's frame.
    """
    same = dot(world_wi, at.ng) * wi[2]
    return same if surface.side is None else same * surface.side


# ---- BSDF sampling: the next ray of a path, its throughput, roulette
#
# :func:`scatter` = :func:`sample_bsdf` (BSDF sampling) -> :func:`attach` (only under derivatives) -> :func:`continue_paths`
# (throughput and roulette) -> :func:`next_ray`. Each hands a record to the next.


@dataclass(frozen=True)
class Continuation:
    """Throughput of paths behind a vertex, after roulette."""

    alive: Tensor  # (n,) bool
    throughput: Tensor  # (3, n)
    eta: Tensor | None  # see PathState
    carried: Tensor  # (3, n) throughput before roulette
    chance: Tensor | None  # (n,) survival probability of roulette; None without roulette


def scatter(
    context: StageContext, model: int, state: PathState, at: Interaction, surface: Surface
) -> tuple[PathState, Hit | None, Drawn, Continuation]:
    """Sample the next direction from the BSDF and play roulette.

    Where geometry is differentiated the next hit is searched here, since the throughput depends on both ends of the ray.

    Returns:
        The paths with their next rays, their hits (None: not searched yet), the BSDF samples, throughput and roulette.
    """
    plan = context.plan
    draws = Draws(plan.sampler, state.key, context.salts)
    drawn, hit = sample_bsdf(context, model, at, surface, draws), None
    if plan.tape:
        drawn, hit = attach(context, model, state, at, surface, drawn)
    continuation = continue_paths(plan, state, surface, drawn, draws, context.roulette)
    if hit is not None:
        hit = replace(hit, prim=torch.where(continuation.alive, hit.prim, -1))
    return next_ray(context, model, state, at, surface, drawn, continuation), hit, drawn, continuation


def sample_bsdf(context: StageContext, model: int, at: Interaction, surface: Surface, draws: Draws) -> Drawn:
    """Sample a direction from the BSDF, or uniformly (strategy ``uniform``), and return the ray along it."""
    plan, world = context.plan, context.world
    kind = world.materials.models[model]
    u = draws.two(Dimension.BSDF).to(plan.dtype)
    if plan.strategy == "uniform" and not kind.delta:
        wi = uniform_sphere(u) if kind.transmits else uniform_hemisphere(u)
        # 1 / (4 pi) over the sphere, 1 / (2 pi) over the hemisphere, per steradian.
        pdf = torch.full_like(wi[2], (0.25 if kind.transmits else 0.5) / math.pi)
        sample = BsdfSample(wi=wi, pdf=pdf, weight=kind.eval(surface.parameters, surface.wo, wi) / pdf)
    else:
        # The number that chooses a lobe; models that are not `lobed` need none.
        lobe = draws.one(Dimension.LOBE).to(plan.dtype) if kind.lobed else None
        sample = kind.sample(surface.parameters, surface.wo, lobe, u)
    pdf = sample.pdf.detach()
    sharp = torch.isinf(pdf) if kind.delta else None  # (n,), True where a delta lobe was sampled
    d = surface.frame.to_world(sample.wi).detach()
    o = offset_origin(world, at, d)
    # The minimum of all values that must be positive for a valid sample: minima are cheaper than comparisons.
    least = pdf
    if has_shading_normals(world, model):
        least = torch.minimum(least, same_hemisphere(at, surface, d, sample.wi.detach()))
    if surface.front_mask is not None:
        least = torch.minimum(least, surface.front_mask)
    return Drawn(o=o, d=d, wi=sample.wi, pdf=pdf, weight=sample.weight, least=least, sharp=sharp, eta=sample.eta)


def attach(
    context: StageContext, model: int, state: PathState, at: Interaction, surface: Surface, drawn: Drawn
) -> tuple[Drawn, Hit | None]:
    """Return the BSDF sample with derivatives: direction and pdf are constants, the integrand depends on the parameters.

    Where geometry is differentiated (``plan.attached``) the next hit is searched, and the direction depends on both ends of the
    ray.
    """
    plan, world = context.plan, context.world
    kind, frame = world.materials.models[model], surface.frame
    d, weight, pdf, sharp = drawn.d, drawn.weight, drawn.pdf, drawn.sharp
    # attached_d: the same direction, differentiable in both ends of the ray. measure: 1, with the derivative of the measure of
    # directions, see `reattach`.
    hit, attached_d, measure, alive = None, d, 1.0, drawn.least > 0
    if plan.attached:
        hit = context.search(replace(state, o=drawn.o, d=d, t_max=alive.to(plan.dtype) * T_MAX))
        assert context.near is not None
        attached_d, measure = reattach(world, at.p, hit, d, context.near)
    if not kind.smooth:
        value = kind.eval(surface.parameters, surface.wo, frame.to_local(attached_d))
        attached_weight = value * (measure / torch.where(alive & ~torch.isinf(pdf), pdf, 1.0))
        weight = attached_weight if sharp is None else torch.where(sharp, weight, attached_weight)
    if plan.attached:
        # The direction of a delta lobe depends on the surface that it leaves; the next hit is intersected anew along it.
        d = attached_d if sharp is None else torch.where(sharp, frame.to_world(drawn.wi), attached_d)
    return replace(drawn, d=d, weight=weight), hit


def continue_paths(
    plan: Plan, state: PathState, surface: Surface, drawn: Drawn, draws: Draws, roulette: float | Tensor
) -> Continuation:
    """Return the throughput behind the surface and the mask of paths that go on: not black, and alive after roulette.

    ``roulette``: upper bound of the survival probability; 0: no roulette at this vertex. A number, or a tensor ``(1,)``.
    """
    weight = drawn.weight
    if surface.perturbed_normal is not None:
        weight = weight * surface.perturbed_normal.shadowing(drawn.d)
    throughput = state.throughput * weight
    brightest = largest(throughput.detach())  # (n,) over the channels
    # Under differentiation black paths go on: the light behind is the derivative with respect to a reflectance of 0.
    alive = (drawn.least if plan.tape else torch.minimum(drawn.least, brightest)) > 0
    eta = state.eta
    if eta is not None and drawn.eta is not None:
        eta = eta * drawn.eta.detach()
    if not isinstance(roulette, Tensor) and not roulette:
        return Continuation(alive=alive, throughput=throughput, eta=eta, carried=throughput, chance=None)
    chance = survival_probability(plan.rr_prob, roulette, brightest, eta, tape=plan.tape)
    alive, survivors = russian_roulette(chance, draws, alive, throughput)
    return Continuation(alive=alive, throughput=survivors, eta=eta, carried=throughput, chance=chance)


def next_ray(
    context: StageContext,
    model: int,
    state: PathState,
    at: Interaction,
    surface: Surface,
    drawn: Drawn,
    continuation: Continuation,
) -> PathState:
    """Return the paths with the rays that leave the surface; paths that ended have rays of length 0."""
    plan, world = context.plan, context.world
    on = continuation.alive.to(plan.dtype)  # (n,) 1 where the path goes on, 0 where it ended
    # The pdf that weights emission by MIS if the ray hits a light.
    if plan.strategy == "mis" and world.lights is not None:
        pdf = drawn.pdf
    else:
        by_lights_alone = plan.strategy == "light" and world.lights is not None  # emission was counted by light samples
        pdf = torch.full_like(drawn.pdf, 0.0 if by_lights_alone else math.inf)
        if by_lights_alone and drawn.sharp is not None:  # but behind a delta lobe, which light samples miss
            pdf = torch.where(drawn.sharp, drawn.pdf, pdf)
    # A throughput that is NaN ends the path, since comparisons with NaN are false. Added to radiance, it is still reported.
    radiance = state.radiance if plan.tape else state.radiance + continuation.throughput * 0.0
    leaving = PathState(
        o=drawn.o,
        d=drawn.d,
        t_max=on * T_MAX,
        throughput=continuation.throughput * on,
        radiance=radiance,
        pdf=pdf,
        lane=state.lane,
        key=state.key,
        eta=continuation.eta,
        extra=state.extra,
    )
    if state.p is None:
        return leaving
    n = torch.zeros_like(at.p) if world.materials.models[model].transmits else surface.frame.n
    # Cloned, since no two tensors of a state may share memory.
    return replace(leaving, p=at.p.detach().clone(), n=n.detach().clone())


# ---- The stages: camera rays, emitters and environment that rays hit, scattering at surfaces


def generate(plan: Plan, camera: Camera, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
    """Return camera rays at points sampled from the filter (and on the lens, if any).

    Args:
        plan: static configuration of the render.
        camera: the camera of the whole film.
        filter: the reconstruction filter, from which the offset to the pixel's centre is sampled.
        x: column of each pixel on the whole film ``(N,)``, in the lanes' dtype.
        y: row of each pixel, likewise.
        key: the sampler's keys ``(rows, N)`` int32.
        salts: the camera's random dimensions, :func:`torchpt.physics.samplers.salts` of depth 0.
    """
    draws = Draws(plan.sampler, key, salts)
    offset = filter.offset(draws.two(Dimension.PIXEL)).to(plan.dtype)
    lens = draws.two(Dimension.LENS).to(plan.dtype) if camera.lens else None
    o, d = camera.rays(x + 0.5 + offset[0], y + 0.5 + offset[1], lens)
    n = d.shape[1]
    ones = torch.ones_like(d)
    forever = torch.full((n,), math.inf, dtype=plan.dtype, device=d.device)
    lane = torch.arange(n, device=d.device)
    # Cloned, since `radiance` is added to in place and no two tensors of a state may share memory.
    return PathState(
        o=o.expand(3, n).clone(),
        d=d,
        t_max=forever,
        throughput=ones,
        radiance=torch.zeros_like(d),
        pdf=forever.clone(),
        lane=lane,
        key=key,
    )


def emit(context: StageContext, vertex: VertexInput) -> Emission:
    """Return the emission of the emitters that paths hit, weighted by MIS."""
    state = vertex.state
    return emission_at(
        context, vertex, interact(context.world, state.o, state.d, vertex.hit, follow_ray=context.follow_ray)
    )


def emission_at(context: StageContext, vertex: VertexInput, at: Interaction) -> Emission:
    """Return the emission of :func:`emit` at the points ``at`` that paths hit."""
    world, state = context.world, vertex.state
    assert world.lights is not None
    # Where the light sampler depends on the point, its pdf is that at the vertex itself, which differs from the ray's origin.
    x = state.o if state.p is None else state.p
    radiance, pdf = lights.emitted(world.lights, x, at, state.d, state.n)
    if world.textures.emission is not None:
        radiance = radiance * emission_map(world, at)
    return _emission_of(vertex, radiance, light_pdf=pdf)


def escape(context: StageContext, vertex: VertexInput) -> Emission:
    """Return the radiance of the environment along rays that hit nothing, weighted by MIS."""
    assert context.world.lights is not None
    radiance, pdf = lights.environment(context.world.lights, vertex.state.d)
    return _emission_of(vertex, radiance, light_pdf=pdf)


def _emission_of(vertex: VertexInput, radiance: Tensor, light_pdf: Tensor) -> Emission:
    """Return emitted ``radiance (3, n)`` as a contribution; light sampling finds it with ``light_pdf (n,)`` per steradian."""
    state, hit = vertex.state, vertex.hit
    # `chance` is 1 with the derivative of the probability that the ray passed the surfaces before.
    throughput = state.throughput if hit.chance is None else state.throughput * hit.chance
    # PathState.pdf is inf where emission counts whole and 0 where it does not count: limits of the power heuristic.
    weight = power_heuristic(state.pdf, light_pdf).detach()
    return Emission(radiance=radiance, pdf=light_pdf, weight=weight, brought=throughput * radiance * weight)


def bounce(context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
    """Return the outputs of a vertex on surfaces of one BSDF model: light sample, next ray, roulette."""
    world, state, hit = context.world, vertex.state, vertex.hit
    at = interact(world, state.o, state.d, hit, follow_ray=context.follow_ray)
    if hit.chance is not None:
        state = replace(state, throughput=state.throughput * hit.chance)
    return scattered(context, model, state, at, *shade(context, model, state, at))


def scattered(
    context: StageContext,
    model: int,
    state: PathState,
    at: Interaction,
    surface: Surface,
    direct: DirectLight | None,
    shadow: Shadow | None,
) -> VertexOutput:
    """Sample the next ray, and return the outputs of a vertex of which :func:`shade` has returned the last three arguments."""
    leaving, next_hit, drawn, continuation = scatter(context, model, state, at, surface)
    return VertexOutput(
        leaving=leaving,
        next_hit=next_hit,
        shadow=shadow,
        at=at,
        surface=surface,
        direct=direct,
        drawn=drawn,
        carried=continuation.carried,
        chance=continuation.chance,
    )
