"""The package's own rules of size: files and functions that a reader can hold in mind."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import torchpt

PACKAGE = Path(torchpt.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
MOST_LINES, MOST_FUNCTION = 400, 80
#: Files and functions that are still too long, and how long they may be until they are divided. Nothing is to be added.
OFFENDERS: dict[str, int] = {}


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def functions(tree: ast.AST, prefix: str = "") -> Iterator[tuple[str, int]]:
    """All functions and methods with their lengths, decorators not counted."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = f"{prefix}{node.name}"
            if not isinstance(node, ast.ClassDef):
                assert node.end_lineno is not None
                yield name, node.end_lineno - node.lineno + 1
            yield from functions(node, f"{name}.")
        else:
            yield from functions(node, prefix)


def lengths(path: Path) -> Iterator[tuple[str, int, int]]:
    """What has a length in a file, how long it is and may be."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    reasons = [line for line in (ast.get_docstring(tree) or "").splitlines() if line.startswith("Long because")]
    if not reasons:
        yield name_of(path), len(text.splitlines()), MOST_LINES
    for name, lines in functions(tree):
        yield f"{name_of(path)}: {name}", lines, MOST_FUNCTION


def test_files_and_functions_are_short():
    """A file that must be longer says why in a line of its docstring that begins with ``Long because``."""
    every = [length for path in FILES for length in lengths(path)]
    assert len(every) > 1000
    assert {name: lines for name, lines, most in every if lines > max(most, OFFENDERS.get(name, 0))} == {}
    still = {name for name, lines, most in every if lines > most}
    assert OFFENDERS.keys() <= still, "what was divided is no offender any more"
