"""Cameras: rays through film positions and projections to the film, one kind a file in ``kinds/``.

A pose is Mitsuba's ``to_world``: the camera looks along its own ``+z``, ``+y`` is up and ``+x`` points to the image's left,
so that image right is ``(target - origin) x up``.
"""

from __future__ import annotations

from torchpt.physics.cameras.base import Camera
from torchpt.spec import Kinds

__all__ = ["KINDS", "Camera"]

#: The kinds of cameras.
KINDS: Kinds[Camera] = Kinds("torchpt.physics.cameras.kinds", ("perspective", "thinlens", "orthographic"))
