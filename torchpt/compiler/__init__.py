"""The lane compiler: a stage of the wavefront, written as tensor operations, becomes one loop of machine code.

A stage is run once on a few lanes (:mod:`~torchpt.compiler.tracing`: start here), which gives a graph of scalar operations
(:mod:`~torchpt.compiler.graph`); the graph becomes LLVM IR over vectors or single lanes (:mod:`~torchpt.compiler.form`,
:mod:`~torchpt.compiler.codegen`, :mod:`~torchpt.compiler.functions`), with loads and stores around it
(:mod:`~torchpt.compiler.kernel`), and that machine code (:mod:`~torchpt.compiler.cpu`). Programs are kept by structure and on
disk (:mod:`~torchpt.compiler.cache`). The tensor form stays the only statement of what a stage does.

May import: ``core``, ``native``, ``math``. It knows nothing of rendering but for the search among few primitives
(:mod:`~torchpt.compiler.packet`).
"""
