"""What every room may use, and nothing of rendering.

Start with ``tree.py``: one walker over nested records. No other room of the package is imported here.
"""
