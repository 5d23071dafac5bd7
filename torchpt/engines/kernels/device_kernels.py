"""The kernels of a render on a device, and their tables there.

Stages are traced on the host: torch's operators round differently on a GPU.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler import cache
from torchpt.compiler.program import LaidOut, Program, Tables, bind_tables
from torchpt.compiler.sinks import Sinks
from torchpt.compiler.target import Target
from torchpt.core.tree import moved
from torchpt.engines.kernels.device_search import SearchWords
from torchpt.engines.kernels.driver import Cuda
from torchpt.engines.kernels.layout import Layout
from torchpt.engines.kernels.programs import Kernels, NamedTensors, probed_kernels, records_of, trace_stage
from torchpt.paths.wave import Wave

__all__ = ["DeviceKernels", "KernelsOnDevice", "device_kernels", "on_host"]


def on_host(wave: Wave, known: dict[int, Tensor]) -> Wave:
    """Return a wave with all tensors on the host, to trace stages with; its search is left as it is.

    ``known``: tensors of the host by the id of the device's, used in place of new copies; new ones are added.
    """
    host = torch.device("cpu")
    filter = type(wave.filter)(wave.filter.values, host)
    there = moved(replace(wave, light_paths=None), host, known)
    context = replace(there.context, filter=None if there.context.filter is None else filter)
    return replace(there, context=context, filter=filter)


class _HostLeaves(Mapping[str, Tensor]):
    """Copies of a render's tensors on the host, made when they are first read.

    Args:
        leaves: the tensors on the device by path.
    """

    def __init__(self, leaves: Mapping[str, Tensor]) -> None:
        self._leaves = leaves
        self._copies: dict[str, Tensor] = {}

    def __getitem__(self, path: str) -> Tensor:
        if path not in self._copies:
            self._copies[path] = self._leaves[path].detach().cpu()
        return self._copies[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._leaves)

    def __len__(self) -> int:
        return len(self._leaves)


class KernelsOnDevice(Kernels, ABC):
    """Base of kernels that run on a device; it comes before the other base of a class, which says what kernels there are.

    Args:
        cuda: the device.
        target: the target that stages are compiled for; its form has the row length of arenas.
        search: from :func:`search_on_device`; None: rays are searched outside of kernels.
        arguments: of the other base.

    Attributes:
        row: number of lanes of an arena.
    """

    def __init__(self, cuda: Cuda, target: Target, search: SearchWords | None, *arguments: Any) -> None:
        self.cuda, self.target, self.row = cuda, target, target.form.row
        self._search = search
        self._host: tuple[Layout, NamedTensors] | None = None
        self.tree = None if search is None else search.tree
        super().__init__(*arguments)
        #: What prologues read: torch's operators round differently on a GPU.
        self._host_leaves = _HostLeaves(self._leaves.tensors)

    @abstractmethod
    def _host_inputs(self) -> tuple[Layout, NamedTensors]:
        """Return layout and leaves on the host, to trace stages with."""

    def _search_inputs(self) -> tuple[Any, None]:
        return self._search, None

    def _program(self, key: tuple[Any, ...], listed: bool, build: Callable[[Any], Sinks]) -> Program:
        """Return the program of a stage, traced on the host if it is new."""

        def trace() -> Any:
            if self._host is None:
                self._host = self._host_inputs()
            layout, leaves = self._host
            layout.tree = self.tree
            return trace_stage(leaves, layout, build, listed)

        return cache.program_of((key, self.structure), self._host_leaves, trace, self.target)

    def _bind(self, program: Program, kept: Sequence[LaidOut | None]) -> Tables:
        return bind_tables(
            program.tables,
            program.steps,
            program.constants,
            self._host_leaves,
            self._laid_out,
            program.names,
            self._results,
            self.cuda.device,
            self._leaves.tensors,
            kept,
            program.in_order,
        )


class DeviceKernels(KernelsOnDevice):
    """The kernels of one render on a device.

    Args:
        wave: the render; its tensors are on the device.
        cuda: the device.
        target: see :class:`KernelsOnDevice`.
        search: see there.
        fused: True: the search is part of the stages.
        before: see :class:`Kernels`.
        fixed: see there.
    """

    def __init__(
        self,
        wave: Wave,
        cuda: Cuda,
        target: Target,
        search: SearchWords | None,
        fused: bool,
        before: Kernels | None = None,
        fixed: bool = False,
    ) -> None:
        super().__init__(cuda, target, search, wave, search is not None, fused, before, fixed)

    def _host_inputs(self) -> tuple[Layout, NamedTensors]:
        layout = Layout(on_host(self.wave, {}), self.by_kernels, self.fused)
        return layout, NamedTensors(records_of(layout, None))


def device_kernels(
    wave: Wave,
    own: Sequence[int],
    cuda: Cuda,
    target: Target,
    search: SearchWords | None,
    before: Kernels | None = None,
) -> DeviceKernels:
    """Return the kernels of a render on a device; its ``eager`` lists models that cannot be compiled, with the reasons.

    Args:
        wave: of the render, on the device.
        own: indices of the user's own models, which are compiled at once to find out whether they can be.
        cuda: the device.
        target: see :class:`DeviceKernels`.
        search: see :class:`KernelsOnDevice`. A tree is searched by kernels of its own, with fewer registers than stages need.
        before: kernels of another render; its tables are shared where they were made of the same tensors.
    """
    packets = search is not None and search.tree is None
    make = partial(DeviceKernels, wave, cuda, target, search, before=before, fixed=not own)
    kernels = probed_kernels(wave, own, packets, make)
    if wave.light_paths is not None:
        earlier = None if before is None else before.light_paths
        kernels.light_paths = device_kernels(wave.light_paths, own, cuda, target, search, earlier)
    return kernels
