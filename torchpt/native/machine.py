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


def new_machine() -> Any:
    """Return a target machine of LLVM for this CPU, for code that is loaded into this process (``jit``).

    ``opt=2`` is LLVM's default level of code generation: it selects instructions and registers, and runs no passes on the IR.
    """
    cpu, features = host()
    return llvm().Target.from_default_triple().create_target_machine(cpu=cpu, features=features, opt=2, jit=True)


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
    module = llvm().parse_assembly(ir)
    module.triple = llvm().get_default_triple()
    module.data_layout = str(machine.target_data)
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
