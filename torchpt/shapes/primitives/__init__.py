"""One kind of primitive a file, see :mod:`torchpt.shapes.primitive`."""
