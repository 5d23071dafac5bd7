"""Run the stages of a path, bound to one plan and scene, by tensor operations."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from torchpt.cameras import Camera
from torchpt.film import Filter
from torchpt.integrators import stages
from torchpt.integrators.stages import Plan
from torchpt.records import Hit, PathState, Shadow, World

__all__ = ["Stages"]

Search = Callable[[PathState], Hit]


class Stages:
    """The stages by tensor operations, on any device; the reference for kernels.

    Attributes:
        pixel: how large a pixel is in the world, see :func:`torchpt.integrators.surfaces.texture_point_at`;
            None where nothing asks.
    """

    def __init__(self, plan: Plan, world: World, pixel: Tensor | None = None) -> None:
        self.plan, self.world, self.pixel = plan, world, pixel

    def generate(self, camera: Camera, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """See :func:`torchpt.integrators.stages.generate`."""
        return stages.generate(self.plan, camera, filter, x, y, key, salts)

    def emit(self, state: PathState, hit: Hit, index: Tensor, slide: bool) -> Tensor:
        """See :func:`torchpt.integrators.stages.emit`."""
        return stages.emit(self.world, state, hit, index, slide)

    def escape(self, state: PathState, hit: Hit, index: Tensor) -> Tensor:
        """See :func:`torchpt.integrators.stages.escape`."""
        return stages.escape(self.world, state, hit, index)

    def bounce(
        self,
        model: int,
        roulette: float,
        slide: bool,
        search: Search,
        state: PathState,
        hit: Hit,
        index: Tensor,
        salts: Tensor,
    ) -> tuple[PathState, Hit | None, Shadow | None]:
        """See :func:`torchpt.integrators.stages.bounce`."""
        return stages.bounce(
            self.plan, self.world, model, roulette, slide, search, state, hit, index, salts, self.pixel
        )
