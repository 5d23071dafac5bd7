"""Engines: who runs the events of a path.

``tensors.py`` is plain torch on any device: the reference, and what derivatives and models of a caller's own run by.
``kernels/`` is a CPU's: stages as compiled loops over lanes, in arenas of a thread. Both serve :func:`torchpt.paths.walk.walk`,
whose ``Engine`` is the interface, and give the same pictures but for rounding. ``taken_over.py`` has the functions of physics
that run otherwise where an engine does (:mod:`torchpt.core.dispatch`).

May import: ``paths``, ``search``, ``compiler``, ``physics`` and below; none of these imports an engine. Start with
``tensors.py``.
"""

from torchpt.engines import dispatch  # noqa: F401  (registers)
