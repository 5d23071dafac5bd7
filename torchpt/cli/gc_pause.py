"""Python's cycle collector and a short process: importing torch makes 150,000 objects that live to the end.

Looking through them again and again while more are imported, and once more when the process ends, takes a quarter of the
time. So the command starts with the collector off, and a job turns it on once all is imported, for what comes after.
What is imported later (OpenImageIO, which counts its objects as the process ends) is collected as ever.
"""

from __future__ import annotations

import gc

__all__ = ["pause", "resume"]

_paused = False


def pause() -> None:
    """Turn the collector off until `resume`; for a process that is the command's own."""
    global _paused
    _paused = gc.isenabled()
    gc.disable()


def resume() -> None:
    """Turn it on again where `pause` turned it off; it will not look at what is there by now."""
    global _paused
    if _paused:
        _paused = False
        gc.freeze()
        gc.enable()
