"""LLVM for this machine: compile IR to object code, and load object code."""

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
    """Return a target machine of LLVM for this CPU."""
    cpu, features = host()
    return llvm().Target.from_default_triple().create_target_machine(cpu=cpu, features=features, opt=2, jit=True)


def object_code(ir: str) -> bytes:
    """Compile IR to object code without further passes.

    Args:
        ir: a module in LLVM's text form, without triple and data layout.
    """
    check_address_space()  # LLVM ends the process where it finds no memory
    machine = new_machine()
    return machine.emit_object(parse(ir, machine))


def parse(ir: str, machine: Any) -> Any:
    """Return a module of LLVM for a target machine, of IR as :func:`object_code` takes it."""
    module = llvm().parse_assembly(ir)
    module.triple = llvm().get_default_triple()
    module.data_layout = str(machine.target_data)
    module.verify()
    return module


def load_object(code: bytes) -> tuple[Any, Callable[[str], int]]:
    """Link object code into this process; return what keeps it in memory, and a function from names to addresses."""
    check_address_space()
    engine = llvm().create_mcjit_compiler(llvm().parse_assembly(""), new_machine())  # which owns and frees the machine
    engine.add_object_file(llvm().ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine, engine.get_function_address
