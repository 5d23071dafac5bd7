"""What every room may use, and nothing of rendering.

Start with ``tree.py``: one walker over nested records. Nothing of the package may be imported here but :mod:`torchpt.errors`.
"""
