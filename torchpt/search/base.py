"""The contract of a search structure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry

__all__ = ["Accel", "Array", "Hits", "mark_non_opaque"]

#: A numpy array, float32 or int32.
Array = np.ndarray[Any, Any]

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
    #: Whether :meth:`refit` ever gives a structure.
    refits: bool = False

    @torch.no_grad()
    def intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        """The nearest hit of each ray: ``t, prim, u, v``, each ``(N,)``."""
        return self._intersect(*_rays(o, d, t_max))

    @torch.no_grad()
    def occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        """Whether anything lies in the open interval ``(0, t_max)``: ``(N,)`` bool."""
        return self._occluded(*_rays(o, d, t_max))

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """The nearest hits of the first ``count`` rays of arrays, for loops outside of torch.

        Serial, and in the numba backends without the GIL, so that several Python threads may search at once. Only lanes
        below ``count`` are read and written. Misses are those of :meth:`intersect`.

        Args:
            o: origins ``(3, C)`` float32, C-contiguous, ``C >= count``.
            d: directions, likewise.
            t_max: ``(C,)`` float32.
            count: how many rays.
            t: ``(C,)`` float32, filled.
            prim: ``(C,)`` int32, filled.
            u: ``(C,)`` float32, filled.
            v: ``(C,)`` float32, filled.
        """
        rays = (torch.from_numpy(x[..., :count]) for x in (o, d, t_max))
        for out, found in zip((t, prim, u, v), self.intersect(*rays), strict=True):
            out[:count] = found.numpy()

    def refit(self, geometry: Geometry, threads: int | None = None) -> Accel | None:
        """A structure for primitives that have moved, made from this one, which stays as it is and may be in use.

        Args:
            geometry: the primitives where they are now, on the same device.
            threads: as where a structure is built.

        Returns:
            The structure, or None where one has to be built: this kind has no refit, the primitives are others, or they have
            moved too far for a search to be quick.
        """
        return None

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """Whether anything lies in ``(0, t_max)``: 1 or 0 in ``out (C,)`` int32; else as :meth:`nearest`.

        Args:
            o: as in :meth:`nearest`.
            d: likewise.
            t_max: likewise.
            count: how many rays.
            out: ``(C,)`` int32, filled.
            non_opaque: a uint8 for each primitive, not 0 where light may pass it. A ray gets 2 where it
                may be that all it meets lets light pass, so that it has to be looked at closer.
        """
        rays = (torch.from_numpy(x[..., :count]) for x in (o, d, t_max))
        out[:count] = self.occluded(*rays).numpy()
        mark_non_opaque(out[:count], non_opaque)

    @abstractmethod
    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits: ...

    @abstractmethod
    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor: ...

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What was built: name, primitives, nodes, leaves, sah_cost, depth, bytes, build_seconds."""


def mark_non_opaque(out: Array, non_opaque: Array | None) -> None:
    """What was found without a look at ``non_opaque`` as :meth:`Accel.blocked` tells it: 2 for 1 where there are any."""
    if non_opaque is not None:
        np.left_shift(out, 1, out=out)


def _rays(o: Tensor, d: Tensor, t_max: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(x.detach().to(torch.float32).contiguous() for x in (o, d, t_max))  # type: ignore[return-value]
