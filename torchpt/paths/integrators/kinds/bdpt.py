"""Bidirectional path tracing: the strategies of ``path``, and light paths whose vertices are joined to the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import dot, safe_reciprocal
from torchpt.paths import vertex as stages
from torchpt.paths.integrators.base import DEPTHS, LIGHT_CHOICE, STRICT, Integrator, Limits
from torchpt.paths.integrators.kinds.path import Path
from torchpt.paths.integrators.light_paths import LightPaths
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.paths.integrators.weights import FIELDS, Arrival, leaving_dvc, reduced, reverse_pdf
from torchpt.paths.state import Emission, PathState, Plan, StageContext, VertexInput, VertexOutput
from torchpt.physics.lights.emission import density_of_environment, density_of_hit, density_of_sample
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Interaction
from torchpt.spec import Choice, Flag, Refused, Scalar

if TYPE_CHECKING:
    from torchpt.physics.samplers import Points

__all__ = ["STRATEGIES", "Bdpt"]

#: Ways to find light: a camera path meets it, a light sample ends a camera path, a light path is joined to the camera.
STRATEGIES = ("bsdf", "light", "light_paths")


class Bdpt(PathIntegrator):
    """Bidirectional path tracing: camera paths with light samples, and light paths joined to the camera."""

    name = "bdpt"
    parameters: ClassVar = {
        **DEPTHS,
        "strategy": Choice(
            "mis",
            names=("mis", *STRATEGIES),
            doc="how light is found: all ways weighted; or by camera paths that meet it, light samples or light paths alone",
        ),
        "weighted": Flag(False, doc="whether one strategy alone keeps its weight among all"),
        "light_paths": Scalar(0.5, above=0.0, high=1.0, doc="number of light paths for each camera path"),
        **LIGHT_CHOICE,
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
        """Refuse values by which paths would never end; arguments as for :meth:`torchpt.spec.FrozenConfig.check`."""
        Path.check(values, given)
        if values["weighted"] and values["strategy"] == "mis":
            raise Refused("one strategy alone beside weighted", "mis", ("strategy",))

    def plan(self, sampler: Points, dtype: torch.dtype, *, tape: bool = False, attached: bool = False) -> Plan:
        """Return the static configuration of the stages; see :meth:`Integrator.plan`."""
        # Light samples alone have no weights, and draw dim parts of environment maps too.
        alone = self.strategy == "light" and not self.weighted
        strategy = "light" if alone else "mis"
        return Plan(sampler=sampler, strategy=strategy, rr_prob=self.rr_prob, dtype=dtype, tape=tape, attached=attached)

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

    def light_walk(self) -> Integrator:
        """Return the integrator of the light paths: :meth:`Integrator.light_walk`."""
        return LightPaths(
            max_depth=self.max_depth if self.strategy in ("mis", "light_paths") else 0,
            rr_depth=self.rr_depth,
            rr_prob=self.rr_prob,
            fraction=self.light_paths,
            weighted=self.strategy == "mis" or self.weighted,
        )

    def generate(self, context: StageContext, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """Return camera rays; see :meth:`Integrator.generate`."""
        camera, crop = context.camera, context.crop
        assert camera is not None and crop is not None
        state = super().generate(context, x, y, key, salts)
        # Light paths for each sample of a pixel, over the density with which the camera samples the direction.
        dvcm = self.light_paths * float(crop[2] * crop[3]) * safe_reciprocal(camera.film_density(state.d))
        return replace(state, extra={"dvcm": dvcm, "dvc": torch.zeros_like(dvcm)})

    def _arrival(self, context: StageContext, vertex: VertexInput) -> tuple[Arrival, Interaction]:
        """Return the numbers of MIS at a vertex, and the surface points."""
        state, camera = vertex.state, context.camera
        assert camera is not None
        at = interact(context.world, state.o, state.d, vertex.hit, follow_ray=context.follow_ray)
        cosine = Arrival.cosine_of(state.d, at)
        dvcm = state.extra["dvcm"] / cosine
        if not camera.parallel:
            way = at.p - state.o
            dvcm = dvcm * dot(way, way)
        return Arrival(dvcm, state.extra["dvc"] / cosine, cosine), at

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
        arrival, at = self._arrival(context, vertex)
        surface, direct, shadow = stages.shade(context, model, state, at)
        if direct is not None and shadow is not None:
            assert world.emission is not None
            wi = direct.sample.wi
            reverse = reverse_pdf(context, model, at, surface, -state.d, wi)
            density = density_of_sample(world.emission, direct.sample) * direct.sample.weight
            other = density * dot(wi, at.ng).abs() * arrival.others(reverse)
            factor = self._scale("light", reduced(direct.weight, other), direct.weight)
            shadow = replace(shadow, radiance=shadow.radiance * factor)
            if direct.weight is not None:
                direct = replace(direct, weight=direct.weight * factor)
        output = stages.scattered(context, model, state, at, surface, direct, shadow)
        drawn = output.drawn
        assert drawn is not None
        reverse = None if kind.smooth else reverse_pdf(context, model, at, surface, -state.d, drawn.d)
        dvc = leaving_dvc(context, model, at, surface, arrival, drawn.d, drawn.pdf, drawn.eta, reverse)
        leaving = replace(output.leaving, extra={"dvcm": torch.zeros_like(dvc), "dvc": dvc})
        return replace(output, leaving=leaving)
