"""Implementations that engines register for dispatched functions of physics.

A *dispatched* function (:mod:`torchpt.core.dispatch`) asks its registered implementations first; one that answers
NotImplemented leaves the call to the function itself. On a CPU some functions of whole tensors run as kernels of the lane
compiler (:class:`~torchpt.compiler.function.Lanewise`). Two others have another form while a stage is traced for the lane
compiler.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchpt.compiler import bits
from torchpt.compiler.function import Lanewise
from torchpt.compiler.tracing import tracing
from torchpt.math import hashing
from torchpt.paths import transmission
from torchpt.paths.surface import opacity_map
from torchpt.physics import samplers
from torchpt.physics.lights import solid_angle, tree
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.world import World

__all__: list[str] = []

for _draw in (samplers.draw_1d, samplers.draw_2d, samplers.draw_further):
    _draw.register(Lanewise(_draw.function, lanes=("key",), uniforms=("salt",)))

solid_angle.sample.register(Lanewise(solid_angle.sample.function, lanes=("row", "x", "u"), detached=True))
solid_angle.angles.register(Lanewise(solid_angle.angles.function, lanes=("row", "x"), detached=True))
tree.sample.register(Lanewise(tree.sample.function, lanes=("x", "n", "u", "given"), detached=True))
tree.probability.register(Lanewise(tree.probability.function, lanes=("row", "x", "n"), detached=True))

hashing.reverse_bits.register(bits.reverse_bits)


def _times_opacity_map(world: World, o: Tensor, d: Tensor, hit: Hit, opacity: Tensor, textured: Tensor) -> Any:
    """Return opacities ``(N,)``, times the texture in lanes where the mask ``textured`` is set, while a stage is traced."""
    if not tracing():
        return NotImplemented
    # Every lane of a kernel takes the same steps, so the texture is read in all lanes and selected by the mask.
    return torch.where(textured, opacity * opacity_map(world, interact(world, o, d, hit)), opacity)


transmission.times_opacity_map.register(_times_opacity_map)
