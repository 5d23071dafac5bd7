"""The lane compiler makes a wavefront stage that is written in tensor operations into one loop of machine code.

A stage is run once on a few lanes (:mod:`~torchpt.compiler.tracing`: start here), which gives a graph of scalar operations
(:mod:`~torchpt.compiler.graph`); the graph becomes LLVM IR over vectors or single lanes (:mod:`~torchpt.compiler.form`,
:mod:`~torchpt.compiler.codegen`, :mod:`~torchpt.compiler.functions`) inside a loop that loads and stores
(:mod:`~torchpt.compiler.kernel`); LLVM compiles the IR (:mod:`~torchpt.compiler.cpu`). Compiled programs are cached in memory
and on disk (:mod:`~torchpt.compiler.cache`). The tensor code remains the only definition of a stage.

May import: ``core``, ``native``, ``math``. The compiler knows nothing of rendering except for ray searches among few primitives
(:mod:`~torchpt.compiler.packet`).
"""
