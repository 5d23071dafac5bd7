"""What engines take over of the functions that physics declares: on a CPU they are kernels of the lane compiler."""

from __future__ import annotations

from torchpt import samplers
from torchpt.lanes import bits
from torchpt.lanes.function import Lanewise
from torchpt.samplers import scrambling

__all__: list[str] = []

scrambling.reverse_bits.register(bits.reverse_bits)
for _draw in (samplers.draw_1d, samplers.draw_2d, samplers.draw_further):
    _draw.register(Lanewise(_draw.function, lanes=("key",), uniforms=("salt",)))
