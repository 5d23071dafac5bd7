"""Integrators: what a picture estimates.

One kind a file in ``kinds/``: ``path`` (and ``direct``, which is ``path`` with one bounce of light) carries radiance, ``ibl``
is a preview, ``aov`` shows layers. One layer a file in ``layers/``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchpt.spec import Kinds

if TYPE_CHECKING:
    from torchpt.integrators.base import Integrator
    from torchpt.integrators.layer import Layer

#: The integrators.
KINDS: Kinds[Integrator] = Kinds("torchpt.integrators.kinds", ("path", "direct", "aov", "ibl"))
#: The layers of pictures.
LAYERS: Kinds[Layer] = Kinds(
    "torchpt.integrators.layers",
    ("albedo", "normal", "depth", "position", "uv", "object_id", "alpha", "variance", "samples"),
)

__all__ = ["KINDS", "LAYERS"]
