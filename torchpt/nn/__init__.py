"""Modules of ``torch.nn`` that render: ``torchpt.nn.Renderer``.

=================  ==================================================
``renderer.py``    a scene with chosen parameters as ``nn.Parameter``
``ranges.py``      numbers without bounds for parameters that have some
=================  ==================================================
"""

from __future__ import annotations

from torchpt.nn.renderer import Renderer

__all__ = ["Renderer"]
