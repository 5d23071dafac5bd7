"""Kernels that only search: rays in tensors, their hits and whether they are blocked in tensors."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler import cpu
from torchpt.compiler.form import VECTORS, Form
from torchpt.compiler.graph import Graph
from torchpt.compiler.kernel import HEAD, kernel_ir
from torchpt.compiler.program import TracedStage
from torchpt.compiler.searching import RaySearch
from torchpt.compiler.sinks import Sinks, Store
from torchpt.search.instance_rays import instance_search, instance_tables
from torchpt.search.tree import WideBvh
from torchpt.search.tree_instances import InstancedWideBvh
from torchpt.search.tree_rays import TreeSearch, tree_search, tree_tables

__all__ = ["Search", "SearchedTrees", "argument_block", "results_of", "search_stage", "searched_trees", "searches"]

#: A function of rays ``o, d, t_max``.
Search = Callable[[Tensor, Tensor, Tensor], list[Tensor]]
_RESULTS = (torch.float32, torch.int32, torch.float32, torch.float32, torch.bool)


@dataclass(frozen=True)
class SearchedTrees:
    """What kernels on this CPU search.

    Attributes:
        functions: generates ``nearest`` and ``occluded``.
        tables: arrays that kernels read.
        words: of the scene, with the tables' addresses.
    """

    functions: TreeSearch
    tables: Sequence[np.ndarray]
    words: np.ndarray


def searched_trees(accel: WideBvh | InstancedWideBvh) -> SearchedTrees:
    """Return what kernels search for an acceleration structure."""
    if isinstance(accel, WideBvh):
        functions, (tables, numbers) = tree_search(accel), tree_tables(accel)
    else:
        functions, (tables, numbers) = instance_search(accel), instance_tables(accel)
    return SearchedTrees(functions, tables, np.array([*(x.ctypes.data for x in tables), *numbers], np.int64))


def search_stage(functions: RaySearch, hits: bool = True, blocked: bool = True) -> TracedStage:
    """Return a stage around the nodes ``nearest`` (``hits``) and ``occluded`` (``blocked``); its inputs are ``o, d, t_max``."""
    graph = Graph()
    ray = [graph.node("tensor", "f", extra=at) for at in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0))]
    stores = []
    if hits:
        found = graph.node("nearest", "S", *ray)
        stores += [Store((graph.node("part", ty, found, extra=k),), ty) for k, ty in enumerate("fiff")]
    if blocked:
        stores.append(Store((graph.node("occluded", "b", *ray),), "b"))
    return TracedStage(graph, Sinks(store=stores), tensors=3, search=functions)


def results_of(stage: TracedStage, count: int) -> list[Tensor]:
    """Return new tensors for the results: ``t, prim, u, v``, ``blocked``, or all of them."""
    wanted = {1: _RESULTS[4:], 4: _RESULTS[:4], 5: _RESULTS}[len(stage.sinks.store)]
    return [torch.empty(count, dtype=dtype) for dtype in wanted]


def argument_block(words: int, tensors: list[Tensor]) -> Any:
    """Return the arguments of a kernel; ``words``: address of the scene's words."""
    block = (ctypes.c_int64 * (len(HEAD) + 2 * len(tensors)))()
    block[HEAD.index("search")] = words
    for k, tensor in enumerate(tensors):
        block[len(HEAD) + 2 * k] = tensor.data_ptr()
        block[len(HEAD) + 2 * k + 1] = tensor.shape[-1]
    return block


def searches(functions: RaySearch, words: int, form: Form = VECTORS) -> Search:
    """Return a function of rays that gives ``t, prim, u, v, blocked``, by a kernel of this CPU.

    Args:
        functions: generates ``nearest`` and ``occluded``.
        words: address of the scene's words, which the caller keeps alive.
        form: of the kernel.
    """
    stage = search_stage(functions)
    made = cpu.compile_ir(kernel_ir(stage, form))

    def run(o: Tensor, d: Tensor, t_max: Tensor) -> list[Tensor]:
        rays, results = [x.contiguous() for x in (o, d, t_max)], results_of(stage, t_max.shape[0])
        made.call(ctypes.addressof(argument_block(words, [*rays, *results])), t_max.shape[0])
        return results

    return run
