"""What renders of one structure hand on to each other: kernels, and tables of tensors that are the same ones, unchanged."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchpt.engines.kernels.leaves import Leaves, State
from torchpt.lanes.program import Program
from torchpt.lanes.prologue import Name

if TYPE_CHECKING:
    from torchpt.engines.kernels.kernels import Kernel

__all__ = ["Handed"]


class Handed:
    """The latest kernel of each stage and the latest table of each tensor, with the tensors that they were made of.

    Renders that share it may run at the same time, on several threads.
    """

    def __init__(self) -> None:
        self._kernels: dict[Any, tuple[Kernel, dict[str, State]]] = {}
        self._tables: dict[tuple[str, Any], tuple[State, Tensor]] = {}
        self._results: dict[frozenset[str], tuple[dict[str, State], dict[Name, Tensor]]] = {}
        self._lock = threading.Lock()

    def kernel(self, key: Any, program: Program, leaves: Leaves) -> Kernel | None:
        """The kernel of a stage where it was made of the same program and tensors; None where there is none such."""
        found = self._kernels.get(key)
        if found is None or found[0].program is not program or program.held:
            return None
        same = all(leaves.has(path, state) for path, state in found[1].items())
        return found[0] if same else None

    def tables(self, leaves: Leaves) -> dict[Any, Tensor]:
        """Tables of a render's tensors as kernels read them, those that there are, by path and axis."""
        with self._lock:
            return {key: table for key, (state, table) in self._tables.items() if leaves.has(key[0], state)}

    def results(self, leaves: Leaves) -> dict[Name, Tensor]:
        """Return what steps of prologues came to on a render's tensors, those that were taken, by name."""
        found: dict[Name, Tensor] = {}
        with self._lock:
            for states, results in self._results.values():
                if all(leaves.has(path, state) for path, state in states.items()):
                    found |= results
        return found

    def keep(
        self,
        key: Any,
        kernel: Kernel,
        tables: dict[Any, Tensor],
        results: dict[Name, Tensor],
        leaves: Leaves,
    ) -> None:
        """Hand a kernel on, and all tables and results of steps of its render."""
        groups: dict[frozenset[str], dict[Name, Tensor]] = {}
        for name, result in results.items():
            groups.setdefault(name.leaves, {})[name] = result
        with self._lock:
            self._kernels[key] = kernel, {path: leaves.states[path] for path in kernel.program.leaves()}
            for paths, group in groups.items():
                self._results[paths] = {path: leaves.states[path] for path in paths}, group
            self._tables |= {place: (leaves.states[place[0]], table) for place, table in tables.items()}
