"""Lower the sources of ``scripts/kernel_sources`` to the IR that the package holds, in ``torchpt/native/ir``.

    python scripts/make_kernels.py            # write what has changed
    python scripts/make_kernels.py --check    # exit code 1 if anything has changed

numba does the work, so this is for those who change kernels. It takes a minute.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib
import io
import lzma
import os
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

from torchpt.native.kernels import FOLDER, read_module

#: CPU for which numba's own passes work, whatever the machine: they make loops of gathers where a CPU's are slow.
CPU = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "scripts" / "kernel_sources"
MODULES = (
    "tree_packet",
    "tree_instances",
    "tree_build",
    "tree_refit",
    "light_tree",
    "sums",
    "obj_text",
    "photons",
    "splats",
)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args(arguments).check
    os.environ |= CPU  # before numba is imported
    made, changed = make(), []
    for name, text in made.items():
        path = FOLDER / f"{name}.ll.xz"
        if not path.exists() or read_module(name) != text:
            changed.append(name)
            if not check:
                FOLDER.mkdir(exist_ok=True)
                path.write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))
    for path in FOLDER.glob("*.ll.xz"):
        if path.name.removesuffix(".ll.xz") not in made:
            changed.append(path.name)
            if not check:
                path.unlink()
    print(f"{len(made)} modules, changed: {', '.join(changed) or 'none'}")
    return 1 if check and changed else 0


def make() -> dict[str, str]:
    """Return the text of each module: a line for each kernel, with its arguments; what it was made of and by; its IR."""
    import llvmlite
    import numba
    from kernel_sources import jit
    from kernel_sources.lowering import lower

    for module in MODULES:
        importlib.import_module(f"kernel_sources.{module}")
    found = {}
    for name in sorted({kernel.module for kernel in jit.KERNELS}):
        kernels = [kernel for kernel in jit.KERNELS if kernel.module == name]
        head = [f"; sources {digest()}, numba {numba.__version__}, llvmlite {llvmlite.__version__}"]
        head += [f"; {kernel.name}({', '.join(map(_argument, kernel.arguments))})" for kernel in kernels]
        found[name] = "\n".join([*head, lower(kernels)])
    return found


def _argument(kind: object) -> str:
    """Return the type of an argument: ``int``, ``f4*`` for a pointer, or ``f4[2]`` for an array of two dimensions."""
    from numba.core import types
    from numba.np.numpy_support import as_dtype

    if isinstance(kind, types.Integer):
        return "int"
    assert isinstance(kind, types.CPointer | types.Array)
    dtype = as_dtype(kind.dtype).str[1:]
    return f"{dtype}[{kind.ndim}]" if isinstance(kind, types.Array) else f"{dtype}*"


def digest() -> str:
    """Return a digest of the sources, without comments and docstrings, and of the constants that they take from the package."""
    total = hashlib.sha256()
    for path in sorted(SOURCES.rglob("*.py")):
        text = path.read_text()
        parts = (str(path.relative_to(SOURCES)), _code(text), *_constants(ast.parse(text)))
        total.update("\0".join((*parts, "")).encode())
    return total.hexdigest()[:32]


def _constants(source: ast.Module) -> Iterator[str]:
    """Yield the values that a source imports from the package."""
    for statement in source.body:
        if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith("torchpt."):
            module = importlib.import_module(str(statement.module))
            yield from (f"{name.name} = {getattr(module, name.name)!r}" for name in statement.names)


def _code(text: str) -> str:
    """Return the tokens of a source without comments and docstrings."""
    words, begins, in_docstring = [], True, False  # begins: a statement begins here
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in (tokenize.COMMENT, tokenize.NL):
            continue
        if token.type == tokenize.STRING and begins:
            in_docstring = True
            continue
        if in_docstring and token.type == tokenize.NEWLINE:  # the end of the docstring's line
            in_docstring = False
            continue
        begins = token.type in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
        words.append(token.string if not begins else tokenize.tok_name[token.type])
    return " ".join(words)


if __name__ == "__main__":
    sys.exit(main())
