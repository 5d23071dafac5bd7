"""Interfaces of engines for the packages above, and the functions that make an engine for a wave."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import torch
from torch import Tensor

from torchpt.compiler.cpu import wait_for_final_code
from torchpt.core.memory import Budget, Span
from torchpt.core.threads import thread_count
from torchpt.engines import work
from torchpt.engines.kernels.engine import LANES as LANES_OF_KERNELS
from torchpt.engines.kernels.programs import KernelCaches, Kernels, probed_kernels
from torchpt.engines.kernels.threads import KernelsForward
from torchpt.engines.tensors import hits, layers, radiance, seen, trace, weighted_radiance
from torchpt.engines.tensors_forward import TensorsForward
from torchpt.engines.work import TASKS, Block, SampleRange, TaskResult
from torchpt.paths.walk import Engine, Population
from torchpt.paths.wave import Wave

if TYPE_CHECKING:  # backward engines are imported when first used
    from torchpt.math.sums import ChunkGradientSums, GradientSums
    from torchpt.paths.adjoint import Tape

__all__ = [
    "LANES_OF_KERNELS",
    "TASKS",
    "Backward",
    "BackwardDevice",
    "BackwardKernels",
    "Block",
    "Forward",
    "ForwardDevice",
    "KernelCaches",
    "Kernels",
    "SampleRange",
    "TaskResult",
    "Tasks",
    "backward_kernels",
    "backward_tensors",
    "describe_kernels",
    "device_backward",
    "forward_device",
    "forward_kernels",
    "forward_tensors",
    "hits",
    "kernels_of",
    "layers",
    "radiance",
    "seen",
    "trace",
    "wait_for_final_code",
    "weighted_radiance",
    "why_no_kernels",
]

#: Of a backward engine: its populations, its marks, and the gradient sums that it adds to.
P = TypeVar("P", bound=Population)
M = TypeVar("M")
S = TypeVar("S", contravariant=True)


# ---- Samples of a picture


class Forward(Protocol):
    """Renders samples and adds them to the films; the sums do not depend on threads or chunks.

    Attributes:
        compiled: True: it runs kernels.
        budget: threads and lanes at the moment; they shrink when memory runs out.
    """

    compiled: bool
    budget: Budget

    @property
    def seconds(self) -> float:
        """Return the seconds spent on making kernels."""
        ...

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return how many 32-bit numbers a lane takes in each thread, for these layers; 0: unknown, memory is measured."""
        ...

    def run(self, spans: Sequence[work.SampleRange], each: Callable[[TaskResult | None], bool]) -> bool:
        """Render samples of every pixel of pixel sets; return True if all were rendered.

        Args:
            spans: pixel sets, each with its first sample and number of samples.
            each: called in this thread after every task, and now and then with None; returning True ends the render.
        """
        ...

    def release_workers(self, keeps: bool) -> None:
        """Release the memory of threads, or (``keeps``) keep it for the next render of the same structure."""


class Tasks(Forward, Protocol):
    """A forward engine whose tasks a caller may schedule on threads, among those of other renders."""

    def blocks(self, spans: Sequence[work.SampleRange], tasks: int) -> list[Block]:
        """Split the samples of pixel sets into blocks of pixels: ``tasks`` for each set, unless blocks get too small."""
        ...

    def task(self, block: Block) -> TaskResult:
        """Render a block; called on any thread."""
        ...

    def retry_blocks(self, blocks: list[Block], each: Callable[[TaskResult | None], bool]) -> bool:
        """Render blocks that ran out of memory again, with fewer threads or lanes; else as :meth:`run`."""
        ...

    def halt(self) -> None:
        """Cancel the render: tasks stop at their next kernel."""


class ForwardDevice(Forward, Protocol):
    """A forward engine on a device.

    Attributes:
        kernels: of the render.
    """

    kernels: Any


def forward_tensors(wave: Wave, budget: Budget) -> Forward:
    """Return a forward engine of tensor operations, in pieces of as many lanes as the budget allows."""
    return TensorsForward(wave, budget)


def kernels_of(
    wave: Wave, own: Sequence[int], before: Kernels | None = None, caches: KernelCaches | None = None
) -> Kernels:
    """Return the kernels of a render; its ``eager`` lists models that cannot be compiled, with the reasons.

    Args:
        wave: of the render.
        own: indices of the user's own models, which are compiled at once to find out whether they can be.
        before: kernels of another render; its tables are shared where they were made of the same tensors.
        caches: those of the scene; None: those of ``before``, or new ones.
    """
    packets = uses_packets(wave)
    make = partial(Kernels, wave, packets, before=before, fixed=not own, caches=caches)
    kernels = probed_kernels(wave, own, packets, make)
    if wave.light_paths is not None:
        kernels.light_paths = kernels_of(wave.light_paths, own, None if before is None else before.light_paths, caches)
    return kernels


def forward_kernels(kernels: Kernels, threads: int | None = None, strict: bool = False) -> Tasks:
    """Return a forward engine of kernels.

    Args:
        kernels: of the render.
        threads: None: those of the render.
        strict: True: a task ends at its first chunk with a sample that is not finite; the caller has to end the render.
    """
    return KernelsForward(kernels, thread_count(threads), kernels.wave.integrator.clamp, strict)


def why_no_kernels(device: torch.device) -> str:
    """Return why kernels cannot run on a device, in a few words; empty if they can."""
    if device.type == "cpu":
        return ""
    if device.type != "cuda":
        return "kernels run on a CPU or with CUDA"
    from torchpt.engines.kernels.driver import missing  # imported where there is such a device

    return missing(torch.cuda.current_device() if device.index is None else device.index)


def forward_device(wave: Wave, own: Sequence[int], by_kernels: bool, before: Kernels | None = None) -> ForwardDevice:
    """Return a forward engine of kernels on a CUDA device.

    Args:
        wave: of the render, on the device.
        own: see :func:`kernels_of`.
        by_kernels: True: rays are searched by kernels where these can; False: by the wave's acceleration structure.
        before: kernels of another render; its tables are shared where they were made of the same tensors.

    Raises:
        RenderError: kernels cannot run on the device.
    """
    from torchpt.engines.kernels.device_forward import device_forward

    return device_forward(wave, own, by_kernels, before)


def describe_kernels(kernels: Kernels) -> dict[str, Any]:
    """Return a description of the compiled loop, for the summary of a render."""
    of_kernels = "kernels of packets" if kernels.tree is None else "kernels of a tree"
    search = "inside the stages" if kernels.fused else of_kernels if kernels.by_kernels else kernels.wave.accel.name
    names = [str(model) for model in kernels.wave.context.world.materials.models]
    eager = {names[number]: reason for number, reason in kernels.eager.items()}
    return {
        "stages": "compiled to loops over lanes",
        "search": search,
        "rows_a_path": kernels.state.count,
        **({"eager": eager} if eager else {}),
    }


# ---- Backward passes


class Backward(Engine[P], Protocol[P, M, S]):
    """An engine that also pulls cotangents back through the vertices of a chunk's paths, one chunk after the other.

    It keeps the first :data:`KEPT` populations of a walk until the next walk; later ones are overwritten two vertices on.
    Cotangents of a vertex's inputs are stored by sample, where the VJP of the vertex before reads them.
    """

    wave: Wave

    def begin(self, span: Span, sums: S) -> P:
        """Start the paths of a chunk at the camera; from now on gradients are added to ``sums``."""
        ...

    def mark(self, paths: P) -> M:
        """Return a copy of a population with its hits, before it is sorted: a checkpoint."""
        ...

    def resume(self, mark: M) -> P:
        """Start again from a mark; radiance found before it is left out of the samples."""
        ...

    def radiance_of_samples(self) -> Tensor:
        """Return the radiance of the samples ``(3, samples * pixels)``, weighted by the filter."""
        ...

    def receive(self, cotangent: Tensor) -> None:
        """Set the cotangent of :meth:`radiance_of_samples`, the start of the backward pass."""

    def vjp(self, paths: P) -> None:
        """Pull cotangents back through a vertex, after all vertices behind it."""

    def vjp_rays(self) -> None:
        """Pull cotangents back through the first rays of the paths."""


class BackwardKernels(Protocol):
    """The kernels of a backward pass.

    Attributes:
        eager_vjps: stages whose VJP runs as tensor operations, since it cannot be compiled, with the reasons. Keys begin with
            the name of the stage: ``("bounce", model, ...)``, ``("emit", ...)``.
    """

    eager_vjps: dict[tuple[Any, ...], str]

    def prefetch(self, processes: int) -> None:
        """Begin to compile the large kernels in other processes, unless some were made before; at most so many at a time."""
        ...

    def engine(self) -> Backward[Any, Any, ChunkGradientSums]:
        """Return an engine for one more thread."""
        ...

    def bytes_per_lane(self, levels: int) -> int:
        """Return the bytes that a lane takes if ``levels`` vertices are kept."""
        ...

    def release(self, engines: Sequence[Any]) -> None:
        """Keep engines for the next pass of the same structure, and drop what no other pass can use again."""
        ...


def uses_packets(wave: Wave) -> bool:
    """Return True if packet kernels search the primitives, inside or between the stages; they do not support quadrics."""
    *_, quadrics = wave.context.world.geometry.counts
    return wave.accel.name == "brute" and not quadrics


def backward_tensors(tape: Tape, cotangent: Tensor | None) -> Backward[Any, Any, GradientSums]:
    """Return a backward engine of tensor operations.

    Args:
        tape: the wave and its differentiated tensors.
        cotangent: ``(3, H W)`` of the picture, divided by the samples a pixel; None for an integrator without splats.
    """
    from torchpt.engines.tensors_backward import TensorsBackward

    return TensorsBackward(tape, None if cotangent is None else cotangent.to(tape.wave.context.plan.dtype))


def backward_kernels(
    tape: Tape, own: Sequence[int], cotangent: Tensor | None, caches: KernelCaches | None = None
) -> BackwardKernels:
    """Return the kernels of a backward pass, which make a backward engine for each thread.

    Args:
        tape: as for :func:`backward_tensors`.
        own: indices of the user's own models, which are compiled at once to find out whether they can be.
        cotangent: as for :func:`backward_tensors`.
        caches: those of the scene; None: nothing is kept for other passes.
    """
    from torchpt.engines.kernels.backward import VjpKernels

    cotangent = None if cotangent is None else cotangent.float().contiguous()
    # What a user's model compiles to may change from pass to pass.
    kernels = VjpKernels(tape, uses_packets(tape.wave), cotangent, None if own else caches)
    kernels.eager = kernels.probe(own)
    return kernels


class BackwardDevice(Protocol):
    """The kernels of a backward pass on a device.

    Attributes:
        eager_vjps: stages that cannot be compiled, with the reasons.
    """

    eager_vjps: dict[tuple[Any, ...], str]

    @property
    def lanes(self) -> int:
        """Return the number of lanes of a wave."""
        ...

    def engine(self) -> Backward[Any, Any, Any]:
        """Return an engine."""
        ...

    def bytes_per_lane(self, levels: int) -> int:
        """Return the bytes that a lane takes if ``levels`` vertices are kept."""
        ...

    def wave_sums(self, whole: GradientSums, size: int) -> Any:
        """Return sums of a wave of chunks of at most ``size`` samples.

        Their ``merge_into_whole`` adds them to those of the pass.
        """
        ...


def device_backward(
    tape: Tape, own: Sequence[int], cotangent: Tensor | None, by_kernels: bool, lanes: int, before: Kernels | None
) -> BackwardDevice:
    """Return the kernels of a backward pass on a CUDA device.

    Args:
        tape: as for :func:`backward_tensors`.
        own: as for :func:`backward_kernels`.
        cotangent: as for :func:`backward_tensors`.
        by_kernels: as for :func:`forward_device`.
        lanes: of a wave.
        before: kernels of an earlier render, whose tree is refitted where primitives have moved.

    Raises:
        RenderError: kernels cannot run on the device.
    """
    from torchpt.engines.kernels.device_backward import device_backward

    return device_backward(tape, own, cotangent, by_kernels, lanes, before)
