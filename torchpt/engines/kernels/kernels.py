"""The kernels of a render: which there are, and how each is made once.

To add a kernel: write the function that traces it (in ``vertex.py``, ``packets.py``, ``transmission.py``, ``output.py`` or a
file of its own; it takes a :class:`~torchpt.engines.kernels.trace.Trace` and returns sinks), give it a method here, and run it
where ``chunk.py`` needs it. What a path must carry for it is a row in ``layout.py``.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.tree import fingerprint, signature
from torchpt.engines.kernels import output, transmission, vertex
from torchpt.engines.kernels import packets as packet_kernels
from torchpt.engines.kernels.handed import Handed
from torchpt.engines.kernels.layout import Layout
from torchpt.engines.kernels.leaves import Leaves
from torchpt.engines.kernels.programs import program_of
from torchpt.integrators.transmission import non_opaque
from torchpt.lanes.graph import Unsupported
from torchpt.lanes.program import Program, Tables, bound
from torchpt.lanes.sinks import Sinks

if TYPE_CHECKING:
    from torchpt.integrators.wave import Wave

__all__ = ["Kernel", "Kernels"]


@dataclass(frozen=True)
class Kernel:
    """A stage's machine code with the tables of one scene."""

    program: Program
    tables: Tables


class Kernels(Layout):
    """The kernels of one render, made when they are first asked for.

    Args:
        wave: the render.
        packets: see :class:`~torchpt.engines.kernels.layout.Layout`.
        fused: see there.
        before: kernels of another render, whose tables are taken over where they are made of the same tensors.
        fixed: whether a world says the same of itself as long as it is the same one; models of the caller's own may not.
        cotangent: see :class:`~torchpt.engines.kernels.joint_kernels.JointKernels`.

    Attributes:
        eager: models whose stage does what no kernel can, and what that is; they run as tensor operations.
        seconds: spent on making kernels.
        structure: what renders have in common that can share kernels, and threads their memory.
        handed: what renders of the same structure share.
        search: what the search by packets reads; None where the search structure is called.
        non_opaque: for each primitive whether a ray may pass it, as uint8, for the search structure.
    """

    def __init__(
        self,
        wave: Wave,
        packets: bool,
        fused: bool,
        before: Kernels | None = None,
        fixed: bool = False,
        cotangent: Tensor | None = None,
    ) -> None:
        super().__init__(wave, packets, fused)
        self._leaves = Leaves(
            {
                "world": self.world,
                "camera": wave.camera,
                "filter": wave.filter.tensors(),
                "sampler": self.numbers,
                "centre": wave.centre,
                "pixel": wave.context.pixel,
                "first": wave.first,
                "cotangent": cotangent,
            },
            None if before is None else before._leaves,
        )
        same = fixed and before is not None and before.world is self.world
        self._of_world = before._of_world if same else signature(self.world)  # pyright: ignore[reportOptionalMemberAccess]
        own = (fingerprint(wave.integrator), wave.context.crop) if wave.integrator.own_stages else None
        asked = (wave.camera.kind(), wave.filter.kind(), self.plan, wave.first, own, self._leaves.tensors)
        self.structure = (self._of_world, *map(signature, asked), packets, fused)
        alike = before is not None and before.structure == self.structure
        self.handed = before.handed if alike else Handed()  # pyright: ignore[reportOptionalMemberAccess]
        self._laid_out = self.handed.tables(self._leaves)
        self._results = self.handed.results(self._leaves)
        self._made: dict[tuple[Any, ...], Kernel] = {}
        self._lock = threading.Lock()
        self.search = packet_kernels.search_words(wave) if packets else None
        self.non_opaque: np.ndarray | None = None
        if self.has_opacity and not packets:
            prims = torch.arange(sum(self.world.geometry.counts))
            self.non_opaque = non_opaque(self.world, prims).to(torch.uint8).numpy()
        self.seconds = 0.0
        self.eager: dict[int, str] = {}

    def probe(self, numbers: Iterable[int]) -> dict[int, str]:
        """Return which of the models' stages no kernel can be made of, and why."""
        reasons = {}
        for number in numbers:
            try:
                self.bounce(number, 0.0)
            except Unsupported as error:
                reasons[number] = str(error)
        return reasons

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Rows of 32-bit numbers that a thread keeps for its lanes, see :mod:`torchpt.engines.kernels.chunk`."""
        shown = sum(len(layer.channels) for layer in layers.values())
        return 2 * self.state.count + 2 * (self.models + 2) + 3 + shown

    # -- vertices of paths

    def generate(self, chosen: bool, given: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.vertex.generate`."""
        return self._get(False, vertex.generate, chosen, given)

    def settle(self, shadow: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.vertex.settle`."""
        return self._get(False, vertex.settle, shadow)

    def emit(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.vertex.emit`."""
        return self._get(True, vertex.emit)

    def escape(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.vertex.escape`."""
        return self._get(True, vertex.escape)

    def bounce(self, model: int, roulette: float) -> Kernel:
        """See :func:`torchpt.engines.kernels.vertex.bounce`."""
        return self._get(self.listed, vertex.bounce, model, roulette)

    def retire(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.vertex.retire`."""
        return self._get(self.listed, vertex.retire)

    # -- the search by packets

    def find(self, passed: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.packets.find`."""
        return self._get(False, packet_kernels.find, passed)

    def block(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.packets.block`."""
        return self._get(False, packet_kernels.block)

    # -- surfaces that are not opaque

    def sift(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.transmission.sift`."""
        return self._get(False, transmission.sift)

    def transmit(self, again: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.transmission.transmit`."""
        return self._get(not again, transmission.transmit, again)

    def begin(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.transmission.begin`."""
        return self._get(False, transmission.begin)

    def through(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.transmission.through`."""
        return self._get(False, transmission.through)

    # -- what leaves a chunk

    def layers(self, model: int, names: tuple[str, ...]) -> Kernel:
        """See :func:`torchpt.engines.kernels.output.layers`."""
        return self._get(self.listed, output.layers, model, names)

    def deposit(self, channels: int, clamp: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.output.deposit`."""
        return self._get(False, output.deposit, channels, clamp)

    # -- how they are made

    def _get(self, listed: bool, build: Callable[..., Sinks], *arguments: Any) -> Kernel:
        """The kernel that ``build(trace, *arguments)`` traces; ``listed``: it takes lanes by a list, else all in order."""
        key = (build.__name__, *arguments)
        made = self._made.get(key)
        if made is not None:
            return made
        with self._lock:
            made = self._made.get(key)
            if made is None:
                begin = time.perf_counter()
                made = self._made[key] = self._make(key, listed, build, arguments)
                self.seconds += time.perf_counter() - begin
            return made

    def _make(
        self, key: tuple[Any, ...], listed: bool, build: Callable[..., Sinks], arguments: tuple[Any, ...]
    ) -> Kernel:
        def traced(trace: Any) -> Sinks:
            return build(trace, *arguments)

        program = program_of(key, self.structure, self._leaves, self, traced, listed)
        old = self.handed.kernel(key, program, self._leaves)
        if old is not None:
            return old
        leaves = self._leaves.tensors
        tables = bound(
            program.tables, program.steps, program.held, leaves, self._laid_out, program.names, self._results
        )
        made = Kernel(program, tables)
        self.handed.keep(key, made, self._laid_out, self._results, self._leaves)
        return made
