"""Receivers of light that passes edges: paths by which the camera sees them, and how they move in the interior's frame.

Light that arrives at a receiver x is worth ``W(x)`` to the loss, by area of x. Where the camera sees x, that is the worth of
its place on the film times the film's area for one of the surface; else light is followed on by the BSDF of x, and the camera
connected with each vertex behind. The surfaces from the camera to x are the *prefix* of the path.

The interior differentiates paths in a frame of its own (:mod:`torchpt.physics.shapes.interaction`), in which points partly
slide along the rays that reach them. So x moves with all surfaces of its prefix::

    V(x_1) = S(camera's ray, x_1)
    V(x_k+1) = (1 - a) v(x_k+1) + a S(V(x_k), x_k+1)

with ``v`` the velocity of the surface's own point, ``S`` that of the point that slides along a ray whose origin moves, and
``a`` the share of :func:`torchpt.physics.shapes.interaction.slide_share`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.cotangents import Cotangents
from torchpt.gradients.edges.film import Worth, flat_places
from torchpt.gradients.edges.traced import Passing, Traced
from torchpt.gradients.edges.vertices import Spot, met
from torchpt.math.vectors import dot, lanes_of, largest, rows, take
from torchpt.paths.roulette import russian_roulette, survival_probability
from torchpt.physics.shapes.interaction import slide_share

__all__ = ["MovingFrame", "PathVertex", "Prefix", "one_of_each", "prefixes_of"]

#: Rounding of a point that the search finds, against its coordinates.
_ROUNDING = 2.0**-18
#: Along normals, against the rounding of the primitive: with more of it rays from a large floor would pass small bodies on it.
_LIFT = 2.0
#: Vertices after which light that reaches no camera is given up where paths have no limit of their own.
_MAX_VERTICES = 32
#: From this vertex on roulette plays.
_ROULETTE = 3
#: Random numbers of rays to the camera are as of vertices that prefixes do not have.
_TO_CAMERA = 1 << 12
#: What is met so far from a point, against the way to the camera, is behind that.
_TO_LENS = 2.0**-20


@dataclass(frozen=True)
class MovingFrame:
    """The frame of the interior, and what is seen in it.

    Attributes:
        bodies: detached.
        traced: what sees.
        worth: of places on the film.
        near: ``(1,)`` length over which points slide along their rays.
        moves: ``(P,)`` bool by ids of the search: primitives that move.
        holds_first: True: what the camera sees is held in place (:mod:`torchpt.gradients.camera`).
        camera_moves: True: the camera moves.
    """

    bodies: Bodies
    traced: Traced
    worth: Worth
    near: Tensor
    moves: Tensor
    holds_first: bool
    camera_moves: bool

    @property
    def follows_camera(self) -> bool:
        """Return True if what the camera sees moves with it."""
        return self.camera_moves and not self.holds_first

    def share(self, prim: Tensor, r: Tensor) -> Tensor:
        """Return the share ``(N,)`` by which points slide at the ends of rays of length ``r (N,)``; 1 where these miss."""
        world = self.traced.wave.context.world
        return torch.where(prim >= 0, slide_share(world, prim.clamp_min(0), r, self.near), 1.0)

    def rounding(self, prim: Tensor, *points: Tensor) -> Tensor:
        """Return the rounding of points ``(3, N)`` of primitives that the search finds ``(N,)``."""
        size = largest(self.bodies.sizes(prim))
        for p in points:
            size = torch.maximum(size, largest(p.abs()))
        return size * _ROUNDING

    def lift(self, prim: Tensor, n: Tensor) -> Tensor:
        """Return how far off primitives ``(N,)`` rays begin along their normals ``n (3, N)``; little if these are axes."""
        return _LIFT * self.bodies.rounding(n, prim)

    def emits(self, prim: Tensor) -> Tensor:
        """Return a mask of primitives ``(N,)`` that emit light."""
        world = self.traced.wave.context.world
        if world.lights is None or world.lights.row_of_prim is None:
            return torch.zeros_like(prim, dtype=torch.bool)
        return take(world.lights.row_of_prim, world.geometry.slot(prim)) >= 0

    def moving(self, prim: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of primitives that move; False where ``prim`` is -1."""
        return take(self.moves, prim.clamp_min(0)) & (prim >= 0)


@dataclass(frozen=True)
class PathVertex:
    """Vertices of paths from the camera, M lanes.

    Attributes:
        held: the points, held on their surfaces.
        p: where they are ``(3, M)``.
        n: geometric normals ``(3, M)``.
    """

    held: Held
    p: Tensor
    n: Tensor


@dataclass(frozen=True)
class Prefix:
    """Paths from the camera to M receivers, with as many surfaces each.

    Attributes:
        frame: of the interior.
        lane: ``(M,)`` the receivers.
        weight: ``(3, M)`` worth of the light that arrives at them, by area.
        moves: ``(M,)`` bool: the paths move.
        place: ``(2, M)`` of the paths on the film.
        lens: ``(2, M)`` samples of the lens that they pass; None: there is none.
        chain: vertices behind the camera, first that which it sees, of these paths and others; the last is the receiver.
        columns: ``(M,)`` for each of them: where it has those of these paths.
    """

    frame: MovingFrame
    lane: Tensor
    weight: Tensor
    moves: Tensor
    place: Tensor
    lens: Tensor | None
    chain: tuple[PathVertex, ...]
    columns: tuple[Tensor, ...]

    @property
    def count(self) -> int:
        """Return the number of vertices behind the camera."""
        return len(self.chain)

    @cached_property
    def vertices(self) -> list[PathVertex]:
        """Return the vertices of these paths: most are left out before anyone asks for them."""
        return [rows(vertex, column) for vertex, column in zip(self.chain, self.columns, strict=True)]

    def taken(self, index: Tensor) -> Prefix:
        """Return some of the lanes."""
        own = self.lane, self.weight, self.moves, self.place, self.lens, self.columns
        lane, weight, moves, place, lens, columns = rows(own, index)
        return Prefix(self.frame, lane, weight, moves, place, lens, self.chain, columns)

    def motion(self) -> Tensor:
        """Return about how far receivers move where all that moves does by 1 ``(M,)``."""
        how = (self.moves if self.frame.follows_camera else self.frame.moving(self.vertices[0].held.prim)).double()
        for before, vertex in pairwise(self.vertices):
            away = vertex.p - before.p
            share = self.frame.share(vertex.held.prim, dot(away, away).sqrt())
            how = (1.0 - share) * self.frame.moving(vertex.held.prim) + share * how
        return how

    def pull_back(self, cotangents: Cotangents, cotangent: Tensor) -> None:
        """Add the cotangents of all that moves receivers, by one of where these are in the interior's frame ``(3, M)``."""
        some = self.moves.nonzero().squeeze(1)
        if len(some) < len(self.lane):
            if len(some):
                self.taken(some).pull_back(cotangents, take(cotangent, some))
            return
        first, *others = self.vertices
        chain = [(before, vertex) for before, vertex in zip(self.vertices, others, strict=False)]
        for before, vertex in reversed(chain):
            away = vertex.p - before.p
            share = self.frame.share(vertex.held.prim, dot(away, away).sqrt())
            # The point of the vertex, in the part that slides, is that of the vertex before moved along the ray.
            slid = vertex.n * (dot(away, cotangent) / dot(vertex.n, away))
            cotangents.add_points(vertex.held, cotangent * (1.0 - share) + slid * share)
            cotangent = (cotangent - slid) * share
        if self.frame.holds_first:
            cotangents.add_points(first.held, cotangent)
            return
        o, d = self.frame.bodies.film.rays(self.place, self.lens)
        steep = dot(first.n, d)
        slid = first.n * (dot(d, cotangent) / steep)
        cotangents.add_points(first.held, slid)
        if self.frame.camera_moves:
            rest, away = cotangent - slid, self.frame.bodies.points(first.held) - o
            cotangents.add_rays(self.place, self.lens, rest, rest * (dot(first.n, away) / steep))


def prefixes_of(
    frame: MovingFrame,
    spot: Spot,
    wi: Tensor,
    key: Tensor,
    depth: int,
    behind: int,
    *,
    moves: Tensor | None = None,
    side: Tensor | None = None,
) -> list[Prefix]:
    """Return paths from the camera to receivers; those with the same number of vertices in one.

    Args:
        frame: of the interior.
        spot: the receivers.
        wi: ``(3, N)`` unit directions from which light arrives at them.
        key: the sampler's keys ``(rows, N)`` of the samples.
        depth: vertices of whole paths at most; -1: any number.
        behind: the least number of vertices between receiver and light, the light included.
        moves: ``(N,)`` bool: what the light passes moves; elsewhere only paths that move themselves are returned. None: all.
        side: ``(N,)`` where light arrives in the plane of the receivers' geometric normals, see :meth:`Spot.sent`.
    """
    longest = (depth if depth >= 0 else _MAX_VERTICES) - behind
    found: list[Prefix] = []
    lane = torch.arange(wi.shape[1], device=wi.device)
    carried = torch.ones_like(wi)
    chain, columns = (_vertex(frame, spot),), (lane,)
    every = torch.ones_like(lane, dtype=torch.bool)
    moving = every if frame.follows_camera else frame.moving(spot.hit.prim)
    for k in range(1, longest + 1):
        counts = take(every, lane) if moves is None else moving | take(moves, lane)
        index, place, lens, wo = _seen(frame, spot, counts, Passing(key, _TO_CAMERA + k))
        if len(index):
            seen = spot.taken(index)
            back = take(wi, index).to(spot.p)
            own = None if side is None else take(side, index)
            sent = seen.sent(wo.to(spot.p), back, own).double()
            area = frame.bodies.film.area(seen.p.double(), seen.n.double(), lens)
            weight = frame.worth.at(place) * sent * take(carried, index) * area
            own = take(lane, index), weight, take(moving, index), place, lens
            prefix = Prefix(frame, *own, chain, rows(columns, index))
            some = (weight != 0).any(0).nonzero().squeeze(1)
            if len(some):
                found.append(prefix.taken(some))
        if k == longest:
            break
        o, d, weight = spot.scattered(wi.to(spot.p), key, k + 1, side)
        side = None
        carried = carried * weight.double()
        alive = (carried != 0).any(0)
        if k >= _ROULETTE:
            draws = frame.traced.draws(key, k + 1)
            chance = survival_probability(None, 1.0, largest(carried.abs()), None)
            alive, carried = russian_roulette(chance, draws, alive, carried)
        on = lanes_of(alive)
        spot = met(frame.traced, take(o, on), take(d, on), Passing(take(key, on), k + 1))
        some = lanes_of(spot.hit.prim >= 0)
        kept = on if some is None else some if on is None else take(on, some)
        spot, (lane, key, carried) = spot.taken(some), rows((lane, key, carried), kept)
        if not len(lane):
            break
        moving = take(moving, kept) | frame.moving(spot.hit.prim)
        chain = _vertex(frame, spot), *chain
        columns = torch.arange(len(lane), device=wi.device), *rows(columns, kept)
        wi = -spot.d.double()
    return found


def one_of_each(prefixes: list[Prefix], u: Tensor) -> list[Prefix]:
    """Return one of the paths of each receiver, chosen by their worth and weighted by one over the chance.

    Args:
        prefixes: as from :func:`prefixes_of`, of N receivers.
        u: ``(N,)`` in [0, 1).
    """
    if len(prefixes) < 2:
        return prefixes
    worths = [largest(prefix.weight.abs()) for prefix in prefixes]
    total = torch.zeros_like(u)
    for prefix, worth in zip(prefixes, worths, strict=True):
        total[prefix.lane] += worth
    rest, chosen = u * total, list[Prefix]()
    for prefix, worth in zip(prefixes, worths, strict=True):
        before = take(rest, prefix.lane)
        rest[prefix.lane] -= worth
        some = ((before >= 0) & (before < worth)).nonzero().squeeze(1)
        if len(some):
            kept = prefix.taken(some)
            scale = take(take(total, prefix.lane) / worth, some)
            chosen.append(replace(kept, weight=kept.weight * scale))
    return chosen


def _vertex(frame: MovingFrame, spot: Spot) -> PathVertex:
    return PathVertex(spot.held(frame.bodies), spot.p.double(), spot.n.double())


def _seen(
    frame: MovingFrame, spot: Spot, counts: Tensor, passing: Passing
) -> tuple[Tensor, Tensor, Tensor | None, Tensor]:
    """Return which points the picture sees ``(n,)``, their places on the film and on the lens, and directions to the camera.

    Args:
        frame: of the interior.
        spot: the points.
        counts: mask ``(N,)`` of those that are looked at.
        passing: decides which surfaces between them rays pass by their opacity; its numbers choose points on the lens too.
    """
    film, x = frame.bodies.film, spot.p.double()
    lens = frame.traced.lens(passing.key, passing.depth)
    seen = film.of(x, lens)
    s = flat_places(seen)
    x0, x1, y0, y1 = frame.worth.bounds()
    counts = counts & (seen[2] > 0) & (seen[3] > 0) & (s[0] >= x0) & (s[0] <= x1) & (s[1] >= y0) & (s[1] <= y1)
    index = counts.nonzero().squeeze(1)
    s, x, lens = rows((s, x, lens), index)
    o, d = film.rays(s, lens)
    o = o.expand_as(d)
    # From the point: the rounding of a ray from far away is more than what may lie before the point.
    n, prim = take(spot.n, index).double(), take(spot.hit.prim, index)
    lift = torch.maximum(frame.lift(prim, n), largest(x.abs()) * _ROUNDING)
    begin = x - n * (torch.sign(dot(n, d)) * lift)
    passing = replace(passing, key=take(passing.key, index))
    some = (~frame.traced.blocked(begin, -d, dot(begin - o, d) * (1.0 - _TO_LENS), passing)).nonzero().squeeze(1)
    return take(index, some), take(s, some), rows(lens, some), -take(d, some)
