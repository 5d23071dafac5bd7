"""Bidirectional path tracing: the strategies of ``path``, and light paths joined to the camera and to camera paths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import dot, largest, safe_reciprocal
from torchpt.paths import vertex as stages
from torchpt.paths.integrators.base import DARK_RIMS, DEPTHS, LIGHT_CHOICE, STRICT, Limits
from torchpt.paths.integrators.kinds.path import Path
from torchpt.paths.integrators.light_paths import LightPaths
from torchpt.paths.integrators.merging import merged_light
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.paths.integrators.weights import (
    FIELDS,
    Arrival,
    leaving_dvc,
    leaving_dvcm,
    reduced,
    reverse_pdf,
    root_of_squares,
)
from torchpt.paths.state import (
    Emission,
    End,
    Partner,
    PathState,
    Plan,
    Shadow,
    StageContext,
    VertexInput,
    VertexOutput,
)
from torchpt.paths.surface import Surface
from torchpt.physics.lights.emission import density_of_environment, density_of_hit, density_of_sample
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Interaction
from torchpt.spec import Choice, Flag, Refused, Scalar

if TYPE_CHECKING:
    from torchpt.physics.samplers import Points

__all__ = ["STRATEGIES", "Bdpt"]

#: Ways to find light: a camera path meets it, a light sample ends a camera path, a light path is joined to the camera, or to a
#: camera path.
STRATEGIES = ("bsdf", "light", "light_paths", "connections")
#: For how many samples a connection counts in weights: below 1, since one vertex of a light path, chosen at random, stands for
#: all of them. Any number gives the same mean; of 1, 1/2 and 1/4 this one left the least variance.
SHARE = 0.5


class Bdpt(PathIntegrator):
    """Bidirectional path tracing: camera paths with light samples, and light paths joined to the camera and to camera paths."""

    name = "bdpt"
    parameters: ClassVar = {
        **DEPTHS,
        "strategy": Choice(
            "mis",
            names=("mis", *STRATEGIES),
            doc="how light is found: all ways weighted; or by camera paths that meet it, light samples, light paths joined to "
            "the camera, or connections alone",
        ),
        "weighted": Flag(False, doc="whether one strategy alone keeps its weight among all"),
        "light_paths": Scalar(0.5, above=0.0, high=1.0, doc="number of light paths for each camera path"),
        "connections": Choice(
            "none",
            names=("none", "one"),
            doc="whether each vertex of a camera path is connected to one of the light path",
        ),
        **LIGHT_CHOICE,
        **DARK_RIMS,
        **STRICT,
    }
    splats = True
    fields = FIELDS

    @property
    def limits(self) -> Limits:
        """Return the depth limits that the parameters set; camera paths end at once where light paths alone count."""
        return Limits(0 if self.strategy == "light_paths" else self.max_depth, self.rr_depth)

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that contradict each other, or by which paths would never end.

        Arguments as for :meth:`torchpt.spec.FrozenConfig.check`.
        """
        Path.check(values, given)
        if values["weighted"] and values["strategy"] == "mis":
            raise Refused("one strategy alone beside weighted", "mis", ("strategy",))
        if values["strategy"] == "connections" and values["connections"] == "none":
            raise Refused("one beside strategy=connections", "none", ("connections",))
        if values["strategy"] == "connections" and not values["weighted"]:
            # A path of k edges has k - 2 connections, each of which finds it.
            raise Refused("true beside strategy=connections", False, ("weighted",))

    def plan(self, sampler: Points, dtype: torch.dtype, *, tape: bool = False, attached: bool = False) -> Plan:
        """Return the static configuration of the stages; see :meth:`Integrator.plan`."""
        # Light samples alone have no weights, and draw dim parts of environment maps too.
        alone = self.strategy == "light" and not self.weighted
        strategy = "light" if alone else "mis"
        return replace(super().plan(sampler, dtype, tape=tape, attached=attached), strategy=strategy)

    def _scale(self, strategy: str, among_all: Tensor, weight: Tensor | None) -> Tensor | float:
        """Return the factor on contributions of a strategy, which have its weight among those of ``path``.

        Args:
            strategy: one of :data:`STRATEGIES`.
            among_all: factor ``(N,)`` by which the weight falls among all strategies.
            weight: the weight ``(N,)``; None: 1.
        """
        if self.strategy == "mis" or (self.weighted and self.strategy == strategy):
            return among_all
        if self.strategy != strategy:
            return 0.0
        return 1.0 if weight is None else safe_reciprocal(weight)

    @property
    def connects(self) -> bool:
        """Return True if vertices of camera paths are connected to those of light paths."""
        # A path with a connection has three edges at least.
        return self.connections != "none" and self.strategy in ("mis", "connections") and not 0 <= self.max_depth < 3

    @property
    def _number(self) -> float:
        """Return the number of connections of two vertices for each sample, which weights count with."""
        return SHARE * self.light_paths if self.connections != "none" else 0.0

    def light_walk(self) -> LightPaths:
        """Return the integrator of the light paths: :meth:`Integrator.light_walk`."""
        return LightPaths(
            max_depth=0 if self.strategy in ("bsdf", "light") else self.max_depth,
            rr_depth=self.rr_depth,
            rr_prob=self.rr_prob,
            dark_rims=self.dark_rims,
            fraction=self.light_paths,
            weighted=self.strategy == "mis" or self.weighted,
            joined=self.strategy in ("mis", "light_paths"),
            connected=self.connects,
            number=self._number,
            merging=self.merging_counts,
            sends_photons=self.merges,
        )

    def generate(self, context: StageContext, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """Return camera rays; see :meth:`Integrator.generate`."""
        camera, crop = context.camera, context.crop
        assert camera is not None and crop is not None
        state = super().generate(context, x, y, key, salts)
        # Light paths for each sample of a pixel, over the density with which the camera samples the direction.
        dvcm = self.light_paths * float(crop[2] * crop[3]) * safe_reciprocal(camera.film_density(state.d))
        return replace(state, extra={"dvcm": dvcm, "dvc": torch.zeros_like(dvcm)})

    def _arrival(self, context: StageContext, model: int, vertex: VertexInput) -> tuple[Arrival, Interaction]:
        """Return the numbers of MIS at a vertex on surfaces of one BSDF model, and the surface points."""
        state, camera = vertex.state, context.camera
        assert camera is not None
        at = interact(context.world, state.o, state.d, vertex.hit, follow_ray=context.follow_ray)
        cosine = Arrival.cosine_of(state.d, at)
        dvcm = state.extra["dvcm"] / cosine
        if self._number or not camera.parallel:
            way = at.p - state.o
            square = dot(way, way)
            if camera.parallel:  # the camera's density is that of points already
                depth = context.depth
                first = depth == 1 if isinstance(depth, torch.Tensor) else torch.full_like(square, depth == 1).bool()
                square = torch.where(first, 1.0, square)
            dvcm = dvcm * square
        merging = None if context.world.materials.models[model].smooth else context.merging
        return Arrival(dvcm, state.extra["dvc"] / cosine, cosine, merging), at

    def emit(self, context: StageContext, vertex: VertexInput) -> Emission:
        """Return the emission of emitters that paths hit; see :meth:`Integrator.emit`."""
        assert context.world.emission is not None
        state = vertex.state
        at = interact(context.world, state.o, state.d, vertex.hit, follow_ray=context.follow_ray)
        density = density_of_hit(context.world.emission, at)
        return self._reduced(stages.emission_at(context, vertex, at), density * state.extra["dvc"])

    def escape(self, context: StageContext, vertex: VertexInput) -> Emission:
        """Return the radiance of the environment; see :meth:`Integrator.escape`."""
        assert context.world.emission is not None
        found = stages.escape(context, vertex)
        density = density_of_environment(context.world.emission, found.pdf)
        return self._reduced(found, density * vertex.state.extra["dvc"])

    def _reduced(self, emission: Emission, other: Tensor) -> Emission:
        """Return emission where light paths find it too, with ``other (N,)`` times the density."""
        factor = self._scale("bsdf", reduced(emission.weight, other), emission.weight)
        return replace(emission, weight=emission.weight * factor, brought=emission.brought * factor)

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        """Return the outputs of a vertex: as of ``path``, with weights in which light paths take part."""
        world, state = context.world, vertex.state
        kind = world.materials.models[model]
        arrival, at = self._arrival(context, model, vertex)
        surface, direct, shadow = stages.shade(context, model, state, at)
        if direct is not None and shadow is not None:
            assert world.emission is not None
            wi = direct.sample.wi
            reverse = reverse_pdf(context, model, at, surface, -state.d, wi)
            density = density_of_sample(world.emission, direct.sample) * direct.sample.weight
            other = density * dot(wi, at.ng).abs() * arrival.others(reverse)
            factor = self._scale("light", reduced(direct.weight, other), direct.weight)
            if isinstance(factor, float) and factor == 0.0:  # not traced, and no 0 times infinity
                none = torch.zeros_like(shadow.radiance)
                shadow = replace(shadow, radiance=none, t_max=none[0])
            else:
                shadow = replace(shadow, radiance=shadow.radiance * factor)
            if direct.weight is not None:
                direct = replace(direct, weight=direct.weight * factor)
        output = stages.scattered(context, model, state, at, surface, direct, shadow)
        drawn = output.drawn
        assert drawn is not None
        reverse = None if kind.smooth else reverse_pdf(context, model, at, surface, -state.d, drawn.d)
        dvc = leaving_dvc(context, model, at, surface, arrival, drawn.d, drawn.pdf, drawn.eta, reverse)
        dvcm = leaving_dvcm(drawn.pdf, kind.smooth, self._number)
        leaving, end = replace(output.leaving, extra={"dvcm": dvcm, "dvc": dvc}), None
        if vertex.partner is not None and not kind.smooth:
            end = self._end(context, model, state, at, surface, arrival, vertex.partner)
        if vertex.photon is not None and not kind.smooth:
            merged = merged_light(
                context, model, vertex.photon, self.limits, state=state, at=at, surface=surface, arrival=arrival
            )
            leaving = replace(leaving, radiance=leaving.radiance + merged)
        return replace(output, leaving=leaving, end=end)

    # -- connections

    def _end(
        self,
        context: StageContext,
        model: int,
        state: PathState,
        at: Interaction,
        surface: Surface,
        arrival: Arrival,
        partner: Partner,
    ) -> End:
        """Return the camera paths' ends of connections with ``partner``."""
        to = partner.p - at.p
        w = to * safe_reciprocal(dot(to, to).sqrt())
        wi = surface.frame.to_local(w)
        value, pdf = context.world.materials.models[model].eval_pdf(surface.parameters, surface.wo, wi)
        # One of the path's vertices stands for all, and a light path for those samples that have none.
        scale = partner.count.to(pdf.dtype) / self.light_paths
        share = stages.shading_weight(context.world, model, at, surface, w, wi)
        value = state.throughput * value * (scale if share is None else scale * share)
        joined = (partner.count > 0) & (partner.model >= 0) & ~(largest(value.abs()) == 0)  # a NaN is reported
        if not self.limits.endless:
            joined = joined & (partner.depth + context.depth + 1 <= self.limits.last)
        return End(
            p=at.p,
            o=offset_origin(context.world, at, w),
            value=value,
            pdf=pdf,
            others=arrival.others(reverse_pdf(context, model, at, surface, -state.d, w)),
            cosine=dot(w, at.ng).abs(),
            partner=torch.where(joined, partner.model, -1),
        )

    def connect(self, context: StageContext, model: int, vertex: VertexInput, depth: Tensor, end: End) -> Shadow:
        """Return the light of connections: see :meth:`Integrator.connect`."""
        other = self.light_walk().end(context, model, vertex, depth, end.p)
        way = other.p - end.p
        inverse = safe_reciprocal(dot(way, way))
        # Densities by area at either end, with which the path from the other end would have come there.
        at_light, at_camera = end.pdf * other.cosine * inverse, other.pdf * end.cosine * inverse
        ratio = root_of_squares(at_light * other.others, at_camera * end.others) / self._number
        radiance = end.value * other.value * (inverse * reduced(None, ratio))
        lit = ~(largest(radiance.abs()) == 0)  # a NaN is reported
        t_max = lit.to(radiance.dtype) * (1.0 - stages.SHORTEN)
        return Shadow(o=end.o, d=other.o - end.o, t_max=t_max, radiance=radiance)
