"""What a render is foreseen to take beside its scene, by how it runs; in bytes.

The numbers are measured (docs/guides/stability.md). What is done where there is less, :mod:`torchpt.core.memory` says.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from torchpt.core.errors import SceneError
from torchpt.core.memory import FEWEST, free_memory
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

#: Lanes of a wave where memory is not limited: large enough to hide the cost of dispatch, small enough for the caches.
LANES = {"cpu": 1 << 18, "cuda": 1 << 22}
#: Peak bytes a lane takes in a wave, measured on the Cornell box; under a tape each vertex keeps about this much.
BYTES_PER_LANE = 640
#: Lanes that repay a thread of the compiled loop.
FEWEST_OF_KERNELS = 1024
#: Of machine code and tables of libraries, which are read from disk when they are first called, once a process.
CODE = {"eager": 75_000_000, "compiled": 54_000_000, "tape": 100_000_000}
#: Of numba, which not all renders import.
NUMBA = 60_000_000
#: Of the machine code of a material model, beside that.
CODE_OF_MODEL = 3_000_000
#: Of a pixel while the picture is made of the films: alone, with pilots, with adaptive sampling, with layers of variance.
PICTURE, PILOTS, ADAPTIVE, VARIANCE = 64, 225, 160, 160
#: Bytes a pixel of what is made of films in the end, and bytes of films that are taken without asking how many there are.
PICTURES, SMALL = 80, 2**28
#: What the least is above what was foreseen.
SLACK, SPARE = 1.04, 3_000_000

#: What has run in this process: its code is there.
_ran: set[str] = set()


def mark_loaded(how: str) -> None:
    """Say that code of a kind is there."""
    _ran.add(how)


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes that a render is to take beside what is held when it begins.

    Attributes:
        films: sums of samples, as long as it runs.
        code: loaded while it runs.
        waves: of the fewest lanes that it works with.
        picture: made of the films at the end.
    """

    films: int
    code: int
    waves: int
    picture: int

    def least(self, held: int) -> int:
        """The most that is held at once, beside ``held``; with some to spare."""
        return int(SLACK * (held + self.films + self.code + max(self.waves, self.picture))) + SPARE

    def backward_bytes(self, held: int) -> int:
        """The same of a backward pass, which has neither films nor a picture."""
        return int(SLACK * (held + self.code + self.waves)) + SPARE

    def left(self, limit: int, held: int) -> int:
        """What waves may have of a limit."""
        return limit - held - self.films - self.code - self.picture


def memory_estimate(settings: Settings, device: torch.device, how: str, models: int, rows: int = 0) -> MemoryEstimate:
    """What a render takes.

    Args:
        settings: complete.
        device: of the lanes; where it is not the CPU, code takes none of its memory.
        how: ``eager``, ``compiled`` or ``tape``.
        models: of materials.
        rows: of 32-bit numbers that a thread of the compiled loop has for its lanes.
    """
    _, _, width, height = settings.film.crop or (0, 0, settings.film.width, settings.film.height)
    pixels = width * height
    channels = [len(layer.channels) for layer in surface_layers(settings).values()]
    films = Film.bytes_of(1, settings.streams, splats=settings.integrator.splats) + sum(16 * c + 8 for c in channels)
    picture = PICTURE
    if "variance" in settings.film.aovs:
        picture = VARIANCE
    elif settings.pilots:
        picture = ADAPTIVE if settings.adaptive else PILOTS
    picture += sum(8 * c + 4 for c in channels)
    code = 0 if how in _ran else CODE[how] + (CODE_OF_MODEL * models if how == "compiled" else 0)
    if how != "compiled" and "numba" not in sys.modules:
        code += NUMBA
    if device.type != "cpu":
        code = 0
    waves = FEWEST_OF_KERNELS * 4 * rows if how == "compiled" else FEWEST * 2 * BYTES_PER_LANE
    return MemoryEstimate(pixels * films, code, waves, pixels * picture)


def check_film(
    width: int, height: int, streams: int, layers: Sequence[int], device: torch.device, splats: bool = False
) -> None:
    """Refuse a film that would end the process, with no word of the system's, before a byte of it is touched.

    Args:
        width: of the picture (after a crop) in pixels.
        height: of the picture in pixels.
        streams: randomizations of the picture's samples.
        layers: how many channels each layer has.
        device: where the films lie.
        splats: whether samples light other pixels than their own.

    Raises:
        SceneError: it takes more memory than there is.
    """
    pixels = width * height
    needed = Film.bytes_of(pixels, streams, splats=splats) + sum(
        Film.bytes_of(pixels, 1, channels) for channels in layers
    )
    needed += PICTURES * pixels
    if needed < SMALL:
        return
    free = free_memory(device)
    if free is not None and needed > free:
        expected = f"a film that fits into memory: it takes {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free"
        raise SceneError("film.width", [width, height], expected)
