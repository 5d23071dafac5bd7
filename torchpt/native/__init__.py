"""Numba kernels: their compilation, cache on disk and compile time, and SIMD vectors as a numba type.

``jit.py`` has the decorators: start there. ``content.py`` computes digests of code, by which ``cache.py`` caches kernels;
``compile_time.py`` measures the time of compilation; ``simd/`` has the vector type. ``device_checks.py`` knows
the GPU's driver, and whether a card has passed the check of kernels. ``jit.py`` and ``simd/`` import numba, so
other packages import them only when a kernel is needed.

May import: ``core``.
"""
