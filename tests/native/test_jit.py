"""Numba kernels on disk: found by the content that they are made of, and compiled anew where an entry is of no use."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from few import few

from torchpt.native import cache, content
from torchpt.native.content import code_of_folder, code_of_function

KERNEL = '''"""A module."""
import math
import numpy as np
from torchpt.native import simd
from torchpt.native.jit import jit, jit_internal

STEP = 3
TABLE = np.arange(4.0)

@jit_internal()
def inner(x):
    """Add a step."""
    return x + STEP

def plain(x):
    return x * 2

def made(k):
    return jit()(lambda x: x + k)

by_cell = made(5)

@jit()
def kernel(x):
    """Do something."""
    return by_cell(inner(x)) + TABLE[1] + math.sqrt(4.0)

other = jit(fastmath=True)(kernel.py_func)
'''


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Imports the module anew with some of its text replaced."""
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(tmp_path))
    cache._folder.cache_clear()
    count = [0]

    def loaded(**changes: str) -> ModuleType:
        text = KERNEL
        for old, new in changes.items():
            assert text.count(KEYS[old]) == 1, old
            text = text.replace(KEYS[old], new)
        count[0] += 1
        (tmp_path / f"kernel_{count[0]}.py").write_text(text)
        importlib.invalidate_caches()
        return importlib.import_module(f"kernel_{count[0]}")

    yield loaded
    cache._folder.cache_clear()
    for k in range(count[0]):
        sys.modules.pop(f"kernel_{k + 1}", None)


KEYS = {
    "docstring": '"""Do something."""',
    "inner's docstring": '"""Add a step."""',
    "place": '"""A module."""',
    "constant": "STEP = 3",
    "inner": "x + STEP",
    "cell": "made(5)",
    "table": "np.arange(4.0)",
    "body": "math.sqrt(4.0)",
    "options": "@jit_internal()",
    "function": "math.sqrt(",
}


@pytest.mark.parametrize(
    ("what", "new", "same"),
    [
        ("docstring", '"""Say it otherwise."""', True),
        ("inner's docstring", '"""Say it otherwise."""', True),
        ("place", "# a comment\n\n\n", True),
        ("constant", "STEP = 4", False),
        ("inner", "x - STEP", False),
        ("cell", "made(6)", False),
        ("table", "np.arange(4.0) + 1", False),
        ("body", "math.sqrt(9.0)", False),
        ("options", "@jit_internal(fastmath=True)", False),
        ("function", "math.exp(", False),
    ],
)
def test_a_name_is_that_of_what_the_code_says(load, what, new, same):
    before, after = load().kernel, load(**{what: new}).kernel
    assert (code_of_function(before) == code_of_function(after)) == same


def test_options_are_content(load):
    module = load()
    assert code_of_function(module.kernel) != code_of_function(module.other)


def test_each_kernel_has_a_name():
    """What a kernel reads can be told of all of them, so that all are kept."""
    package = Path(content.__file__).parents[1]
    found: dict[str, str] = {}
    for path in sorted(
        [*package.glob("search/*.py"), package / "physics/lights/tree_build.py", package / "math/sum_kernels.py"]
    ):
        module = importlib.import_module(".".join(("torchpt", *path.relative_to(package).with_suffix("").parts)))
        for name, value in vars(module).items():
            if hasattr(value, "py_func") and value.py_func.__module__ == module.__name__:
                found[f"{module.__name__}.{name}"] = code_of_function(value)
    assert len(found) > 60 and len(set(found.values())) == len(found)


def test_the_code_of_intrinsics_is_content(monkeypatch):
    from torchpt.search import tree_packet

    before = code_of_function(tree_packet.nearest)
    monkeypatch.setattr(content, "code_of_folder", lambda folder: "other")
    assert code_of_function(tree_packet.nearest) != before


def entries() -> list[Path]:
    folder = cache.cache_folder()
    assert folder is not None
    return sorted(folder.glob("*.nbc"))


def hits(kernel: Any) -> int:
    return sum(kernel.stats.cache_hits.values())


def test_another_checkout_compiles_nothing(load):
    first = load().kernel
    assert first(1.0) == 12.0 and hits(first) == 0
    made = entries()
    again = load(place="# elsewhere\n").kernel
    assert again(1.0) == 12.0 and hits(again) == 1 and entries() == made
    changed = load(constant="STEP = 4").kernel
    assert changed(1.0) == 13.0 and hits(changed) == 0 and len(entries()) > len(made)


@pytest.mark.parametrize("content", few([b"", b"\x80\x05garbage", None], 2))
def test_a_damaged_entry_costs_a_compilation(load, content):
    assert load().kernel(1.0) == 12.0
    for path in entries():
        if content is None:  # sound to the checksum, and no kernel
            cache.write(path.name, b"\x80\x05garbage")
        else:
            path.write_bytes(content)
    kernel = load().kernel
    assert kernel(1.0) == 12.0 and hits(kernel) == 0


def test_without_a_folder(load, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path / "file" / "cache"))
    cache._folder.cache_clear()
    assert load().kernel(1.0) == 12.0 and cache.cache_folder() is None


# -- whole folders


def test_code_of_a_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path / "cache"))
    cache._folder.cache_clear()
    root = tmp_path / "package"
    (root / "inner").mkdir(parents=True)
    file = root / "inner" / "a.py"

    def code(text: str) -> str:
        file.write_text(text)
        code_of_folder.cache_clear()
        return code_of_folder(root)

    first = code("def f(x):\n    'Say.'\n    return x in {'a', 'b'}\n")
    assert code("# more\ndef f(x):\n    'Say more.'\n\n    return x in {'a', 'b'}\n") == first
    assert code("def f(x):\n    'Say.'\n    return x in {'a', 'c'}\n") != first
    assert code("def f(y):\n    'Say.'\n    return y in {'a', 'b'}\n") != first
    (root / "b.py").write_text("")
    assert code("def f(x):\n    'Say.'\n    return x in {'a', 'b'}\n") != first
    code_of_folder.cache_clear()
    cache._folder.cache_clear()


def test_files_that_did_not_change_are_not_read(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path / "cache"))
    cache._folder.cache_clear()
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "a.py").write_text("x = 1\n")
    code_of_folder.cache_clear()
    first = code_of_folder(tmp_path / "package")
    monkeypatch.setattr(content, "_code_of_file", lambda path: pytest.fail("read"))
    code_of_folder.cache_clear()
    assert code_of_folder(tmp_path / "package") == first
    code_of_folder.cache_clear()
    cache._folder.cache_clear()


@pytest.mark.slow
def test_numba_without_its_compiler_is_told_in_a_line(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "torchpt", "render", "scene=cornell_box", "render.spp=1", "render.accel=numba"]
    words += ["film.width=4", "film.height=4", f"out={tmp_path / 'box.png'}"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 2 and not list(tmp_path.iterdir())
    said = done.stderr.strip().splitlines()
    assert len(said) == 1 and "NUMBA_DISABLE_JIT is set" in said[0]
