"""Path tracing as pure functions of tensors: the loop over vertices, the stages, and the records between them.

========================  ==============================================================================
``walk.py``               the loop over vertices, and the interfaces of an engine and an observer: start here
``state.py``              the state of paths, and the records that stages read and return
``vertex.py``             the stages: camera rays, emitters that are hit, light sampling, BSDF sampling
``roulette.py``           Russian roulette
``surface.py``            surface points with their materials resolved
``perturbed_normals.py``  normal and bump maps
``transmission.py``       opacity: rays that pass surfaces
``integrators/``          the base class of integrators, and one kind a file
``layers.py``             layers (AOVs), a class each
``wave.py``               everything that one render fixes for its waves
``adjoint.py``            vector-Jacobian products of the stages
``explain.py``            an observer that records the events along a path
``nonfinite.py``          samples that are NaN or infinite
========================  ==============================================================================

An engine (:mod:`torchpt.engines`) runs the stages. May import: ``physics``, ``search`` and the packages below them.
"""
