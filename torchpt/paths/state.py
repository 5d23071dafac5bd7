"""The records of paths: their state, and what stages read and return.

A stage is a pure function of a :class:`StageContext` and a :class:`VertexInput`. What happens at a surface returns a
:class:`VertexOutput` with every intermediate that an observer may ask for: compiled stages drop what nobody reads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.physics.lights.records import LightSample
from torchpt.physics.samplers import Points
from torchpt.physics.shapes.geometry import Hit, Interaction
from torchpt.physics.world import World

if TYPE_CHECKING:
    from torch import Tensor

    from torchpt.paths.surface import Surface
    from torchpt.physics.cameras import Camera

__all__ = [
    "EXTRA",
    "STRATEGIES",
    "T_MAX",
    "DirectLight",
    "Drawn",
    "Emission",
    "Field",
    "PathState",
    "Plan",
    "Shadow",
    "Splat",
    "StageContext",
    "Transmission",
    "VertexInput",
    "VertexOutput",
    "no_search",
    "no_shadow",
]


# ---- The state of paths and their shadow rays


@dataclass(frozen=True)
class PathState:
    """One path a lane."""

    o: Tensor  # (3, N) ray origin
    d: Tensor  # (3, N) ray direction, unit
    t_max: Tensor  # (N,) the largest float; 0 once the path has ended
    throughput: Tensor  # (3, N)
    radiance: Tensor  # (3, N) gathered so far
    pdf: Tensor  # (N,) with which d was drawn: inf where emission counts whole, 0 where it does not count
    lane: Tensor  # (N,) int64 place in the wave
    key: Tensor  # (2, N) int32 of the sampler
    eta: Tensor | None = None  # (N,) index of refraction here over that at the camera; None where nothing refracts
    #: (3, N) the vertex that d leaves, and its normal as `lights.sample` was given it; None where the choice of lights is the
    #: same everywhere.
    p: Tensor | None = None
    n: Tensor | None = None
    #: By name what the integrator carries along, see :class:`torchpt.paths.state.Field`; `(N,)` or `(rows, N)` each.
    extra: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Shadow:
    """Shadow rays and what the light brings where they pass."""

    o: Tensor  # (3, N)
    d: Tensor  # (3, N)
    t_max: Tensor  # (N,) in units of |d|; 0 where the light brings nothing
    radiance: Tensor  # (3, N)


# ---- What a render asks of the stages


#: mis: light and BSDF sampling combined; bsdf, light: one of them; uniform: directions uniform over the hemisphere.
STRATEGIES = ("mis", "bsdf", "light", "uniform")
#: ``t_max`` of a path that goes on; times 0 it is that of one that ended.
T_MAX = torch.finfo(torch.float32).max


@dataclass(frozen=True)
class Plan:
    """What a render asks of the stages; static."""

    sampler: Points
    strategy: str
    rr_prob: float | None
    dtype: torch.dtype
    tape: bool  # whether derivatives are wanted
    attached: bool  # whether they are wanted with respect to geometry


# ---- The records of a path vertex: what its stages read and return


def no_search(state: PathState) -> Hit:
    """Stand for a search in stages that must not ask for one."""
    raise AssertionError("hits are found between stages where no geometry is differentiated")


def no_shadow(state: PathState) -> Shadow:
    """Return shadow rays for the lanes of paths that bring no light."""
    nothing = torch.zeros_like(state.o)
    return Shadow(nothing, nothing, torch.zeros_like(state.t_max), nothing)


#: What names of fields begin with where they stand beside those of a path's state.
EXTRA = "extra."


@dataclass(frozen=True)
class Field:
    """One more number, or several, that an integrator carries along its paths; engines lay them out.

    Attributes:
        name: under which stages find it in ``state.extra``, as ``(N,)``, or ``(rows, N)`` where there are several.
        rows: how many numbers it has.
        start: its value where paths begin.
        whole: whether it is an integer of 32 bits (int64 to stages), without derivatives; else it is of the lanes' dtype and
            is differentiated.

    Raises:
        ValueError: no rows, or a start that is not whole where the field is.
    """

    name: str
    rows: int = 1
    start: float = 0.0
    whole: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1 or (self.whole and self.start != int(self.start)):
            raise ValueError(f"the field {self.name}: rows >= 1, and a whole start where it is whole")

    def begin(self, like: Tensor) -> Tensor:
        """Return the values of paths that begin; ``like (N,)`` tells how many, their dtype and device."""
        shape = (len(like),) if self.rows == 1 else (self.rows, len(like))
        dtype = torch.int64 if self.whole else like.dtype
        return torch.full(shape, self.start, dtype=dtype, device=like.device)


@dataclass(frozen=True)
class StageContext:
    """Inputs of a stage that do not change from lane to lane.

    A wave has one for all of its vertices; :meth:`at` adds what belongs to a depth.

    Attributes:
        plan: static needs of the render.
        world: the scene's tensors.
        pixel: how large a pixel is in the world, see :func:`torchpt.paths.surface.texture_point_at`; None where nothing
            asks.
        salts: names of the random dimensions at this depth, see :func:`torchpt.physics.samplers.salts`.
        follow_shape: whether points slide along their rays, see :func:`torchpt.physics.shapes.interact`.
        roulette: the most that roulette lets paths survive with; 0: it does not play.
        search: finds the hits of rays that leave; called only where ``plan.attached``.
        camera: that took the picture; None for an integrator without splats.
        crop: ``(x, y, width, height)`` of the picture on the camera's film; likewise.
    """

    plan: Plan
    world: World
    pixel: Tensor | None = None
    salts: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int32))
    follow_shape: bool = False
    roulette: float = 0.0
    search: Callable[[PathState], Hit] = no_search
    camera: Camera | None = None
    crop: tuple[int, int, int, int] | None = None

    def at(
        self,
        salts: Tensor,
        follow_shape: bool = False,
        roulette: float = 0.0,
        search: Callable[[PathState], Hit] = no_search,
    ) -> StageContext:
        """Return the same at a vertex."""
        return replace(self, salts=salts, follow_shape=follow_shape, roulette=roulette, search=search)


@dataclass(frozen=True)
class VertexInput:
    """Inputs of a stage by lane.

    Attributes:
        state: of the paths as they arrive.
        hit: what their rays met.
    """

    state: PathState
    hit: Hit


@dataclass(frozen=True)
class Transmission:
    """One step of rays through what may let them pass.

    Attributes:
        on: ``(n,)`` bool: which rays go on; the others end at what they met.
        o: ``(3, n)`` where those go on from that pass straight on; their distances are counted from where they began.
        scattered: ``(n,)`` bool: which rays something between surfaces scattered; None: none.
        state: these rays as they go on: their origins, directions, densities and fields may be others, and ``t_max`` 0 ends
            them; their throughput stays.
        chance: ``(n,)`` 1, with the derivative of the chance to stop or to pass; None: it has none.
    """

    on: Tensor
    o: Tensor
    scattered: Tensor | None = None
    state: PathState | None = None
    chance: Tensor | None = None


@dataclass(frozen=True)
class Emission:
    """Light that paths met by chance.

    Attributes:
        radiance: ``(3, n)`` of it.
        pdf: ``(n,)`` density in solid angle with which it would have been sampled.
        weight: ``(n,)`` of MIS.
        brought: ``(3, n)`` to the samples.
    """

    radiance: Tensor
    pdf: Tensor
    weight: Tensor
    brought: Tensor


@dataclass(frozen=True)
class DirectLight:
    """Light that was sampled at a vertex.

    Attributes:
        sample: a point on the lights.
        radiance: ``(3, n)`` of the light, with its textures.
        reflected: ``(3, n)`` what the BSDF, with the cosine, makes of it.
        share: ``(n,)`` of that: less than 1 where normals lean, and 0 on a back that is black; None: all.
        pdf: ``(n,)`` with which the BSDF would have drawn the direction; None where nobody asks.
        weight: ``(n,)`` of MIS; None: 1.
    """

    sample: LightSample
    radiance: Tensor
    reflected: Tensor
    share: Tensor | None
    pdf: Tensor | None
    weight: Tensor | None


@dataclass(frozen=True)
class Drawn:
    """The next ray as the BSDF gave it."""

    o: Tensor  # (3, n) detached
    d: Tensor  # (3, n) in the world, detached but for what `attach` adds
    wi: Tensor  # (3, n) local; that of a delta follows its parameters
    pdf: Tensor  # (n,) detached; inf where the lobe is a delta
    weight: Tensor  # (3, n) = eval / pdf
    least: Tensor  # (n,) positive where a path may go on
    sharp: Tensor | None  # (n,) bool: whether the lobe is a delta; None: the model has none
    eta: Tensor | None  # see BsdfSample


@dataclass(frozen=True)
class Splat:
    """Light that a vertex sends to pixels other than its sample's own.

    A pixel of a picture of N pixels gets what comes to it, over the samples a pixel. The pixel has no derivative.

    Attributes:
        pixel: ``(n,)`` int64: of the picture, counted row by row; -1: none.
        light: shadow rays whose light it is; those with ``t_max`` 0 pass everything.
    """

    pixel: Tensor
    light: Shadow


@dataclass(frozen=True)
class VertexOutput:
    """Results of a vertex on surfaces of one BSDF model.

    Attributes:
        leaving: the paths with their next rays; of those that ended ``t_max`` is 0.
        next_hit: what these rays met, where that had to be found already.
        shadow: shadow rays whose light is still to be added; None where no light is sampled.
        at: the points.
        splat: light to other pixels; None where there is none. Only of integrators that say that they have ``splats``.
        surface: with its material; None where nobody asked for it.
        direct: the light that was sampled; None where none was.
        drawn: the direction that the BSDF gave; None where paths end here.
        carried: ``(3, n)`` throughput before roulette; None where paths end here.
        chance: ``(n,)`` to survive roulette; None where it does not play.
    """

    leaving: PathState
    next_hit: Hit | None
    shadow: Shadow | None
    at: Interaction
    surface: Surface | None = None
    direct: DirectLight | None = None
    drawn: Drawn | None = None
    carried: Tensor | None = None
    chance: Tensor | None = None
    splat: Splat | None = None
