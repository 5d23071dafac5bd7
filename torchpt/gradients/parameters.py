"""From parameters to what waves read, differentiated once a backward pass, and what moves with which parameter.

The *assembly* makes world, camera and what belongs to them of the parameters (:mod:`torchpt.scene.world`). Chunks of lanes are
differentiated with respect to its tensors, and their sums go back through it at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchpt.core.memory import Budget, Span
from torchpt.core.tree import map_leaves
from torchpt.math.sums import GradientSums
from torchpt.paths.adjoint import Tape
from torchpt.paths.wave import Wave
from torchpt.ranks import Group, blocks
from torchpt.scene import Scene
from torchpt.scene.prepare import make_wave
from torchpt.scene.settings import Settings
from torchpt.spec import Moves

__all__ = ["SceneTape", "attached"]


# ---- What parameters move: decided once, from their specs, so that a derivative by a colour costs nothing for geometry


def attached(scene: Scene, names: Iterable[str]) -> bool:
    """Whether any of the parameters moves surfaces or the camera, or bends rays that a delta lobe sends on."""
    owners = [*scene.built.parts, *scene.built.copies]
    bending = {material.name for owner in owners for material in owner.material.all() if material.bends}

    def moves(name: str) -> bool:
        moved = scene.spec(name).moves
        if moved is Moves.RAYS:  # by the material's name, or by a texture that any of them may read
            return any(name.startswith(f"{own}.") for own in bending) or bool(bending and "textures." in name)
        return moved is Moves.SURFACES

    return any(map(moves, names))


# ---- From parameters to what waves read, differentiated once a backward pass


class SceneTape(Tape):
    """Tensors that the waves of a backward pass read, as functions of parameters.

    Args:
        scene: whose.
        settings: of the backward pass.
        params: tensors in place of the scene's.
        wanted: names of those that are differentiated.
        captured: tensors that stages use by themselves, such as weights of modules.
        dtype: of the lanes.
        attached: whether geometry is differentiated.
        ranks: those that share the pixels; None: there is but one process.
        rays: in place of the camera's, see :func:`torchpt.scene.prepare.make_wave`.
        by_rays: whether they are differentiated too.
    """

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        params: Mapping[str, Tensor],
        wanted: Sequence[str],
        captured: Sequence[Tensor],
        dtype: torch.dtype,
        attached: bool,
        ranks: Group | None = None,
        rays: tuple[Tensor, Tensor] | None = None,
        by_rays: bool = False,
    ) -> None:
        self._ranks = ranks
        self._inputs = [params[name].detach().requires_grad_() for name in wanted]
        if rays is not None:
            o, d = rays = rays[0].detach().requires_grad_(by_rays), rays[1].detach().requires_grad_(by_rays)
            self._inputs += [o, d] if by_rays else []
        given = {name: value.detach() for name, value in params.items()} | dict(zip(wanted, self._inputs, strict=False))
        with torch.enable_grad():
            made = make_wave(scene, settings, given, dtype, True, attached, rays=rays)
        self._outputs: list[Tensor] = []
        primals: dict[int, Tensor] = {}
        leaves: dict[int, Tensor] = {}

        def detached(tensor: Tensor) -> Tensor:
            if not tensor.requires_grad or (tensor.is_leaf and id(tensor) not in inputs):
                return tensor
            if id(tensor) not in primals:
                primals[id(tensor)] = tensor.detach()
                self._outputs.append(tensor)
            return primals[id(tensor)]

        def leaf(tensor: Tensor) -> Tensor:
            return leaves.get(id(tensor), tensor)

        inputs = {id(tensor) for tensor in self._inputs}
        wave = _over(made, detached)
        ones = [primals[id(tensor)] for tensor in self._outputs]
        leaves |= {id(one): one.detach().requires_grad_() for one in ones}
        super().__init__(wave, _over(wave, leaf), [leaves[id(one)] for one in ones], ones, tuple(captured))

    def blocks(self, pixels: int, samples: int) -> list[tuple[int, int]]:
        """Consecutive pixels, first and how many, that this process takes: the same ones by kernels and without."""
        return blocks(pixels, samples, self._ranks)

    def through(self, budget: Budget, work: Callable[[Span], None], pixels: int, samples: int) -> None:
        """Work on them, piece by piece."""
        for start, count in self.blocks(pixels, samples):

            def moved(span: Span, start: int = start) -> None:
                work((start + span[0], *span[1:]))

            for _ in budget.through(moved, count, 0, samples):
                pass

    def sums(self) -> GradientSums:
        """Sums of the gradients of the leaves, and of what is held."""
        return GradientSums(self.tables)

    def gradients(self, sums: GradientSums) -> list[Tensor]:
        """Gradients of the parameters, of rays, and of what is held, from those of the leaves."""
        found = sums.gradients()
        pairs = [(y, g) for y, g in zip(self._outputs, found, strict=False) if g is not None]
        own: Sequence[Tensor | None] = [None] * len(self._inputs)
        if pairs and self._inputs:
            own = torch.autograd.grad([y for y, _ in pairs], self._inputs, [g for _, g in pairs], allow_unused=True)
        given = zip((*self._inputs, *self.captured), (*own, *found[len(self.leaves) :]), strict=True)
        return [torch.zeros_like(tensor) if gradient is None else gradient for tensor, gradient in given]


def _over(wave: Wave, change: Callable[[Tensor], Tensor]) -> Wave:
    """A wave with other tensors; stages run as tensor operations."""
    context = wave.context
    own = context.world, context.pixel, wave.camera, wave.first, wave.given
    world, pixel, camera, first, given = map_leaves(change, own)
    context = replace(context, world=world, pixel=pixel, camera=None if context.camera is None else camera)
    return replace(wave, context=context, camera=camera, first=first, given=given)
