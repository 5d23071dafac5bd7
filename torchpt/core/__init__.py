"""What every room may use, and nothing of rendering.

==================  =====================================================================================
``errors.py``       errors that users read, in one line: start here
``files.py``        files that a scene may name, those that ship, writes that are whole or not at all
``tree.py``         one walker over nested records: their tensors, copies with other tensors, a fingerprint
``dispatch.py``     functions of tensors that physics declares and an engine may take over
``memory.py``       the one policy for memory: how much a job may use, and what is tried when it runs out
``threads.py``      the one pool of threads, and dealers that give results in the order of tasks
``autograd.py``     functions whose backward pass is given, as autograd and ``torch.func`` take them
``version.py``      the version of the package
==================  =====================================================================================

May import: nothing of the package.
"""
