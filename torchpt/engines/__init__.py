"""Engines run the stages of paths: with tensor operations on any device, or with compiled kernels on a CPU or with CUDA.

``engine.py`` has the interfaces of forward and backward engines, and the functions that make them; packages above import only
this file. ``tensors*.py`` is plain torch on any device: the reference, also for gradients and for models of a user's own.
``kernels/`` has stages as compiled loops over lanes, in the memory of one thread of a CPU, or of a GPU. Both implement the
``Engine`` of :mod:`torchpt.paths.walk`, and their pictures differ only by rounding. ``dispatch.py`` registers kernels in
place of functions of physics (:mod:`torchpt.core.dispatch`).

May import: ``paths``, ``search``, ``compiler``, ``physics`` and below; none of these imports an engine. Start with
``engine.py``, then ``tensors.py``.
"""

from torchpt.engines import dispatch  # noqa: F401  (registers)
