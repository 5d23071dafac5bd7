"""One forward render: chunks of pixels, each a wave, accumulate in films.

``wave`` makes what all waves of a render share, ``stopping`` says how many samples are next, ``need`` foresees the memory that
this takes, ``piece`` computes a piece, ``run`` adds them up, ``twice`` samples pilots and ``adaptive`` sends samples where they
say, ``along`` traces rays alone, ``many`` renders several at once, ``kept`` is what renders of a scene leave for the next one.
"""

from __future__ import annotations

from torchpt.forward.entry import render_scene
from torchpt.forward.kept import Kept, kept
from torchpt.forward.many import Entry, render_many
from torchpt.forward.result import Progress, Rendering
from torchpt.forward.run import Run
from torchpt.forward.wave import kernels_of, loop_facts, looped, make_wave, rebound

__all__ = [
    "Entry",
    "Kept",
    "Progress",
    "Rendering",
    "Run",
    "kept",
    "kernels_of",
    "loop_facts",
    "looped",
    "make_wave",
    "rebound",
    "render_many",
    "render_scene",
]
