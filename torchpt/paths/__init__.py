"""What happens along a path, and in which order; nothing of how it is run.

====================  ==================================================================================
``walk.py``           the one loop over vertices, and the interfaces of an engine and an observer: start here
``state.py``          the state of paths, and the records that stages read and return
``vertex.py``         the stages: camera rays, light that is met or sampled, the bounce
``roulette.py``       which paths go on, and by how much more those count
``surface.py``        points on surfaces with their materials resolved
``transmission.py``   what lets rays pass
``integrators/``      what an integrator is, and one kind a file
``layers.py``         layers (AOVs), one entry each
``wave.py``           what a render fixes for all of its waves
``adjoint.py``        stages gone back through, for gradients
``explain.py``        the observer that keeps what happened along a path
``lost.py``           samples that are not finite
====================  ==================================================================================

An engine (:mod:`torchpt.engines`) runs the events. May import: ``physics``, ``search`` and what lies below.
"""
