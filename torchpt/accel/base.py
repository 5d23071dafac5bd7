"""The contract of a search structure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["Accel", "Hits"]

#: ``t`` (N,) float32, ``prim`` (N,) int32, ``u`` (N,), ``v`` (N,).
Hits = tuple[Tensor, Tensor, Tensor, Tensor]


class Accel(ABC):
    """Finds what rays hit first, and whether they hit anything.

    Rays are ``o, d`` ``(3, N)`` and ``t_max`` ``(N,)``; ``d`` need not be unit, ``t`` counts in units of ``|d|``. A hit
    has ``0 < t < t_max``, from either side; equal ``t`` goes to the lowest primitive id. A miss is ``prim = -1``,
    ``t = inf``, ``u = v = 0``. Rays with ``t_max <= 0`` or with a component that is not finite miss. Nothing is
    differentiable here.
    """

    name: str = ""

    @torch.no_grad()
    def intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        """The nearest hit of each ray: ``t, prim, u, v``, each ``(N,)``."""
        return self._intersect(*_rays(o, d, t_max))

    @torch.no_grad()
    def occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        """Whether anything lies in the open interval ``(0, t_max)``: ``(N,)`` bool."""
        return self._occluded(*_rays(o, d, t_max))

    def nearest(
        self,
        o: np.ndarray,
        d: np.ndarray,
        t_max: np.ndarray,
        count: int,
        t: np.ndarray,
        prim: np.ndarray,
        u: np.ndarray,
        v: np.ndarray,
    ) -> None:
        """:meth:`intersect` for the first ``count`` lanes of an arena, into the arena, in the calling thread alone.

        Args:
            o: ``(3, C)`` float32.
            d: ``(3, C)`` float32.
            t_max: ``(C,)`` float32.
            count: at most C.
            t: ``(C,)`` float32, written.
            prim: ``(C,)`` int32, written.
            u: ``(C,)`` float32, written.
            v: ``(C,)`` float32, written.
        """
        rays = (torch.from_numpy(x[..., :count]) for x in (o, d, t_max))
        for out, found in zip((t, prim, u, v), self.intersect(*rays), strict=True):
            out[:count] = found.numpy()

    def blocked(self, o: np.ndarray, d: np.ndarray, t_max: np.ndarray, count: int, out: np.ndarray) -> None:
        """:meth:`occluded` likewise; ``out (C,)`` int32 becomes 1 or 0."""
        rays = (torch.from_numpy(x[..., :count]) for x in (o, d, t_max))
        out[:count] = self.occluded(*rays).numpy()

    @abstractmethod
    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits: ...

    @abstractmethod
    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor: ...

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What was built: name, primitives, nodes, leaves, sah_cost, depth, bytes, build_seconds."""


def _rays(o: Tensor, d: Tensor, t_max: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(x.detach().to(torch.float32).contiguous() for x in (o, d, t_max))  # type: ignore[return-value]
