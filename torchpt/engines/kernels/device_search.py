"""Searches of rays in kernels of a device: trees and tables of the host, copied there once for each scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchpt.core.tree import moved
from torchpt.engines.kernels.programs import Kernels
from torchpt.search import Accel, build
from torchpt.search.brute import Brute
from torchpt.search.instance_rays import instance_search, instance_tables
from torchpt.search.instances import Instanced
from torchpt.search.lbvh import Lbvh
from torchpt.search.tree import WideBvh
from torchpt.search.tree_instances import InstancedWideBvh
from torchpt.search.tree_rays import TreeSearch, tree_search, tree_tables

__all__ = ["SearchWords", "search_on_device"]


@dataclass(frozen=True)
class SearchWords:
    """The argument of searches in kernels, on a device.

    Attributes:
        words: int64, see :func:`torchpt.compiler.packet.scene_words`, :func:`torchpt.search.tree.scene_words` and
            :func:`torchpt.search.instance_rays.instance_tables`.
        tables: tensors whose addresses are the first words.
        tree: see :class:`~torchpt.engines.kernels.layout.Layout`.
        host: the search of the host that was built for the tables; None: they are the scene's own.
    """

    words: Tensor
    tables: tuple[Tensor, ...]
    tree: TreeSearch | None
    host: Accel | None


def _host_search(accel: Accel, before: SearchWords | None = None) -> Accel | None:
    """Return the search, on the host, whose data kernels of a device read; None if they know none for this one.

    ``before``: of an earlier render. Its tree is refitted to primitives that have moved, where that is good enough.
    """
    if isinstance(accel, Instanced):
        accel = accel.base
    if isinstance(accel, Lbvh):
        return build(moved(accel.geometry, torch.device("cpu")), before=None if before is None else before.host)
    return None if isinstance(accel, Brute) and accel.quadrics else accel


#: Searches that were copied to devices, by the accel of the scene.
_ON_DEVICE: WeakKeyDictionary[Accel, dict[torch.device, SearchWords | None]] = WeakKeyDictionary()


def search_on_device(
    accel: Accel, by_kernels: bool, device: torch.device, before: Kernels | None = None
) -> SearchWords | None:
    """Return the argument of searches in kernels of a scene, on a device; None: rays are searched outside of kernels.

    Args:
        accel: the scene's acceleration structure.
        by_kernels: False: only ``accel`` itself is searched by kernels, not a tree of tensors by another one.
        device: where kernels run.
        before: kernels of an earlier render, whose tree may be refitted.
    """
    if not by_kernels and not isinstance(accel, Brute):
        return None
    found = _ON_DEVICE.setdefault(accel, {})
    if device not in found:
        earlier = None if before is None else before.search
        host = _host_search(accel, earlier if isinstance(earlier, SearchWords) else None)
        words = None if host is None else _copied(host, device)
        # The cache must not hold its own keys.
        found[device] = replace(words, host=None) if words is not None and host is accel else words
    return found[device]


def _copied(host: Accel, device: torch.device) -> SearchWords | None:
    """Return a search of the host on a device; None if kernels do not know it."""
    tree: TreeSearch | None = None
    if isinstance(host, Brute):
        tables = tuple(table.numpy() for table in host.tables)
        numbers = np.frombuffer(host.words, np.int64)[len(tables) :]
    elif isinstance(host, WideBvh):
        (tables, numbers), tree = tree_tables(host), tree_search(host)
    elif isinstance(host, InstancedWideBvh):
        (tables, numbers), tree = instance_tables(host), instance_search(host)
    else:
        return None
    copies = tuple(torch.from_numpy(table).to(device) for table in tables)
    addresses = np.array([table.data_ptr() for table in copies])
    return SearchWords(torch.from_numpy(np.concatenate([addresses, numbers])).to(device), copies, tree, host)
