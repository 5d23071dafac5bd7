"""What a render is foreseen to take beside its scene; the numbers are measured (docs/stability.md), in bytes."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import torch

from torchpt.film import Film
from torchpt.forward.schedule import BYTES_PER_LANE, streams_of
from torchpt.forward.wave import surface_layers
from torchpt.settings import Settings

__all__ = ["CODE", "Need", "loaded", "need_of", "shape_of"]

#: Of machine code and tables of libraries, which are read from disk when they are first called, once a process.
CODE = {"eager": 75_000_000, "compiled": 54_000_000, "tape": 100_000_000}
#: Of numba, which not all renders import.
NUMBA = 60_000_000
#: Of the machine code of a material model, beside that.
CODE_OF_MODEL = 3_000_000
#: Of a pixel while the picture is made of the films: alone, with pilots, with adaptive sampling, with layers of variance.
PICTURE, PILOTS, ADAPTIVE, VARIANCE = 64, 225, 160, 160
#: Lanes of the smallest wave of tensor operations, and of a chunk that one thread takes in the compiled loop.
FEWEST, FEWEST_OF_LOOP = 4096, 1024
#: What the least is above what was foreseen.
SLACK, SPARE = 1.04, 3_000_000

#: What has run in this process: its code is there.
_ran: set[str] = set()


def loaded(how: str) -> None:
    """Say that code of a kind is there."""
    _ran.add(how)


@dataclass(frozen=True)
class Need:
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

    def of_tape(self, held: int) -> int:
        """The same of a backward pass, which has neither films nor a picture."""
        return int(SLACK * (held + self.code + self.waves)) + SPARE

    def left(self, limit: int, held: int) -> int:
        """What waves may have of a limit."""
        return limit - held - self.films - self.code - self.picture


def need_of(settings: Settings, device: torch.device, how: str, models: int, rows: int = 0) -> Need:
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
    films = Film.bytes_of(1, streams_of(settings), splats=settings.integrator.splats) + sum(
        16 * c + 8 for c in channels
    )
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
    waves = FEWEST_OF_LOOP * 4 * rows if how == "compiled" else FEWEST * 2 * BYTES_PER_LANE
    return Need(pixels * films, code, waves, pixels * picture)


def shape_of(left: int, threads: int, rows: int, most: int) -> tuple[int, int]:
    """Threads of the compiled loop, and the lanes of each, that fit in so many bytes; one thread always does."""
    for count in range(threads, 0, -1):
        lanes = left // (4 * rows * count)
        if lanes >= FEWEST_OF_LOOP or count == 1:
            return count, max(FEWEST_OF_LOOP, min(lanes, most))
    return 1, FEWEST_OF_LOOP
