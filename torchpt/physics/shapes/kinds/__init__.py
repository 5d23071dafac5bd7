"""One kind of shape a file, see :mod:`torchpt.physics.shapes`."""
