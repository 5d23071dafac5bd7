"""Image-based lighting by split-sum approximation: prefiltered environment maps and shading, differentiable in the map.

Split-sum: the reflected radiance is a look-up into a blurred map times a look-up into a table of the BRDF's integral.
``convolve.py`` and ``pyramid.py`` blur maps, ``table.py`` integrates the BRDF, ``shading.py`` does look-ups: start there.
The public module is :mod:`torchpt.ibl`; the integrator ``ibl`` (the preview) uses it too.
"""
