"""Kinds of primitives, one a file; see :mod:`torchpt.physics.shapes.primitive`."""
