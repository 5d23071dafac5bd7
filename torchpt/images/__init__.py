"""Pictures: files in and out, colour, and how far one is from another.

``read.py`` and ``write.py`` are the doors: start there. ``decode.py`` and ``header.py`` know the formats, ``layers.py`` the
layers of an EXR, ``movie.py`` moving pictures, ``metrics.py`` the measures, ``colour.py`` tone mapping, ``denoiser.py`` the
denoiser.

May import: ``core``, ``math``, ``spec``.
"""

from torchpt.images.decode import EncodedImage
from torchpt.images.header import read_header
from torchpt.images.read import read_image, read_layers
from torchpt.images.texels import Texels, has_alpha, read_texels
from torchpt.images.write import check_writable, write_image

__all__ = [
    "EncodedImage",
    "Texels",
    "check_writable",
    "has_alpha",
    "read_header",
    "read_image",
    "read_layers",
    "read_texels",
    "write_image",
]
