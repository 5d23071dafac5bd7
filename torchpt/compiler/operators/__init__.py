"""Lowerings of torch's operators to nodes of a graph.

A lowering is a function ``handler(tracer, out, *args, **kwargs)``. ``args`` are those of the operator, ``out`` is the tensor
that it returned in the trace; the handler sets the nodes of ``out`` (:meth:`torchpt.compiler.tracing.Tracer.put`). To add one,
write a function with ``@register_lowering("its aten name")`` in one of the files here.
"""

from torchpt.compiler.operators import arithmetic, choices, derivatives, gathers, reductions, views

__all__ = ["arithmetic", "choices", "derivatives", "gathers", "reductions", "views"]
