"""Integrators: what a picture estimates.

One kind a file in ``kinds/``: ``path`` (and ``direct``, which is ``path`` with one bounce of light) carries radiance, ``ibl``
is a preview, ``aov`` shows layers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchpt.spec import Kinds

if TYPE_CHECKING:
    from torchpt.paths.integrators.base import Integrator

#: The integrators.
KINDS: Kinds[Integrator] = Kinds("torchpt.paths.integrators.kinds", ("path", "direct", "aov", "ibl"))

__all__ = ["KINDS"]
