"""Sources of the machine code that searches and builds trees, and adds up gradients: Python that numba lowers to LLVM IR.

Only developers run numba. ``scripts/make_kernels.py`` lowers these functions once and writes their IR to
``torchpt/native/ir/``, which :mod:`torchpt.native.kernels` compiles for the machine at hand at the first use. A test
compares that folder with these sources.

A *kernel* is a function that Python calls (:func:`kernel_sources.jit.kernel`): it takes integers and pointers, allocates
nothing and raises nothing. The other functions (:func:`kernel_sources.jit.inner`) are called by kernels only. ``simd/`` has
vectors as values of numba, and pointers.

``tree_packet.py`` and ``tree_instances.py`` search wide trees, by the tests of ``tree_nodes.py``, ``tree_leaf.py`` and
``tree_single.py``; ``tree_build.py`` and ``tree_refit.py`` build and refit them; ``light_tree.py`` builds light trees;
``sums.py`` adds up gradients.
"""
