"""Splats and connections: the shadow rays of paths besides those to lights, and what they bring.

These rays are searched by the kernels of those to lights, in their rows: side by side, as many paths have none. What was there
is put back.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from torchpt.engines.kernels.calls import LaneCount
from torchpt.engines.kernels.layout import Memory
from torchpt.engines.kernels.searches import ChunkSearch
from torchpt.native.kernels import kernel
from torchpt.physics.film.splats import LARGEST, Splats

__all__ = ["RAY_ROWS", "HostJoins", "Joins", "TensorJoins"]

#: Rows of a ray: o, d and t.
RAY_ROWS = 7
#: Bits of the magnitude of a float32.
_MAGNITUDE = 0x7FFFFFFF
_LARGEST = np.array([LARGEST], np.float32)


class Joins(Protocol):
    """Joins of paths to other pixels, and to light paths."""

    def splats(self, arena: Memory, count: LaneCount) -> tuple[Splats, Any] | None:
        """Search the rays of splats, and set their transmittance, 0 where there is none.

        Args:
            arena: of the paths.
            count: number of lanes.

        Returns:
            The splats that arrive, by sample; the samples with one that is not finite, left out. None: no path has a splat.
        """
        ...

    def connect(self, arena: Memory, count: LaneCount) -> None:
        """Search the rays of connections, and add what they bring to the radiance of their paths; arguments as above."""
        ...


class HostJoins:
    """Joins on a CPU.

    Args:
        search: of a thread.
    """

    def __init__(self, search: ChunkSearch) -> None:
        self.search = search

    def splats(self, arena: Memory, count: int) -> tuple[Splats, np.ndarray] | None:
        """See :class:`Joins`."""
        rows, words, stride = self.search.kernels.state, arena.address, arena.words.shape[1]
        began = self._begin(arena, count, rows.first("splat_pixel"), -1, -1, "splat")
        if began is None:
            arena.floats[rows.first("splat_transmittance"), :count] = 0.0
            return None
        lanes, saved, n = began
        samples, pixels, lost = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n + 1, np.int32)
        values = np.empty((3, n), np.float32)
        found = kernel("splats", "end_splats")(
            words, words, stride, count, n, rows.first("shadow_o"), *self._result(),
            rows.first("lane"), rows.first("splat_pixel"), rows.first("splat_radiance"), rows.first("splat_transmittance"),
            lanes, saved, _LARGEST, samples, pixels, values, lost,
        )  # fmt: skip
        sample, pixel = (torch.from_numpy(x[:found].astype(np.int64)) for x in (samples, pixels))
        return Splats(sample, pixel, torch.from_numpy(values[:, :found])), lost[1 : 1 + lost[0]]

    def connect(self, arena: Memory, count: int) -> None:
        """See :class:`Joins`."""
        rows, words, stride = self.search.kernels.state, arena.address, arena.words.shape[1]
        began = self._begin(arena, count, rows.first("connection_t"), _MAGNITUDE, 0, "connection")
        if began is not None:
            lanes, saved, n = began
            kernel("splats", "add_connections")(
                words, words, stride, n, rows.first("shadow_o"), *self._result(),
                rows.first("connection_radiance"), rows.first("radiance"), lanes, saved,
            )  # fmt: skip

    def _begin(
        self, arena: Memory, count: int, row: int, mask: int, least: int, name: str
    ) -> tuple[np.ndarray, np.ndarray, int] | None:
        """Search the rays of the lanes with more than ``least`` in the bits ``mask`` of ``row``.

        ``name``: of the rays' rows, ``splat`` or ``connection``.

        Returns:
            The lanes, what was in the rows of rays to lights, and the number of rays; None: there are none.
        """
        rows, stride = self.search.kernels.state, arena.words.shape[1]
        lanes, saved = np.empty(count, np.int32), np.empty(RAY_ROWS * count, np.int32)
        n = kernel("splats", "begin_rays")(
            arena.address, stride, count, row, mask, least, rows.first(f"{name}_o"), rows.first("shadow_o"), lanes, saved,
        )  # fmt: skip
        if not n:
            return None
        self.search.light(arena, n)
        return lanes, saved, n

    def _result(self) -> tuple[int, int]:
        """Return the row of the results of a search of shadow rays, and 1 where they are transmittances."""
        rows = self.search.kernels.state
        partly = "transmittance" in rows
        return rows.first("transmittance" if partly else "blocked"), int(partly)


class TensorJoins:
    """Joins on a device, by tensor operations; the number of rays is waited for.

    Args:
        search: of a wave.
    """

    def __init__(self, search: ChunkSearch) -> None:
        self.search = search

    def splats(self, arena: Any, count: LaneCount) -> tuple[Splats, Tensor] | None:
        """See :class:`Joins`."""
        rows, n = self.search.kernels.state, self.search.calls.known(count)
        pixel = arena.words[rows.first("splat_pixel"), :n]
        transmittance = arena.floats[rows.first("splat_transmittance"), :n]
        transmittance[:] = 0.0
        lanes = (pixel >= 0).nonzero()[:, 0]
        if not len(lanes):
            return None
        transmittance[lanes] = passed = self._passed(arena, "splat", lanes, n)
        first = rows.first("splat_radiance")
        value = arena.floats[first : first + 3][:, lanes] * passed
        arrives, finite = passed != 0, (abs(value) < LARGEST).all(0)
        lane, counts = arena.words[rows.first("lane"), :n][lanes], arrives & finite
        found = Splats(lane[counts].long(), pixel[lanes][counts].long(), value[:, counts])
        return found, lane[arrives & ~finite]

    def connect(self, arena: Any, count: LaneCount) -> None:
        """See :class:`Joins`."""
        rows, n = self.search.kernels.state, self.search.calls.known(count)
        lanes = arena.floats[rows.first("connection_t"), :n].nonzero()[:, 0]
        if len(lanes):
            passed = self._passed(arena, "connection", lanes, n)
            first, radiance = rows.first("connection_radiance"), rows.first("radiance")
            arena.floats[radiance : radiance + 3, lanes] += arena.floats[first : first + 3][:, lanes] * passed

    def _passed(self, arena: Any, name: str, lanes: Tensor, n: int) -> Tensor:
        """Return the transmittance of rays.

        Args:
            arena: of ``n`` lanes.
            name: of the rays' rows: ``splat`` or ``connection``.
            lanes: those that have such a ray.
            n: number of lanes.
        """
        rows, search = self.search.kernels.state, self.search
        # The rows o, d and t of these rays, and of those to lights.
        ray, shadow = (arena.words[rows.first(f"{k}_o") : rows.first(f"{k}_radiance"), :n] for k in (name, "shadow"))
        columns = slice(0, len(lanes))
        saved = shadow[:, columns] + 0
        shadow[:, columns] = ray[:, lanes]
        search.light(arena, search.calls.lanes(len(lanes)))
        shadow[:, columns] = saved
        if "transmittance" in rows:
            return arena.floats[rows.first("transmittance"), columns]
        return (arena.words[rows.first("blocked"), columns] == 0) * 1.0
