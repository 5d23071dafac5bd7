"""What each operator of torch is as nodes of a graph.

To add one: a function marked ``@register_lowering("its aten name")`` in one of the files here.
"""

from torchpt.compiler.operators import arithmetic, choices, derivatives, gathers, reductions, views

__all__ = ["arithmetic", "choices", "derivatives", "gathers", "reductions", "views"]
