"""Machine code: the kernels that the package carries, and what all compiled code needs: LLVM, a cache on disk, a clock.

``kernels.py`` compiles and runs the kernels that lie in ``ir/`` as LLVM IR: start there. ``machine.py`` is LLVM for this
machine; ``codegen.py`` makes machine code of IR, here or in the processes of ``compilers.py``; ``cache.py`` keeps machine
code on disk; ``content.py`` computes digests of Python code; ``compile_time.py`` measures the time of compilation.
``device_checks.py`` asks for the GPU's driver, and remembers whether a card has passed the check of kernels.

May import: ``core``.
"""
