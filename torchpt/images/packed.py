"""Images of 8 bits a value that stay so in memory: a texel is one number of 32 bits, decoded where it is read.

A texel takes 4 bytes, where a colour in float32 takes 12. The numbers have their place all the same, as a tensor that
anyone may ask for, but nothing is written there, and so no memory is taken, before someone does.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchpt.images.texels import ByteImage, decoded_bytes

__all__ = ["PackedImages", "PackedTexels", "decode_table"]


def decode_table() -> Tensor:
    """Return what bytes stand for ``(512,)`` float32: first fractions of 255, then colours decoded from sRGB."""
    return torch.from_numpy(np.concatenate([decoded_bytes(encoded=False), decoded_bytes(encoded=True)]))


@dataclass(frozen=True, eq=False)
class PackedTexels:
    """An image among the words of :class:`PackedImages`.

    Attributes:
        words: ``(T,)`` int32, the texels of all images: the first channel in the lowest byte.
        first: number of its first texel there.
        image: the image, its bytes in the same memory.
        has_numbers: True: the tensor of the image has its numbers too.
    """

    words: Tensor
    first: int
    image: ByteImage
    has_numbers: bool


class PackedImages:
    """The images of a scene that are packed, and the tensors that get their numbers once someone asks for these.

    Args:
        images: the images by name.
        tensors: ``(H, W, C)`` float32 each, by name; not written to before :meth:`unpack`. Images without one have their
            numbers elsewhere.
    """

    def __init__(self, images: Mapping[str, ByteImage], tensors: Mapping[str, Tensor]) -> None:
        sizes = {name: image.shape[0] * image.shape[1] for name, image in images.items()}
        # By numpy: tensors that are made within a transform of torch.func, or under another default device, have no memory.
        numbers = np.zeros(sum(sizes.values()), np.int32)
        words, bytes_of = torch.from_numpy(numbers), numbers.view(np.uint8).reshape(-1, 4)
        self._found: dict[str, PackedTexels] = {}
        first = 0
        for name, image in images.items():
            height, width, channels = image.shape
            for k in range(channels):  # one by one: several times faster than texel by texel
                bytes_of[first : first + sizes[name], k] = image.stored[..., k].reshape(-1)
            stored = bytes_of[first : first + sizes[name], :channels].reshape(height, width, channels)
            packed = ByteImage(stored, image.encoded)
            self._found[name] = PackedTexels(words, first, packed, has_numbers=name not in tensors)
            first += sizes[name]
        self._arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
        self._lock = threading.Lock()

    @property
    def pending(self) -> bool:
        """Return True until images are unpacked."""
        return bool(self._found)

    def found(self) -> Mapping[str, PackedTexels]:
        """Return the images by name; none once they are unpacked."""
        return self._found

    def unpack(self) -> bool:
        """Write the numbers of all images to their tensors; return False if that was done before."""
        with self._lock:
            for name, array in self._arrays.items() if self._found else ():
                array[...] = self._found[name].image.values()  # which torch does not count as a change of the tensor
            unpacked, self._found = self.pending, {}
            return unpacked
