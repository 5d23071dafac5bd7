"""Whether the memory has room for the films of a render: a process that asks for more is ended by the system, with no word."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from torchpt.errors import SceneError
from torchpt.film import Film
from torchpt.native.memory import free_memory

__all__ = ["PICTURES", "SMALL", "check_room"]

#: Bytes a pixel of what is made of films in the end: sums over streams, means, the picture.
PICTURES = 80
#: Bytes of films that are taken without asking how many there are.
SMALL = 2**28


def check_room(
    width: int, height: int, streams: int, layers: Sequence[int], device: torch.device, splats: bool = False
) -> None:
    """Refuse a film that would end the process, before a byte of it is touched.

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
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else free_memory()
    if free is not None and needed > free:
        expected = f"a film that fits into memory: it takes {needed / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free"
        raise SceneError("film.width", [width, height], expected)
