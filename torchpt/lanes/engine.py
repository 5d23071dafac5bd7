"""From IR to machine code: LLVM through llvmlite, and a cache on disk.

The cache holds native code, so its folder is this user's alone (mode 0700, owner checked) and each entry carries a checksum.
Where there can be no such folder, kernels are compiled in memory.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import stat
import sys
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchpt.native.memory import MARGIN, room_for

__all__ = [
    "Function",
    "Target",
    "cache_folder",
    "compiled",
    "counts",
    "estimates",
    "host",
    "identity",
    "kept",
    "read",
    "write",
]

#: Enters every key: entries of another form are never read.
_FORM = "4"
_lock = threading.Lock()
_state: dict[str, Any] = {"ready": False, "compiled": 0, "loaded": 0}
_functions: dict[str, Function] = {}
_machines: dict[Target, Any] = {}


@dataclass(frozen=True)
class Target:
    """What code is made for; names are LLVM's."""

    cpu: str
    features: str
    triple: str | None = None


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
        _check_room()
        llvm = _llvm()
        _state["host"] = Target(llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten())
    return _state["host"]


def estimates() -> bool:
    """Whether this machine has AVX-512's estimates of reciprocals."""
    return "+avx512f" in host().features.split(",")


def counts() -> tuple[int, int]:
    """How many kernels this process compiled, and how many it loaded from disk."""
    return _state["compiled"], _state["loaded"]


def compiled(ir: str, target: Target | None = None) -> Function:
    """The function ``kernel`` of a module, from this process, from disk, or made now."""
    with _lock:
        target = target or host()
        key = _key(ir, target)
        function = _functions.get(key)
        if function is None:
            code = read(f"{key[:40]}.o")
            _check_room()
            if code is None:
                code = _object(ir, target)
                _state["compiled"] += 1
                write(f"{key[:40]}.o", code)
            else:
                _state["loaded"] += 1
            function = _functions[key] = _loaded(code, target, key)
        return function


def _check_room() -> None:
    """LLVM ends the process where it finds no memory, so it is asked for before.

    Raises:
        MemoryError: there is none.
    """
    if not room_for(MARGIN):
        raise MemoryError("no room to make kernels")


def kept(key: str) -> Function | None:
    """A function of this machine by its key, from this process or from disk; None where there is none."""
    with _lock:
        function = _functions.get(key)
        code = read(f"{key[:40]}.o") if function is None else None
        if code is not None:
            _check_room()
            _state["loaded"] += 1
            function = _functions[key] = _loaded(code, host(), key)
        return function


def identity() -> str:
    """What machine code depends on beside the IR."""
    import llvmlite

    target = host()
    return "\n".join((_FORM, llvmlite.__version__, target.cpu, target.features))


def _key(ir: str, target: Target) -> str:
    import llvmlite

    text = "\n".join((_FORM, llvmlite.__version__, target.cpu, target.features, str(target.triple), ir))
    return hashlib.sha256(text.encode()).hexdigest()


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


def cache_folder() -> Path | None:
    """Where kernels are kept: ``$TORCHPT_CACHE``, else the user's cache folder; None where that cannot be trusted."""
    given = os.environ.get("TORCHPT_CACHE")
    if given == "":
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # as its specification says
        base = os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(given).absolute() if given else Path(base) / "torchpt" / "kernels"
    if not folder.is_absolute():  # no home
        return None
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        facts = [folder.stat(), folder.lstat()]  # a link must be this user's as well
    except OSError:
        return None
    if not hasattr(os, "getuid"):  # no owners and modes to check
        return folder
    if any(fact.st_uid != os.getuid() for fact in facts) or stat.S_IMODE(facts[0].st_mode) & 0o077:
        return None
    return folder


def _folder() -> Path | None:
    if "folder" not in _state:
        _state["folder"] = cache_folder()
    return _state["folder"]


def read(name: str) -> bytes | None:
    """An entry of the cache; None where there is none, or a damaged or a doubtful one, which is made again."""
    folder = _folder()
    if folder is None:
        return None
    try:
        handle = os.open(folder / name, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as file:
            facts = os.fstat(handle)
            if not stat.S_ISREG(facts.st_mode):
                return None
            # Whoever may rename the folder could have put another in its place since it was looked at.
            if hasattr(os, "getuid") and (facts.st_uid != os.getuid() or facts.st_mode & 0o022):
                return None
            content = file.read()
    except OSError:
        return None
    check, code = content[:32], content[32:]
    return code if _check(name, code) == check else None


def _check(name: str, code: bytes) -> bytes:
    return hashlib.sha256(name.encode() + code).digest()


def write(entry: str, code: bytes) -> None:
    """Put an entry in its place at once or not at all; a full disk is no reason to stop."""
    folder = _folder()
    if folder is None:
        return
    path, name = folder / entry, None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(_check(entry, code) + code)
        os.replace(name, path)
    except OSError:
        if name is not None:
            try:
                os.unlink(name)
            except OSError:
                print(f"torchpt: {name} could not be removed", file=sys.stderr)
