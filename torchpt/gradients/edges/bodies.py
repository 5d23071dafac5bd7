"""Surfaces, the camera and the lights as float64 tensors whose derivatives edges need, and points held on them.

A point of a primitive is affine in three numbers of its own: ``p0 + a0 e1 + a1 e2 + a2 e3``; of a sphere the axes are those of
the world times its radius. So curves of primitives are written in these numbers, and a point that is held on its surface is
its primitive and three constants. On an outline that slides over a round surface that is enough: the surface moves along the
line of sight there, so that its points and the outline have the same motion across the outline.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from torchpt.gradients.edges.film import FilmMap
from torchpt.math.vectors import affine, cross, dot, normalize, take
from torchpt.math.vectors import rows as columns
from torchpt.physics.cameras import Camera
from torchpt.physics.shapes.geometry import Instances
from torchpt.scene import Scene
from torchpt.scene.settings import Film
from torchpt.scene.world.primitives import copies_of, copy_maps, corners_of, primitives_of

__all__ = ["ROUNDING", "Bodies", "Held", "bodies_of"]

#: Rounding of places, against coordinates: parameters are of float32.
ROUNDING = 2.0**-22

#: A unit sphere as a row of :attr:`Bodies.forms`.
_BALL = (1.0, 0.0, 1.0, -math.inf, math.inf)


@dataclass(frozen=True)
class Held:
    """Points that stay on their primitives."""

    prim: Tensor  # (N,) int64 as the search gives them
    a: Tensor  # (3, N) float64


@dataclass(frozen=True)
class Bodies:
    """Places of primitives, camera and lights, float64.

    Attributes:
        p0, e1, e2: ``(3, P)``.
        e3: ``(3, Q)`` of the quadrics, which come last.
        counts: as in :class:`~torchpt.physics.shapes.geometry.Geometry`.
        copies: instances; None where there are none.
        forms: ``(5, Q)`` of the quadrics: ``bend shift level low high`` of :class:`~torchpt.physics.shapes.quadrics.Form`.
        camera: in the lanes' coordinates.
        lights: ``(3, L)`` where point and spot lights are, and where directional ones go, by their order among the sources.
    """

    p0: Tensor
    e1: Tensor
    e2: Tensor
    e3: Tensor
    counts: tuple[int, int, int, int, int]
    copies: Instances | None
    forms: Tensor
    camera: Camera
    lights: Tensor

    @cached_property
    def first_sphere(self) -> int:
        """Return the id of the first sphere."""
        return sum(self.counts[:3])

    @cached_property
    def first_quadric(self) -> int:
        """Return the id of the first quadric."""
        return sum(self.counts[:4])

    @cached_property
    def film(self) -> FilmMap:
        """Return where the camera sees points."""
        return FilmMap(self.camera)

    @cached_property
    def _flat(self) -> Tensor:
        """Return origins and two axes ``(9, P)`` in one table, as one look-up is faster than three."""
        return torch.cat((self.p0, self.e1, self.e2))

    @cached_property
    def _sizes(self) -> Tensor:
        """Return :meth:`sizes` of all primitives but for copies."""
        return _size(*self.place(torch.arange(self.p0.shape[1], device=self.p0.device)))

    def place(self, prim: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return origin and three axes ``(3, N)`` each of primitives ``(N,)``; the third of flat ones is zero."""
        table = None
        if self.copies is not None:
            column = torch.searchsorted(self.copies.start[1:], prim, right=True)
            table = columns(self.copies, column)
            prim = prim - table.start + table.first
        p0, x, y = take(self._flat, prim).view(3, 3, -1)
        z = torch.zeros_like(p0)
        if self.counts[4]:
            mine = prim >= self.first_quadric
            z = torch.where(mine, take(self.e3, (prim - self.first_quadric).clamp_min(0)), z)
        if self.counts[3]:
            ball = (prim >= self.first_sphere) & (prim < self.first_quadric)
            radius, one = x[0], torch.eye(3, dtype=p0.dtype, device=p0.device)
            x, y, z = (torch.where(ball, one[:, k : k + 1] * radius, axis) for k, axis in enumerate((x, y, z)))
        if table is not None:
            p0, x, y = _moved(table, p0) + table.move, _moved(table, x), _moved(table, y)
        return p0, x, y, z

    def sizes(self, prim: Tensor) -> Tensor:
        """Return sums ``(3, N)`` of the absolute coordinates of origin and axes of primitives ``(N,)``."""
        return take(self._sizes, prim) if self.copies is None else _size(*self.place(prim))

    def corners(self, prim: Tensor) -> list[Tensor]:
        """Return the four corners ``(3, N)`` of triangles and parallelograms; the last of a triangle is its first."""
        four = (prim >= self.counts[0]) & (prim < sum(self.counts[:2]))
        p0, x, y, _ = self.place(prim)
        return [p0, p0 + x, torch.where(four, p0 + x + y, p0 + y), torch.where(four, p0 + y, p0)]

    def boxes(self, prim: Tensor) -> tuple[Tensor, Tensor]:
        """Return lower and upper corners ``(3, N)`` of boxes about primitives ``(N,)``."""
        p0, x, y, z = self.place(prim)
        low, high = torch.minimum(x, y).clamp_max(0.0), torch.maximum(x, y).clamp_min(0.0)
        triangle = self.is_triangle(prim)
        four = ~triangle & (prim < sum(self.counts[:2]))
        if self.counts[1]:
            fourth = torch.where(four, x + y, 0.0)
            low, high = torch.minimum(low, fourth), torch.maximum(high, fourth)
        if any(self.counts[2:]):
            zero = torch.zeros_like(p0)
            ring = (x * x + y * y).sqrt()
            ball = (x * x + y * y + z * z).sqrt()
            tall = ~self.is_flat(prim) & torch.isfinite(self.forms_of(prim)[3])
            for mask, reach, up in ((~triangle & ~four, ball, zero), (tall, ring, z)):
                low = torch.where(mask, -reach + torch.minimum(up, zero), low)
                high = torch.where(mask, reach + torch.maximum(up, zero), high)
        return p0 + low, p0 + high

    def rounding(self, along: Tensor, *prims: Tensor) -> Tensor:
        """Return by how much rounding moves primitives ``(N,)`` along directions ``(3, N)``; little along an axis near 0."""
        size = sum(map(self.sizes, prims), torch.zeros(1, 1, dtype=along.dtype, device=along.device))
        return dot(along.abs(), size) * ROUNDING

    def points(self, held: Held) -> Tensor:
        """Return where points are ``(3, N)``."""
        p0, *axes = self.place(held.prim)
        return p0 + self.vectors(axes, held.a)

    def vectors(self, axes: Sequence[Tensor], a: Tensor) -> Tensor:
        """Return vectors ``(3, N)`` of numbers ``a (3, N)`` along the axes of :meth:`place`."""
        flat = torch.addcmul(axes[0] * a[0], axes[1], a[1])
        return torch.addcmul(flat, axes[2], a[2]) if self.counts[3] or self.counts[4] else flat

    def own(self, prim: Tensor, p: Tensor) -> Tensor:
        """Return the numbers ``(3, N)`` of points ``p (3, N)`` of primitives."""
        p0, x, y, z = self.place(prim)
        z = torch.where(self.is_flat(prim), cross(x, y), z)
        faces = cross(y, z), cross(z, x), cross(x, y)
        det = dot(x, faces[0])
        return torch.stack([dot(face, p - p0) for face in faces]) / det

    def normals(self, held: Held) -> Tensor:
        """Return unit normals ``(3, N)``, of any sign, at points of flat primitives and of quadrics with a known outline."""
        _, x, y, z = self.place(held.prim)
        n = cross(x, y)
        flat = self.is_flat(held.prim)
        if not bool(flat.all()):
            forms = self.forms_of(held.prim)
            slope = held.a[0], held.a[1], forms[0] * (held.a[2] - forms[1])
            round_n = cross(y, z) * slope[0] + cross(z, x) * slope[1] + n * slope[2]
            n = torch.where(flat, n, round_n)
        return normalize(n)

    def forms_of(self, prim: Tensor) -> Tensor:
        """Return the rows of ``forms (5, N)`` of round primitives ``(N,)``; of anything else those of a unit sphere."""
        ball = torch.tensor(_BALL, dtype=torch.float64, device=prim.device)[:, None].expand(5, len(prim))
        if not self.counts[4]:
            return ball
        mine = (prim >= self.first_quadric) & (prim < sum(self.counts))
        return torch.where(mine, take(self.forms, (prim - self.first_quadric).clamp(0, self.counts[4] - 1)), ball)

    def is_flat(self, prim: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of triangles, parallelograms and disks; copies are of meshes."""
        return (prim < self.first_sphere) | (prim >= sum(self.counts))

    def is_triangle(self, prim: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of triangles, copies of them included."""
        return (prim < self.counts[0]) | (prim >= sum(self.counts))

    def tensors(self) -> dict[str, Tensor]:
        """Return all that may move, by name."""
        found = {name: getattr(self, name) for name in ("p0", "e1", "e2", "e3", "lights")}
        if self.copies is not None:
            found |= {f"copies.{name}": getattr(self.copies, name) for name in ("x", "y", "z", "move")}
        own = ((f.name, getattr(self.camera, f.name)) for f in fields(self.camera))
        return found | {f"camera.{name}": value for name, value in own if isinstance(value, Tensor)}

    def having(self, tensors: Mapping[str, Tensor]) -> Bodies:
        """Return the same of other tensors, named as :meth:`tensors` names them."""

        def of(stem: str) -> dict[str, Tensor]:
            return {name.removeprefix(stem): t for name, t in tensors.items() if name.startswith(stem)}

        own = {name: tensors[name] for name in ("p0", "e1", "e2", "e3", "lights")}
        copies = None if self.copies is None else replace(self.copies, **of("copies."))
        return replace(self, **own, copies=copies, camera=replace(self.camera, **of("camera.")))


def _size(p0: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Return sums ``(3, N)`` of the absolute coordinates of an origin and three axes."""
    return p0.abs() + x.abs() + y.abs() + z.abs()


def _moved(table: Instances, w: Tensor) -> Tensor:
    return affine(table.x * w[0], table.y, w[1], table.z, w[2])


def bodies_of(scene: Scene, film: Film, params: Mapping[str, Tensor]) -> Bodies:
    """Return what moves in a scene under ``params``, differentiable in them."""
    built, space, merged = scene.built, scene.space, scene.merged(params)
    wide = torch.float64
    corners = [corners_of(part, merged, space, wide) for part in built.parts]
    primitives = primitives_of(built.parts, corners, wide, scene.device)
    copies = None
    if built.copies:
        copies = copies_of(copy_maps(built.parts, primitives.sizes, built.copies, merged, space), built.copies, wide)
    e3 = torch.zeros(3, 0, dtype=wide, device=scene.device) if primitives.frame is None else primitives.frame[9:12]
    places = []
    for source in built.sources:
        place = torch.zeros(3, dtype=wide, device=scene.device)
        if source.kind in ("point", "spot"):
            place = space.point(merged[f"{source.name}.position"])
        elif source.kind == "directional":
            place = normalize(merged[f"{source.name}.direction"].double()[:, None])[:, 0]
        places.append(place)
    lights = torch.stack(places, 1) if places else torch.zeros(3, 0, dtype=wide, device=scene.device)
    camera = scene.camera(film, merged, wide)
    forms = [part.quadric.form for part in built.parts if part.quadric is not None]
    table = [(form.bend, form.shift, form.level, form.low, form.high) for form in forms]
    quadrics = torch.tensor(table, dtype=wide, device=scene.device).reshape(-1, 5).T
    return Bodies(primitives.p0, primitives.e1, primitives.e2, e3, primitives.counts, copies, quadrics, camera, lights)
