"""Paths: what happens along them, and in which order.

:mod:`~torchpt.paths.walk` is the one loop over vertices. It knows the order of events and nothing of how they are run: an
engine (:mod:`torchpt.engines`) runs them. Start with :func:`torchpt.paths.walk.walk`.
"""
