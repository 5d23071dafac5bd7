"""Write GIF and MP4 through imageio; a failure leaves no partial file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from importlib.util import find_spec
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import OutputError
from torchpt.images.write import check_writable, open_pillow_writer, output_path, temporary_beside, write_error

__all__ = ["MOVIES", "check_movie", "write_movie"]

#: ``(H, W, 3)`` display values.
Frame = NDArray[np.uint8]

#: Most frames a second by format. Players slow down a GIF whose frames last less than 2 hundredths of a second.
_FASTEST = {".gif": 50.0, ".mp4": 240.0}
#: Options for H.264 in the colours of ITU-R BT.709, which players assume, with the header first for streaming.
_H264 = [
    *("-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_primaries", "bt709"),
    *("-color_trc", "iec61966-2-1", "-color_range", "tv", "-movflags", "+faststart"),
]


def check_movie(path: str | PathLike[str], fps: float) -> None:
    """Check before a long render that a movie can be written.

    Raises:
        OutputError: an unsupported ending, too many frames a second for the format, a package that is not installed, or a path
            that cannot be written.
    """
    destination = check_writable(path, tuple(MOVIES))
    ending = destination.suffix.lower()
    if fps > _FASTEST[ending]:
        raise OutputError(
            path, f"{ending} shows at most {_FASTEST[ending]:g} frames a second, fps={fps:g} are asked for"
        )
    if ending == ".mp4" and not find_spec("imageio_ffmpeg"):
        how = "pip install '.[video]' in the checkout of torchpt (.gif needs nothing)"
        raise OutputError(path, f"writing .mp4 needs the package imageio-ffmpeg: {how}")


def write_movie(path: str | PathLike[str], frames: Iterable[Frame], fps: float) -> None:
    """Write frames ``(H, W, 3)`` of one size, 8-bit display values, in the format of the file's ending.

    A ``.gif`` loops for ever; each frame has 256 colours of its own and lasts whole hundredths of a second, rounded so that the
    total is right. An ``.mp4`` is H.264; the last row or column is repeated if the height or width is odd.

    Raises:
        OutputError: as `check_movie`, or the encoder failed.
    """
    destination = output_path(path, tuple(MOVIES))
    temporary = temporary_beside(destination)
    try:
        MOVIES[temporary.suffix](temporary, frames, fps)
        os.replace(temporary, destination)
    except (OSError, ValueError, TypeError, ImportError) as problem:
        raise OutputError(path, write_error(problem, destination)) from problem
    finally:
        with suppress(OSError):  # exists only after a failure
            temporary.unlink()


def _write_gif(temporary: Path, frames: Iterable[Frame], fps: float) -> None:
    """Write frames as a GIF."""
    encoded = BytesIO()
    durations: list[int] = []  # milliseconds, by frame
    with open_pillow_writer(encoded) as writer:
        for number, frame in enumerate(frames):
            # Whole hundredths of a second, whose sum never differs from the exact time by more than half of one.
            durations.append(10 * (round(100 * (number + 1) / fps) - round(100 * number / fps)))
            # Written at the end of the context, with the last call's options: the list is complete by then. Pillow merges
            # equal frames and adds up their durations; of a single frame it takes no list. `bits` are those of the palette, and
            # `loop` 0 stands for ever.
            shown_for = durations if number else durations[0]
            writer.write(frame, format="GIF", is_batch=False, bits=8, duration=shown_for, loop=0)
    temporary.write_bytes(encoded.getvalue())


def _write_mp4(temporary: Path, frames: Iterable[Frame], fps: float) -> None:
    """Write frames as H.264 in an MP4, which needs even widths and heights."""
    import imageio.v2 as iio

    # quality: of 0 to 10, where imageio's default is 5. macro_block_size 1: no scaling to a multiple of 16 pixels.
    codec = {"codec": "libx264", "pixelformat": "yuv420p", "quality": 8, "macro_block_size": 1}
    options = {"output_params": _H264, "ffmpeg_log_level": "error"}
    writer: Any = iio.get_writer(temporary, "FFMPEG", "I", fps=fps, **codec, **options)
    with writer:
        for frame in frames:
            height, width = frame.shape[:2]
            writer.append_data(np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))


#: Writers by file ending.
MOVIES: dict[str, Callable[[Path, Iterable[Frame], float], None]] = {".gif": _write_gif, ".mp4": _write_mp4}
