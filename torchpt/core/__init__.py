"""What every room may use, and nothing of rendering.

``tree.py`` is the one walker over nested records, ``dispatch.py`` lets engines take over functions of tensors, ``memory.py`` is
what is done where memory is short, ``threads.py`` the one pool of threads. Of the package only ``errors.py`` is imported here.
"""
