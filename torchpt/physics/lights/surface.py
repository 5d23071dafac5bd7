"""The base class of emissive surfaces, one kind for each kind of primitive. They emit on the side of the normal.

The functions of ``table.py`` call a kind with rows of the light table, gathered so that there is one for each of N lanes:
parameters named ``at``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import affine, dot, inverse_square
from torchpt.physics.lights.base import KINDS, Cone, Emitter
from torchpt.physics.lights.records import Lights
from torchpt.physics.shapes.geometry import KINDS as PRIMITIVES
from torchpt.physics.shapes.geometry import Quadrics
from torchpt.spec import Kinds

__all__ = ["SURFACES", "Faces", "Surface", "SurfaceSample", "emitter", "flat_inverse_pdf", "flat_point"]


@dataclass(frozen=True)
class SurfaceSample:
    """Points sampled on emissive surfaces."""

    p: Tensor  # (3, N)
    normal: Tensor  # (3, N) unit, on the side that emits
    uv: Tensor | None = None  # (2, N) the primitive's u, v; None for primitives without
    own: Tensor | None = None  # (3, N) the point in the quadric's object space; None for other kinds


@dataclass(frozen=True)
class Faces:
    """E emissive primitives of one kind."""

    e1: Tensor  # (3, E) first edge, as in LaneGeometry
    edge_cross: Tensor  # (3, E) cross product of the edges
    column: Tensor  # (E,) int64 index among the scene's primitives of the kind
    quadrics: Quadrics | None  # all quadrics of the scene
    frame: Tensor | None  # (12, Q) float64: p0 e1 e2 e3 of all quadrics


def flat_point(p0: Tensor, e1: Tensor, e2: Tensor, uv: Tensor) -> Tensor:
    """Return the point ``(3, N)`` at ``(u, v)`` of affine primitives."""
    return affine(p0, e1, uv[0], e2, uv[1])


def flat_inverse_pdf(normal: Tensor, area: Tensor, wi: Tensor, square: Tensor) -> Tensor:
    """Return ``1 / pdf`` in steradians of a point sampled by area, ``area cos / r^2``; 0 behind the emitter.

    Args:
        normal: unit normal on the emitting side ``(3, N)``.
        area: ``(N,)``.
        wi: unit direction toward the light ``(3, N)``.
        square: squared distance ``(N,)``.
    """
    cosine = (-dot(wi, normal)).clamp_min(0.0)
    return area * cosine * inverse_square(square)


class Surface(Emitter):
    """A kind of emissive primitive. This class implements flat ones; a method returns None where a kind is like these.

    Attributes:
        name: kind of primitive, from :data:`torchpt.physics.shapes.geometry.KINDS`.
        convex: whether it emits to all sides.
        area_factor: area over the length of the cross product of the edges: 1/2 for a triangle.
        needs_quadrics: whether sampling reads :class:`~torchpt.physics.shapes.geometry.Quadrics`.
    """

    convex: ClassVar[bool] = False
    area_factor: ClassVar[float] = 1.0
    needs_quadrics: ClassVar[bool] = False

    @classmethod
    def areas(cls, faces: Faces) -> tuple[Tensor, Tensor]:
        """Return the column ``Lights.area``, differentiable, and the areas in the world, detached; each ``(E,)`` float64."""
        # In float64: the fourth power of a length leaves float32 long before the length is extreme.
        cross_product = faces.edge_cross.double()
        area = dot(cross_product, cross_product).clamp_min(
            torch.finfo(torch.float64).tiny
        ).sqrt() * faces.edge_cross.new_tensor(cls.area_factor)
        return area, area.detach()

    @classmethod
    def bounds(cls, at: Lights, intensity: Tensor) -> Cone:
        """Bound the emission, as :meth:`Emitter.bounds`. A flat light has its whole ``intensity`` along the normal."""
        return super().bounds(at, intensity) if cls.convex else Cone(cos_o=1.0, cos_e=0.0, intensity=intensity)

    @classmethod
    def sample_area(cls, at: Lights, u: Tensor) -> SurfaceSample:
        """Sample points by area, with the density ``1 / size``; a quadric's is even in its object space.

        Args:
            at: rows of the table, one a lane.
            u: ``(2, N)`` in [0, 1).
        """
        raise NotImplementedError

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor) -> SurfaceSample:
        """Sample points as seen from ``x``, by default by area.

        Not called for kinds that :mod:`torchpt.physics.lights.solid_angle` samples.

        Args:
            at: rows of the table, one a lane.
            x: reference points ``(3, N)``; the sampled points are not differentiated in them.
            u: ``(2, N)`` in [0, 1).
        """
        return cls.sample_area(at, u)

    @classmethod
    def size(cls, at: Lights, normal: Tensor) -> Tensor | None:
        """Return one over the density by area ``(N,)`` at unit normals ``normal (3, N)``; None: ``Lights.area``."""
        return None

    @classmethod
    def bound(cls, at: Lights, normal: Tensor) -> Tensor | None:
        """Return rounding bounds ``(N,)`` at unit normals ``normal (3, N)``; None: ``Lights.bound``."""
        return None

    @classmethod
    def inverse_pdf(
        cls, at: Lights, x: Tensor, normal: Tensor, wi: Tensor, square: Tensor, by_area: Tensor
    ) -> Tensor | None:
        """Return ``1 / pdf`` in steradians ``(N,)`` of :meth:`sample`, 0 behind the emitting side; None: ``by_area``.

        Args:
            at: rows of the table, one a lane.
            x: reference points ``(3, N)``.
            normal: unit normal on the emitting side ``(3, N)``, at the sampled or hit point.
            wi: unit directions toward the point ``(3, N)``.
            square: squared distance ``(N,)``.
            by_area: ``area cos / r^2``, whose relative derivative becomes that of the result.
        """
        return None


#: The kinds of emissive surfaces.
SURFACES: Kinds[Surface] = Kinds("torchpt.physics.lights.surfaces", PRIMITIVES)


def emitter(name: str) -> type[Emitter]:
    """Return the class of a kind of ``Lights.kinds``."""
    return SURFACES[name] if name in SURFACES else KINDS[name]
