"""Seconds of compiling, by a clock of our own."""

from __future__ import annotations

import threading
import time

import pytest

from torchpt.native import cache, compile_time, kernels


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(compile_time, "time", made)
    return made


def test_nested_compilations_count_once(clock):
    before = compile_time.seconds()
    compile_time.begin()
    clock.now += 2.0
    assert compile_time.seconds() - before == 2.0  # one that is under way counts too
    compile_time.begin()
    clock.now += 1.0
    compile_time.end()
    clock.now += 0.5
    compile_time.end()
    clock.now += 7.0
    assert compile_time.seconds() - before == 3.5


def test_a_module_that_compiles_at_its_first_call_is_counted(monkeypatch):
    """As those of searches, builds and light trees do."""
    monkeypatch.setattr(kernels, "_modules", {})
    monkeypatch.setattr(cache, "read", lambda entry: None)
    monkeypatch.setattr(cache, "write", lambda entry, code: None)
    before, start = compile_time.seconds(), time.perf_counter()
    kernels.kernel("tree_refit", "refit")
    took, wall = compile_time.seconds() - before, time.perf_counter() - start
    assert 0.9 * wall < took <= wall
    again = compile_time.seconds()
    kernels.kernel("tree_refit", "refit")
    assert compile_time.seconds() == again


def test_threads_that_wait_for_each_other_count_once(clock):
    before = compile_time.seconds()
    compile_time.begin()
    other = threading.Thread(target=compile_time.begin)
    other.start()
    other.join()
    clock.now += 4.0
    compile_time.end()
    compile_time.end()
    assert compile_time.seconds() - before == 4.0
