"""Integrators: the quantity that a picture estimates, and the stages and limits of its paths.

One kind a file in ``kinds/``: ``path`` (and ``direct``, which is ``path`` of depth 2) estimates radiance, and so do ``bdpt``
and ``vcm``, with light paths; ``ibl`` is a preview under an environment map, ``aov`` shows layers. ``base.py`` has their base
class: start there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchpt.spec import Kinds

if TYPE_CHECKING:
    from torchpt.paths.integrators.base import Integrator

#: The integrators by ``type`` of a scene file, one file each in ``kinds/``; lists show them in this order.
KINDS: Kinds[Integrator] = Kinds("torchpt.paths.integrators.kinds", ("path", "direct", "bdpt", "vcm", "aov", "ibl"))

__all__ = ["KINDS"]
