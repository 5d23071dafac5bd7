"""The stages bound to one scene and plan, run eagerly, or compiled by torch on CUDA.

A CPU runs :mod:`torchpt.integrators.loop` instead.

Compiled, a stage is one graph for any number of lanes: whole-state tensors, the gather inside, the index padded to a
multiple of 16 by repeating its last lane. The extra lanes are exact duplicates of a path: they carry the same numbers and
write the same result twice, so nothing needs to know of them. (Under gradients they would count twice: eager only.)
"""

from __future__ import annotations

import copy
import types
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchpt.cameras import Camera
from torchpt.core.tree import leaves
from torchpt.film import Filter
from torchpt.integrators import stages
from torchpt.integrators.stages import Plan
from torchpt.records import Hit, PathState, Shadow, World

__all__ = ["CompiledStages", "Stages"]

#: Inductor writes what is used more than once out again for each use, unless it took more operations than this. Indices into
#: textures and the frames of maps are long chains in which each step uses the one before twice: beyond its own 50 that is
#: 2^50 visits, and compilation does not end. Of scenes without textures the default makes the faster code.
REALIZE = 10

Search = Callable[[PathState], Hit]


class Stages:
    """The stages, eager: always complete and correct.

    Attributes:
        pixel: how large a pixel is in the world, see :func:`torchpt.integrators.surfaces.texture_point_at`;
            None where nothing asks.
    """

    compiled = False

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

    def met(self, depth: int, state: PathState, hit: Hit) -> bool:
        """Told of each vertex, before anything is made of it; returns whether nobody wants to see more of these paths.

        Nobody listens but :class:`torchpt.integrators.recorder.Recorder`.
        """
        return False

    def cleared(self, clear: Tensor) -> None:
        """Told how much of the light ``(n,)`` of the latest bounce gets through."""


class CompiledStages(Stages):
    """The same stages through ``torch.compile``; forward only.

    Attributes:
        graphs: how many graphs each variant of a stage was compiled to so far; two at most.
    """

    compiled = True

    def __init__(self, plan: Plan, world: World, pixel: Tensor | None = None) -> None:
        super().__init__(plan, world, pixel)
        # Only lanes vary in number; a scene's tables do not.
        for table in leaves(world):
            torch._dynamo.mark_static(table)
        self.graphs: dict[str, int] = {}
        self._made: dict[tuple[Any, ...], Callable[..., Any]] = {}

    def through(self, pixel: Tensor | None) -> CompiledStages:
        """The same graphs for another camera."""
        if pixel is not None:
            torch._dynamo.mark_static(pixel)
        found = copy.copy(self)
        found.pixel = pixel
        return found

    def generate(self, camera: Camera, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """See :func:`torchpt.integrators.stages.generate`."""
        if len(x) % 16:  # the last chunk of a film: once a pass, not worth a graph
            return super().generate(camera, filter, x, y, key, salts)

        def stage(camera: Camera, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
            return stages.generate(self.plan, camera, filter, x, y, key, salts)

        variant = (*camera.kind(), *filter.kind())
        return self._get("generate", variant, stage)(camera, filter, x, y, key, salts)

    def emit(self, state: PathState, hit: Hit, index: Tensor, slide: bool) -> Tensor:
        """See :func:`torchpt.integrators.stages.emit`."""

        def stage(state: PathState, hit: Hit, index: Tensor) -> Tensor:
            return stages.emit(self.world, state, hit, index, slide)

        return self._get("emit", (slide,), stage)(state, hit, _padded(index))[:, : len(index)]

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

        def stage(
            state: PathState, hit: Hit, index: Tensor, salts: Tensor, pixel: Tensor | None
        ) -> tuple[PathState, Hit | None, Shadow | None]:
            return stages.bounce(self.plan, self.world, model, roulette, slide, search, state, hit, index, salts, pixel)

        name = f"bounce {self.world.materials.models[model]}"
        return self._get(name, (model, roulette, slide), stage)(state, hit, _padded(index), salts, self.pixel)

    def _get(self, name: str, variant: tuple[Any, ...], stage: Callable[..., Any]) -> Callable[..., Any]:
        """The compiled form of ``stage``, made once for each variant."""
        made = self._made.get((name, *variant))
        if made is None:
            made = self._made[name, *variant] = self._compile(" ".join((name, *map(str, variant))), stage)
        return made

    def _compile(self, name: str, stage: Callable[..., Any]) -> Callable[..., Any]:
        import torch._dynamo.config
        from torch._inductor.compile_fx import compile_fx
        from torch.fx.experimental import _config

        options: dict[str, Any] = {"assert_indirect_indexing": False}
        if any(table.count for table in self.world.textures.tables):
            options["realize_opcount_threshold"] = REALIZE

        def backend(graph: torch.fx.GraphModule, inputs: list[Tensor]) -> Any:
            self.graphs[name] = self.graphs.get(name, 0) + 1
            return compile_fx(graph, inputs, config_patches=options)

        config: Any = _config  # its `patch` is put there at run time
        # A code object of its own: dynamo counts graphs by code, and those of another scene are no business of this one.
        assert isinstance(stage, types.FunctionType)
        own = types.FunctionType(
            stage.__code__.replace(), stage.__globals__, stage.__name__, stage.__defaults__, stage.__closure__
        )
        run = torch.compile(own, dynamic=True, fullgraph=True, backend=backend)

        def call(*args: Any) -> Any:
            # Equal sizes are a coincidence, not a fact to compile in; and more than two graphs are an error, where the
            # default would fall back to eager with a line in a log.
            with (
                torch._dynamo.config.patch(recompile_limit=2, fail_on_recompile_limit_hit=True),
                config.patch(use_duck_shape=False),
            ):
                return run(*args)

        return call


def _padded(index: Tensor) -> Tensor:
    """The lanes with the last one repeated up to a multiple of 16, in fresh memory."""
    extra = -len(index) % 16
    return torch.cat((index, index[-1:].expand(extra))) if extra else index.clone()
