"""The search of trees by kernels as PTX on the machine of the tests, beside the CPU's search by packets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from forms import differing
from ptx_calls import ptx_of
from ptx_machine import WARP, DeviceMemory, PtxMachine
from ray_kernels import argument_block, results_of, search_stage, searched_trees
from torch import Tensor

from torchpt.search.tree import WideBvh
from torchpt.search.tree_instances import InstancedWideBvh

__all__ = ["Found", "search_on_machine"]


@dataclass(frozen=True)
class Found:
    """What the machine found of a search.

    Attributes:
        differing: number of rays whose results are not the CPU's bits.
        machine: that ran the kernel.
        instructions: of a ray.
        issues: instructions that warps issued for a ray, times the threads of a warp.
    """

    differing: int
    machine: PtxMachine
    instructions: float
    issues: float


def search_on_machine(
    accel: WideBvh | InstancedWideBvh,
    rays: tuple[Tensor, Tensor, Tensor],
    any_hit: bool,
    per_thread: int = 1,
    seed: int = 0,
) -> Found:
    """Search rays ``o, d, t_max``: their nearest hits, or (``any_hit``) whether they are blocked.

    ``per_thread``: how many rays a thread takes.
    """
    o, d, t_max = rays = rays[0].contiguous(), rays[1].contiguous(), rays[2].contiguous()
    lanes = t_max.shape[0]
    trees = searched_trees(accel)
    stage = search_stage(trees.functions, hits=not any_hit, blocked=any_hit)
    machine, memory, results = PtxMachine(ptx_of(stage)), DeviceMemory(), results_of(stage, lanes)
    count = np.array([lanes])
    for array in (*(x.numpy() for x in (o, d, t_max)), *(x for x in trees.tables if x.size), trees.words, count):
        memory.add(array, constant=True)
    for result in results:
        memory.add(result.numpy())
    block = argument_block(trees.words.ctypes.data, [*rays, *results])
    threads = -(-lanes // per_thread // WARP) * WARP
    arguments = bytes(block), np.int64(count.ctypes.data).tobytes()
    machine.launch(memory, arguments, threads // WARP, WARP, seed=seed)
    wanted = (accel.occluded(*rays),) if any_hit else accel.intersect(*rays)
    wrong = torch.stack([differing(a, b.to(a.dtype)) for a, b in zip(results, wanted, strict=True)]).any(0)
    executed, issued = sum(machine.executed.values()), WARP * sum(machine.issued.values())
    return Found(int(wrong.sum()), machine, executed / lanes, issued / lanes)
