"""The photon map: light paths as they arrive at surfaces, which camera paths are merged with.

Sample s of each pixel has a map of its own, of the light paths of sample s of all pixels, and a radius. A vertex of a camera
path is merged with one of the photons within the radius, chosen at random, which stands for all of them. So the work is that
of one merge a vertex, however many photons there are. Photons are chosen by their flux times about the weight that their merge
will have: else those of direct light, which light samples find better, would hide those of a caustic. The choice is a function
of the sample and of the map alone, as photons have an order of their own, that of pixels and depths.

Photons are found by a grid of cells as wide as two radii, so that a sphere meets eight at most. Cells are numbered by a hash.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.native.kernels import kernel
from torchpt.paths.state import Photon
from torchpt.physics.samplers.dimensions import Dimension, salt

__all__ = ["MERGE_SHARE", "PHOTON", "PhotonMap", "merging_of", "photon_of"]

#: For how many photons one within the radius counts in weights: below 1, so that merges are left to light that other strategies
#: hardly find. Any number gives the same mean in the limit; a small one has less bias and less variance where others find it.
MERGE_SHARE = 0.3
#: Density with which camera paths go on along a photon's direction, for the chance to be chosen: that of a diffuse surface.
_REVERSE = 1.0 / math.pi
#: Least chance of photons to be chosen, relative to those of their flux that nothing else finds.
_LEAST_CHANCE = 0.01
#: Fields of a photon, and their rows.
PHOTON = {"p": 3, "d": 3, "value": 3, "dvcm": 1, "dvc": 1, "depth": 1}
_DATA = ("d", "value", "dvcm", "dvc", "depth")
#: Rows of the table of all fields but the points.
_ROWS = sum(PHOTON[name] for name in _DATA)


def merging_of(radius: float, paths: float) -> float:
    """Return the ratio of densities of a merge, as weights count it; ``paths``: number of light paths of a sample."""
    return MERGE_SHARE * math.pi * radius * radius * paths


def photon_of(values: Mapping[str, Tensor]) -> Photon:
    """Return photons from tensors by field."""
    return Photon(**{name: values[name] for name in PHOTON})


def _importance(data: np.ndarray, merging: float) -> np.ndarray:
    """Return what the chances of photons to be chosen are proportional to ``(n,)``, from rows of :data:`_DATA`."""
    _, _, _, *value, dvcm, dvc, _ = data.astype(np.float64)
    others = np.hypot(dvcm, dvc * _REVERSE) / merging
    found = abs(np.array(value)).max(0) * np.maximum(1.0 / (1.0 + others * others), _LEAST_CHANCE)
    # The splats of a light path tell that it is not finite.
    return np.where(found < np.finfo(np.float32).max, found, 0.0)


@dataclass(frozen=True)
class PhotonMap:
    """The photons of one sample of each pixel.

    Attributes:
        points: ``(n, 4)`` float32: point, and what the chance to be chosen is proportional to, sorted by cell.
        data: ``(n, 9)`` float32: the other fields of :data:`PHOTON`.
        starts: ``(cells + 1,)`` int32: the first photon of each cell.
        radius: of merges.
        scale: of the value of all photons within the radius: one over area and number of light paths.
    """

    points: np.ndarray
    data: np.ndarray
    starts: np.ndarray
    radius: float
    scale: float

    @staticmethod
    def of(parts: Sequence[tuple[np.ndarray, Mapping[str, np.ndarray]]], radius: float, paths: float) -> PhotonMap:
        """Return the map of photons.

        Args:
            parts: the index of the pixel ``(n,)`` of photons, and their fields ``(n,)`` or ``(rows, n)``, in any order.
            radius: of merges.
            paths: number of light paths.
        """
        pixel = np.concatenate([np.asarray(pixels, np.int64) for pixels, _ in parts] or [np.zeros(0, np.int64)])

        def rows(names: Sequence[str]) -> np.ndarray:
            """Return the rows of fields of all parts, one below the other ``(rows, n)``."""
            blocks = [
                np.concatenate([np.atleast_2d(values[name]) for name in names], dtype=np.float32) for _, values in parts
            ]
            return np.concatenate(blocks, 1) if blocks else np.zeros((sum(PHOTON[k] for k in names), 0), np.float32)

        p, data = rows(("p",)), rows(_DATA)
        count = len(pixel)
        cells = 1 << max(int(2 * count).bit_length() - 1, 4)
        cell = np.empty(count, np.int32)
        columns = np.ascontiguousarray(p)
        inverse = np.float32(0.5) / np.float32(radius)  # rounded as in `near`
        kernel("photons", "cells_of")(columns, count, np.array([inverse], np.float32), cells, cell)
        depth = data[_ROWS - 1].astype(np.int64)
        # Unique: a light path has one vertex of each depth.
        pixels, depths = int(pixel.max(initial=0)) + 1, int(depth.max(initial=0)) + 1
        order = np.argsort((cell.astype(np.int64) * pixels + pixel) * depths + depth)
        points = np.empty((count, 4), np.float32)
        points[:, :3] = p.T[order]
        points[:, 3] = _importance(data, merging_of(radius, paths))[order]
        starts = np.zeros(cells + 1, np.int32)
        np.cumsum(np.bincount(cell, minlength=cells), out=starts[1:])
        scale = 1.0 / (math.pi * radius * radius * paths)
        return PhotonMap(points, np.ascontiguousarray(data.T[order]), starts, radius, scale)

    def near(self, p: np.ndarray, key: np.ndarray, depth: int) -> dict[str, np.ndarray]:
        """Return a photon near each vertex: fields of :class:`Photon` by name, without ``p``; ``value`` 0 where there is none.

        Args:
            p: the points ``(3, n)`` float32.
            key: the sampler's keys ``(rows, n)`` int32.
            depth: number of the vertices.
        """
        count = p.shape[1]
        p, key = np.ascontiguousarray(p, np.float32), np.ascontiguousarray(key, np.int32)
        found = np.empty((_ROWS, count), np.float32)
        kernel("photons", "near")(
            p, count, key, len(key), salt(Dimension.MERGE, depth), self.points.reshape(-1), self.data.reshape(-1), self.starts,
            len(self.starts) - 1, np.array([self.radius, self.scale], np.float32), found,
        )  # fmt: skip
        values, first = {}, 0
        for name in _DATA:
            rows = found[first : first + PHOTON[name]]
            values[name] = rows if len(rows) > 1 else rows[0]
            first += PHOTON[name]
        values["depth"] = values["depth"].astype(np.int64)
        return values

    def photons(self, p: Tensor, key: Tensor, depth: int) -> Photon:
        """Return a photon near each vertex; arguments as for :meth:`near`, tensors of any device and dtype."""
        found: dict[str, Any] = self.near(p.detach().float().cpu().numpy(), key.cpu().numpy(), depth)
        values = {name: torch.from_numpy(value).to(p.device) for name, value in found.items()}
        values = {name: value.to(p.dtype) if value.is_floating_point() else value for name, value in values.items()}
        return Photon(p=p, **values)
