"""One forward render: chunks of pixels, each a wave, accumulate in films.

``wave`` makes what all waves of a render share, ``stopping`` says how many samples are next, ``waves`` cuts them into pieces as
large as memory lets them be (``budget``), ``piece`` computes one, ``run`` adds them up, ``twice`` samples pilots and
``adaptive`` sends samples where they say, ``along`` traces rays alone, ``many`` renders several at once, ``kept`` is what
renders of a scene leave for the next one.
"""

from __future__ import annotations

from torchpt.forward.entry import render_scene
from torchpt.forward.kept import Kept, kept
from torchpt.forward.many import Entry, render_many
from torchpt.forward.result import Progress, Rendering
from torchpt.forward.run import Run
from torchpt.forward.schedule import BYTES_PER_LANE, budget_of
from torchpt.forward.threads import limited_threads
from torchpt.forward.wave import kernels_of, loop_facts, looped, make_wave, rebound
from torchpt.forward.waves import Waves, say_once

__all__ = [
    "BYTES_PER_LANE",
    "Entry",
    "Kept",
    "Progress",
    "Rendering",
    "Run",
    "Waves",
    "budget_of",
    "kept",
    "kernels_of",
    "limited_threads",
    "loop_facts",
    "looped",
    "make_wave",
    "rebound",
    "render_many",
    "render_scene",
    "say_once",
]
