"""Compile LLVM IR by llvmlite: to machine code of this CPU that can be called, or to code for another machine.

Code is cached in memory and on disk; its key is a hash of the IR, the target and the version of llvmlite.
"""

from __future__ import annotations

import ctypes
import threading
from dataclasses import dataclass
from typing import Any

from torchpt.compiler.target import Target
from torchpt.core.memory import check_address_space
from torchpt.native import cache, machine

__all__ = [
    "Function",
    "compile_ir",
    "counts",
    "host",
    "identity",
    "load_function",
]

#: Part of every key: raised when compilation changes, so that older entries are not read.
_VERSION = "5"
_lock = threading.Lock()
_state: dict[str, Any] = {"compiled": 0, "loaded": 0}  # counters for `counts`, and the target of this machine
_functions: dict[str, Function] = {}  # by key
_machines: dict[Target, Any] = {}  # LLVM's target machines


@dataclass(frozen=True)
class Function:
    """A compiled kernel.

    Attributes:
        call: ``call(address of the arguments, lanes)`` runs the kernel without the GIL; None for another machine's code.
        code: an object file, or the text of PTX.
        engine: keeps the code in memory.
        key: cache key of the code.
    """

    call: Any
    code: bytes
    engine: Any
    key: str = ""


def host() -> Target:
    """Return the target of this machine."""
    if "host" not in _state:
        _state["host"] = Target(*machine.host())
    return _state["host"]


def counts() -> tuple[int, int]:
    """Return the numbers of kernels that this process has compiled and has loaded from disk."""
    return _state["compiled"], _state["loaded"]


def compile_ir(ir: str, target: Target | None = None) -> Function:
    """Return the function ``kernel`` of an LLVM module from memory, from disk, or compiled now for the target."""
    with _lock:
        target = target or host()
        key = cache.digest(_identity(target), ir)
        function = _functions.get(key)
        if function is None:
            code = cache.read(_entry(key, target))
            if code is None:
                check_address_space()  # LLVM ends the process if it gets no memory
                code = _code(ir, target)
                _state["compiled"] += 1
                cache.write(_entry(key, target), code)
            else:
                _state["loaded"] += 1
            function = _functions[key] = _loaded(code, target, key)
        return function


def load_function(key: str, target: Target | None = None) -> Function | None:
    """Return a function of a target (None: this machine) by its key, from memory or disk; None if it is in neither."""
    with _lock:
        target = target or host()
        function = _functions.get(key)
        code = cache.read(_entry(key, target)) if function is None else None
        if code is not None:
            _state["loaded"] += 1
            function = _functions[key] = _loaded(code, target, key)
        return function


def identity(target: Target | None = None) -> str:
    """Return text that identifies compiler and target (None: this machine), as part of cache keys."""
    return _identity(target or host())


def _entry(key: str, target: Target) -> str:
    """Return the name of the entry on disk."""
    return f"{key}.{'ptx' if target.form.threads else 'o'}"


def _identity(target: Target) -> str:
    return "\n".join((_VERSION, machine.version(), repr(target)))


def _machine(target: Target) -> Any:
    if target not in _machines:
        opt = 3 if target.form.threads else 2
        _machines[target] = machine.new_machine(target.cpu, target.features, target.triple, opt)
    return _machines[target]


def _code(ir: str, target: Target) -> bytes:
    """Compile IR to an object file, or for threads to the text of PTX."""
    llvm, target_machine, threads = machine.llvm(), _machine(target), target.form.threads
    module = machine.parse(ir, target_machine)
    # The IR is already vectorized and its constants are folded: LLVM's standard pipelines take three times as long as these
    # passes, and the code is no faster; kernels of GPUs then need more registers.
    passes = llvm.create_new_module_pass_manager()
    if threads:
        passes.add_always_inliner_pass()
        passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    passes.add_new_gvn_pass()
    passes.add_aggressive_dce_pass()
    if threads:  # definitions of functions that were inlined
        passes.add_global_dead_code_eliminate_pass()
    passes.run(module, llvm.create_pass_builder(target_machine, llvm.create_pipeline_tuning_options()))
    return target_machine.emit_assembly(module).encode() if threads else target_machine.emit_object(module)


def _loaded(code: bytes, target: Target, key: str) -> Function:
    if target.triple is not None:  # code for another machine cannot be called here
        return Function(call=None, code=code, engine=None, key=key)
    engine, address_of_function = machine.load_object(code)
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)(address_of_function("kernel"))
    return Function(call, code, engine, key)
