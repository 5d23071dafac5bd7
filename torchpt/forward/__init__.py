"""One forward render: chunks of pixels, each a wave, accumulate in films.

``wave`` makes what all waves of a render share, ``stopping`` says how many samples are next, ``schedule`` cuts them into
chunks, ``run`` takes them and adds them up, ``twice`` samples pilots and ``adaptive`` sends samples where they say, ``kept`` is
what renders of a scene leave for the next one.
"""

from __future__ import annotations

from torchpt.forward.kept import Kept, kept
from torchpt.forward.result import Progress, Rendering
from torchpt.forward.run import Run, say_once
from torchpt.forward.schedule import BYTES_PER_LANE, lanes_for, pieces
from torchpt.forward.threads import limited_threads
from torchpt.forward.wave import kernels_of, loop_facts, looped, make_wave, rebound

__all__ = [
    "BYTES_PER_LANE",
    "Kept",
    "Progress",
    "Rendering",
    "Run",
    "kept",
    "kernels_of",
    "lanes_for",
    "limited_threads",
    "loop_facts",
    "looped",
    "make_wave",
    "pieces",
    "rebound",
    "say_once",
]
