"""Integrators: what a picture estimates.

``path`` (and ``direct``, which is ``path`` with one bounce of light) carries radiance, ``aov`` the first surface's layers.
"""

from __future__ import annotations

from torchpt.integrators.wave import Wave

__all__ = ["Wave"]
