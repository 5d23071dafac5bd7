"""Faces that are shaded smooth end light at their own plane, which turns with the face.

Light from below the plane of a face does not count where the shading normal differs from the geometric one
(:func:`torchpt.paths.vertex.same_hemisphere`). There the integrand ``f cos_s`` jumps from a value to 0, so the plane's horizon
is a boundary. With ``n`` the geometric normal on the side that counts, ``ω`` on the horizon and ``y`` what is seen there at
distance r, the derivative of the loss is the integral over the surface and over the angle ``φ`` of ``ω`` of::

    W(x) f cos_s L(ω) [dn·ω + (1 - a) n·(V(y) - V(x)) / r]

in the frame of :mod:`torchpt.gradients.edges.receivers`; ``a`` is 1 for the sky. On flat shading ``f cos_s`` is 0 there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.cotangents import Cotangents
from torchpt.gradients.edges.curves import smooth_faces
from torchpt.gradients.edges.receivers import MovingFrame, Prefix, prefixes_of
from torchpt.gradients.edges.traced import Use
from torchpt.gradients.edges.vertices import TILT, Spot, met
from torchpt.math.guiding import Round
from torchpt.math.sampling import Distribution1D, uniform_triangle
from torchpt.math.vectors import cross, dot, normalize, take
from torchpt.paths.transmission import opacity_at
from torchpt.physics.samplers import Dimension
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit
from torchpt.scene import Scene

__all__ = ["HorizonSamples", "Horizons", "horizons_of"]


@dataclass(frozen=True)
class HorizonSamples:
    """Samples of horizons; the derivative of the loss is that of :meth:`sum`.

    Attributes:
        frame: of the interior.
        face: the points on faces.
        n: geometric normals on the side that counts ``(3, N)``.
        omega: directions in their planes ``(3, N)``.
        seen: what is seen there.
        r: ``(N,)`` how far it is.
        share: ``(N,)`` by which it slides.
        prefixes: of the faces' points, each with the light ``(M,)``.
    """

    frame: MovingFrame
    face: Held
    n: Tensor
    omega: Tensor
    seen: Held
    r: Tensor
    share: Tensor
    prefixes: list[tuple[Prefix, Tensor]]

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``; of no meaning but for its derivative."""
        cotangents, opens, ends = Cotangents(self.frame.moves), torch.zeros_like(self.r), torch.zeros_like(self.r)
        turns = (1.0 - self.share) / self.r
        for prefix, light in self.prefixes:
            turned = take(turns, prefix.lane) * light
            opens.index_add_(0, prefix.lane, light)
            ends.index_add_(0, prefix.lane, turned)
            prefix.pull_back(cotangents, take(self.n, prefix.lane) * -turned)
        cotangents.add_points(self.seen, self.n * ends)
        _, x, y, _ = bodies.place(self.face.prim)
        n = normalize(cross(x, y))
        turning = dot(n * torch.sign(dot(n.detach(), self.n)), self.omega)
        return (turning * opens).sum() + cotangents.sum(bodies)


@dataclass(frozen=True)
class Horizons:
    """The estimator of one render.

    Attributes:
        frame: of the interior.
        prim: faces that are shaded smooth ``(F,)``.
        choice: of a face, by area and by how far its normals are from the geometric one.
        area: of each ``(F,)``.
        depth: vertices of paths at most; -1: any number.
    """

    frame: MovingFrame
    prim: Tensor
    choice: Distribution1D
    area: Tensor
    depth: int

    @torch.no_grad()
    def samples(self, turn: Round, first: int, count: int) -> HorizonSamples | None:
        """Return samples ``first .. first + count`` of a round; None where none of them counts."""
        traced, bodies = self.frame.traced, self.frame.bodies
        number, key, u, coin = traced.edges(turn, first, count, Use.HORIZONS)
        draws = traced.draws(key)
        numbers = torch.stack((u, draws.two(Dimension.BSDF)[0].double(), *draws.two(Dimension.LIGHT).double()))
        drawn, scale = turn.draw(numbers)
        u, angle, *place = drawn
        place, angle = torch.stack(place), 2.0 * math.pi * angle
        index, _ = self.choice.draw(u)
        weight = take(self.area, index) * (2.0 * 2.0 * math.pi) * scale / take(self.choice.pmf, index)
        prim, uv = take(self.prim, index), uniform_triangle(place)
        face = Held(prim, torch.cat((uv, torch.zeros_like(uv[:1]))))
        x = bodies.points(face)
        _, e1, e2, _ = bodies.place(prim)
        side = torch.where(coin < 0.5, 1.0, -1.0).double()
        across, along = normalize(cross(e1, e2)), normalize(e1)
        omega = along * torch.cos(angle) + cross(across, along) * torch.sin(angle)
        spot = self._spot(prim, uv, x, omega)
        if traced.has_opacity:  # no ray has stopped at these points
            world = traced.wave.context.world
            weight = weight * opacity_at(world, spot.o, spot.d, spot.hit, miss=1.0).double()
        n = spot.n.double() * side
        o, d = x + n * self.frame.rounding(prim, x), normalize(omega + n * TILT)
        y = met(traced, o, d, traced.of_paths(number, Use.BEHIND))
        r = torch.where(y.hit.prim >= 0, y.hit.t.double(), 1.0)
        moves = self.frame.moving(prim) | self.frame.moving(y.hit.prim)
        prefixes = []
        for prefix in prefixes_of(
            self.frame, spot, omega, key, self.depth, behind=1, moves=moves, side=side.to(spot.p)
        ):
            lane, depth = prefix.lane, self.depth if self.depth < 0 else self.depth - prefix.count
            light = traced.radiance(take(o, lane), take(d, lane), take(number, lane), Use.BEHIND, depth)
            prefixes.append((prefix, (light * prefix.weight).sum(0) * take(weight, lane)))
        if turn.memory is not None:
            brought = torch.zeros_like(u)
            for prefix, light in prefixes:
                brought.index_add_(0, prefix.lane, light.abs())
            turn.record(drawn, scale, brought)
        seen, share = y.held(bodies), self.frame.share(y.hit.prim, r)
        return HorizonSamples(self.frame, face, n, omega, seen, r, share, prefixes) if prefixes else None

    def _spot(self, prim: Tensor, uv: Tensor, x: Tensor, omega: Tensor) -> Spot:
        """Return the points of faces as what rays met."""
        dtype, world = self.frame.traced.dtype, self.frame.traced.wave.context.world
        hit = Hit(torch.zeros_like(x[0]).to(dtype), prim, uv[0].to(dtype), uv[1].to(dtype))
        at = interact(world, x.to(dtype), omega.to(dtype), hit)
        return Spot(self.frame.traced, x.to(dtype), omega.to(dtype), hit, at.p, at.ng)


def horizons_of(scene: Scene, frame: MovingFrame, depth: int) -> Horizons | None:
    """Return the estimator; None where no face is shaded smooth.

    Args:
        scene: the scene.
        frame: of the interior.
        depth: vertices of paths at most; -1: any number.
    """
    geometry = frame.traced.wave.context.world.geometry
    if geometry.normals is None or 0 <= depth < 2:
        return None
    prim, area = smooth_faces(scene, frame.bodies)
    if not len(prim):
        return None
    dtype, apart = geometry.p0.dtype, torch.zeros_like(area)
    for u, v in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)):
        uv = torch.tensor([[u], [v]], dtype=dtype, device=prim.device).expand(2, len(prim))
        hit = Hit(torch.zeros_like(uv[0]), prim, uv[0], uv[1])
        at = interact(frame.traced.wave.context.world, uv.new_zeros(3, len(prim)), uv.new_ones(3, len(prim)), hit)
        off = at.ns.double() - at.ng.double()
        apart = torch.maximum(apart, dot(off, off).sqrt())
    weight = area * apart
    if not bool((weight > 0).any()):
        return None
    return Horizons(frame, prim, Distribution1D.of(weight, torch.float64, even=0.0), area, depth)
