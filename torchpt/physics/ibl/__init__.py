"""Image-based lighting by split-sum approximation: prefiltered environment maps and shading, differentiable in the map.

``convolve.py`` and ``pyramid.py`` prefilter maps, ``table.py`` integrates the BRDF, ``shading.py`` does look-ups: start there.
The public module is :mod:`torchpt.ibl`.
"""
