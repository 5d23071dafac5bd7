"""Copies of parameters on the host, where worlds are assembled.

A render on a GPU reads a world that was computed on the CPU. Parameters of the scene that do not change between renders, such
as texels and the vertices of a scene whose lights are optimized, are copied once.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchpt.core.threads import outside_inference_mode

__all__ = ["HostCopies"]


class HostCopies:
    """Copies of a scene's tensors, kept until these change."""

    def __init__(self) -> None:
        #: By name: the tensor, its version by torch, and the copy.
        self._kept: dict[str, tuple[Tensor, int, Tensor]] = {}

    def of(self, params: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return parameters on the host, themselves where they are there; gradients flow back to the originals.

        Args:
            params: the parameters by name.
            own: the scene's own parameters: copies of these alone are kept.
        """
        return {name: self._copy_of(name, value, kept=own.get(name) is value) for name, value in params.items()}

    def _copy_of(self, name: str, value: Tensor, *, kept: bool) -> Tensor:
        if value.device.type == "cpu":
            return value
        if not kept or value.is_inference() or (value.requires_grad and torch.is_grad_enabled()):
            return value.cpu()
        tensor, version, copy = self._kept.get(name, (None, 0, value))
        if tensor is not value or version != value._version:
            with outside_inference_mode():
                copy = value.detach().cpu()
            self._kept[name] = value, value._version, copy
        return copy
