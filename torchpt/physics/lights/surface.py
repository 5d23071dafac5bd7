"""What a surface that emits is: one kind for each kind of primitive. They shine from the side of their normal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import affine, dot, safe_reciprocal
from torchpt.physics.lights.base import KINDS, Cone, Emitter
from torchpt.physics.lights.records import Lights
from torchpt.physics.shapes.geometry import KINDS as PRIMITIVES
from torchpt.physics.shapes.geometry import Quadrics
from torchpt.spec import Kinds

__all__ = ["SURFACES", "Faces", "Surface", "SurfaceSample", "emitter", "flat_inverse_pdf", "flat_point"]


@dataclass(frozen=True)
class SurfaceSample:
    """Points drawn on surfaces."""

    p: Tensor  # (3, N)
    normal: Tensor  # (3, N) unit, of the side that emits
    uv: Tensor | None = None  # (2, N) in the primitive's own parametrization; None where that has none
    own: Tensor | None = None  # (3, N) in a quadric's own space


@dataclass(frozen=True)
class Faces:
    """E primitives of one kind that emit."""

    e1: Tensor  # (3, E)
    face: Tensor  # (3, E) cross product of the edges
    column: Tensor  # (E,) int64 among the scene's primitives of the kind
    quadrics: Quadrics | None  # of the scene
    frame: Tensor | None  # (12, Q) float64: p0 e1 e2 e3 of them


def flat_point(p0: Tensor, e1: Tensor, e2: Tensor, uv: Tensor) -> Tensor:
    """Return the point ``(3, N)`` at ``(u, v)`` of affine primitives."""
    return affine(p0, e1, uv[0], e2, uv[1])


def flat_inverse_pdf(normal: Tensor, area: Tensor, wi: Tensor, square: Tensor) -> Tensor:
    """Return ``1 / pdf`` in solid angle of a point drawn by area, ``area cos / r^2``; 0 behind the emitter.

    Args:
        normal: of the emitting side ``(3, N)``.
        area: ``(N,)``.
        wi: unit direction toward the light ``(3, N)``.
        square: squared distance ``(N,)``.
    """
    cosine = (-dot(wi, normal)).clamp_min(0.0)
    return area * cosine * safe_reciprocal(square)


class Surface(Emitter):
    """A kind of primitive as a light; as it stands a flat one. What a method gives as None is what flat ones share.

    Attributes:
        name: from :data:`torchpt.physics.shapes.geometry.KINDS`.
        convex: whether it shines to all sides.
        share: area over the length of the cross product of the edges.
        needs_quadrics: whether lanes need columns of :class:`~torchpt.physics.shapes.geometry.Quadrics`.
    """

    convex: ClassVar[bool] = False
    share: ClassVar[float] = 1.0
    needs_quadrics: ClassVar[bool] = False

    @classmethod
    def areas(cls, faces: Faces) -> tuple[Tensor, Tensor]:
        """``(E,)`` float64: the column ``Lights.area``, differentiable, and the surfaces' areas, detached."""
        # In float64: the fourth power of a length leaves float32 long before the length is extreme.
        wide = faces.face.double()
        area = dot(wide, wide).clamp_min(torch.finfo(torch.float64).tiny).sqrt() * faces.face.new_tensor(cls.share)
        return area, area.detach()

    @classmethod
    def bounds(cls, at: Lights, intensity: Tensor) -> Cone:
        """See :class:`Emitter`: seen face on a flat light is as bright as any of its power."""
        return super().bounds(at, intensity) if cls.convex else Cone(1.0, 0.0, intensity)

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor) -> SurfaceSample:
        """Points seen from ``x (3, N)``, for kinds that :mod:`torchpt.physics.lights.solid_angle` does not draw.

        Args:
            at: the lanes' rows of the table.
            x: reference points ``(3, N)``; the points on the light do not follow their derivative.
            u: ``(2, N)`` in [0, 1).
        """
        raise NotImplementedError

    @classmethod
    def size(cls, at: Lights, normal: Tensor) -> Tensor | None:
        """One over the density by area ``(N,)`` where the unit normal is ``normal (3, N)``; None: ``Lights.area``."""
        return None

    @classmethod
    def bound(cls, at: Lights, normal: Tensor) -> Tensor | None:
        """``(N,)`` in place of ``Lights.bound`` where the unit normal is ``normal (3, N)``; None: that."""
        return None

    @classmethod
    def inverse_pdf(
        cls, at: Lights, x: Tensor, normal: Tensor, wi: Tensor, square: Tensor, by_area: Tensor
    ) -> Tensor | None:
        """``1 / pdf`` in solid angle ``(N,)`` of :meth:`sample`, 0 behind the emitting side; None: ``by_area``.

        Args:
            at: the lanes' rows of the table.
            x: reference points ``(3, N)``.
            normal: of the emitting side ``(3, N)``, at the point drawn or met.
            wi: unit directions toward that ``(3, N)``.
            square: squared distance ``(N,)``.
            by_area: ``area cos / r^2``, whose derivative is that of the result.
        """
        return None


#: The kinds of surfaces that emit.
SURFACES: Kinds[Surface] = Kinds("torchpt.physics.lights.surfaces", PRIMITIVES)


def emitter(name: str) -> type[Emitter]:
    """The class of a kind among ``Lights.kinds``."""
    return SURFACES[name] if name in SURFACES else KINDS[name]
