"""Lowerings of torch's operators to nodes of a graph.

To add one, write a function with ``@register_lowering("its aten name")`` in one of the files here.
"""

from torchpt.compiler.operators import arithmetic, choices, derivatives, gathers, reductions, views

__all__ = ["arithmetic", "choices", "derivatives", "gathers", "reductions", "views"]
