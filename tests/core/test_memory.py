"""What is done where memory is short: who fits, what goes first, and that it is tried again."""

from __future__ import annotations

import pytest
import torch

from torchpt.core import memory
from torchpt.core.errors import RenderError, SceneError
from torchpt.core.memory import Budget, Span, check_limit, fits_in_memory, retry_out_of_memory

CPU = torch.device("cpu")


def budget(lanes: int = 1000, threads: int = 1, fewest: int = 1, limit: int | None = None) -> Budget:
    return Budget(CPU, lanes, threads, what="a thing", limit=limit, bytes_per_lane=10, min_lanes=fewest)


@pytest.mark.parametrize(
    ("left", "threads", "lanes"),
    [
        (10**9, 4, 1000),  # all
        (16_000, 4, 400),  # all threads, fewer lanes
        (15_999, 4, 399),
        (3_999, 3, 133),  # fewer threads, as too few lanes repay none
        (1_500, 1, 150),
        (5, 1, 100),  # one thread with the least lanes always does
        (-7, 1, 100),
    ],
)
def test_as_many_threads_and_lanes_as_fit(left, threads, lanes):
    found = budget(threads=4)
    found.fit(left, 10, 100)
    assert (found.threads, found.lanes) == (threads, lanes)


def test_threads_go_first_and_then_lanes(capsys):
    found, seen = budget(64, 3, 16), []
    with pytest.raises(RenderError, match="^not enough memory for a thing$"):
        while True:
            found.shrink()
            seen.append((found.threads, found.lanes))
    assert seen == [(1, 64), (1, 32), (1, 16)] and found.has_shrunk


def test_pieces_take_each_sample_once_and_those_of_a_pixel_in_their_order():
    found, taken = budget(64), list[tuple[int, int]]()
    calls = [0]

    def work(span: Span) -> None:
        calls[0] += 1
        if calls[0] in (2, 3, 7, 8, 9):
            raise MemoryError
        pixel, n, sample, samples = span
        taken.extend((p, s) for s in range(sample, sample + samples) for p in range(pixel, pixel + n))

    spans = list(found.run_in_chunks(work, 13, 5, 70))
    assert sorted(taken) == [(p, s) for p in range(13) for s in range(5, 75)]
    for p in range(13):
        own = [s for pixel, s in taken if pixel == p]
        assert own == sorted(own)
    assert sum(n * samples for _, n, _, samples in spans) == 13 * 70 and found.has_shrunk and found.lanes < 8
    with pytest.raises(ZeroDivisionError):
        list(found.run_in_chunks(lambda _: 1 // 0, 1, 0, 1))


def test_a_chunk_of_one_lane_is_taken_whole_once_one_thread_goes_on_alone(capsys):
    found, tried = budget(4, threads=2), list[Span]()

    def work(span: Span) -> None:
        tried.append(span)
        if len(tried) == 1:
            raise MemoryError

    assert list(found.run_in_chunks(work, 1, 0, 1)) == [(0, 1, 0, 1)]
    assert tried == [(0, 1, 0, 1)] * 2 and (found.threads, found.lanes) == (1, 4)


def test_a_limit_without_an_expected_size_of_a_lane_is_refused():
    with pytest.raises(ValueError, match="a limit needs the expected bytes of a lane"):
        Budget(CPU, 8, what="a thing", limit=1000)


def test_lanes_grow_to_what_was_measured(monkeypatch):
    held = {"now": 1000, "peak": 1000}
    monkeypatch.setattr(memory.MemoryMeter, "base", lambda _: 0)
    monkeypatch.setattr(memory.MemoryMeter, "now", lambda _: held["now"])
    monkeypatch.setattr(memory.MemoryMeter, "peak", lambda _: held["peak"])
    monkeypatch.setattr(memory, "FIRST_WAVE_LANES", 16)
    found, lanes = budget(10_000, limit=101_000), []
    most = [0]

    def work(span: Span) -> None:
        taken = span[1] * span[3]
        lanes.append(taken)
        most[0] = max(most[0], 1000 + 20 * taken)
        held["peak"] = max(held["peak"], 1000 + 20 * taken)

    list(found.run_in_chunks(work, 100_000, 0, 1))
    assert lanes[0] == 16 and most[0] <= 101_000
    assert max(lanes) == int(memory.WAVE_FRACTION * 100_000 / 20)  # twice what was expected of a lane


def test_a_limit_that_holds_all_lanes_is_forgotten(monkeypatch):
    monkeypatch.setattr(memory.MemoryMeter, "base", lambda _: 0)
    monkeypatch.setattr(memory.MemoryMeter, "now", lambda _: 0)
    for limit, lanes in ((11_500, 8000), (20_000, 8000), (80_000, 8000), (100_000, 8000)):
        found = Budget(CPU, lanes, what="a thing", limit=limit, bytes_per_lane=10)
        found.drop_unneeded_limit()
        assert (found.limit is None and found.lanes == lanes) == (limit == 100_000)


def test_what_is_kept_goes_before_it_is_an_error(monkeypatch):
    kept = [1]
    monkeypatch.setattr(memory, "_cache_releasers", [])
    memory.on_low_memory(kept.clear)

    def work() -> str:
        if kept:
            raise MemoryError
        return "done"

    assert not fits_in_memory(work) and kept
    assert retry_out_of_memory("a thing", work) == "done"

    def never() -> None:
        raise RuntimeError("std::bad_alloc")

    with pytest.raises(RenderError, match=r"^not enough memory for a thing, with \d+MB held already$"):
        retry_out_of_memory("a thing", never)
    with pytest.raises(KeyError):
        retry_out_of_memory("a thing", lambda: {}["other errors go on their way"])


def test_a_limit_is_told_in_its_unit():
    check_limit(5_000_000, 5_000_000, "more")
    with pytest.raises(SceneError, match="render.max_memory: expected more, got '5MB'"):
        check_limit(5_000_000, 5_000_001, "more")
    with pytest.raises(SceneError, match="expected more, as bytes or with a unit such as 4GB, got '50 bytes'"):
        check_limit(50, 51, "more")
