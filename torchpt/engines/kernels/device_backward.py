"""Path replay by kernels on a CUDA device, with the gradients of a CPU bit by bit.

Waves of many chunks are traced again and differentiated one after the other by the kernels of
:mod:`~torchpt.engines.kernels.backward`. Their rows of derivatives lie in random order, as do the lanes; they are added in the
order of chunks and samples (:mod:`~torchpt.engines.kernels.device_sums`). The host does not wait for the device within a wave.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler.graph import Unsupported
from torchpt.compiler.ptx import ptx_target
from torchpt.compiler.target import Target
from torchpt.core.memory import Span
from torchpt.engines.kernels.backward import KernelsBackward, VjpKernels
from torchpt.engines.kernels.device import Count, DeviceEngine, DeviceMemory, LateCheck
from torchpt.engines.kernels.device_kernels import KernelsOnDevice, on_host
from torchpt.engines.kernels.device_search import SearchWords, search_on_device
from torchpt.engines.kernels.device_sums import SegmentSums, Terms, WaveSums
from torchpt.engines.kernels.driver import Cuda, cuda_of
from torchpt.engines.kernels.engine import Chunk, Paths
from torchpt.engines.kernels.layout import Layout
from torchpt.engines.kernels.programs import Kernel, Kernels, NamedTensors
from torchpt.math.sums import GradientSums
from torchpt.paths.adjoint import Tape

__all__ = ["DeviceBackward", "DeviceVjpKernels", "device_backward"]


# ---- The kernels of a backward pass


class _HostVjpKernels(VjpKernels):
    """Kernels on the host that stages are traced with; none is run, so they have no search."""

    def _search_inputs(self) -> tuple[None, None]:
        return None, None


class DeviceVjpKernels(KernelsOnDevice, VjpKernels):
    """The kernels of one backward pass on a device.

    Args:
        tape: the wave and its differentiated tensors, on the device.
        cotangent: see :class:`~torchpt.engines.kernels.backward.VjpKernels`.
        cuda: the device.
        target: see :class:`~torchpt.engines.kernels.device_kernels.KernelsOnDevice`.
        search: see there.
    """

    def __init__(
        self, tape: Tape, cotangent: Tensor | None, cuda: Cuda, target: Target, search: SearchWords | None
    ) -> None:
        super().__init__(cuda, target, search, tape, search is not None, cotangent)
        self._segments = SegmentSums(cuda, target)

    def _host_inputs(self) -> tuple[Layout, NamedTensors]:
        known: dict[int, Tensor] = {}
        wave = on_host(self.tape.wave, known)
        primals = [known.setdefault(id(primal), primal.cpu()) for primal in self.tape.primals]
        leaves = [primal.detach().requires_grad_() for primal in primals]
        known |= {id(leaf): copy for leaf, copy in zip(self.tape.leaves, leaves, strict=True)}
        tape = Tape(wave, on_host(self.tape.taped, known), leaves, primals, captured=())
        kernels = _HostVjpKernels(tape, self.by_kernels, None if self.cotangent is None else self.cotangent.cpu())
        return kernels, kernels._leaves

    def engine(self) -> DeviceBackward:
        """Return an engine."""
        return DeviceBackward(self)

    @property
    def lanes(self) -> int:
        """Return the number of lanes of a wave."""
        return self.row

    def wave_sums(self, whole: GradientSums, size: int) -> WaveSums:
        """Return sums of a wave of chunks of at most ``size`` samples, which go to those of the pass."""
        return WaveSums(self.tape.tables, whole, self._segments, size)


def device_backward(
    tape: Tape,
    own: Sequence[int],
    cotangent: Tensor | None,
    by_kernels: bool,
    lanes: int,
    before: Kernels | None = None,
    cuda: Cuda | None = None,
    target: Callable[[int], Target] = ptx_target,
) -> DeviceVjpKernels:
    """Return the kernels of a backward pass on a device.

    Args:
        tape: see :class:`DeviceVjpKernels`.
        own: indices of the user's own models, which are compiled at once to find out whether they can be.
        cotangent: see :class:`DeviceVjpKernels`.
        by_kernels: True: rays are searched by kernels where these can; False: by the wave's acceleration structure.
        lanes: of a wave.
        before: see :func:`~torchpt.engines.kernels.device_search.search_on_device`.
        cuda: the device; None: that of the wave.
        target: returns the target of a row length.

    Raises:
        RenderError: kernels cannot run on the device.
    """
    device = cuda_of(tape.wave.centre.device) if cuda is None else cuda
    search = search_on_device(tape.wave.accel, by_kernels, device.device, before)
    cotangent = None if cotangent is None else cotangent.float().contiguous()
    kernels = DeviceVjpKernels(tape, cotangent, device, target(lanes), search)
    kernels.eager = kernels.probe(own)
    return kernels


# ---- The backward engine


@dataclass(frozen=True)
class Mark:
    """Checkpoint of a replay: copies of an arena before its lanes were listed, and of the number of lanes."""

    depth: int
    words: Tensor
    count: Tensor


class DeviceBackward(DeviceEngine, KernelsBackward):
    """Backward engine of kernels on a device; see :class:`torchpt.engines.engine.Backward`.

    The verbs of the walk are those of :class:`DeviceEngine`; :class:`KernelsBackward` has the order of the backward pass.

    Args:
        kernels: :class:`DeviceVjpKernels` of the backward pass.
    """

    def begin(self, span: Span, sums: Any) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`; ``sums``: :class:`WaveSums`."""
        self.sums, self._chunk, self._first = sums, Chunk(*span), 1
        self._places = sums.begin(self._chunk.pixels, self._chunk.samples, self._cuda.device)
        n = self._chunk.pixels * self._chunk.samples
        self.begin_wave(self._chunk)
        paths: Any = self.spawn(self._chunk)
        self._weight = None
        if "weight" in self.kernels.state:
            self._weight = paths.arena.floats[self.kernels.state.first("weight"), :n].clone()
        return paths

    def mark(self, paths: Paths) -> Any:
        """See :class:`torchpt.engines.engine.Backward`."""
        arena: Any = paths.arena
        return Mark(paths.depth, arena.words.clone(), paths.count.value.clone())

    def resume(self, mark: Any) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`."""
        self._first = mark.depth
        self._lost.clear()
        self._look = LateCheck(self._cuda)
        paths: Any = self._begin(self.room(mark.depth), mark.depth, Count(mark.count, ()))
        paths.arena.words.copy_(mark.words)
        paths.arrived = True
        return paths

    def radiance_of_samples(self) -> Tensor:
        """See :class:`torchpt.engines.engine.Backward`."""
        self.mark_lost()
        slots: Any = self.slots
        return slots.floats[:, : self._chunk.pixels * self._chunk.samples]

    def receive(self, cotangent: Tensor) -> None:
        """See :class:`torchpt.engines.engine.Backward`."""
        n, first, slots = cotangent.shape[1], self.back.slots.first("radiance"), self._device_slots()
        slots.words[:, :n] = 0
        slots.floats[first : first + 3, :n] = cotangent if self._weight is None else cotangent * self._weight

    def _device_slots(self) -> DeviceMemory:
        slots: Any = self._sample_slots
        return slots

    def _vjp_of_stage(self, key: tuple, paths: Paths, places: Any, count: Any, *, added: bool) -> None:
        """Pull cotangents back through one stage on the lanes of a list, by its kernel.

        Raises:
            Unsupported: the stage cannot be compiled.
        """
        kernel = self.back.vjp_kernel(key)
        if kernel is None:
            raise Unsupported(self.back.eager_vjps[key])
        self._results = self._results_of(kernel)
        self.calls.run(kernel, count, paths.arena, self._results, places, slots=self._sample_slots)
        if not kernel.program.sums:
            return
        arena: Any = paths.arena
        lanes = places.words[0].long()
        exists = torch.arange(len(lanes), device=lanes.device) < count.value
        sample = arena.words[self.back.state.first("lane")].index_select(0, lanes).long()
        self._add_terms(kernel, self._places.terms(sample, exists))

    def _add_all_lanes(self, kernel: Kernel, count: int) -> None:
        self._add_terms(kernel, self._places.all_terms())

    def _add_terms(self, kernel: Kernel, terms: Terms) -> None:
        """Add the rows that a VJP's kernel wrote to the sums."""
        results: Any = self._results
        for number, index, first, width in kernel.program.sums:
            values = results.floats[first : first + width]
            if index < 0:
                self.sums.add_all(number, values, terms)
            else:
                self.sums.add_terms(number, index, results.words[index], values, terms)

    def _ray_cotangents(self, row: int, n: int) -> Tensor:
        return self._device_slots().floats[row : row + 3, :n].clone()
