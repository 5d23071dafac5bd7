"""Cameras: from film positions to rays, one kind a file.

A pose is Mitsuba's ``to_world``: the camera looks along its own ``+z``, ``+y`` is up and ``+x`` points to the image's left,
so that image right is ``(target - origin) x up``.
"""

from __future__ import annotations

from torchpt.cameras.base import Camera
from torchpt.cameras.conventions import (
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
from torchpt.cameras.opencv import PinholeMatrices
from torchpt.cameras.transforms_json import Frame, frame_of, read_transforms, write_transforms
from torchpt.spec import Kinds

__all__ = [
    "KINDS",
    "Camera",
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

#: The kinds of cameras.
KINDS: Kinds[Camera] = Kinds("torchpt.cameras.kinds", ("perspective", "thinlens", "orthographic"))
