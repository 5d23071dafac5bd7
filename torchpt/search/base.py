"""The interface of acceleration structures.

It comes twice: on tensors, whole waves of rays at once on all threads (:meth:`Accel.intersect`, :meth:`Accel.occluded`), for
the engine of tensors; and on numpy arrays, some rays in the calling thread (:meth:`Accel.nearest`, :meth:`Accel.blocked`), for
the workers of the engine of kernels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry

__all__ = ["Accel", "Array", "Hits", "Search", "mark_non_opaque"]

#: A numpy array, float32 or int32.
Array = np.ndarray[Any, Any]

#: Searches the first rays of arrays, as many as it is given.
Search = Callable[[int], None]

#: ``t`` (N,) float32, ``prim`` (N,) int32, ``u`` (N,) and ``v`` (N,) float32: distance, primitive id, and parameters of the
#: point on the primitive (:class:`torchpt.physics.shapes.geometry.Geometry`). See :class:`Accel`.
Hits = tuple[Tensor, Tensor, Tensor, Tensor]


class Accel(ABC):
    """An acceleration structure: finds the nearest hits of rays, and whether rays hit anything.

    Rays are ``o, d`` ``(3, N)`` and ``t_max`` ``(N,)``; ``d`` need not have length 1, ``t`` is in units of ``|d|``. A hit has
    ``0 < t < t_max``, from either side; of hits with equal ``t`` the lowest primitive id wins. A miss has ``prim = -1``,
    ``t = inf``, ``u = v = 0``. Rays with ``t_max <= 0`` or a non-finite component miss. Results have no gradients.
    """

    name: str = ""
    #: True if :meth:`refit` is supported.
    refits: bool = False

    @torch.no_grad()
    def intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        """Return the nearest hit of each ray: ``t, prim, u, v``, each ``(N,)``."""
        return self._intersect(*_rays(o, d, t_max))

    @torch.no_grad()
    def occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        """Return True for rays with a hit in the open interval ``(0, t_max)``: ``(N,)`` bool."""
        return self._occluded(*_rays(o, d, t_max))

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """Find the nearest hits of the first ``count`` rays of numpy arrays, for loops outside of torch.

        Runs in the calling thread; backends of machine code release the GIL, so several Python threads may search at once. Only
        lanes below ``count`` are read and written. Misses are as in :meth:`intersect`.

        Args:
            o: origins ``(3, C)`` float32, C-contiguous; C is the capacity of the arrays, at least ``count``.
            d: directions, likewise.
            t_max: ``(C,)`` float32.
            count: number of rays.
            t: ``(C,)`` float32, filled.
            prim: ``(C,)`` int32, filled.
            u: ``(C,)`` float32, filled.
            v: ``(C,)`` float32, filled.
        """
        rays = (torch.from_numpy(x[..., :count]) for x in (o, d, t_max))
        for out, result in zip((t, prim, u, v), self.intersect(*rays), strict=True):
            out[:count] = result.numpy()

    def nearest_in(self, o: Array, d: Array, t_max: Array, t: Array, prim: Array, u: Array, v: Array) -> Search:
        """Return a function of ``count`` that does what :meth:`nearest` does in these arrays, for one thread.

        It is quicker to call where there are few rays.
        """
        return lambda count: self.nearest(o, d, t_max, count, t, prim, u, v)

    def refit(self, geometry: Geometry, threads: int | None = None) -> Accel | None:
        """Return a structure for primitives that have moved, refitted from this one, which is not changed and may be in use.

        Args:
            geometry: the primitives at their new positions, on the same device.
            threads: CPU threads, as for :func:`torchpt.search.build`.

        Returns:
            The structure, or None if it has to be built anew: this backend does not refit, the primitives are others, or they
            have moved so far that the refitted tree would be slow.
        """
        return None

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """Write 1 to ``out`` for rays with a hit in ``(0, t_max)``, else 0; otherwise as :meth:`nearest`.

        Args:
            o: as in :meth:`nearest`.
            d: likewise.
            t_max: likewise.
            count: number of rays.
            out: ``(C,)`` int32, filled.
            non_opaque: ``(P,)`` uint8, nonzero for a primitive that may let light pass; None: all are opaque. A ray gets 2
                instead of 1 if possibly all primitives that it hits are of this sort: the caller then computes its
                transmittance. A backend that does not look at the primitives it hits writes 2 for every ray that hits.
        """
        rays = (torch.from_numpy(x[..., :count]) for x in (o, d, t_max))
        out[:count] = self.occluded(*rays).numpy()
        mark_non_opaque(out[:count], non_opaque)

    def blocked_in(self, o: Array, d: Array, t_max: Array, out: Array, non_opaque: Array | None = None) -> Search:
        """Return a function of ``count`` that does what :meth:`blocked` does in these arrays, as :meth:`nearest_in`."""
        return lambda count: self.blocked(o, d, t_max, count, out, non_opaque)

    @abstractmethod
    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits: ...

    @abstractmethod
    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor: ...

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return statistics: name, primitives, nodes, leaves, sah_cost, depth, bytes, build_seconds.

        ``sah_cost`` is the expected cost of a random ray that meets the root's box, by the surface area heuristic.
        """


def mark_non_opaque(out: Array, non_opaque: Array | None) -> None:
    """Replace 1 by 2 in ``out`` if there are non-opaque primitives, for a search that does not look which ones a ray hits.

    2 means that the caller has to compute the transmittance, see :meth:`Accel.blocked`.
    """
    if non_opaque is not None:
        np.left_shift(out, 1, out=out)  # 1 becomes 2, 0 stays


def _rays(o: Tensor, d: Tensor, t_max: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(x.detach().to(torch.float32).contiguous() for x in (o, d, t_max))  # type: ignore[return-value]
