"""Seconds of compiling, by a clock of our own."""

from __future__ import annotations

import threading
import time
from typing import Any

import pytest

from torchpt.native import compile_time


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


def test_a_kernel_that_compiles_at_its_first_call_is_counted():
    """As those of builds and light trees do, and functions that such a kernel calls."""
    from torchpt.native.jit import jit

    def doubled(x: Any) -> Any:
        return x + x

    kernel, before = jit()(doubled), compile_time.seconds()
    start = time.perf_counter()
    assert kernel(3.0) == 6.0
    took, wall = compile_time.seconds() - before, time.perf_counter() - start
    assert 0.5 * wall < took <= wall
    again = compile_time.seconds()
    assert kernel(4.0) == 8.0 and compile_time.seconds() == again


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
