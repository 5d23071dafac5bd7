"""Utilities that every other package of torchpt may use; nothing here is about rendering.

==================  =====================================================================================
``errors.py``       exceptions and warnings, each a line for the user: start here
``files.py``        paths of scene files, safe reading, and the configs that ship
``tree.py``         nested records of tensors: leaves, copies with other tensors, a fingerprint
``dispatch.py``     tensor functions for which engines register implementations
``memory.py``       the memory limit, and what is done when memory runs out
``threads.py``      the thread pool, and results that do not depend on the number of threads
``autograd.py``     custom VJPs for autograd and ``torch.func``
``version.py``      the version of the package
==================  =====================================================================================

May import: nothing of the package.
"""
