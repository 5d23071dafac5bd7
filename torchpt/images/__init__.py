"""Pictures: files in and out, colour, and how far one is from another."""

from torchpt.images.read import read_image, read_layers
from torchpt.images.write import check_writable, write_image

__all__ = ["check_writable", "read_image", "read_layers", "write_image"]
