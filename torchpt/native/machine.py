"""LLVM for this machine, through llvmlite: compile IR to object code, and load object code.

Where all code comes from the cache, LLVM is not loaded: :mod:`torchpt.native.elf` links the code, and LLVM's name of the CPU is
cached.

The kernels of ``ir/`` and those of the lane compiler come here. :func:`torchpt.core.memory.check_address_space` stands before
each use of LLVM that takes much memory, since LLVM ends the process when it gets none.
"""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchpt.core.memory import check_address_space
from torchpt.native import cache, codegen, elf
from torchpt.native.codegen import llvm, parse

__all__ = ["host", "identity", "llvm", "load_object", "new_machine", "object_code", "parse", "version"]


@functools.cache
def host() -> tuple[str, str]:
    """Return LLVM's name of this CPU, and its features in LLVM's words."""
    boot = _boot()
    entry = f"{cache.digest('host', version(), boot)}.json" if boot else None
    known = cache.read(entry) if entry else None
    if known is not None:
        name, features = json.loads(known)
        return name, features
    check_address_space()
    found = llvm().get_host_cpu_name(), llvm().get_host_cpu_features().flatten()
    if entry:
        cache.write(entry, json.dumps(found).encode())
    return found


def _boot() -> str | None:
    """Return text that tells CPUs apart: Linux' description of the first one, and the random number of this boot.

    The description may lack features that LLVM finds, hence the number, which no other machine has. None on other systems.
    """
    try:
        number = Path("/proc/sys/kernel/random/boot_id").read_text()
        with open("/proc/cpuinfo") as file:
            lines = list(itertools.takewhile(str.strip, file))  # up to the empty line behind the first processor
    except OSError:
        return None
    return number + "".join(line for line in lines if not line.startswith("cpu MHz"))


def version() -> str:
    """Return the version of llvmlite. Its package is imported for it, which is small; LLVM is not."""
    import llvmlite

    return llvmlite.__version__


def identity() -> str:
    """Return text that identifies the version of LLVM's binding and this CPU, as part of cache keys."""
    return "\n".join((version(), *host()))


def new_machine(cpu: str = "", features: str = "", triple: str | None = None, opt: int = 2) -> Any:
    """Return a target machine of LLVM.

    Args:
        cpu: LLVM's name of the processor; empty: that and the features of this CPU.
        features: LLVM's list of processor features.
        triple: of another machine; None: this one, for code that is loaded into this process (``jit``).
        opt: level of code generation, by default LLVM's: it selects instructions and registers, and runs no passes on the IR.
    """
    if not cpu:
        cpu, features = host()
    return codegen.target_machine(cpu, features, triple, opt)


def object_code(ir: str) -> bytes:
    """Compile IR to object code. No passes run on it: whoever wrote the IR has optimized it.

    Args:
        ir: a module in LLVM's text form, without triple and data layout.
    """
    check_address_space()
    machine = new_machine()
    return machine.emit_object(parse(ir, machine))


def load_object(code: bytes) -> tuple[Any, Callable[[str], int]]:
    """Link object code into this process.

    Returns:
        An object that keeps the code in memory as long as it is referenced; and a function that returns the address of a
        function of the code by its name.
    """
    linked = elf.link(code)
    if linked is not None:
        return linked.memory, linked.functions.__getitem__
    check_address_space()
    # An engine needs a module, here an empty one. It takes the target machine over and frees it.
    engine = llvm().create_mcjit_compiler(llvm().parse_assembly(""), new_machine())
    engine.add_object_file(llvm().ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine, engine.get_function_address
