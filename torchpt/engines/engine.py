"""The door of the engines: what they do for those above, and who is picked. Nobody above imports an engine by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from torch import Tensor

from torchpt.core.memory import Span
from torchpt.engines.kernels.engine import LANES as LANES_OF_KERNELS
from torchpt.paths.walk import KEPT, Engine, Population
from torchpt.paths.wave import Wave

if TYPE_CHECKING:  # the way back is imported where somebody goes it
    from torchpt.engines.kernels.backward import VjpKernels
    from torchpt.math.sums import Sums
    from torchpt.paths.adjoint import Tape

__all__ = ["KEPT", "LANES_OF_KERNELS", "Backward", "backward_kernels", "backward_tensors", "packets_of"]

P = TypeVar("P", bound=Population)
M = TypeVar("M")
S = TypeVar("S", contravariant=True)


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


def packets_of(wave: Wave) -> bool:
    """Return True where kernels search by packets, which know no quadrics."""
    return wave.accel.name == "brute" and not wave.context.world.geometry.counts[4]


def backward_tensors(tape: Tape, cotangent: Tensor | None) -> Backward[Any, Any, Sums]:
    """Return the way back by tensor operations.

    Args:
        tape: the wave, and what is differentiated in it.
        cotangent: ``(3, H W)`` of the picture, over the samples of a pixel, where paths have splats.
    """
    from torchpt.engines.tensors_backward import TensorsBackward

    return TensorsBackward(tape, None if cotangent is None else cotangent.to(tape.wave.context.plan.dtype))


def backward_kernels(tape: Tape, own: Sequence[int], cotangent: Tensor | None) -> VjpKernels:
    """Return the kernels of a way back, which make an engine for each thread.

    Args:
        tape: as of :func:`backward_tensors`.
        own: numbers of the models of which no kernel may be made.
        cotangent: as of :func:`backward_tensors`.
    """
    from torchpt.engines.kernels.backward import VjpKernels

    kernels = VjpKernels(tape, packets_of(tape.wave), None if cotangent is None else cotangent.float().contiguous())
    kernels.eager = kernels.probe(own)
    return kernels
