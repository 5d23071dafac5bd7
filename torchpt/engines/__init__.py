"""Engines: who runs the events of a path.

``tensors`` is plain torch on any device: the reference, and what derivatives and models of a caller's own run by. ``kernels``
is a CPU's: stages as compiled loops over lanes, in arenas of a thread. Both serve :func:`torchpt.paths.walk.walk`, whose
``Engine`` is the interface, and give the same pictures but for rounding. An engine may import physics, paths, the search and
the lane compiler; none of these imports an engine.

``taken_over.py`` has the functions of physics that run otherwise where an engine does (:mod:`torchpt.core.dispatch`).
"""

from torchpt.engines import taken_over  # noqa: F401  (registers)
