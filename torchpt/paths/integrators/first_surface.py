"""Integrators that stop at the first surface: one vertex, with at most one shadow ray.

Such an integrator returns a :class:`FirstSurface` from ``first``, whose stage runs in place of ``Integrator.bounce``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from torchpt.paths.integrators.base import Integrator, Limits
from torchpt.paths.state import StageContext, VertexInput, VertexOutput
from torchpt.physics.world import World

__all__ = ["FirstSurface", "FirstSurfaceIntegrator"]


class FirstSurface(ABC):
    """Shading of first surfaces.

    Implementations are frozen dataclasses: kernels read their tensors as data, and are compiled anew if other fields differ.
    """

    def again(self, world: World) -> FirstSurface:
        """Return the shading for ``world``, whose tensors are on an autograd tape.

        It is made again where it depends on tensors that require gradients; by default it does not, and is returned as it is.
        """
        return self

    def shadows(self, world: World) -> bool:
        """Return True if :meth:`bounce` returns shadow rays for any model."""
        return world.lights is not None

    @abstractmethod
    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        """Return the paths with the radiance of surfaces of one BSDF model added, and shadow rays. A stage.

        All paths end there.
        """


class FirstSurfaceIntegrator(Integrator):
    """Base class of integrators whose radiance is the emission of the first surface and the shading of :meth:`first`."""

    @property
    def limits(self) -> Limits:
        """Return limits that end paths at the first surface, after its light sample."""
        return Limits(max_depth=2, rr_depth=3, first_surface=True)
