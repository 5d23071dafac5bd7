"""What torch alone does not run well: numba kernels (:mod:`~torchpt.native.jit`) and custom operators around them.

Nothing here imports numba by itself; :mod:`torchpt.native.jit` does.
"""
