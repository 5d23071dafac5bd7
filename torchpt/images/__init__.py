"""Images: reading and writing files, colour, error metrics, denoising.

``read.py`` and ``write.py`` are the entry points: start there. ``decode.py`` and ``header.py`` handle the formats,
``layers.py`` the layers of an EXR, ``texels.py`` images for textures, ``packed.py`` those of 8 bits a value, ``movie.py`` GIF
and MP4, ``metrics.py`` and ``comparison.py`` error metrics, ``colour.py`` tone mapping, ``denoiser.py`` Open Image Denoise.

May import: ``core``, ``math``, ``spec``.
"""

from torchpt.images.decode import EncodedImage
from torchpt.images.header import read_header
from torchpt.images.packed import PackedImages, PackedTexels, decode_table
from torchpt.images.read import read_image, read_layers
from torchpt.images.texels import ByteImage, Texels, has_alpha, read_texels
from torchpt.images.write import check_writable, write_image

__all__ = [
    "ByteImage",
    "EncodedImage",
    "PackedImages",
    "PackedTexels",
    "Texels",
    "check_writable",
    "decode_table",
    "has_alpha",
    "read_header",
    "read_image",
    "read_layers",
    "read_texels",
    "write_image",
]
