"""Keep Python's garbage collector off while modules are imported, so that short commands start and end faster.

Importing torch creates 150,000 objects that live until the process ends. Scanning them again and again during imports, and once
more at exit, takes a quarter of a short command's time. The command starts with the collector off; a job freezes the
objects that exist after its imports and turns the collector on. Modules imported later (such as OpenImageIO) are collected
as usual.
"""

from __future__ import annotations

import gc

__all__ = ["pause", "resume"]

_paused = False


def pause() -> None:
    """Turn the garbage collector off until `resume`. Only for a process that runs nothing but the command."""
    global _paused
    _paused = gc.isenabled()
    gc.disable()


def resume() -> None:
    """Freeze all objects that exist and turn the garbage collector on again, if `pause` turned it off."""
    global _paused
    if _paused:
        _paused = False
        gc.freeze()
        gc.enable()
