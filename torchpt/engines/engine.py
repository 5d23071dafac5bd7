"""The door of the engines: what they do for those above, and who is picked. Nobody above imports an engine by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import torch
from torch import Tensor

from torchpt.core.memory import Budget, Span
from torchpt.engines import work
from torchpt.engines.kernels.engine import LANES as LANES_OF_KERNELS
from torchpt.engines.kernels.programs import Kernels
from torchpt.engines.kernels.threads import KernelsForward
from torchpt.engines.tensors import brought, hits, layers, radiance, seen, trace
from torchpt.engines.tensors_forward import TensorsForward
from torchpt.engines.work import TASKS, Block, TaskResult
from torchpt.paths.walk import Engine, Population
from torchpt.paths.wave import Wave

if TYPE_CHECKING:  # the way back is imported where somebody goes it
    from torchpt.math.sums import ChunkGradientSums, GradientSums
    from torchpt.paths.adjoint import Tape

__all__ = [
    "LANES_OF_KERNELS",
    "TASKS",
    "Backward",
    "BackwardKernels",
    "Block",
    "Forward",
    "Kernels",
    "TaskResult",
    "Tasks",
    "backward_kernels",
    "backward_tensors",
    "brought",
    "describe_kernels",
    "forward_kernels",
    "forward_tensors",
    "hits",
    "kernels_of",
    "layers",
    "radiance",
    "seen",
    "trace",
]

P = TypeVar("P", bound=Population)
M = TypeVar("M")
S = TypeVar("S", contravariant=True)


# ---- Samples of a picture


class Forward(Protocol):
    """Takes samples of a render and adds them to its films, the same sums however it cuts the work.

    Attributes:
        compiled: whether by kernels.
        budget: threads and lanes that it has at the moment.
    """

    compiled: bool
    budget: Budget

    @property
    def seconds(self) -> float:
        """Return the seconds that were spent on making kernels."""
        ...

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return how many 32-bit numbers a lane takes in a thread, where the picture has such layers; 0: it is measured."""
        ...

    def run(self, spans: Sequence[work.Span], each: Callable[[TaskResult | None], bool]) -> bool:
        """Take samples of every pixel of plates; return whether all were taken.

        Args:
            spans: plates, with the first sample and how many are to be taken.
            each: called in this thread after every task, and now and then with None; returning True ends the render.
        """
        ...

    def release_workers(self, keeps: bool) -> None:
        """Give up the memory of threads, or keep it for the next render of the same structure."""


class Tasks(Forward, Protocol):
    """One whose tasks others may deal to threads, among those of other renders."""

    def blocks(self, spans: Sequence[work.Span], tasks: int) -> list[Block]:
        """Cut samples of plates into blocks of pixels: ``tasks`` for each plate, as far as they repay."""
        ...

    def task(self, block: Block) -> TaskResult:
        """Take a block, in a thread of its own."""
        ...

    def retry_blocks(self, blocks: list[Block], each: Callable[[TaskResult | None], bool]) -> bool:
        """Take blocks for which there was no memory, by fewer threads or lanes; else as :meth:`run`."""
        ...

    def halt(self) -> None:
        """End the render: tasks stop at their next kernel."""


def forward_tensors(wave: Wave, budget: Budget) -> Forward:
    """Return who takes samples by tensor operations, in pieces of as many lanes as a budget has."""
    return TensorsForward(wave, budget)


def kernels_of(wave: Wave, own: Sequence[int], before: Kernels | None = None) -> Kernels:
    """Return the kernels of a render; models that no kernel can be made of are named in ``eager``.

    Args:
        wave: of the render.
        own: numbers of the models that are the caller's: it is tried at once whether kernels can be made of them.
        before: those of another render, whose tables are taken over where they are made of the same tensors.
    """
    packets = uses_packets(wave)
    opaque = wave.context.world.materials.opacity is None and not wave.integrator.own_transmit
    fused = packets and opaque and wave.first is None and not wave.integrator.splats
    kernels = Kernels(wave, packets, fused, before, fixed=not own)
    eager = kernels.probe(own) if wave.integrator.light else {}
    if eager and kernels.fused:  # what runs as tensor operations hands its rays to the search structure
        kernels = Kernels(wave, packets, False)
    kernels.eager = eager
    return kernels


def forward_kernels(kernels: Kernels, threads: int | None = None, strict: bool = False) -> Tasks:
    """Return who takes samples by kernels.

    Args:
        kernels: of the render.
        threads: None: as many as torch's.
        strict: whether a task ends at a sample that is not finite; whoever is told of it ends the render.
    """
    return KernelsForward(kernels, threads or torch.get_num_threads(), kernels.wave.integrator.clamp, strict)


def describe_kernels(kernels: Kernels) -> dict[str, Any]:
    """Tell how a render runs by kernels."""
    search = (
        "inside the stages" if kernels.fused else "kernels of packets" if kernels.packets else kernels.wave.accel.name
    )
    names = [str(model) for model in kernels.wave.context.world.materials.models]
    eager = {names[number]: reason for number, reason in kernels.eager.items()}
    return {
        "stages": "compiled to loops over lanes",
        "search": search,
        "rows_a_path": kernels.state.count,
        **({"eager": eager} if eager else {}),
    }


# ---- The way back


class Backward(Engine[P], Protocol[P, M, S]):
    """An engine that also goes back along the vertices of a chunk's paths, one chunk after the other.

    Of a walk it keeps the first :data:`KEPT` populations as they are until it walks again; the others are gone two vertices
    on. Derivatives by what a vertex was given lie with the samples, where the vertex before finds them.
    """

    wave: Wave

    def begin(self, span: Span, sums: S) -> P:
        """Start the paths of a chunk by its rays; derivatives are added to ``sums`` from now on."""
        ...

    def mark(self, paths: P) -> M:
        """Copy a population with its hits, not sorted yet."""
        ...

    def resume(self, mark: M) -> P:
        """Start there once more; what the paths brought so far is not in what they bring then."""
        ...

    def radiance_of_samples(self) -> Tensor:
        """Return what the paths from the camera brought ``(3, samples * pixels)``, weighted by the filter."""
        ...

    def receive(self, cotangent: Tensor) -> None:
        """Take the cotangents of that, with which the way back begins."""

    def vjp(self, paths: P) -> None:
        """Pull cotangents back through a vertex, once those of all vertices behind it were."""

    def vjp_rays(self) -> None:
        """Pull them back through the rays that the paths began with."""


class BackwardKernels(Protocol):
    """The kernels of a way back.

    Attributes:
        eager_vjps: stages that run by tensor operations (``("bounce", model, ...)``, ``("emit", ...)``), and why.
    """

    eager_vjps: dict[tuple[Any, ...], str]

    def engine(self) -> Backward[Any, Any, ChunkGradientSums]:
        """Return an engine for one more thread."""
        ...

    def bytes_per_lane(self, levels: int) -> int:
        """Return what a lane costs that keeps so many vertices."""
        ...


def uses_packets(wave: Wave) -> bool:
    """Return True where kernels search by packets, which know no quadrics."""
    return wave.accel.name == "brute" and not wave.context.world.geometry.counts[4]


def backward_tensors(tape: Tape, cotangent: Tensor | None) -> Backward[Any, Any, GradientSums]:
    """Return the way back by tensor operations.

    Args:
        tape: the wave, and what is differentiated in it.
        cotangent: ``(3, H W)`` of the picture, over the samples of a pixel, where paths have splats.
    """
    from torchpt.engines.tensors_backward import TensorsBackward

    return TensorsBackward(tape, None if cotangent is None else cotangent.to(tape.wave.context.plan.dtype))


def backward_kernels(tape: Tape, own: Sequence[int], cotangent: Tensor | None) -> BackwardKernels:
    """Return the kernels of a way back, which make an engine for each thread.

    Args:
        tape: as of :func:`backward_tensors`.
        own: numbers of the models of which no kernel may be made.
        cotangent: as of :func:`backward_tensors`.
    """
    from torchpt.engines.kernels.backward import VjpKernels

    kernels = VjpKernels(tape, uses_packets(tape.wave), None if cotangent is None else cotangent.float().contiguous())
    kernels.eager = kernels.probe(own)
    return kernels
