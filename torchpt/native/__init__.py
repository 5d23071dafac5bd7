"""What torch alone does not run well: numba kernels (:mod:`~torchpt.native.jit`).

Nothing here imports numba by itself; :mod:`torchpt.native.jit` does.
"""
