"""Kernels that the package carries: they are what their sources give, are compiled once, and take only what they can read."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import make_kernels
import numpy as np
import pytest

from torchpt.native import cache, kernels, machine

ROOT = Path(__file__).resolve().parents[2]
MODULES = sorted(path.name.removesuffix(".ll.xz") for path in kernels.FOLDER.iterdir())


# -- what lies in the package


@pytest.mark.parametrize("module", MODULES)
def test_the_package_carries_what_the_sources_give(module):
    """If this fails: ``python scripts/make_kernels.py``."""
    head, *_ = kernels.read_module(module).splitlines()
    pins = dict(re.findall(r"^([\w.-]+)==(.+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    assert head == f"; sources {make_kernels.digest()}, numba {pins['numba']}, llvmlite {pins['llvmlite']}"


@pytest.mark.slow
def test_the_script_writes_the_same_again():
    command = [
        sys.executable,
        str(Path(make_kernels.__file__)),
        "--check",
    ]  # numba reads its settings when it is imported
    ran = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_sources_are_told_apart(tmp_path, monkeypatch):
    def digest(text: str) -> str:
        (tmp_path / "a.py").write_text(text)
        return make_kernels.digest()

    monkeypatch.setattr(make_kernels, "SOURCES", tmp_path)
    text = 'from torchpt.search.tree_layout import LINE\n\n\ndef f(x):\n    """Say."""\n    return x + LINE\n'
    first = digest(text)
    assert digest("# more\n" + text.replace("Say.", "Say more.")) == first
    assert digest(text.replace("x +", "x -")) != first
    monkeypatch.setattr("torchpt.search.tree_layout.LINE", 32)
    assert digest(text) != first


@pytest.mark.parametrize("module", MODULES)
def test_ir_names_no_machine(module):
    text = kernels.read_module(module)
    assert not re.search(r"target (triple|datalayout)|target-(cpu|features)|/[\w.]+\.py", text)


# -- calls


def words_of(**changes):
    return kernels.kernel("sums", "sort_by_sample").words(*({**arguments(), **changes}).values())


def arguments():
    lanes, slot_of_lane = np.array([2, 0, 1, 0], np.int32), np.array([5, 9, 3], np.int32)
    slots, lane_of_slot, used = np.zeros(4, np.int32), np.zeros(16, np.int32), np.zeros(16, np.uint8)
    return {
        "lanes": lanes, "count": 3, "slot_of_lane": slot_of_lane, "slots": slots, "lane_of_slot": lane_of_slot,
        "used": used, "used_by_eight": used.view(np.uint64),
    }  # fmt: skip


@pytest.mark.parametrize("lanes", [np.zeros(4, np.int64), np.zeros(8, np.int32)[::2], np.zeros((2, 2), np.int32)])
def test_other_types_and_layouts_are_refused(lanes):
    with pytest.raises(TypeError, match=r"sort_by_sample takes a contiguous array of int32, got"):
        words_of(lanes=lanes)


def test_another_number_of_arguments_is_refused():
    with pytest.raises(TypeError, match="sort_by_sample takes 7 arguments, got 1"):
        kernels.kernel("sums", "sort_by_sample").words(1)


# -- the cache


@pytest.fixture
def made(monkeypatch, tmp_path):
    """IR that was compiled, with an empty cache folder and nothing in memory."""
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path / "cache"))
    cache._folder.cache_clear()
    found: list[str] = []
    original = machine.object_code
    monkeypatch.setattr(machine, "object_code", lambda ir: found.append(ir) or original(ir))
    monkeypatch.setattr(kernels, "_modules", {})
    yield found
    cache._folder.cache_clear()


def sorted_slots(monkeypatch) -> list[int]:
    monkeypatch.setattr(kernels, "_modules", {})
    given = arguments()
    kernels.kernel("sums", "sort_by_sample")(*given.values())
    return given["slots"][:3].tolist()


def test_a_module_is_compiled_once(made, monkeypatch):
    assert [sorted_slots(monkeypatch) for _ in range(2)] == [[3, 5, 9]] * 2 and len(made) == 1


def test_a_damaged_entry_is_compiled_anew(made, monkeypatch):
    sorted_slots(monkeypatch)
    folder = cache.cache_folder()
    assert folder is not None
    (entry,) = folder.glob("*.o")
    entry.write_bytes(entry.read_bytes()[:-1])
    assert sorted_slots(monkeypatch) == [3, 5, 9] and len(made) == 2


def test_without_a_folder_kernels_work(made, monkeypatch):
    monkeypatch.setenv("TORCHPT_CACHE", "")
    cache._folder.cache_clear()
    assert [sorted_slots(monkeypatch) for _ in range(2)] == [[3, 5, 9]] * 2 and len(made) == 2


# -- several threads


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_each_item_is_worked_on_once(threads):
    found: list[tuple[int, int, int]] = []

    class Recorder:
        def words(self, *args: int) -> tuple[int, ...]:
            return args

        def call(self, first: int, last: int, memory: int, other: int) -> None:
            assert memory % 8 == 0 and other == 7
            found.append((first, last, memory))

    kernels.run_parallel(Recorder(), 1003, threads, 10, 64, (7,))  # pyright: ignore[reportArgumentType]
    items = sorted(k for first, last, _ in found for k in range(first, last))
    assert items == list(range(1003)) and (len(found) > 1) == (threads > 1)
