"""From IR to machine code: LLVM through llvmlite."""

from __future__ import annotations

import ctypes
import hashlib
import threading
from dataclasses import dataclass
from typing import Any

from torchpt.compiler.form import VECTORS, Form
from torchpt.core.memory import check_address_space
from torchpt.native import cache

__all__ = [
    "Function",
    "Target",
    "compiled",
    "counts",
    "host",
    "identity",
    "load_function",
]

#: Enters every key: entries that are made otherwise are never read.
_VERSION = "5"
_lock = threading.Lock()
_state: dict[str, Any] = {"ready": False, "compiled": 0, "loaded": 0}
_functions: dict[str, Function] = {}
_machines: dict[Target, Any] = {}


@dataclass(frozen=True)
class Target:
    """A machine that kernels are made for.

    Attributes:
        cpu: LLVM's name of it.
        features: LLVM's names of its features.
        triple: LLVM's name of the machine; None: this one.
        form: how its kernels hold lanes.
    """

    cpu: str
    features: str
    triple: str | None = None
    form: Form = VECTORS


@dataclass(frozen=True)
class Function:
    """A kernel's machine code: ``call(address of the arguments, lanes)`` runs it without the GIL."""

    call: Any
    code: bytes
    engine: Any  # keeps the code in memory
    key: str = ""  # its name on disk


def _llvm() -> Any:
    """Llvmlite's binding, ready for this machine."""
    import llvmlite.binding as llvm

    if not _state["ready"]:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        _state["ready"] = True
    return llvm


def host() -> Target:
    """This machine."""
    if "host" not in _state:
        check_address_space()
        llvm = _llvm()
        _state["host"] = Target(llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())
    return _state["host"]


def counts() -> tuple[int, int]:
    """Return how many kernels this process compiled, and how many it loaded from disk."""
    return _state["compiled"], _state["loaded"]


def compiled(ir: str, target: Target | None = None) -> Function:
    """The function ``kernel`` of a module, from this process, from disk, or made now."""
    with _lock:
        target = target or host()
        key = _key(ir, target)
        function = _functions.get(key)
        if function is None:
            code = cache.read(f"{key[:40]}.o")
            check_address_space()  # LLVM ends the process where it finds no memory
            if code is None:
                code = _object(ir, target)
                _state["compiled"] += 1
                cache.write(f"{key[:40]}.o", code)
            else:
                _state["loaded"] += 1
            function = _functions[key] = _loaded(code, target, key)
        return function


def load_function(key: str) -> Function | None:
    """A function of this machine by its key, from this process or from disk; None where there is none."""
    with _lock:
        function = _functions.get(key)
        code = cache.read(f"{key[:40]}.o") if function is None else None
        if code is not None:
            check_address_space()
            _state["loaded"] += 1
            function = _functions[key] = _loaded(code, host(), key)
        return function


def identity() -> str:
    """Return what this machine's code depends on beside a stage."""
    return _named(host())


def _named(target: Target) -> str:
    import llvmlite

    return "\n".join((_VERSION, llvmlite.__version__, repr(target)))


def _key(ir: str, target: Target) -> str:
    return hashlib.sha256(f"{_named(target)}\n{ir}".encode()).hexdigest()


def _machine(target: Target) -> Any:
    if target not in _machines:
        _machines[target] = _new_machine(target)
    return _machines[target]


def _new_machine(target: Target) -> Any:
    llvm = _llvm()
    if target.triple is not None:
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
    kind = llvm.Target.from_default_triple() if target.triple is None else llvm.Target.from_triple(target.triple)
    options = {"jit": True} if target.triple is None else {}
    return kind.create_target_machine(cpu=target.cpu, features=target.features, opt=2, **options)


def _object(ir: str, target: Target) -> bytes:
    """Object code."""
    llvm, machine = _llvm(), _machine(target)
    module = llvm.parse_assembly(ir)
    module.triple = target.triple or llvm.get_default_triple()
    module.data_layout = str(machine.target_data)
    module.verify()
    # The IR is vectors already, its constants folded: what LLVM's own pipelines do beyond this takes three times as long, and
    # the code is no faster for it.
    passes = llvm.create_new_module_pass_manager()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    passes.add_new_gvn_pass()
    passes.add_aggressive_dce_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_object(module)


def _loaded(code: bytes, target: Target, key: str) -> Function:
    if target.triple is not None:
        return Function(None, code, None, key)  # for another machine: not to be run here
    llvm = _llvm()
    machine = _new_machine(target)  # becomes the engine's own, and goes with it
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)(engine.get_function_address("kernel"))
    return Function(call, code, engine, key)
