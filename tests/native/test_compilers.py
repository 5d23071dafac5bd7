"""Processes that compile for this one: the same code, and no code where they die or cannot run."""

from __future__ import annotations

import multiprocessing
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

import torchpt
from torchpt.compiler import cache as programs
from torchpt.compiler import cpu
from torchpt.native import cache, compilers, machine
from torchpt.native.codegen import Job, compile_job

IR = """
define void @kernel(i8* %words, i64 %count) {
  ret void
}
"""

#: Code of the tests: kernels that outlast them are called by their addresses.
ALIVE: list[dict[str, cpu.Function]] = []


def job(ir: str = IR) -> Job:
    return Job(ir, *machine.host(), None, False)


@pytest.fixture(autouse=True)
def ended():
    yield
    compilers._end()


def test_the_code_is_that_of_this_process():
    futures = [compilers.submit(job(IR.replace("kernel", f"kernel{k}")), 2) for k in range(4)]
    for k, future in enumerate(futures):
        assert future is not None
        assert future.result(60) == compile_job(job(IR.replace("kernel", f"kernel{k}")))


def test_one_thread_needs_no_process():
    assert compilers.submit(job(), 1) is None


def test_a_program_with_an_interpreter_inside_is_not_started(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/usr/bin/blender")
    assert compilers.submit(job(), 2) is None


@pytest.mark.parametrize("executable", ["python-that-is-not-there", None])
def test_no_code_where_the_process_ends(monkeypatch, executable):
    """It cannot be started, or LLVM does not take the module, which ends it."""
    if executable is not None:
        monkeypatch.setattr(sys, "executable", executable)
    future = compilers.submit(job("no module"), 2)
    assert future is not None and future.result(60) is None
    monkeypatch.undo()
    again = compilers.submit(job(), 2)
    assert again is not None and again.result(60) == compile_job(job())


def test_a_compiler_that_is_closed_as_it_starts_does_not_end_its_thread(monkeypatch):
    """As the program exits, and between tests: the next job is done all the same."""
    closed = []

    def setting(self, name, value):
        object.__setattr__(self, name, value)
        if name == "process" and value is not None and not closed:
            closed.append(value)
            self.close()

    monkeypatch.setattr(compilers._Compiler, "__setattr__", setting)
    futures = [compilers.submit(job(IR.replace("kernel", f"kernel{k}")), 2) for k in range(2)]
    codes = [future.result(60) for future in futures if future is not None]
    assert closed and codes.count(None) == 1


def test_a_job_that_fails_in_any_way_is_left_to_the_caller(monkeypatch):
    def failing(self, job):
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(compilers._Compiler, "_compile", failing)
        futures = [compilers.submit(job(IR.replace("kernel", f"kernel{k}")), 2) for k in range(3)]
        assert [future.result(60) for future in futures if future is not None] == [None] * 3
    again = compilers.submit(job(), 2)
    assert again is not None and again.result(60) == compile_job(job())


def test_processes_end_when_nothing_is_left(monkeypatch):
    monkeypatch.setattr(compilers, "IDLE", 0.05)
    future = compilers.submit(job(), 2)
    assert future is not None and future.result(60) is not None
    end = time.monotonic() + 60
    while compilers._compilers and time.monotonic() < end:
        time.sleep(0.02)
    assert not compilers._compilers


def test_a_render_has_the_same_bits(monkeypatch, tmp_path):
    """With nothing in caches, by two processes and by this one; all code of the first is of other processes."""
    monkeypatch.setattr(cache, "_folder", lambda: tmp_path)
    wish = {
        "film": {"width": 16, "height": 12},
        "spp": 2,
        "integrator": {"type": "path", "max_depth": 8},
        "compile": "on",
    }
    pictures, here = [], []
    monkeypatch.setattr(cpu, "compile_job", lambda job: here.append(job.ir) or compile_job(job))
    for threads in (2, 1):
        programs.clear_programs()
        ALIVE.append({})
        monkeypatch.setattr(cpu, "_functions", ALIVE[-1])
        for path in tmp_path.iterdir():
            path.unlink()
        here.clear()
        pictures.append(torchpt.render(torchpt.load("cornell_box", "cpu"), threads=threads, **wish))
        cpu.wait_for_final_code()  # which else lands in the caches of the next turn
        assert (max(map(len, here)) > 100_000) == (threads == 1)  # small ones are compiled where they are needed
    assert torch.equal(*pictures)
    programs.clear_programs()


@pytest.fixture
def empty(monkeypatch, tmp_path):
    """Caches without code; returns the folder of that on disk."""
    monkeypatch.setattr(cache, "_folder", lambda: tmp_path)
    ALIVE.append({})
    monkeypatch.setattr(cpu, "_functions", ALIVE[-1])
    monkeypatch.setitem(cpu._state, "processes", 2)
    return tmp_path


def wait_for(there):
    end = time.monotonic() + 60
    while not there() and time.monotonic() < end:
        time.sleep(0.01)
    assert there()


def test_quick_code_is_replaced(empty, monkeypatch):
    replace, read = cpu._replace, threading.Event()
    monkeypatch.setattr(cpu, "_replace", lambda *args: read.wait(60) and replace(*args))
    assert cpu.begin(IR)
    function = cpu.compile_ir(IR)
    quick, call = function.code, function.call
    read.set()  # the final code may be there already
    call(0, 0)
    wait_for(lambda: function.call is not call)
    function.call(0, 0)
    call(0, 0)  # its code is still there
    cpu.wait_for_final_code()
    assert function.code == compile_job(job()) and quick == compile_job(job()._replace(quick=True))
    # Whoever is first in the process also writes what is known of the machine.
    assert sorted({path.suffix for path in empty.iterdir()} - {".json"}) == [".o", ".quick"]


def test_quick_code_of_an_earlier_process_is_replaced(empty, monkeypatch):
    """That process has ended before the final code was there."""
    assert cpu.begin(IR)
    function = cpu.compile_ir(IR)
    wait_for(lambda: len(list(empty.iterdir())) == 2)
    (empty / f"{function.key}.o").unlink()
    ALIVE.append({})
    monkeypatch.setattr(cpu, "_functions", ALIVE[-1])
    monkeypatch.setitem(cpu._state, "processes", 1)
    assert cpu.load_function(function.key) is None  # no other process may compile: it is compiled here, at once
    monkeypatch.setitem(cpu._state, "processes", 2)
    again = cpu.load_function(function.key)
    assert again is not None and again is not function
    wait_for(lambda: (empty / f"{function.key}.o").exists())


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Python's, of a fork beside threads
def test_a_forked_child_does_not_wait_for_compilers_of_its_parent(empty, monkeypatch):
    monkeypatch.setattr(compilers, "_Compiler", object)  # none that would do the job
    assert cpu.begin(IR)
    context = multiprocessing.get_context("fork")
    made = context.Queue()
    child = context.Process(target=lambda: made.put(cpu.compile_ir(IR).code))
    child.start()
    assert made.get(timeout=60) == compile_job(job())
    child.join()
    cpu._pending.clear()
    compilers._compilers.clear()
    compilers._end()


def test_the_program_imports_nothing_of_the_package():
    """Torch would take a second."""
    import torchpt.native.codegen as codegen

    assert "torchpt" not in Path(codegen.__file__).read_text().split('"""', 2)[2].replace(
        "torchpt.native.compilers", ""
    )
