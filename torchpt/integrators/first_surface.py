"""Integrators that stop at the first surface: one vertex, with at most one shadow ray from it."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from torchpt.integrators.base import Integrator, Limits
from torchpt.integrators.stages import Plan
from torchpt.records import Hit, PathState, Shadow, World

__all__ = ["FirstSurface", "FirstSurfaceIntegrator"]


class FirstSurface(ABC):
    """What happens at first surfaces.

    Implementations are frozen dataclasses: kernels read their tensors as tables, and are made anew where another field differs.
    """

    def again(self, world: World) -> FirstSurface:
        """The same for its world under a tape: made anew where a derivative goes through it."""
        return self

    def shadows(self, world: World) -> bool:
        """Whether :meth:`shade` gives shadow rays for any model."""
        return world.lights is not None

    @abstractmethod
    def shade(
        self,
        plan: Plan,
        world: World,
        model: int,
        state: PathState,
        hit: Hit,
        salts: Tensor,
        pixel: Tensor | None,
        slide: bool,
    ) -> tuple[Tensor, Shadow | None]:
        """What surfaces of one model bring: pure, of n lanes.

        Args:
            plan: static needs.
            world: the scene's tensors.
            model: number of the BSDF model.
            state: camera rays.
            hit: what they met.
            salts: names of the dimensions.
            pixel: see :func:`torchpt.integrators.surfaces.texture_point_at`.
            slide: see :func:`torchpt.shapes.interact`.

        Returns:
            Radiance ``(3, n)``, and shadow rays whose light is still to be added (None: there are none).
        """


class FirstSurfaceIntegrator(Integrator):
    """Integrators whose radiance is what :meth:`first` says of the first surface, and what shines there by itself."""

    looped = True

    @property
    def limits(self) -> Limits:
        """See :class:`Integrator`."""
        return Limits(2, 3, first_surface=True)
