"""Integrators that stop at the first surface: one vertex, with at most one shadow ray from it."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torchpt.paths.integrators.base import Integrator, Limits
from torchpt.paths.state import StageContext, VertexInput, VertexOutput
from torchpt.physics.world import World

__all__ = ["FirstSurface", "FirstSurfaceIntegrator"]


class FirstSurface(ABC):
    """Events at first surfaces.

    Implementations are frozen dataclasses: kernels read their tensors as tables, and are made anew where another field differs.
    """

    def again(self, world: World) -> FirstSurface:
        """The same for its world under a tape: made anew where a derivative goes through it."""
        return self

    def shadows(self, world: World) -> bool:
        """Return True where :meth:`bounce` gives shadow rays for any model."""
        return world.lights is not None

    @abstractmethod
    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        """Return what surfaces of one BSDF model bring: pure, of n lanes.

        The paths leave with what the surfaces bring added to their radiance, and end there.
        """


class FirstSurfaceIntegrator(Integrator):
    """Integrators whose radiance is what :meth:`first` says of the first surface, and what shines there by itself."""

    @property
    def limits(self) -> Limits:
        """See :class:`Integrator`."""
        return Limits(2, 3, first_surface=True)
