"""Estimate the memory of a render beside its scene, in bytes.

A render compares the estimate with ``render.max_memory`` before it begins, and cuts its waves (paths traced together) to what
is left; :mod:`torchpt.core.memory` handles shortage. Stages run in one of three *modes*: ``eager`` (tensor operations),
``compiled`` (kernels) or ``tape`` (tensor operations recorded by autograd). The constants are measured
(docs/guides/stability.md).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from torchpt.core.errors import SceneError
from torchpt.core.memory import FIRST_WAVE_LANES, free_memory
from torchpt.physics.film import Film
from torchpt.scene.prepare import surface_layers
from torchpt.scene.settings import Settings

__all__ = [
    "BYTES_PER_LANE",
    "FEWEST_OF_KERNELS",
    "LANES",
    "MemoryEstimate",
    "check_film",
    "mark_loaded",
    "memory_estimate",
]

#: Lanes of a wave without a memory limit: enough to hide the cost of dispatch, few enough for the caches.
LANES = {"cpu": 1 << 18, "cuda": 1 << 22}
#: Peak bytes of a lane in a wave, measured on the Cornell box; under a tape each vertex keeps about as much.
BYTES_PER_LANE = 640
#: Fewest lanes for which another thread of kernels pays.
FEWEST_OF_KERNELS = 1024
#: Bytes of machine code and tables of libraries, loaded on the first call of a process, by mode.
CODE_OF_MODE = {"eager": 75_000_000, "compiled": 54_000_000, "tape": 100_000_000}
#: Bytes of LLVM, which renders by tensor operations load for the search where its kernels are not cached.
CODE_OF_LLVM = 60_000_000
#: Bytes of the machine code of a BSDF model, in addition.
CODE_OF_MODEL = 3_000_000
#: Bytes of a pixel while the picture is computed from the films: plain, with error probes, adaptive, with the AOV variance.
PICTURE_BYTES, PROBES_BYTES, ADAPTIVE_BYTES, VARIANCE_BYTES = 64, 225, 160, 160
#: Bytes of the photons of a light path while their map is made: 280 each, at five vertices.
PHOTONS_BYTES = 1400
#: Bytes of a pixel of the finished pictures.
FINISHED_BYTES = 80
#: Bytes of a film that is allocated without looking at free memory.
SMALL_FILM = 2**28
#: Factor of the estimate, and bytes added to it: the spread of what was measured.
SLACK, SPARE = 1.04, 3_000_000

#: Modes that have run in this process, whose code is loaded.
_loaded_modes: set[str] = set()


def mark_loaded(mode: str) -> None:
    """Record that the code of a mode (``eager``, ``compiled`` or ``tape``) is loaded."""
    _loaded_modes.add(mode)


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes that a render needs beyond those that are held when it begins.

    Attributes:
        films: sums of samples, during the whole render.
        code: code that the render loads.
        waves: a wave of the fewest lanes that a render uses.
        picture: the pictures, which are computed at the end, when the wave is gone.
        photons: those of a sample of all pixels, beside waves.
    """

    films: int
    code: int
    waves: int
    picture: int
    photons: int = 0

    def least(self, held: int) -> int:
        """Return the smallest memory limit with which the render can run, ``held`` bytes included, with a margin."""
        largest = max(self.waves + self.photons, self.picture)
        return int(SLACK * (held + self.films + self.code + largest)) + SPARE

    def backward_bytes(self, held: int) -> int:
        """Return the smallest limit of a backward pass, which has neither films nor a picture; ``held`` as in :meth:`least`."""
        return int(SLACK * (held + self.code + self.waves)) + SPARE

    def left(self, limit: int, held: int) -> int:
        """Return the bytes of a limit that are left for waves, where the process holds ``held`` bytes.

        ``picture`` is taken off too, for the pictures of progress that are computed beside a wave. What is left may be less
        than ``waves``, as :meth:`least` counts the larger of both: the render then has waves of the fewest lanes.
        """
        return limit - held - self.films - self.code - self.photons - self.picture


def memory_estimate(settings: Settings, device: torch.device, mode: str, models: int, rows: int = 0) -> MemoryEstimate:
    """Estimate the memory of a render.

    Args:
        settings: complete.
        device: device of the lanes; other devices than the CPU hold no code.
        mode: the mode: ``eager``, ``compiled`` or ``tape``.
        models: number of BSDF models.
        rows: 32-bit numbers per lane in the workspace of a thread of kernels.
    """
    _, _, width, height = settings.film.window
    pixels = width * height
    channels = [len(layer.channels) for layer in surface_layers(settings).values()]
    # Bytes of a pixel, as in `Film.bytes_of`: of each layer two float64 a channel (first samples, sums) and a count.
    films = Film.bytes_of(1, settings.streams, splats=settings.integrator.splats)
    films += sum(16 * count + 8 for count in channels)
    picture = PICTURE_BYTES
    if "variance" in settings.film.aovs:
        picture = VARIANCE_BYTES
    elif settings.pilots:
        picture = ADAPTIVE_BYTES if settings.adaptive else PROBES_BYTES
    picture += sum(8 * count + 4 for count in channels)
    code = 0 if mode in _loaded_modes else CODE_OF_MODE[mode] + (CODE_OF_MODEL * models if mode == "compiled" else 0)
    if mode not in ("compiled", *_loaded_modes) and "llvmlite.binding" not in sys.modules:
        code += CODE_OF_LLVM
    if device.type != "cpu":
        code = 0
    # Kernels have `rows` numbers of 4 bytes a lane. Tensor operations get twice their measured bytes in the first, small wave.
    waves = FEWEST_OF_KERNELS * 4 * rows if mode == "compiled" else FIRST_WAVE_LANES * 2 * BYTES_PER_LANE
    light_paths = settings.integrator.light_walk() if settings.integrator.merges else None
    photons = 0 if light_paths is None else int(PHOTONS_BYTES * pixels * light_paths.fraction)
    return MemoryEstimate(films=pixels * films, code=code, waves=waves, picture=pixels * picture, photons=photons)


def check_film(
    width: int, height: int, streams: int, layers: Sequence[int], device: torch.device, *, splats: bool = False
) -> None:
    """Raise for a film that does not fit into memory, before it is allocated (the system would kill the process).

    Args:
        width: width of the picture (after a crop) in pixels.
        height: height of the picture in pixels.
        streams: number of randomizations.
        layers: number of channels of each layer.
        device: device of the films.
        splats: True where samples add to other pixels than their own.

    Raises:
        SceneError: the film needs more memory than is free.
    """
    pixels = width * height
    needed = Film.bytes_of(pixels, streams, splats=splats) + sum(
        Film.bytes_of(pixels, 1, channels) for channels in layers
    )
    needed += FINISHED_BYTES * pixels
    if needed < SMALL_FILM:
        return
    free = free_memory(device)
    if free is not None and needed > free:
        expected = f"a film that fits into memory: it takes {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free"
        raise SceneError("film.width", [width, height], expected)
