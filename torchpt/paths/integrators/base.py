"""The base class of integrators: their parameters, stages, fields and limits.

An integrator has no loop of its own: :func:`torchpt.paths.walk.walk` takes paths from vertex to vertex, and an engine calls the
integrator's *stages* there, pure functions of whole tensors with one path a lane. A *field* is a number that each path carries
beside the fields of :class:`~torchpt.paths.state.PathState`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch

from torchpt.core.errors import SceneError
from torchpt.paths import transmission
from torchpt.paths import vertex as stages
from torchpt.paths.roulette import DEEP, DEEP_CAP
from torchpt.paths.state import Emission, End, Field, Shadow, StageContext, Transmission, VertexInput, VertexOutput
from torchpt.paths.vertex import STRATEGIES, Plan
from torchpt.physics.lights import LIGHT_SAMPLERS
from torchpt.physics.samplers import salts
from torchpt.spec import Choice, Flag, FrozenConfig, Integer, Scalar, Spec, parameters_of

if TYPE_CHECKING:
    from typing import Self

    from torch import Tensor

    from torchpt.paths.integrators.first_surface import FirstSurface
    from torchpt.paths.state import PathState
    from torchpt.physics.samplers import Points
    from torchpt.physics.world import World

__all__ = [
    "DARK_RIMS",
    "DEPTHS",
    "ENDLESS",
    "LIGHT_CHOICE",
    "SAMPLES",
    "STRATEGY",
    "STRICT",
    "TO_FIRST_SURFACE",
    "Integrator",
    "Limits",
    "check_fields",
    "check_output",
]

#: With ``max_depth`` -1 roulette ends the paths; those that reach this depth are truncated, and counted. With ``DEEP_CAP`` not
#: one path in 10^12 comes so far, even if it loses nothing: only a later ``rr_depth`` or ``rr_prob`` near 1 truncates paths.
ENDLESS = 1 << 15

#: Parameters that several kinds of integrators share, for their ``parameters``.
DEPTHS: dict[str, Spec] = {
    "max_depth": Integer(
        16,
        low=-1,
        doc="longest path in edges: 1 emission only, 2 direct light, -1 until roulette ends it",
    ),
    "rr_depth": Integer(5, low=1, doc="roulette may end paths from this depth on"),
    "rr_prob": Scalar(
        None,
        above=0.0,
        high=1.0,
        words="null or a number, 0 < rr_prob <= 1",
        doc="chance to survive roulette; null: by throughput",
    ),
}
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
STRICT: dict[str, Spec] = {"strict": Flag(False, doc="whether a sample that is not finite is an error")}
DARK_RIMS: dict[str, Spec] = {
    "dark_rims": Flag(False, doc="whether smooth shading is dark where its normal faces away, as in Mitsuba"),
}
SAMPLES: dict[str, Spec] = {
    "clamp": Scalar(None, above=0.0, words="null or a number > 0", doc="largest component of a sample; biased"),
    **STRICT,
}


@dataclass(frozen=True)
class Limits:
    """Depth limits of paths.

    Attributes:
        max_depth: greatest number of vertices; -1: only roulette ends paths.
        rr_depth: first vertex with Russian roulette; vertex 1 is the first hit.
        first_surface: True: paths end behind the first surface, after its light sample.
    """

    max_depth: int
    rr_depth: int
    first_surface: bool = False

    @property
    def endless(self) -> bool:
        """Return True if only roulette ends paths."""
        return self.max_depth < 0

    @property
    def last(self) -> int:
        """Return the depth at which all remaining paths end."""
        return ENDLESS if self.endless else self.max_depth

    def roulette(self, depth: int) -> float:
        """Return the upper bound of the survival probability at vertex ``depth``; 0: no roulette there."""
        if depth < self.rr_depth:
            return 0.0
        return DEEP_CAP if self.max_depth < 0 and depth > DEEP else 1.0


#: Limits of walks to the first surface alone, as for layers: they do not depend on how far the integrator's paths go.
TO_FIRST_SURFACE = Limits(max_depth=1, rr_depth=2)


class Integrator(FrozenConfig):
    """Base class of integrators; an instance holds the values of its parameters.

    Attributes:
        name: its ``type`` in a scene file.
        light: True: it estimates radiance. False: the picture shows layers.
        layers: layers shown where ``film.aovs`` lists none.
        lit: True: it uses the scene's lights. False: its world has none.
        fields: fields of its own in the path state.
        splats: True: samples add radiance to pixels other than their own, by its stages or by those of its light paths.
        starts_on_lights: True: its paths start on lights, and the stage of the first vertex differs from that of others.
        connected: True: its paths are light paths, and keep vertices for connections.
        sends_photons: True: its paths are light paths, and their vertices are merged with those of camera paths.
        strategy: how light is found, one of :data:`torchpt.paths.state.STRATEGIES`. This value and those below are for kinds
            without a parameter of the name.
        rr_prob: constant survival probability of roulette; None: by throughput.
        light_choice: which of many lights is sampled, one of :data:`torchpt.physics.lights.LIGHT_SAMPLERS`.
        dark_rims: True: smooth shading is dark where its normal faces away.
        clamp: largest component of a sample; None: unbounded.
        strict: True: a sample that is not finite is an error.
    """

    name: ClassVar[str] = ""
    light: ClassVar[bool] = True
    layers: ClassVar[tuple[str, ...]] = ()
    lit: ClassVar[bool] = True
    fields: ClassVar[Sequence[Field]] = ()
    splats: ClassVar[bool] = False
    starts_on_lights: ClassVar[bool] = False
    connected: bool = False
    sends_photons: bool = False

    strategy: str = "mis"
    rr_prob: float | None = None
    light_choice: str = "auto"
    dark_rims: bool = False
    clamp: float | None = None
    strict: bool = False

    def __init_subclass__(cls) -> None:
        names = [field.name for field in cls.fields]
        if len(set(names)) < len(names):
            raise TypeError(f"{cls.__name__} declares a field twice: {', '.join(names)}")

    @property
    def limits(self) -> Limits:
        """Return the depth limits of paths; by default emission and direct light, without roulette."""
        return Limits(max_depth=2, rr_depth=3)

    def plan(self, sampler: Points, dtype: torch.dtype, *, tape: bool = False, attached: bool = False) -> Plan:
        """Return the static configuration of the stages; the arguments are fields of :class:`torchpt.paths.state.Plan`."""
        return Plan(
            sampler=sampler,
            strategy=self.strategy,
            rr_prob=self.rr_prob,
            dark_rims=self.dark_rims,
            dtype=dtype,
            tape=tape,
            attached=attached,
        )

    def light_walk(self) -> Integrator | None:
        """Return the integrator of light paths that are traced beside the samples, one for each; None: there are none."""
        return None

    def start_salts(self, depth: int, device: torch.device) -> Tensor | None:
        """Return the salts of depth 0 at vertex ``depth`` where its stage needs them; None elsewhere."""
        return salts(0, device) if depth == 1 and self.starts_on_lights else None

    @property
    def connects(self) -> bool:
        """Return True if vertices of its paths are connected to those that its light paths keep."""
        return False

    @property
    def merging_counts(self) -> bool:
        """Return True if weights count with merges of camera paths and light paths."""
        return False

    @property
    def merges(self) -> bool:
        """Return True if vertices of its paths are merged with the photons that its light paths send."""
        return False

    def radius_at(self, sample: int) -> float | None:
        """Return the radius with which sample ``sample`` of each pixel counts merges; None: it does not."""
        return None

    def as_traced(self) -> Self:
        """Return a copy without the values that its stages do not read: compiled stages are shared by what it has."""
        return self

    @property
    def splats_at_surfaces(self) -> bool:
        """Return True if its own stages return splats, and not those of its light paths."""
        return self.splats and self.light_walk() is None

    def generate(self, context: StageContext, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """Return the first rays of paths: camera rays. A stage.

        Args:
            context: of the render, with camera and filter.
            x: column of each pixel on the whole film ``(N,)``, in the lanes' dtype.
            y: row of each pixel, likewise.
            key: the sampler's keys ``(rows, N)`` int32.
            salts: the random dimensions of depth 0.
        """
        assert context.camera is not None and context.filter is not None
        return stages.generate(context.plan, context.camera, context.filter, x, y, key, salts)

    def counted_in(self, unit: float) -> Self:
        """Return a copy with parameters that are lengths divided by ``unit``, the world unit in scene units."""
        specs = parameters_of(type(self))
        lengths = {key: value / unit for key, value in self.values.items() if specs[key].length and value is not None}
        return self.but(**lengths) if lengths and unit != 1.0 else self  # `but` returns a copy with other values

    def emit(self, context: StageContext, vertex: VertexInput) -> Emission:
        """Return the emission of emitters that paths hit. A stage: a pure function of lanes."""
        return stages.emit(context, vertex)

    def escape(self, context: StageContext, vertex: VertexInput) -> Emission:
        """Return the radiance of the environment for paths that hit nothing. A stage."""
        return stages.escape(context, vertex)

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        """Return the outputs of a vertex on surfaces of BSDF model ``model``. A stage."""
        return stages.bounce(context, model, vertex)

    def connect(self, context: StageContext, model: int, vertex: VertexInput, depth: Tensor, end: End) -> Shadow:
        """Return the light that goes through connections of camera paths with light paths. A stage.

        Args:
            context: of the vertex of the camera paths, with the salts of depth 0.
            model: index of the BSDF model of the light paths' vertices.
            vertex: the light paths' vertices, as they were kept.
            depth: their numbers ``(n,)``, 1 at the first hit.
            end: the camera paths' ends.
        """
        raise NotImplementedError(f"{self.name} declares connections, and has no stage for them")

    def transmit(self, context: StageContext, vertex: VertexInput) -> Transmission:
        """Return which rays pass their hit, and which a medium scatters before it.

        A stage, repeated until all rays have stopped.

        An integrator's own ``transmit`` runs for all rays, those without a hit included, and calls this one for the rays that
        reach their surface. Only surfaces block shadow rays: ``bounce`` has to weaken them by media in between.
        """
        if context.world.materials.opacity is None:
            return Transmission(on=torch.zeros_like(vertex.hit.prim, dtype=torch.bool), o=vertex.state.o)
        return transmission.transmit(context, vertex)

    @property
    def is_foreign(self) -> bool:
        """Return True for a class outside torchpt, whose code may differ under the same name."""
        return type(self).__module__.partition(".")[0] != "torchpt"

    @property
    def has_own_transmit(self) -> bool:
        """Return True if the kind overrides :meth:`transmit`, so that more than surfaces may stop rays."""
        return type(self).transmit is not Integrator.transmit

    @property
    def has_own_stages(self) -> bool:
        """Return True if the kind has fields, splats or stages of its own, which need kernels of their own."""
        kind, base = type(self), Integrator
        overrides = any(
            getattr(kind, name) is not getattr(base, name)
            for name in ("generate", "emit", "escape", "bounce", "transmit")
        )
        return overrides or bool(self.fields) or self.splats

    def first(self, world: World) -> FirstSurface | None:
        """Return the shading of first surfaces, made once a scene and differentiable in its tensors; None: paths go on.

        The world's tensors are on the host; results are copied to the device of the render.
        """
        return None


def check_output(integrator: Integrator, output: VertexOutput) -> None:
    """Check that the outputs of a stage have the fields and splats that the integrator declares.

    Raises:
        SceneError: a field is wrong, see :func:`check_fields`, or there are splats without ``splats = True``.
    """
    check_fields(integrator, output.leaving)
    if output.splat is not None and not integrator.splats:
        raise SceneError("integrator.splats", False, f"true, as {integrator.name} returns some")


def check_fields(integrator: Integrator, state: PathState) -> None:
    """Check that paths have all fields that the integrator declares, in their shapes and dtypes, and no others.

    Raises:
        SceneError: a field is missing, undeclared, or of another shape or dtype.
    """
    if not integrator.fields and not state.extra:
        return
    declared = {field.name: field for field in integrator.fields}
    for name in declared.keys() | state.extra.keys():
        field, value = declared.get(name), state.extra.get(name)
        if field is None or value is None:
            found = "a field that is not declared" if field is None else "left out by a stage"
            raise SceneError(
                f"integrator.fields.{name}", found, f"the fields of {integrator.name}: {', '.join(declared)}"
            )
        if value.dim() != (1 if field.rows == 1 else 2) or (field.rows > 1 and len(value) != field.rows):
            shape = "(n,)" if field.rows == 1 else f"({field.rows}, n)"
            raise SceneError(f"integrator.fields.{name}", f"a tensor of shape {tuple(value.shape)}", shape)
        if value.is_floating_point() == field.whole:
            raise SceneError(
                f"integrator.fields.{name}", value.dtype, "int64" if field.whole else "numbers of the lanes"
            )
