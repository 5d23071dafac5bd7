"""What torch alone does not run well: numba kernels, how they are compiled, kept on disk and timed; vectors as their values.

``jit.py`` has the decorators: start there. ``content.py`` says what a kernel is made of, by which ``cache.py`` keeps it on
disk; ``compile_time.py`` counts the seconds; ``simd/`` gives numba vectors of the CPU. Nothing here imports numba until a
kernel is called.

May import: ``core``.
"""
