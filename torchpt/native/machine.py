"""LLVM for this machine, through llvmlite: compile IR to object code, and load object code.

The kernels of ``ir/`` and those of the lane compiler come here. :func:`torchpt.core.memory.check_address_space` stands before
each use of LLVM that takes much memory, since LLVM ends the process when it gets none.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from torchpt.core.memory import check_address_space

__all__ = ["host", "identity", "llvm", "load_object", "new_machine", "object_code", "parse"]


@functools.cache
def llvm() -> Any:
    """Return llvmlite's binding, initialized for this machine."""
    import llvmlite.binding

    llvmlite.binding.initialize_native_target()
    llvmlite.binding.initialize_native_asmprinter()
    return llvmlite.binding


@functools.cache
def host() -> tuple[str, str]:
    """Return LLVM's name of this CPU, and its features in LLVM's words."""
    check_address_space()
    return llvm().get_host_cpu_name(), llvm().get_host_cpu_features().flatten()


def identity() -> str:
    """Return text that identifies the version of LLVM's binding and this CPU, as part of cache keys."""
    import llvmlite

    return "\n".join((llvmlite.__version__, *host()))


def new_machine(cpu: str = "", features: str = "", triple: str | None = None, opt: int = 2) -> Any:
    """Return a target machine of LLVM.

    Args:
        cpu: LLVM's name of the processor; empty: that and the features of this CPU.
        features: LLVM's list of processor features.
        triple: of another machine; None: this one, for code that is loaded into this process (``jit``).
        opt: level of code generation, by default LLVM's: it selects instructions and registers, and runs no passes on the IR.
    """
    if triple is not None:
        llvm().initialize_all_targets()
        llvm().initialize_all_asmprinters()
    if not cpu:
        cpu, features = host()
    kind = llvm().Target.from_default_triple() if triple is None else llvm().Target.from_triple(triple)
    return kind.create_target_machine(cpu=cpu, features=features, opt=opt, jit=triple is None)


def object_code(ir: str) -> bytes:
    """Compile IR to object code. No passes run on it: whoever wrote the IR has optimized it.

    Args:
        ir: a module in LLVM's text form, without triple and data layout.
    """
    check_address_space()
    machine = new_machine()
    return machine.emit_object(parse(ir, machine))


def parse(ir: str, machine: Any) -> Any:
    """Parse IR as :func:`object_code` takes it; return the verified module, with triple and data layout of a target machine."""
    # The layout comes before the instructions: LLVM gives loads and stores their alignment as it reads them.
    head = f'target datalayout = "{machine.target_data}"\ntarget triple = "{machine.triple}"\n'
    module = llvm().parse_assembly(head + ir)
    module.verify()
    return module


def load_object(code: bytes) -> tuple[Any, Callable[[str], int]]:
    """Link object code into this process.

    Returns:
        LLVM's execution engine, which keeps the code in memory as long as it is referenced; and a function that returns the
        address of a function of the code by its name.
    """
    check_address_space()
    # An engine needs a module, here an empty one. It takes the target machine over and frees it.
    engine = llvm().create_mcjit_compiler(llvm().parse_assembly(""), new_machine())
    engine.add_object_file(llvm().ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine, engine.get_function_address
