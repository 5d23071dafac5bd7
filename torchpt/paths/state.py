"""Records of paths: their state, and the inputs and outputs of stages.

A stage is a pure function of a :class:`StageContext` and a :class:`VertexInput` that does one step of a vertex
(:mod:`torchpt.paths.vertex`). The stage of a surface returns a :class:`VertexOutput` with all intermediate values that an
observer may read; compiled stages drop those that nobody reads.

Each path has a lane, an index of the last axis. N is the number of paths of a wave, n the number of those that one stage runs
for, such as the paths that hit one BSDF model. Lengths are in the world's unit, directions in world coordinates.
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
    from torchpt.paths.surface import Surface
    from torchpt.physics.cameras import Camera
    from torchpt.physics.film import Filter

__all__ = [
    "EXTRA",
    "STRATEGIES",
    "T_MAX",
    "DirectLight",
    "Drawn",
    "Emission",
    "End",
    "Field",
    "Partner",
    "PathState",
    "Photon",
    "Plan",
    "Shadow",
    "Splat",
    "StageContext",
    "StoredVertex",
    "Transmission",
    "VertexInput",
    "VertexOutput",
    "no_search",
    "no_shadow",
]


# ---- The state of paths and their shadow rays


@dataclass(frozen=True)
class PathState:
    """State of paths, one path a lane."""

    o: Tensor  # (3, N) ray origin
    d: Tensor  # (3, N) ray direction, unit
    t_max: Tensor  # (N,) end of the ray: T_MAX, or inf at the camera; 0 once the path has ended
    throughput: Tensor  # (3, N) product of BSDF weights so far, over the chances of roulette
    radiance: Tensor  # (3, N) gathered so far
    pdf: Tensor  # (N,) density with which d was sampled: inf where emission counts whole, 0 where it does not count
    lane: Tensor  # (N,) int64 index of the sample in the wave
    key: Tensor  # (rows, N) int32: tells the sampler which sample of which pixel the path is; rows depend on its kind
    eta: Tensor | None = None  # (N,) index of refraction here over that at the camera; None where nothing refracts
    #: (3, N) the last vertex, which d leaves, and the normal that `lights.sample` was given there, 0 where light comes from
    #: both sides; None where the light sampler does not depend on the point.
    p: Tensor | None = None
    n: Tensor | None = None
    #: The integrator's own fields by name, see :class:`torchpt.paths.state.Field`; `(N,)` or `(rows, N)` each.
    extra: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class Shadow:
    """Shadow rays, and the radiance that is added to a path where its shadow ray is not blocked."""

    o: Tensor  # (3, N) origin, moved off the surface
    d: Tensor  # (3, N) from the origin to the light, not unit; unit where the light is infinitely far away
    t_max: Tensor  # (N,) in units of |d|; 0 where the contribution is zero
    radiance: Tensor  # (3, N) contribution of the light sample


# ---- Static configuration of the stages


#: mis: light and BSDF sampling combined; bsdf, light: one of them; uniform: directions uniform over the hemisphere.
STRATEGIES = ("mis", "bsdf", "light", "uniform")
#: ``t_max`` of a path that goes on. Finite, so that its product with 0 is the ``t_max`` of a path that ended.
T_MAX = torch.finfo(torch.float32).max


@dataclass(frozen=True)
class Plan:
    """Static configuration of a render's stages: the same for all lanes and vertices."""

    sampler: Points
    strategy: str  # one of STRATEGIES
    rr_prob: float | None  # constant survival probability; None: by throughput
    dark_rims: bool  # smooth shading is dark where its normal faces away
    dtype: torch.dtype  # of the lanes
    tape: bool  # the stages run on an autograd tape
    attached: bool  # geometry is differentiated too: some parameter moves points


# ---- The records of a path vertex: inputs and outputs of its stages


def no_search(state: PathState) -> Hit:
    """Raise an AssertionError: the default of :attr:`StageContext.search`, for stages that must not search."""
    raise AssertionError("hits are found between stages where no geometry is differentiated")


def no_shadow(state: PathState) -> Shadow:
    """Return shadow rays of length 0 and radiance 0, one for each path."""
    nothing = torch.zeros_like(state.o)
    return Shadow(o=nothing, d=nothing, t_max=torch.zeros_like(state.t_max), radiance=nothing)


#: Prefix of an integrator's fields where their names stand beside those of the path state.
EXTRA = "extra."


@dataclass(frozen=True)
class Field:
    """A field of an integrator's own in the path state: one number or several; engines allocate it.

    Attributes:
        name: its key in ``state.extra``, where it is ``(N,)``, or ``(rows, N)`` for several rows.
        rows: how many numbers it has.
        start: its value where paths begin.
        whole: True: a 32-bit integer, which stages see as int64, without derivatives. False: of the lanes' dtype,
            differentiated.

    Raises:
        ValueError: ``rows`` below 1, or a ``start`` with a fraction where the field is whole.
    """

    name: str
    rows: int = 1
    start: float = 0.0
    whole: bool = False

    def __post_init__(self) -> None:
        if self.rows < 1 or (self.whole and self.start != int(self.start)):
            raise ValueError(f"the field {self.name}: rows >= 1, and a whole start where it is whole")

    def begin(self, like: Tensor) -> Tensor:
        """Return the initial values for N paths; ``like (N,)`` has their dtype and device."""
        shape = (len(like),) if self.rows == 1 else (self.rows, len(like))
        dtype = torch.int64 if self.whole else like.dtype
        return torch.full(shape, self.start, dtype=dtype, device=like.device)


@dataclass(frozen=True)
class StageContext:
    """Inputs of a stage that are the same for all lanes.

    A wave has one for all of its vertices; :meth:`at` returns it with the values of one vertex.

    Attributes:
        plan: static configuration of the render.
        world: the scene's tensors.
        pixel: ``(5,)`` footprint of a pixel, as :meth:`torchpt.physics.cameras.base.Camera.pixel` returns it; None: textures
            are not filtered.
        near: ``(1,)`` length over which points slide along their rays in place of being held, see
            :func:`torchpt.physics.shapes.interaction.reattach`; None where geometry is not differentiated.
        salts: ``(len(Dimension),)`` int32, the hashed random dimensions of this vertex: with a path's key they give its random
            numbers, see :func:`torchpt.physics.samplers.salts`.
        follow_ray: True: hit points are intersected anew along their rays, see :func:`torchpt.physics.shapes.interact`.
        roulette: upper bound of the survival probability; 0: no roulette at this vertex. A tensor ``(1,)`` in kernels for any.
        search: returns the hits of rays that leave; called only where ``plan.attached``.
        camera: the camera of the picture; None outside :meth:`torchpt.paths.integrators.base.Integrator.generate` for an
            integrator without splats.
        filter: the reconstruction filter; None as above.
        crop: ``(x, y, width, height)`` of the picture on the camera's film, in pixels; None for an integrator without splats.
        start_salts: salts of depth 0, at the first vertex of a path that started on a light; None elsewhere.
        depth: number of the vertex, 1 at the first hit; in kernels a tensor ``(1,)`` int32. 0 in stages before a vertex.
        merging: ``(1,)`` ratio of densities of a merge, with which weights count; None for an integrator without merges.
    """

    plan: Plan
    world: World
    pixel: Tensor | None = None
    near: Tensor | None = None
    salts: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int32))
    follow_ray: bool = False
    roulette: float | Tensor = 0.0
    search: Callable[[PathState], Hit] = no_search
    camera: Camera | None = None
    filter: Filter | None = None
    start_salts: Tensor | None = None
    crop: tuple[int, int, int, int] | None = None
    depth: int | Tensor = 0
    merging: Tensor | None = None

    def at(
        self,
        salts: Tensor,
        follow_ray: bool = False,
        roulette: float | Tensor = 0.0,
        search: Callable[[PathState], Hit] = no_search,
        start_salts: Tensor | None = None,
        depth: int | Tensor = 0,
    ) -> StageContext:
        """Return the context of one vertex: a copy with its dimensions, bound of roulette, search and depth."""
        return replace(
            self,
            salts=salts,
            follow_ray=follow_ray,
            roulette=roulette,
            search=search,
            start_salts=start_salts,
            depth=depth,
        )


@dataclass(frozen=True)
class Partner:
    """Vertices of light paths that vertices of camera paths may be connected to, one for each.

    Attributes:
        p: ``(3, n)`` the points.
        model: ``(n,)`` int64 index of the BSDF model there; -1: none.
        depth: ``(n,)`` int64 number of the vertex on its light path.
        count: ``(n,)`` int64 number of vertices of the light path, of which this one was chosen at random.
    """

    p: Tensor
    model: Tensor
    depth: Tensor
    count: Tensor


@dataclass(frozen=True)
class Photon:
    """Light paths as they arrive at surfaces.

    Attributes:
        d: ``(3, n)`` unit directions of arrival.
        value: ``(3, n)`` flux. At a vertex of a camera path: that of all photons nearby, for which this one stands, over area
            and number of light paths; 0 where there is none.
        dvcm: ``(n,)`` of the arrival, see :mod:`torchpt.paths.integrators.weights`.
        dvc: ``(n,)`` likewise.
        depth: ``(n,)`` int64 number of the vertex on its light path.
    """

    d: Tensor
    value: Tensor
    dvcm: Tensor
    dvc: Tensor
    depth: Tensor


@dataclass(frozen=True)
class VertexInput:
    """Inputs of a stage that differ from lane to lane.

    Attributes:
        state: the paths as they arrive at the vertex.
        hit: the nearest hits of their rays.
        partner: vertices of light paths, for an integrator that connects paths; else None.
        photon: light paths that arrive nearby, for an integrator that merges paths; else None.
    """

    state: PathState
    hit: Hit
    partner: Partner | None = None
    photon: Photon | None = None


@dataclass(frozen=True)
class Transmission:
    """Result of one step of rays through surfaces that are not opaque, or through media.

    Attributes:
        on: ``(n,)`` bool, True where the ray passes and is searched again; the others stop at their hit.
        o: ``(3, n)`` new origins of rays that pass straight on; ``t`` is still counted from where such a ray began.
        scattered: ``(n,)`` bool, True where a medium scattered the ray; None: nowhere.
        state: the scattered rays, with new origins, directions, pdfs and fields; ``t_max`` 0 ends a path. Their throughput is
            not changed.
        chance: ``(n,)`` factor of value 1 whose derivative is that of the probability of this outcome, over the probability;
            None: it has no derivative.
    """

    on: Tensor
    o: Tensor
    scattered: Tensor | None = None
    state: PathState | None = None
    chance: Tensor | None = None


@dataclass(frozen=True)
class Emission:
    """Emission of emitters, or of the environment, that rays of paths hit.

    Attributes:
        radiance: ``(3, n)`` emitted toward the path.
        pdf: ``(n,)`` density per solid angle with which light sampling would have chosen the point.
        weight: ``(n,)`` MIS weight.
        brought: ``(3, n)`` contribution to the sample: throughput × radiance × weight.
    """

    radiance: Tensor
    pdf: Tensor
    weight: Tensor
    brought: Tensor


@dataclass(frozen=True)
class DirectLight:
    """A light sample at a vertex (next event estimation), before its shadow ray is traced.

    Attributes:
        sample: the points on the lights.
        radiance: ``(3, n)`` of the light, with its textures.
        reflected: ``(3, n)`` value of the BSDF times the cosine.
        share: ``(n,)`` factor of the shading normal: below 1 where perturbed normals shadow, 0 on the back of a one-sided
            surface and where the two normals disagree; None: 1.
        pdf: ``(n,)`` density with which BSDF sampling would have chosen the direction; None without MIS.
        weight: ``(n,)`` MIS weight; None: 1.
    """

    sample: LightSample
    radiance: Tensor
    reflected: Tensor
    share: Tensor | None
    pdf: Tensor | None
    weight: Tensor | None


@dataclass(frozen=True)
class Drawn:
    """The next ray, sampled from the BSDF."""

    o: Tensor  # (3, n) origin of the next ray, detached
    d: Tensor  # (3, n) its direction in the world, detached until `torchpt.paths.vertex.attach`
    wi: Tensor  # (3, n) direction in the local frame; that of a delta lobe is differentiable
    pdf: Tensor  # (n,) detached; inf where the lobe is a delta
    weight: Tensor  # (3, n) = eval / pdf
    least: Tensor  # (n,) least of all values that must be positive: positive where the sample is valid
    sharp: Tensor | None  # (n,) bool, True where the lobe is a delta; None: the model has no delta
    eta: Tensor | None  # (n,) index of refraction on the side of wi over that on the side of wo; None: nothing refracts


@dataclass(frozen=True)
class Splat:
    """Radiance that a vertex adds to pixels other than the one of its own sample.

    A pixel holds the sum of its splats divided by the number of samples a pixel. The choice of the pixel has no derivative.

    Attributes:
        pixel: ``(n,)`` int64 index of the pixel in the picture, row by row; -1: no splat.
        light: shadow rays with the radiance to add where they arrive; one with ``t_max`` 0 is not traced, and arrives.
    """

    pixel: Tensor
    light: Shadow


@dataclass(frozen=True)
class StoredVertex:
    """Vertices of light paths, to be kept where camera paths may be connected to them.

    Attributes:
        where: for each block of the store (:mod:`torchpt.paths.store`) ``(n,)`` bool, True where the vertex replaces the one
            before.
        p: ``(3, n)`` the points.
        model: index of their BSDF model; -1: they cannot be connected.
        depth: number of the vertex, as in :class:`StageContext`.
        count: number of vertices that the light path could have kept by now.
        dvcm: ``(n,)`` replaces the field of that name, which is one of the ray before.
    """

    where: tuple[Tensor, ...]
    p: Tensor
    model: int
    depth: int | Tensor
    count: int | Tensor
    dvcm: Tensor


@dataclass(frozen=True)
class End:
    """Ends of connections: points of paths, and what they do with light that comes from the other end, or goes there.

    Attributes:
        p: ``(3, n)`` the points.
        o: ``(3, n)`` origins of rays to the other end, moved off the surface.
        value: ``(3, n)`` throughput of the path times the value of the BSDF, times the cosine of the geometric normal at a
            light path's end, that of the shading normal at a camera path's.
        pdf: ``(n,)`` density per solid angle with which the path would go on to the other end.
        others: ``(n,)`` ratio of densities to strategies that end nearer to the path's start, over that of the path
            (:mod:`torchpt.paths.integrators.weights`).
        cosine: ``(n,)`` of the direction to the other end and the geometric normal.
        partner: ``(n,)`` int64 index of the BSDF model of the other end; -1: they are not connected. -1 in ends of light paths,
            of which nobody asks it.
    """

    p: Tensor
    o: Tensor
    value: Tensor
    pdf: Tensor
    others: Tensor
    cosine: Tensor
    partner: Tensor


@dataclass(frozen=True)
class VertexOutput:
    """Outputs of a vertex on surfaces of one BSDF model.

    Attributes:
        leaving: the paths with their next rays; ``t_max`` is 0 where a path ended.
        next_hit: the hits of these rays, where geometry is differentiated; else None.
        shadow: shadow rays, which the engine traces to add their contributions; None where no light is sampled.
        at: the surface points.
        splat: radiance for other pixels; None: none. Only integrators that declare ``splats`` return it.
        kept: what connections need of the vertex; None: it is not kept.
        end: the camera path's end of a connection; None: the vertex has none.
        photon: light paths as they arrive at ``at``, to be merged with camera paths; None: they are not.
        surface: the points with their materials; None where the stage did not resolve them.
        direct: the light sample; None where no light was sampled.
        drawn: the BSDF sample; None where paths end here.
        carried: ``(3, n)`` throughput before roulette; None where paths end here.
        chance: ``(n,)`` survival probability; None without roulette.
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
    kept: StoredVertex | None = None
    end: End | None = None
    photon: Photon | None = None
