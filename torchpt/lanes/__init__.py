"""The lane compiler: a stage of the wavefront, written as tensor operations, becomes one loop of machine code.

A stage is run once on a few lanes (:mod:`~torchpt.lanes.tracing`), which gives a graph of scalar operations
(:mod:`~torchpt.lanes.graph`); the graph becomes LLVM IR over vectors or single lanes (:mod:`~torchpt.lanes.form`,
:mod:`~torchpt.lanes.emission`, :mod:`~torchpt.lanes.functions`), with loads and stores around it
(:mod:`~torchpt.lanes.kernel`), and that machine code (:mod:`~torchpt.lanes.engine`). The tensor form stays the only statement
of what a stage does.
"""
