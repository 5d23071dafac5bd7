"""One forward render: chunks of pixels, each a wave, accumulate in films.

``wave`` makes what all waves of a render share, ``schedule`` cuts the picture into chunks and passes, ``run`` takes them and
adds them up, ``kept`` is what renders of a scene leave for the next one.
"""

from __future__ import annotations

from torchpt.forward.kept import Kept, kept
from torchpt.forward.result import Progress, Rendering
from torchpt.forward.run import Run, say_once
from torchpt.forward.schedule import BYTES_PER_LANE, chunks_of, lanes_for
from torchpt.forward.threads import limited_threads
from torchpt.forward.wave import kernels_of, loop_facts, looped, make_wave, rebound

__all__ = [
    "BYTES_PER_LANE",
    "Kept",
    "Progress",
    "Rendering",
    "Run",
    "chunks_of",
    "kept",
    "kernels_of",
    "lanes_for",
    "limited_threads",
    "loop_facts",
    "looped",
    "make_wave",
    "rebound",
    "say_once",
]
