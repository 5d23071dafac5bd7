"""Convert cameras to and from other libraries, and read and write NeRF's ``transforms.json``."""

from torchpt.physics.cameras.opencv import PinholeMatrices
from torchpt.scene.conventions import (
    OpenGLCamera,
    from_kornia,
    from_opencv,
    from_opengl,
    from_pytorch3d,
    to_kornia,
    to_opencv,
    to_opengl,
    to_pytorch3d,
)
from torchpt.scene.transforms_json import Frame, frame_of, read_transforms, write_transforms

__all__ = [
    "Frame",
    "OpenGLCamera",
    "PinholeMatrices",
    "frame_of",
    "from_kornia",
    "from_opencv",
    "from_opengl",
    "from_pytorch3d",
    "read_transforms",
    "to_kornia",
    "to_opencv",
    "to_opengl",
    "to_pytorch3d",
    "write_transforms",
]
