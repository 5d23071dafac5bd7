"""The kernels of a backward pass: those of the paths as they are traced again, and those that go back along them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from torchpt.engines.kernels import joint
from torchpt.engines.kernels.kernels import Kernel, Kernels
from torchpt.engines.kernels.rows import Rows
from torchpt.integrators.wave import Wave, still_of
from torchpt.lanes.graph import Unsupported

__all__ = ["JointKernels"]

_STAGES = {"bounce": joint.back_bounce, "emit": joint.back_emit, "escape": joint.back_escape}


class JointKernels(Kernels):
    """The kernels of one backward pass.

    Args:
        wave: with plain tensors.
        taped: the same with leaves in place of those that are differentiated.
        plain: tensors that are differentiated, as the wave has them.
        tapes: their leaves.
        packets: see :class:`~torchpt.engines.kernels.layout.Layout`.
        cotangent: ``(3, H W)`` float32 of the picture, over the samples of a pixel: what splats read.

    Attributes:
        taped: what stages read where they are gone back along.
        numbers_of: which of the leaves a tensor is, by its id.
        back_eager: stages that no kernel can be made of, and why.
        slots: rows of :func:`torchpt.engines.kernels.joint.slots_of`.
    """

    def __init__(
        self,
        wave: Wave,
        taped: Wave,
        plain: Sequence[Tensor],
        tapes: Sequence[Tensor],
        packets: bool,
        cotangent: Tensor | None = None,
    ) -> None:
        super().__init__(still_of(wave), packets, False, cotangent=cotangent)
        self.cotangent = cotangent
        self.taped = taped.context
        self.plain, self.tapes = tuple(plain), tuple(tapes)
        self.numbers_of = {id(tape): number for number, tape in enumerate(tapes)}
        paths = [self._leaves.ids[id(one)][0] if id(one) in self._leaves.ids else None for one in plain]
        for path, tape in zip(paths, tapes, strict=True):
            if path is not None:
                self._leaves.ids[id(tape)] = path, tape
        self.structure = (*self.structure, self.taped.plan.attached, tuple(paths))
        self.slots = Rows(joint.slots_of(self))
        self.back_eager: dict[tuple[Any, ...], str] = {}

    def back_kernel(self, key: tuple[Any, ...]) -> Kernel | None:
        """The kernel of ``("bounce", model, roulette, slide)``, ``("emit", slide)`` or ``("escape",)`` gone back through.

        None: none can be made; :attr:`back_eager` says why.
        """
        if key in self.back_eager:
            return None
        try:
            return self._get(True, _STAGES[key[0]], *key[1:])
        except Unsupported as error:
            self.back_eager[key] = str(error)
            return None

    def report(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.joint.report`."""
        return self._get(False, joint.report)
