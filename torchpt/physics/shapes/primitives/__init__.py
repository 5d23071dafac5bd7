"""One kind of primitive a file, see :mod:`torchpt.physics.shapes.primitive`."""
