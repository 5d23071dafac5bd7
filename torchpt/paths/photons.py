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
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpt.native.kernels import kernel
from torchpt.paths.state import Photon
from torchpt.physics.film.splats import Splats
from torchpt.physics.samplers.dimensions import Dimension, salt

__all__ = [
    "FIELDS",
    "FIRST_ROW",
    "MERGE_SHARE",
    "PHOTON_ROWS",
    "TESTED",
    "LightOfSample",
    "PhotonMap",
    "PhotonRows",
    "SentLight",
    "SentPhotons",
    "data_of",
    "merging_of",
    "photon_of",
    "values_of",
]

#: For how many photons one within the radius counts in weights: below 1, so that merges are left to light that other strategies
#: hardly find. Any number gives the same mean in the limit; a small one has less bias and less variance where others find it.
MERGE_SHARE = 0.3
#: Density with which camera paths go on along a photon's direction, for the chance to be chosen: that of a diffuse surface.
_REVERSE = 1.0 / math.pi
#: Least chance of photons to be chosen, relative to those of their flux that nothing else finds.
_LEAST_CHANCE = 0.01
#: Fields of :class:`Photon` and their rows, which are the rows of *data* of photons, float32, in this order.
FIELDS = {"d": 3, "value": 3, "dvcm": 1, "dvc": 1, "depth": 1}
PHOTON_ROWS = sum(FIELDS.values())
#: The first row of each.
FIRST_ROW = {name: sum(list(FIELDS.values())[:k]) for k, name in enumerate(FIELDS)}
#: Photons that a kernel tests at a time, and so reads beyond the last one.
TESTED = 16
#: No photons.
_NONE = np.zeros((0, 3 + PHOTON_ROWS), np.float32)


def merging_of(radius: float, paths: float) -> float:
    """Return the ratio of densities of a merge, as weights count it; ``paths``: number of light paths of a sample."""
    return MERGE_SHARE * math.pi * radius * radius * paths


def values_of(photon: Photon) -> dict[str, Tensor]:
    """Return the values of photons by name of :data:`FIELDS`: ``(3, n)`` or ``(n,)``."""
    values = {name: getattr(photon, name) for name in FIELDS}
    return values | {"depth": photon.depth.to(photon.dvcm.dtype)}


def photon_of(values: Mapping[str, Tensor]) -> Photon:
    """Return photons from their values by name."""
    photon = Photon(**{name: values[name] for name in FIELDS})
    return replace(photon, depth=photon.depth.to(torch.int64))


def data_of(photon: Photon) -> np.ndarray:
    """Return the data of photons ``(9, n)``, on the host."""
    rows = [value.float().view(-1, value.shape[-1]) for value in values_of(photon).values()]
    return torch.cat(rows).cpu().numpy()


@dataclass(frozen=True)
class SentPhotons:
    """Photons of the light paths of some pixels.

    Attributes:
        pixel: ``(n,)`` int64 index of the pixel that each belongs to.
        rows: ``(n, 12)`` float32 their points and data, all finite.
    """

    pixel: np.ndarray
    rows: np.ndarray


@dataclass(frozen=True)
class SentLight:
    """Splats and photons of the light paths of some pixels, for the camera paths of the same sample.

    Attributes:
        first_pixel: index of the first one.
        pixels: their number.
        splats: their splats; ``lane`` is the index of the pixel.
        lost: ``(m,)`` int64 pixels whose light path has a splat or a photon that is not finite, each once.
        photons: their photons; None once they are in a map.
    """

    first_pixel: int
    pixels: int
    splats: list[Splats]
    lost: np.ndarray
    photons: SentPhotons | None

    @staticmethod
    def of(
        first_pixel: int,
        pixels: int,
        photons: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
        splats: Sequence[Splats],
        lost: np.ndarray,
    ) -> SentLight:
        """Return the light of consecutive pixels.

        Args:
            first_pixel: index of the first one.
            pixels: their number.
            photons: lanes ``(n,)``, points and data of photons.
            splats: splats by lane.
            lost: lanes ``(m,)`` with a splat that is not finite.
        """
        lanes, points, data = zip(*photons, strict=True) if photons else ((), (), ())
        pixel = np.concatenate([np.zeros(0, np.int64), *lanes]) + first_pixel
        found = np.empty((len(pixel), 3 + PHOTON_ROWS), np.float32)
        if photons:
            np.concatenate(points, 1, out=found.T[:3])
            np.concatenate(data, 1, out=found.T[3:])
        finite = np.isfinite(found).all(1)
        lost = np.union1d(lost + first_pixel, pixel[~finite])
        of_pixels = [Splats(x.lane + first_pixel, x.pixel, x.value) for x in splats]
        if not finite.all():
            pixel, found = pixel[finite], found[finite]
        return SentLight(first_pixel, pixels, of_pixels, lost, SentPhotons(pixel, found))


@dataclass(frozen=True)
class LightOfSample:
    """Splats and photons of the light paths of one sample of all pixels, for its camera paths.

    Attributes:
        photons: the photons.
        sent: the splats and lost pixels, by parts.
    """

    photons: PhotonMap
    sent: Sequence[SentLight]

    @staticmethod
    def of(sent: Sequence[SentLight], radius: float, paths: float) -> LightOfSample:
        """Return the light of all pixels, from parts in any order; other arguments as for :meth:`PhotonMap.of`."""
        photons = PhotonMap.of([x.photons for x in sent if x.photons is not None], radius, paths)
        return LightOfSample(photons, [replace(x, photons=None) for x in sent])

    def of_pixels(self, first: int, count: int) -> tuple[list[Splats], np.ndarray]:
        """Return the splats and the lost pixels of ``count`` pixels, which are counted from the ``first``."""
        found, lost = [], [np.zeros(0, np.int64)]
        for sent in self.sent:
            if sent.first_pixel >= first + count or sent.first_pixel + sent.pixels <= first:
                continue
            lost.append(sent.lost[(sent.lost >= first) & (sent.lost < first + count)] - first)
            for splats in sent.splats:
                if first <= sent.first_pixel and sent.first_pixel + sent.pixels <= first + count:
                    found.append(Splats(splats.lane - first, splats.pixel, splats.value))
                else:
                    index = ((splats.lane >= first) & (splats.lane < first + count)).nonzero().squeeze(1)
                    found.append(Splats(splats.lane[index] - first, splats.pixel[index], splats.value[:, index]))
        return found, np.concatenate(lost)


def _importance(data: np.ndarray, merging: float) -> np.ndarray:
    """Return what the chances of photons to be chosen are proportional to ``(n,)``, from their data."""
    dvcm, dvc, value = (
        data[FIRST_ROW["dvcm"]],
        data[FIRST_ROW["dvc"]],
        data[FIRST_ROW["value"] : FIRST_ROW["value"] + 3],
    )
    least = float(np.finfo(np.float32).tiny)
    with np.errstate(over="ignore"):  # to a weight of 0
        others = np.hypot(dvcm, dvc * np.float32(_REVERSE)) / np.float32(max(merging, least))
        weight = 1.0 / (1.0 + others * others)
    return abs(value).max(0) * np.maximum(weight, np.float32(_LEAST_CHANCE))


class PhotonRows(NamedTuple):
    """First rows of fields of paths: their rays, the distance to the hit, the sampler's keys; and of the data of photons."""

    o: int
    d: int
    t: int
    key: int
    key_rows: int
    found: int


@dataclass(frozen=True)
class PhotonMap:
    """The photons of one sample of each pixel.

    Attributes:
        points: ``(4, n + ...)`` float32: point, and what the chance to be chosen is proportional to, sorted by cell; padded.
        data: ``(n, 9)`` float32: the other rows.
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
    def of(sent: Sequence[SentPhotons], radius: float, paths: float) -> PhotonMap:
        """Return the map of photons.

        Args:
            sent: the photons, in any order.
            radius: of merges.
            paths: number of light paths.
        """
        pixel = np.concatenate([np.zeros(0, np.int64), *(part.pixel for part in sent)])
        photons = np.concatenate([_NONE, *(part.rows for part in sent)])
        count = len(pixel)
        cells = 1 << max(int(2 * count).bit_length() - 1, 6)
        depth = photons[:, 3 + FIRST_ROW["depth"]].astype(np.int64)
        rank = pixel * (int(depth.max(initial=0)) + 1) + depth  # unique: a light path has one vertex of each depth
        starts, cell, order = np.zeros(cells + 1, np.int32), np.empty(count, np.int32), np.empty(count, np.int32)
        points, by_cell = np.zeros((4, count + TESTED), np.float32), np.empty((count, PHOTON_ROWS), np.float32)
        inverse = np.float32(0.5) / np.float32(radius)  # rounded as in `near`
        kernel("photons", "build")(
            photons.reshape(-1), _importance(photons[:, 3:].T, merging_of(radius, paths)), rank, count,
            np.array([inverse], np.float32), cells, starts, cell, order, points.reshape(-1), points.shape[1],
            by_cell.reshape(-1),
        )  # fmt: skip
        scale = 1.0 / (math.pi * radius * radius * paths)
        return PhotonMap(points, by_cell, starts, radius, scale)

    def write_near(self, words: np.ndarray, rows: PhotonRows, lanes: np.ndarray, depth: int) -> None:
        """Write the data of a photon near each vertex, with the value of all those there; 0 where there is none.

        Args:
            words: ``(rows, n)`` int32, the paths: a column a lane, with floats as their bits.
            rows: where the fields of the paths are, and the data goes to.
            lanes: ``(k,)`` int32 the lanes to look at.
            depth: number of the vertices.
        """
        assert words.flags.c_contiguous  # else its rows would be copied
        floats = words.view(np.float32)
        kernel("photons", "near")(
            floats.reshape(-1), words.reshape(-1), words.shape[1], lanes, len(lanes), np.array(rows, np.int32),
            salt(Dimension.MERGE, depth), self.points.reshape(-1), self.points.shape[1], self.data.reshape(-1), self.starts,
            len(self.starts) - 1, np.array([self.radius, self.scale], np.float32),
        )  # fmt: skip

    def near(self, p: np.ndarray, key: np.ndarray, depth: int) -> np.ndarray:
        """Return the data ``(9, n)`` of a photon near each vertex, as :meth:`write_near` writes it.

        Args:
            p: the points ``(3, n)`` float32.
            key: the sampler's keys ``(rows, n)`` int32.
            depth: number of the vertices.
        """
        # As rays of length 0.
        count, key_rows = p.shape[1], len(key)
        words = np.zeros((7 + key_rows + PHOTON_ROWS, count), np.int32)
        words[:3], words[7 : 7 + key_rows] = p.astype(np.float32).view(np.int32), key
        rows = PhotonRows(o=0, d=3, t=6, key=7, key_rows=key_rows, found=7 + key_rows)
        self.write_near(words, rows, np.arange(count, dtype=np.int32), depth)
        return words[rows.found :].view(np.float32)

    def photons(self, p: Tensor, key: Tensor, depth: int) -> Photon:
        """Return a photon near each vertex; arguments as for :meth:`near`, tensors of any device and dtype."""
        rows = torch.from_numpy(self.near(p.detach().float().cpu().numpy(), key.cpu().numpy(), depth)).to(p)
        parts = zip(FIELDS, rows.split(list(FIELDS.values())), strict=True)
        return photon_of({name: part if len(part) > 1 else part[0] for name, part in parts})
