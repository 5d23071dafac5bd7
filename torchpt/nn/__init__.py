"""``torch.nn`` modules that render: ``torchpt.nn.Renderer``.

=======================  ===========================================================
``renderer.py``          a scene with chosen parameters as ``nn.Parameter``
``parametrizations.py``  maps unconstrained numbers to the ranges of parameters
=======================  ===========================================================

May import: ``rendering``, ``scene`` and what lies below.
"""

from __future__ import annotations

from torchpt.nn.renderer import Renderer

__all__ = ["Renderer"]
