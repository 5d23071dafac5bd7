"""Lower kernels to LLVM IR that any 64-bit CPU can compile: numba types and lowers them, LLVM optimizes them.

The text is then stripped of all that depends on numba or on the version of LLVM (attributes, metadata, long names), so that
other versions of llvmlite can read it and a change of a source changes little of it.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import codegen, types
from numba.core.compiler_lock import global_compiler_lock

from kernel_sources.jit import OPTIONS, Kernel

__all__ = ["lower"]

#: The machine for which LLVM's passes estimate costs: one with vectors of sixteen lanes, so that these stay whole.
_TRIPLE, _CPU = "x86_64-unknown-linux-gnu", "x86-64-v4"
#: Reference counts of arrays. Kernels allocate none: all their arrays are views of memory of the caller.
_NO_REFERENCES = "".join(
    f"define linkonce_odr void @{name}(ptr %x) alwaysinline {{ ret void }}\n" for name in ("NRT_incref", "NRT_decref")
)
#: Functions of C that kernels may call: the machine's own are linked.
_ALLOWED = re.compile(r"llvm\.[\w.]+|acos|cos|sin")


def lower(kernels: Sequence[Kernel]) -> str:
    """Return the IR of a module with these kernels.

    Each becomes a function of its name. An integer is one argument ``i64``; a pointer is one argument ``ptr``; an array is a
    pointer, and an ``i64`` for each of its dimensions. It returns an ``i64`` if the Python function returns an integer, else
    nothing.
    """
    module = llvm.parse_assembly(_NO_REFERENCES)
    for kernel in kernels:
        text, function, result = _lowered(kernel)
        module.link_in(llvm.parse_assembly(_without_host(text)))
        module.link_in(llvm.parse_assembly(_entry(kernel, function, result)))
    module = llvm.parse_assembly(_internal(str(module), {kernel.name for kernel in kernels}))
    _optimize(module)
    return _plain(str(module))


@contextmanager
def _unoptimized() -> Iterator[None]:
    """Let numba leave the IR as it lowers it."""
    library = codegen.CPUCodeLibrary
    before = library._optimize_functions, library._optimize_final_module
    library._optimize_functions = lambda self, ll_module: None
    library._optimize_final_module = lambda self: None
    try:
        yield
    finally:
        library._optimize_functions, library._optimize_final_module = before


def _lowered(kernel: Kernel) -> tuple[str, str, Any]:
    """Return numba's module of a kernel, the function's name in it, and the type of its result."""
    with _unoptimized(), warnings.catch_warnings(), global_compiler_lock:
        warnings.simplefilter("ignore")
        function = numba.njit(**OPTIONS)(kernel.function)
        function.compile(kernel.arguments)
        (overload,) = function.overloads.values()
        return str(overload.library._final_module), overload.fndesc.llvm_func_name, overload.signature.return_type


def _entry(kernel: Kernel, function: str, result: Any) -> str:
    """Return a module with the function that Python calls, which calls numba's ``function``.

    For an array numba's function takes the members of its array structure: two pointers to Python objects (here null), number
    of elements, bytes of an element, address, shape and strides. Before all arguments it takes the address of its result and
    that of an exception, and it returns a status code, which is ignored, since kernels raise nothing.
    """
    head, inner, lines = [], [], []
    for k, kind in enumerate(kernel.arguments):
        if isinstance(kind, types.Array):
            item = kind.dtype.bitwidth // 8
            head += [f"ptr %a{k}", *(f"i64 %a{k}.n{axis}" for axis in range(kind.ndim))]
            stride, strides = str(item), []
            for axis in reversed(range(kind.ndim)):
                strides.append(f"i64 {stride}")
                lines.append(f"  %a{k}.s{axis} = mul i64 {stride}, %a{k}.n{axis}")
                stride = f"%a{k}.s{axis}"
            lines.append(f"  %a{k}.count = udiv exact i64 {stride}, {item}")
            shape = [f"i64 %a{k}.n{axis}" for axis in range(kind.ndim)]
            inner += [
                "ptr null",
                "ptr null",
                f"i64 %a{k}.count",
                f"i64 {item}",
                f"ptr %a{k}",
                *shape,
                *reversed(strides),
            ]
        else:
            word = f"{'i64' if isinstance(kind, types.Integer) else 'ptr'} %a{k}"
            head.append(word)
            inner.append(word)
    given = ", ".join(["ptr %result", "ptr %status", *inner])
    kinds = ", ".join(word.split()[0] for word in given.split(", "))
    returns = isinstance(result, types.Integer)
    assert returns or result == types.none, f"{kernel.name} returns {result}"
    lines += [f'  %code = call i32 @"{function}"({given})']
    lines += ["  %value = load i64, ptr %result", "  ret i64 %value"] if returns else ["  ret void"]
    return "\n".join(
        [
            f'declare i32 @"{function}"({kinds})',
            f"define {'i64' if returns else 'void'} @{kernel.name}({', '.join(head)}) {{",
            *("  %result = alloca i64", "  %status = alloca ptr", *lines, "}"),
        ]
    )


def _without_host(text: str) -> str:
    """Return a module without what names the machine that numba compiles for: its target lines and target attributes."""
    text = re.sub(r"^target (?:triple|datalayout) = .*$", "", text, flags=re.MULTILINE)
    return re.sub(r'"target-(?:cpu|features)"="[^"]*"', "", text)


def _internal(text: str, names: set[str]) -> str:
    """Return a module in which all but these functions are internal, and square roots are LLVM's.

    Internal functions and constants may be inlined and dropped.
    """
    # a line `define ... @name(`, with or without a linkage before its type
    text = re.sub(
        r'^define (?:linkonce_odr |hidden |dso_local |internal )*(.*?@("[^"]*"|[\w.$]+)\()',
        lambda line: f"define {line[1]}" if line[2].strip('"') in names else f"define internal {line[1]}",
        text,
        flags=re.MULTILINE,
    )
    # a global constant `@name = linkage ...`
    text = re.sub(r"^(@\S.* = )(?:common|linkonce_odr|linkonce) ", r"\1internal ", text, flags=re.MULTILINE)
    return re.sub(r"@sqrt\(", "@llvm.sqrt.f64(", text)


def _optimize(module: Any) -> None:
    """Run LLVM's standard passes, without those that make vectors of loops: kernels have their vectors already."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(_TRIPLE).create_target_machine(cpu=_CPU, opt=3)
    module.triple, module.data_layout = _TRIPLE, str(machine.target_data)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=3)
    options.loop_vectorization, options.slp_vectorization = False, False
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)


def _plain(text: str) -> str:
    """Return a module without attributes, metadata and comments, and with short names."""
    text = _without_host(text)
    # whole lines of metadata and attributes; comments; references to metadata and to attributes; address hints; hints of
    # parameters
    text = re.sub(r"^(?:source_filename|attributes|!|;).*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\s*;.*$", "", text, flags=re.MULTILINE)
    text = re.sub(r",? ![\w.]+ !\d+", "", text)
    text = re.sub(r" #\d+", "", text)
    text = re.sub(r"\b(?:local_unnamed_addr|unnamed_addr) ?", "", text)
    text = re.sub(r"^(?:define|declare) .*$", lambda line: _HINTS.sub("", line[0]), text, flags=re.MULTILINE)
    text = re.sub(r"^(define .*\)) \{$", r"\1 nounwind {", text, flags=re.MULTILINE)
    outside = {
        name for name in re.findall(r"^declare .*?@([\w.]+)\(", text, re.MULTILINE) if not _ALLOWED.fullmatch(name)
    }
    assert not outside, f"kernels call {', '.join(sorted(outside))}"
    pieces = re.split(r"(?m)^(?=define )", text)
    lines = [line for piece in pieces for line in _renamed(piece).splitlines() if line.strip()]
    return _global_names("\n".join(lines)) + "\n"


#: Attributes of parameters that only passes read. Newer versions of LLVM may not know them.
_HINTS = re.compile(
    r" (?:readonly|writeonly|readnone|noundef|nonnull|noalias|nofree|returned|captures\(.*?\)|initializes\(\(.*?\)\)"
    r"|(?:align|dereferenceable|range)(?:\(.*?\)| \d+))(?=[ ,)])"
)
#: The name of a value (``%name``), or of a basic block at the start of its line (``name:``); names may be quoted.
_LOCAL = re.compile(r'%("[^"]*"|[\w.$-]+)|^("[^"]*"|[\w.$-]+):', re.MULTILINE)


def _renamed(function: str) -> str:
    """Return a function with values and blocks numbered in base 36."""
    if not function.startswith("define"):
        return function
    head, body = function.split("\n", 1)
    if not re.match(r'(?:"[^"]*"|[\w.$-]+):', body):  # the first block's number follows those of the unnamed arguments
        function = f"{head}\n{len(re.findall(r'%[0-9]+', head))}:\n{body}"
    names: dict[str, str] = {}

    def short(match: re.Match[str]) -> str:
        name = names.setdefault(match[1] or match[2], f"v{_base36(len(names))}")
        return f"%{name}" if match[1] else f"{name}:"

    return _LOCAL.sub(short, function)


def _base36(number: int) -> str:
    digits = ""
    while True:
        number, digit = divmod(number, 36)
        digits = "0123456789abcdefghijklmnopqrstuvwxyz"[digit] + digits
        if not number:
            return digits


def _global_names(text: str) -> str:
    """Return a module with short names of its internal functions and constants."""
    names = re.findall(r'^(?:define internal .*?)?@("[^"]*"|[\w.$]+)(?:\(| = )', text, re.MULTILINE)
    for k, name in enumerate(dict.fromkeys(names)):
        text = re.sub(rf"@{re.escape(name)}(?![\w.$])", f"@f{_base36(k)}", text)
    return text
