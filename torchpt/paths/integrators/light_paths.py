"""Light paths: paths that start on the lights, and whose vertices are joined to the camera (light tracing), or kept.

A light path carries flux. At each vertex the light that it sends to the camera is a splat, on whatever pixel sees the vertex;
camera paths may be connected to vertices that are kept (:mod:`torchpt.paths.store`).
The adjoint of a BSDF differs from the BSDF where light is refracted (``eta^2``) and where shading normals are not those of the
geometry (Veach, *Robust Monte Carlo Methods for Light Transport Simulation*, 1997, sections 5.2 and 5.3): values are those of
the BSDF with light that comes from where the path does, over the cosine of its arrival, so that both are in them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import dot, largest, safe_reciprocal
from torchpt.paths import vertex as stages
from torchpt.paths.integrators.base import DARK_RIMS, DEPTHS, ENDLESS, Integrator, Limits
from torchpt.paths.integrators.weights import (
    FIELDS,
    Arrival,
    leaving_dvc,
    leaving_dvcm,
    reduced,
    reverse_pdf,
    seen_from,
)
from torchpt.paths.state import (
    Drawn,
    End,
    Field,
    PathState,
    Photon,
    Shadow,
    Splat,
    StageContext,
    StoredVertex,
    VertexInput,
    VertexOutput,
)
from torchpt.paths.store import BLOCKS
from torchpt.paths.surface import Surface, surface_at
from torchpt.paths.wave import camera_state
from torchpt.physics import lights
from torchpt.physics.lights.emission import LightRay, emit, light_weight
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.shapes.interaction import OFFSET
from torchpt.spec import Flag, Scalar

__all__ = ["LightPaths"]


@dataclass(frozen=True)
class _View:
    """Surface points as they are seen from where light goes on to, and the light path that arrived at them.

    With a normal map the normal depends on where it is seen from.
    """

    surface: Surface
    wi: Tensor  # (3, N) direction to the light, in the surface's frame
    throughput: Tensor  # (3, N), with the factors of shading normals and one-sided surfaces
    arrival: Arrival  # the numbers of MIS
    ray: LightRay | None  # with which the path left its light; None behind the first vertex


class LightPaths(Integrator):
    """Light tracing: the stages of paths that start on lights; :class:`~torchpt.paths.integrators.kinds.bdpt.Bdpt` uses it."""

    name = "light_paths"
    parameters: ClassVar = {
        **DEPTHS,
        **DARK_RIMS,
        "fraction": Scalar(1.0, above=0.0, high=1.0, doc="number of light paths for each camera path"),
        "weighted": Flag(True, doc="whether splats are weighted among all strategies"),
        "joined": Flag(True, doc="whether vertices are joined to the camera"),
        "connected": Flag(False, doc="whether vertices are kept for connections"),
        "number": Scalar(0.0, low=0.0, doc="number of connections of two vertices for each sample, in weights"),
        "merging": Flag(False, doc="whether weights count with merges"),
        "sends_photons": Flag(False, doc="whether vertices are photons, which camera paths are merged with"),
    }
    lit = False
    splats = True
    #: ``flux``: factor of throughput and radiance, so that roulette sees a throughput that begins at 1.
    fields = (*FIELDS, Field("flux"))
    starts_on_lights = True

    @property
    def limits(self) -> Limits:
        """Return the depth limits: a vertex of depth k, joined to the camera, makes a path of k + 1 edges."""
        return Limits(self.max_depth, self.rr_depth)

    # -- the start

    def _ray(self, context: StageContext, key: Tensor, salts: Tensor) -> LightRay:
        """Return the rays with which paths of random ``key`` start; ``salts``: those of depth 0."""
        emission = context.world.emission
        assert emission is not None
        draws, which = Draws(context.plan.sampler, key, salts), None
        u, v = draws.two(Dimension.LIGHT), draws.two(Dimension.BSDF)
        if emission.choice is not None:
            which = lights.from_digits(u[0], draws.one(Dimension.LIGHT_DIGITS))
        u, v = u.to(context.plan.dtype), v.to(context.plan.dtype)
        return emit(emission, which, u, v, OFFSET, mis=self.weighted)

    def generate(self, context: StageContext, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """Return the rays that leave the lights; arguments as for :meth:`Integrator.generate`."""
        world, ray = context.world, self._ray(context, key, salts)
        inverse = safe_reciprocal(ray.density)
        weight = stages.light_radiance(world, ray) * inverse
        flux = largest(weight.abs())
        starts = flux > 0
        if self.fraction < 1.0:
            starts = starts & (Draws(context.plan.sampler, key, salts).one(Dimension.ROULETTE) < self.fraction)
        state = camera_state(ray.o, ray.d, key)
        return replace(
            state,
            throughput=weight / torch.where(flux > 0, flux, 1.0),
            t_max=torch.where(starts, math.inf, 0.0).to(flux.dtype),
            extra={"dvcm": torch.zeros_like(flux), "dvc": ray.met * inverse, "flux": flux},
        )

    # -- vertices

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        """Return the splats of a vertex, and the rays that go on; see :meth:`Integrator.bounce`."""
        world, state, hit = context.world, vertex.state, vertex.hit
        kind = world.materials.models[model]
        at = interact(world, state.o, state.d, hit, follow_ray=context.follow_ray)
        surface = surface_at(world, model, state.d, at, context.pixel, dark_rims=context.plan.dark_rims)
        # At the first vertex: the ray with which the path left its light, drawn again.
        ray = None if context.start_salts is None else self._ray(context, state.key, context.start_salts)
        front = self._view(context, model, state, at, surface, ray)
        splat = self._splat(context, model, state, at, front) if self.joined and not kind.smooth else None
        leaving, drawn = self._leaving(context, model, state, at, front)
        return VertexOutput(
            leaving=leaving,
            next_hit=None,
            shadow=None,
            at=at,
            surface=surface,
            splat=splat,
            drawn=drawn,
            kept=self._kept(context, model, state, at, front) if self.connected else None,
            photon=self._photon(context, state, front) if self.sends_photons and not kind.smooth else None,
        )

    def _photon(self, context: StageContext, state: PathState, front: _View) -> Photon:
        """Return the paths as they arrive. What shading normals take away is left to the camera paths that they merge with."""
        value = state.throughput * state.extra["flux"]
        depth = torch.zeros_like(state.lane) + context.depth
        return Photon(state.d, value, front.arrival.dvcm, front.arrival.dvc, depth)

    def _kept(self, context: StageContext, model: int, state: PathState, at: Interaction, front: _View) -> StoredVertex:
        """Return vertices for connections, each kept in a block with the chance 1/k at vertex k.

        Two blocks share a number of 24 bits: the chance of the second is 1/k within 0.1 % up to vertex 200, 2 % at vertex 1000.
        """
        # Light is sampled at depth 0 alone. Some samplers draw the same there and at vertex 1, which is kept in any case.
        u = Draws(context.plan.sampler, state.key, context.salts).two(Dimension.LIGHT)
        # The last vertex has no path left to be connected to.
        most = ENDLESS if self.limits.endless else self.limits.last - 2
        depth = context.depth
        count = torch.clamp(depth, max=most) if isinstance(depth, Tensor) else min(depth, most)
        where: list[Tensor] = []
        for number in u:
            rest = number
            for _ in range(BLOCKS // 2):
                rest = rest * depth  # its whole part is one of 0 .. k - 1, its fraction a random number again
                where.append((rest < 1.0) & (depth <= most))
                rest = rest - rest.floor()
        smooth = context.world.materials.models[model].smooth
        return StoredVertex(tuple(where), at.p, -1 if smooth else model, depth, count, front.arrival.dvcm)

    def end(self, context: StageContext, model: int, vertex: VertexInput, depth: Tensor, p: Tensor) -> End:
        """Return the light paths' ends of connections.

        Args:
            context: of the stage, with the salts of depth 0.
            model: index of the BSDF model at the vertices.
            vertex: the vertices as they were kept.
            depth: their numbers ``(n,)``.
            p: the other ends ``(3, n)``.
        """
        world, state = context.world, vertex.state
        kind = world.materials.models[model]
        at = interact(world, state.o, state.d, vertex.hit)
        surface = surface_at(world, model, state.d, at, context.pixel, dark_rims=context.plan.dark_rims)
        dvcm = state.extra["dvcm"]
        to = p - at.p
        w = to * safe_reciprocal(dot(to, to).sqrt())
        view = self._view(context, model, state, at, seen_from(context, model, at, surface, w), None, dvcm)
        if surface.perturbed_normal is not None:  # the density of a light sample depends on the normal
            assert context.start_salts is not None
            ray = self._ray(context, state.key, context.start_salts)
            first = self._view(context, model, state, at, view.surface, ray).arrival.dvcm
            view = replace(view, arrival=replace(view.arrival, dvcm=torch.where(depth == 1, first, dvcm)))
        wo = view.surface.local_wo(w)
        value, reverse = kind.eval_pdf(view.surface.parameters, wo, view.wi)
        cosine = dot(w, at.ng).abs()
        value = view.throughput * value * (cosine * state.extra["flux"] / view.arrival.cosine)
        if view.surface.outward is not None:
            value = torch.where(dot(w, view.surface.outward) > 0, value, 0.0)
        return End(
            p=at.p,
            o=offset_origin(world, at, w),
            value=value,
            pdf=reverse_pdf(context, model, at, view.surface, w, -state.d),
            others=view.arrival.others(reverse),
            cosine=cosine,
            partner=torch.full_like(depth, -1),
        )

    def _view(
        self,
        context: StageContext,
        model: int,
        state: PathState,
        at: Interaction,
        surface: Surface,
        ray: LightRay | None,
        dvcm: Tensor | None = None,
    ) -> _View:
        """Return what ``surface`` does with the light that arrives, as it is seen from where the light goes on to.

        As in a camera path that comes from there, normals and sides are asked of the direction to the light alone. ``dvcm``:
        of the arrival, where it is known.
        """
        world = context.world
        wi = surface.frame.to_local(-state.d)
        share = stages.shading_weight(world, model, at, surface, -state.d, wi)
        throughput = state.throughput if share is None else state.throughput * share
        cosine = Arrival.cosine_of(state.d, at)
        dvc = state.extra["dvc"] / cosine
        merging = None if world.materials.models[model].smooth else context.merging
        if dvcm is not None:
            return _View(surface, wi, throughput, Arrival(dvcm, dvc, cosine, merging), ray)
        dvcm = torch.zeros_like(cosine)
        if ray is None and self.number:  # a connection competes
            way = at.p - state.o
            dvcm = state.extra["dvcm"] * dot(way, way) / cosine
        if ray is not None:  # a light sample competes
            emission = world.emission
            assert emission is not None
            n = None if world.materials.models[model].transmits else surface.frame.n
            dvcm = safe_reciprocal(ray.density * light_weight(emission, ray, at.p, n) * cosine)
        return _View(surface, wi, throughput, Arrival(dvcm, dvc, cosine, merging), ray)

    def _seen_from(
        self, context: StageContext, model: int, state: PathState, at: Interaction, front: _View, w: Tensor
    ) -> _View:
        """Return the view from unit directions ``w (3, N)``; ``front``: that from the light."""
        surface = seen_from(context, model, at, front.surface, w)
        return front if surface is front.surface else self._view(context, model, state, at, surface, front.ray)

    def _splat(self, context: StageContext, model: int, state: PathState, at: Interaction, front: _View) -> Splat:
        """Return the light that surface points send to the camera."""
        plan, camera, crop, filter = context.plan, context.camera, context.crop, context.filter
        assert camera is not None and crop is not None and filter is not None
        kind, draws = context.world.materials.models[model], Draws(plan.sampler, state.key, context.salts)
        lens = draws.two(Dimension.LENS).to(plan.dtype) if camera.lens else None
        eye, x, y, ahead = camera.connect(at.p, lens)
        to = eye - at.p
        square = dot(to, to)
        w = to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()
        # Square pixels for each area across the ray, over the number of light paths of a sample of all pixels.
        density = camera.film_density(-w) / (self.fraction * float(crop[2] * crop[3]))
        if not camera.parallel:
            density = density * safe_reciprocal(square)
        view = self._seen_from(context, model, state, at, front, w)
        arrival, wo = view.arrival, view.surface.local_wo(w)
        value, reverse = kind.eval_pdf(view.surface.parameters, wo, view.wi)
        u = draws.two(Dimension.PIXEL)
        (column, weight_x), (row, weight_y) = filter.splat(x, u[0].to(plan.dtype)), filter.splat(y, u[1].to(plan.dtype))
        column, row = column - crop[0], row - crop[1]
        seen = ahead & (column >= 0) & (column < crop[2]) & (row >= 0) & (row < crop[3])
        if view.surface.outward is not None:
            seen = seen & (dot(w, view.surface.outward) > 0)
        area = density * dot(w, at.ng).abs()  # square pixels for each area of the surface
        scale = area * state.extra["flux"] / arrival.cosine
        if self.weighted:
            scale = scale * reduced(None, area * arrival.others(reverse))
        radiance = view.throughput * value * (scale * weight_x * weight_y)
        radiance = torch.where(seen, radiance, 0.0)
        o, lit = offset_origin(context.world, at, w), ~(largest(radiance.abs()) == 0)  # a NaN is reported
        pixel = torch.where(seen & lit, row * crop[2] + column, -1)
        return Splat(pixel, Shadow(o=o, d=eye - o, t_max=lit.to(plan.dtype), radiance=radiance))

    def _leaving(
        self, context: StageContext, model: int, state: PathState, at: Interaction, front: _View
    ) -> tuple[PathState, Drawn]:
        """Return the paths with the rays that leave surface points: sampled as a camera path's, weighted by the adjoint."""
        plan, kind, surface = context.plan, context.world.materials.models[model], front.surface
        draws = Draws(plan.sampler, state.key, context.salts)
        lobe = draws.one(Dimension.LOBE).to(plan.dtype) if kind.lobed else None
        sample = kind.sample(surface.parameters, surface.wo, lobe, draws.two(Dimension.BSDF).to(plan.dtype))
        d, pdf = surface.frame.to_world(sample.wi), sample.pdf
        view = self._seen_from(context, model, state, at, front, d)
        sharp = torch.isinf(pdf) if kind.delta else None
        turned = dot(d, at.ng).abs() / view.arrival.cosine
        weight, reverse, least = sample.weight, None, pdf
        if kind.delta:
            # A delta lobe's weight is that of light from `wi`: with the cosines of both normals it becomes the adjoint.
            weight = weight * (turned * surface.wo[2].abs() * safe_reciprocal(sample.wi[2].abs()))
            if sample.eta is not None:
                weight = weight * (sample.eta * sample.eta)
        if not kind.smooth:
            value, reverse = kind.eval_pdf(view.surface.parameters, view.surface.local_wo(d), view.wi)
            # A failed sample has density 0 though its direction may have a value.
            usable = pdf > 0 if sharp is None else (pdf > 0) & ~sharp
            rough = torch.where(usable, value * (turned / torch.where(usable, pdf, 1.0)), 0.0)
            weight = rough if sharp is None else torch.where(sharp, weight, rough)
        if kind.delta and surface.perturbed_normal is not None:  # light along `d` would meet another normal
            same = dot(view.surface.frame.n, surface.frame.n) > 1.0 - 1e-4
            least = torch.where(torch.isinf(pdf) & ~same, 0.0, least)
        if view.surface.outward is not None and stages.has_shading_normals(context.world, model):
            least = torch.minimum(least, dot(d, view.surface.outward))
        drawn = Drawn(
            o=offset_origin(context.world, at, d),
            d=d,
            wi=sample.wi,
            pdf=pdf,
            weight=weight,
            least=least,
            sharp=sharp,
            eta=None,  # flux is not scaled by refraction
        )
        without_shadowing = replace(surface, perturbed_normal=None)  # it is of the light's direction
        state = replace(state, throughput=view.throughput)
        continuation = stages.continue_paths(plan, state, without_shadowing, drawn, draws, context.roulette)
        leaving = stages.next_ray(context, model, state, at, surface, drawn, continuation)
        dvc = leaving_dvc(context, model, at, surface, view.arrival, d, pdf, sample.eta, reverse)
        dvcm = leaving_dvcm(pdf, kind.smooth, self.number)
        return replace(leaving, extra={**state.extra, "dvcm": dvcm, "dvc": dvc}), drawn
