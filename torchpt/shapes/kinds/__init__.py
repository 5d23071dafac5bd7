"""One kind of shape a file, see :mod:`torchpt.shapes`."""
