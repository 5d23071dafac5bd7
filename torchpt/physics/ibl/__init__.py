"""Image-based lighting by split sum: maps of a sky as tensors, differentiable in the sky, and shading with them.

``convolve.py`` and ``pyramid.py`` make the maps, ``table.py`` the BRDF's, ``shading.py`` looks them up: start there. What users
import is :mod:`torchpt.ibl`.
"""
