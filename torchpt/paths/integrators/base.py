"""Integrators: a kind's settings, what it asks of the stages, and where its paths end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch

from torchpt.core.errors import SceneError
from torchpt.paths import transmission
from torchpt.paths import vertex as stages
from torchpt.paths.roulette import DEEP, DEEP_CAP
from torchpt.paths.state import Emission, Field, StageContext, Transmission, VertexInput, VertexOutput
from torchpt.paths.vertex import STRATEGIES, Plan
from torchpt.physics.lights import LIGHT_SAMPLERS
from torchpt.spec import Choice, Flag, FrozenConfig, Scalar, Spec, parameters_of

if TYPE_CHECKING:
    from typing import Self

    from torchpt.paths.integrators.first_surface import FirstSurface
    from torchpt.paths.state import PathState
    from torchpt.physics.samplers import Points
    from torchpt.physics.world import World

__all__ = ["ENDLESS", "LIGHT_CHOICE", "SAMPLES", "STRATEGY", "Integrator", "Limits", "check_fields", "check_output"]

#: Where ``max_depth`` is -1 roulette ends the paths; after this many vertices they are ended, and counted. Of a million million
#: paths that lose nothing none comes so far (``DEEP_CAP``): only those are cut that roulette was told to leave alone.
ENDLESS = 1 << 15

#: Parameters that several kinds have.
STRATEGY: dict[str, Spec] = {
    "strategy": Choice(
        "mis",
        names=STRATEGIES,
        doc="how light is found: BSDF and lights, one alone, or evenly",
    ),
}
LIGHT_CHOICE: dict[str, Spec] = {
    "light_choice": Choice(
        "auto",
        names=LIGHT_SAMPLERS,
        doc="which of many lights is sampled",
    ),
}
SAMPLES: dict[str, Spec] = {
    "clamp": Scalar(None, above=0.0, words="null or a number > 0", doc="largest component of a sample; biased"),
    "strict": Flag(False, doc="whether a sample that is not finite is an error"),
}


@dataclass(frozen=True)
class Limits:
    """Limits of paths.

    Attributes:
        max_depth: vertices at most; -1: only roulette ends them.
        rr_depth: roulette plays from this vertex on.
        first_surface: whether paths end behind the first surface, with the light that is sampled there.
    """

    max_depth: int
    rr_depth: int
    first_surface: bool = False

    @property
    def endless(self) -> bool:
        """Return True where roulette alone is to end paths."""
        return self.max_depth < 0

    @property
    def last(self) -> int:
        """The vertex at which paths end that came so far."""
        return ENDLESS if self.endless else self.max_depth

    def roulette(self, depth: int) -> float:
        """The most that roulette lets paths survive with at a vertex; 0 where it does not play."""
        if depth < self.rr_depth:
            return 0.0
        return DEEP_CAP if self.max_depth < 0 and depth > DEEP else 1.0


class Integrator(FrozenConfig):
    """A kind of integrator; an instance holds the values of its parameters.

    Attributes:
        name: its ``type`` in a scene file.
        light: whether it estimates radiance; else the picture shows layers.
        layers: layers that are shown where ``film.aovs`` names none.
        lit: whether it sees the scene's lights; else its world has none.
        fields: what its paths carry beside the state of every path.
        splats: whether its surfaces send light to other pixels than a sample's own.
        strategy, rr_prob, light_choice, clamp, strict: as for ``path``, where the kind has no such parameter.
    """

    name: ClassVar[str] = ""
    light: ClassVar[bool] = True
    layers: ClassVar[tuple[str, ...]] = ()
    lit: ClassVar[bool] = True
    fields: ClassVar[Sequence[Field]] = ()
    splats: ClassVar[bool] = False

    strategy: str = "mis"
    rr_prob: float | None = None
    light_choice: str = "auto"
    clamp: float | None = None
    strict: bool = False

    def __init_subclass__(cls) -> None:
        names = [own.name for own in cls.fields]
        if len(set(names)) < len(names):
            raise TypeError(f"{cls.__name__} declares a field twice: {', '.join(names)}")

    @property
    def limits(self) -> Limits:
        """Return where paths end."""
        return Limits(2, 3)

    def plan(self, sampler: Points, dtype: torch.dtype, tape: bool = False, attached: bool = False) -> Plan:
        """Return what it asks of the stages."""
        return Plan(sampler, self.strategy, self.rr_prob, dtype, tape, attached)

    def counted_in(self, unit: float) -> Self:
        """The same with its lengths in a unit that is so long in the scene's: the lanes'."""
        specs = parameters_of(type(self))
        lengths = {key: value / unit for key, value in self.values.items() if specs[key].length and value is not None}
        return self.but(**lengths) if lengths and unit != 1.0 else self

    def emit(self, context: StageContext, vertex: VertexInput) -> Emission:
        """Return what paths gather from the emitters that they hit; a stage: a pure function of lanes."""
        return stages.emit(context, vertex)

    def escape(self, context: StageContext, vertex: VertexInput) -> Emission:
        """Return what paths gather from the environment that they escape to; a stage."""
        return stages.escape(context, vertex)

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        """Return what surfaces of BSDF model number ``model`` make of paths; a stage."""
        return stages.bounce(context, model, vertex)

    def transmit(self, context: StageContext, vertex: VertexInput) -> Transmission:
        """Return which rays pass what they met, or are scattered before it; a stage, taken step by step until all rays stop.

        Where a kind has its own, it is asked for all rays, those that met nothing too, and asks this one which rays pass the
        surface that they reach. Shadow rays are held up by surfaces alone: ``bounce`` weakens them by what lies between.
        """
        if context.world.materials.opacity is None:
            return Transmission(torch.zeros_like(vertex.hit.prim, dtype=torch.bool), vertex.state.o)
        return transmission.transmit(context, vertex)

    @property
    def foreign(self) -> bool:
        """Return True for a class of a user's own, whose code may differ under the same name."""
        return type(self).__module__.partition(".")[0] != "torchpt"

    @property
    def own_transmit(self) -> bool:
        """Return True where something but surfaces may hold rays up."""
        return type(self).transmit is not Integrator.transmit

    @property
    def own_stages(self) -> bool:
        """Return True where it carries fields or has stages of its own, for which kernels are made anew."""
        kind, base = type(self), Integrator
        own = any(getattr(kind, name) is not getattr(base, name) for name in ("emit", "escape", "bounce", "transmit"))
        return own or bool(self.fields) or self.splats

    def first(self, world: World) -> FirstSurface | None:
        """Return what happens at first surfaces, made once a scene and differentiable in its world; None: paths go on."""
        return None


def check_output(integrator: Integrator, output: VertexOutput) -> None:
    """Refuse what a stage made of surfaces where it is not what its integrator declares.

    Raises:
        SceneError: names the field, see :func:`check_fields`, or ``splats``.
    """
    check_fields(integrator, output.leaving)
    if output.splat is not None and not integrator.splats:
        raise SceneError("integrator.splats", False, f"true, as {integrator.name} returns some")


def check_fields(integrator: Integrator, state: PathState) -> None:
    """Refuse paths that a stage left without a field that its integrator declares, or with one of another form.

    Raises:
        SceneError: names the field.
    """
    if not integrator.fields and not state.extra:
        return
    declared = {own.name: own for own in integrator.fields}
    for name in declared.keys() | state.extra.keys():
        own, value = declared.get(name), state.extra.get(name)
        if own is None or value is None:
            found = "a field that is not declared" if own is None else "left out by a stage"
            raise SceneError(
                f"integrator.fields.{name}", found, f"the fields of {integrator.name}: {', '.join(declared)}"
            )
        if value.dim() != (1 if own.rows == 1 else 2) or (own.rows > 1 and len(value) != own.rows):
            form = "(n,)" if own.rows == 1 else f"({own.rows}, n)"
            raise SceneError(f"integrator.fields.{name}", f"a tensor of shape {tuple(value.shape)}", form)
        if value.is_floating_point() == own.whole:
            raise SceneError(f"integrator.fields.{name}", value.dtype, "int64" if own.whole else "numbers of the lanes")
