"""The pool of threads: order, bounds, errors, ends, forks."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from queue import SimpleQueue
from typing import Any

import pytest
import torch

from torchpt.core import threads
from torchpt.core.errors import RenderError
from torchpt.core.threads import TaskQueue, limited_threads, map_in_order, parallel_for, thread_count


def dealt(task: Callable[[int], Any], count: int, **wish: Any) -> list[Any]:
    found = []

    def each(result: Any) -> bool:
        if result is not None:
            found.append(result)
        return False

    map_in_order(range(count), task, wish.pop("threads", 3), each, **wish)
    return found


def test_results_come_in_the_order_of_tasks():
    def task(k: int) -> tuple[int]:
        time.sleep(0.01 * ((7 * k) % 5))
        return (k,)

    assert dealt(task, 20) == [(k,) for k in range(20)]
    assert dealt(task, 0) == []


def test_no_task_is_begun_too_far_ahead():
    begun, told, far = [], [], []

    def task(k: int) -> int:
        begun.append(k)
        far.append(len(begun) - len(told))
        time.sleep(0.02 if k % 6 == 0 else 0.0)
        return k

    def each(k: int | None) -> bool:
        if k is not None:
            told.append(k)
        return False

    map_in_order(range(40), task, 2, each, ahead=4)
    assert told == list(range(40)) and max(far) <= 5  # one more between the end of a task and its result


def test_signals_are_looked_after_while_tasks_run():
    calls = []
    map_in_order([0], lambda _: time.sleep(0.3), 1, lambda result: calls.append(result) or False)
    assert len(calls) >= 3


def test_whoever_is_told_ends_it():
    begun, told = [], []

    def task(k: int) -> int:
        begun.append(k)
        return k

    def each(k: int | None) -> bool:
        if k is not None:
            told.append(k)
        return k == 5

    halt = threading.Event()
    map_in_order(range(1000), task, 2, each, halt, ahead=4)
    assert halt.is_set() and told == sorted(begun) and len(begun) < 12


def test_the_first_error_in_order_is_raised_and_ends_the_others():
    halt = threading.Event()

    def task(k: int) -> int:
        if k == 7:
            raise ValueError("of the later one")
        if k == 3:
            time.sleep(0.1)
            raise KeyError("of the first one")
        return k

    with pytest.raises(KeyError):
        map_in_order(range(1000), task, 3, lambda _: False, halt, ahead=20)
    assert halt.is_set()


def test_an_error_of_whoever_is_told_ends_the_tasks():
    halt, ended, all_begun = threading.Event(), [], threading.Barrier(3, timeout=60)

    def task(k: int) -> int:
        all_begun.wait()
        while k and not halt.is_set():
            time.sleep(0.001)
        ended.append(k)
        return k

    def each(k: int | None) -> bool:
        if k == 0:
            raise KeyboardInterrupt
        return False

    with pytest.raises(KeyboardInterrupt):
        map_in_order(range(3), task, 3, each, halt)
    assert sorted(ended) == [0, 1, 2]  # nobody works on behind the error's back


def test_threads_are_used_again():
    seen = set()

    def task(k: int) -> int:
        seen.add(threading.get_ident())
        time.sleep(0.001)
        return k

    for _ in range(10):
        dealt(task, 6, threads=2)
    there = sum(thread.name.startswith("torchpt_") for thread in threading.enumerate())
    for _ in range(10):
        dealt(task, 6, threads=2)
    assert there == sum(thread.name.startswith("torchpt_") for thread in threading.enumerate())
    assert threading.get_ident() not in seen


def test_idle_threads_hold_nothing():
    import weakref

    class Held:
        pass

    held = Held()
    watch = weakref.ref(held)
    dealt(lambda _, held=held: 1, 4)
    del held
    assert watch() is None


def test_tasks_that_use_threads_do_not_wait_for_each_other():
    sums = [0] * 8

    def task(k: int) -> int:
        def work(first: int, last: int) -> None:
            sums[k] += last - first

        for _ in range(20):
            parallel_for(work, 100, 3)
        return k

    assert dealt(task, 8, threads=4) == list(range(8)) and sums == [2000] * 8


def test_a_share_covers_its_range_once():
    for count in (1, 2, 5):
        found = SimpleQueue[tuple[int, int]]()
        parallel_for(lambda a, b, found=found: found.put((a, b)), 17, count)
        parts = sorted(found.get() for _ in range(found.qsize()))
        assert len(parts) == count and parts[0][0] == 0 and parts[-1][1] == 17
        assert all(a[1] == b[0] for a, b in pairwise(parts))
    with pytest.raises(IndexError, match="of the work"):

        def work(first: int, last: int) -> None:
            if first:
                raise IndexError("of the work")

        parallel_for(work, 10, 3)


@pytest.fixture
def no_more_threads(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Returns what lets so many threads start, and none after them."""
    threads._before_fork()  # ends those that wait
    start, left = threading.Thread.start, [0]

    def starting(self: threading.Thread) -> None:
        if left[0] == 0:
            raise RuntimeError("can't start new thread")
        left[0] -= 1
        start(self)

    def only(count: int) -> None:
        left[0] = count
        monkeypatch.setattr(threading.Thread, "start", starting)

    return only


@pytest.mark.parametrize("left", [1, 2])
def test_fewer_threads_where_there_is_no_memory_for_all(no_more_threads, left):
    no_more_threads(left)
    assert dealt(lambda k: k, 10, threads=4) == list(range(10))
    total = []
    parallel_for(lambda a, b: total.append(b - a), 12, 4)
    assert sum(total) == 12


def test_without_memory_for_a_thread_it_is_one_line(no_more_threads):
    no_more_threads(0)
    with pytest.raises(RenderError, match="^not enough memory for a thread that renders$"):
        dealt(lambda k: k, 10)
    total = []
    parallel_for(lambda a, b: total.append(b - a), 12, 4)  # the calling thread does it all
    assert sum(total) == 12


def test_a_crew_takes_more_while_it_works():
    queue = TaskQueue[str, int](2)
    try:
        queue.add("a", lambda: 1)
        found = [queue.next(wait=True)]
        for k in range(5):
            queue.add("b", lambda k=k: k)
        while queue.pending:
            found.append(queue.next(wait=True))
    finally:
        queue.close()
    came = [one for one in found if one is not None]
    assert came[0] == ("a", 1) and sorted(came[1:]) == [("b", k) for k in range(5)]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Python's, of a fork beside threads: those of other tests
def test_a_child_has_a_pool_of_its_own():
    assert dealt(lambda k: k, 5) == list(range(5))
    child = os.fork()
    if child == 0:
        code = 1
        try:
            code = 0 if not threads._idle and dealt(lambda k: k, 5) == list(range(5)) else 2
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    assert dealt(lambda k: k, 5) == list(range(5))


def test_torch_uses_no_other_thread_in_those_of_the_pool() -> None:
    """And threads of the user's own begin with the number of the process, whatever the pool did."""
    before, found = torch.get_num_threads(), []
    try:
        torch.set_num_threads(3)
        map_in_order(range(4), lambda _: torch.get_num_threads(), 2, lambda number: found.append(number) is not None)
        assert set(found) - {None} == {1} and torch.get_num_threads() == 3
        own: list[int] = []
        thread = threading.Thread(target=lambda: own.append(torch.get_num_threads()))
        thread.start()
        thread.join()
        assert own == [3]
    finally:
        torch.set_num_threads(before)


def test_an_error_of_a_task_that_was_on_its_way_is_not_lost() -> None:
    """Whoever asks for an end while a task fails is told of the failure, after what the others came to."""
    begun, go, seen = threading.Event(), threading.Event(), list[int]()

    def task(number: int) -> int:
        if number == 1:
            begun.set()
            go.wait(10)
            raise ValueError("half of a sum")
        begun.wait(10)
        return number

    def each(number: int | None) -> bool:
        if number is not None:
            seen.append(number)
            go.set()
        return number == 0

    with pytest.raises(ValueError, match="half of a sum"):
        map_in_order([0, 1], task, 2, each)
    assert seen == [0]


def test_few_tasks_run_in_the_calling_thread():
    """In order, with torch in one thread as in the pool; True or an error ends them."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        found = dealt(lambda k: (k, threading.get_ident(), torch.get_num_threads()), 3, here=True)
        assert found == [(k, threading.get_ident(), 1) for k in range(3)] and torch.get_num_threads() == 3
        ended: list[int | None] = []
        map_in_order(range(9), lambda k: k, 3, lambda k: ended.append(k) or k == 2, here=True)
        assert ended == [0, 1, 2]
        with pytest.raises(ZeroDivisionError):
            dealt(lambda k: 1 // k, 2, here=True)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_small_renders_keep_torch_in_one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        for small, of_torch in ((True, 1), (False, 3)):
            with limited_threads("auto", small):
                assert (torch.get_num_threads(), thread_count(None)) == (of_torch, 3)
            with limited_threads(2, small):
                assert (torch.get_num_threads(), thread_count(None), thread_count(5)) == (min(of_torch, 2), 2, 5)
        assert torch.get_num_threads() == thread_count(None) == 3
    finally:
        torch.set_num_threads(before)
