"""The arithmetic of the contest at equal time, its plan, and its file: no renderer is needed."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import bench_error
import bench_figures
import bench_files
import bench_plot
import numpy as np
import pytest
from bench_figures import Point, Reference, at_time, better, between, samples_in, scale_of
from bench_workers import Contender, Turn
from few import few

from torchpt.images.metrics import FLOOR

MULTIJITTER = bench_error.REFEREE


def power_law(seconds: float, factor: float = 0.02, slope: float = -1.2) -> Point:
    error = factor * seconds**slope
    return Point(round(100 * seconds), seconds, error, 0.1 * error)


def noisy(number: int, mean: np.ndarray, deviation: float, seed: int) -> np.ndarray:
    return mean + deviation * np.random.default_rng(seed).standard_normal((number, *mean.shape))


def test_the_error_at_a_time_lies_on_the_line_in_logarithms() -> None:
    points = [power_law(seconds) for seconds in (0.26, 1.07, 4.1, 17.0)]
    for seconds in (1.0, 4.0, 16.0):
        found = at_time(points[::-1], seconds)  # whatever their order
        assert found.relmse == pytest.approx(0.02 * seconds**-1.2)
        assert found.spp == pytest.approx(100 * seconds, rel=0.01) and found.within
    on = at_time(points, 4.1)
    assert (on.relmse, on.deviation) == (pytest.approx(points[2].relmse), pytest.approx(points[2].deviation))


def test_only_the_two_points_that_bracket_the_time_count() -> None:
    points = [Point(1, 0.5, 9.0, None), power_law(1.0), power_law(2.0), Point(400, 4.0, 1e-6, None)]
    found = at_time(points, 1.5)
    assert found.relmse == pytest.approx(0.02 * 1.5**-1.2)
    half = at_time([Point(1, 1.0, 1.0, 0.1), Point(4, 4.0, 0.25, 0.1)], 2.0)
    assert half.relmse == pytest.approx(0.5)
    assert half.deviation == pytest.approx(0.5 * np.hypot(0.5 * 0.1, 0.5 * 0.4))


def test_beyond_the_points_the_error_goes_on_as_one_over_the_time_and_says_so() -> None:
    points = [power_law(seconds) for seconds in (1.0, 1.001, 4.0, 15.0)]  # a line through the first two would be steep
    for seconds, near in ((0.5, points[0]), (16.0, points[-1])):
        found = at_time(points, seconds)
        assert found.relmse == pytest.approx(near.relmse * near.seconds / seconds) and not found.within
        assert found.deviation == pytest.approx(0.1 * found.relmse)


def test_errors_without_logarithm_are_refused() -> None:
    with pytest.raises(ValueError, match="two points"):
        at_time([power_law(1.0)], 1.0)
    points = [power_law(1.0), power_law(2.0), Point(2, 4.0, -1e-6, None)]
    with pytest.raises(ValueError, match="more rounds"):
        at_time(points, 3.0)
    assert at_time(points, 1.5).within, "others do not matter"


def test_the_variance_of_the_reference_is_subtracted() -> None:
    """A reference no better than the pictures doubles the squares, not the error."""
    mean = np.linspace(0.5, 2.5, 48 * 48 * 3).reshape(48, 48, 3)
    own, other = (Reference.of(list(noisy(4, mean, 0.2, seed))) for seed in (1, 2))
    scale = mean**2 + FLOOR
    truth = float((0.1**2 / scale).mean())
    picture = noisy(1, mean, 0.1, 3)[0]
    assert own.relmse(picture, scale) == pytest.approx(truth, rel=0.1)
    assert float(((picture - own.mean) ** 2 / scale).mean()) > 1.8 * truth
    assert own.variance.mean() == pytest.approx(0.2**2 / 4, rel=0.05)
    assert abs(between(own, other)) < 0.1 * float((2 * 0.2**2 / 4 / scale).mean())
    darker = Reference(0.8 * other.mean, 0.64 * other.variance)
    assert between(own, darker) == pytest.approx(
        float(((0.2 * mean) ** 2 / ((0.9 * mean) ** 2 + 1e-2)).mean()), rel=0.1
    )
    with pytest.raises(ValueError, match="two pictures"):
        Reference.of([mean])


def test_the_deviation_knows_of_the_reference() -> None:
    """Over many references the error varies no more than it says, nor much less; most of it the reference makes."""
    mean = np.full((16, 16, 3), 1.0)
    scale = mean**2 + FLOOR
    found = []
    for seed in range(200):
        reference = Reference.of(list(noisy(6, mean, 0.3, 3 * seed)))
        pictures = noisy(5, mean, 0.02, 3 * seed + 1)
        turns = bench_error.judged(reference, scale, list(pictures), part=False)
        rows = [[turn[key] for turn in turns] for key in ("relmse", "without")]
        found.append(Point.of(4, [1.0], *rows))
    told = float(np.mean([point.deviation or 0.0 for point in found]))
    spread = float(np.std([point.relmse for point in found], ddof=1))
    assert 0.9 * spread < told < 2.0 * spread
    by_seeds = Point.of(4, [1.0], *[[0.1, 0.2], [[], []]])
    assert by_seeds.deviation == pytest.approx(0.05)


def test_pictures_of_the_reference_are_held_against_the_others() -> None:
    """Each tells the variance of one picture without bias, and their spread how sure the mean of them is."""
    mean = np.full((16, 16, 3), 1.0)
    scale, found = mean**2 + FLOOR, []
    for seed in range(300):
        pictures = noisy(5, mean, 0.1, seed)
        pictures[:, 0, 0] += (
            2.0 * (np.random.default_rng(seed + 1000).random(5) < 0.3)[:, None]
        )  # errs much now and then
        rows = bench_error.judged(Reference.of(list(pictures)), scale, list(pictures), part=True)
        found.append(Point.of(4, [1.0], *[[turn[key] for turn in rows] for key in ("relmse", "without")]))
    truth = (0.1**2 + 0.3 * 0.7 * 4 / 256) / 1.01
    means = np.array([point.relmse for point in found])
    assert means.mean() == pytest.approx(truth, abs=4 * means.std() / 300**0.5)
    told = float(np.sqrt(np.mean([(point.deviation or 0.0) ** 2 for point in found])))
    assert 0.85 * means.std() < told < 1.3 * means.std()


def test_references_without_one_picture_are_those_of_the_others() -> None:
    pictures = list(noisy(5, np.full((3, 2, 3), 1.0), 0.3, 5))
    for number, lacking in enumerate(Reference.of(pictures).without):
        direct = Reference.of(pictures[:number] + pictures[number + 1 :])
        assert np.allclose(lacking.mean, direct.mean) and np.allclose(lacking.variance, direct.variance)
    assert Reference.of(pictures[:2]).without == ()


def test_both_sides_are_divided_by_the_same() -> None:
    assert bench_figures.FLOOR == FLOOR
    a, b = (Reference(np.full((2, 2, 3), value), np.zeros((2, 2, 3))) for value in (1.0, 3.0))
    assert np.array_equal(scale_of(a, b), np.full((2, 2, 3), 4.01)) and np.array_equal(scale_of(a, b), scale_of(b, a))


def test_the_ratio_is_to_the_better_of_the_two_at_that_time() -> None:
    assert better({"a": 0.2, "b": 0.1}) == "b" and better({"a": 0.1, "b": 0.1}) == "a"
    times = (0.25, 1.1, 4.4, 17.5)
    points = {bench_error.OURS: [power_law(t, 0.01) for t in times]}
    points |= {
        who: [power_law(t, 0.02, slope) for t in times]
        for who, slope in zip(bench_error.RIVALS, (-1, -1.5), strict=True)
    }
    assert bench_error.compared(points, 0.5)["better"] == bench_error.RIVALS[0]
    late = bench_error.compared(points, 16.0)
    assert late["better"] == MULTIJITTER and late["ratio"] == pytest.approx(0.5 * 16**0.3)


def test_cold_turns_are_scored_but_not_timed() -> None:
    rows = [
        {"seconds": s, "relmse": e, "spp": 8, "cold": cold, "without": []}
        for s, e, cold in ((9.0, 3.0, True), (1.0, 1.0, False), (1.2, 2.0, False))
    ]
    point = bench_error.point_of(rows)
    assert (point.spp, point.seconds, point.relmse) == (8, pytest.approx(1.1), pytest.approx(2.0))
    assert point.deviation == pytest.approx(1 / 3**0.5)
    assert bench_error.point_of(rows[:1]) == Point(8, 9.0, 3.0, None)


class Steady:
    """Stands for a worker: a fixed start, a speed, and a compilation for each new number of samples."""

    def __init__(self, speed: float) -> None:
        self.speed, self.seen, self.spent = speed, {64}, 0.0

    def ask(self, spp: int, seed: int, out: Path | None = None) -> Turn:
        cold = spp not in self.seen
        self.seen.add(spp)
        seconds = 0.01 + 1.5 * cold + spp / self.speed
        self.spent += seconds
        return Turn(spp, seconds, 1.0, [0.0] * 3, cold)


@pytest.mark.parametrize("speed", [70.0, 4000.0])
def test_the_samples_bracket_the_times(speed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_error, "ask", lambda worker, *given: worker.ask(*given))
    worker = Steady(speed)
    counts = bench_error.calibrated(worker, [1.0, 4.0, 16.0], 64)
    seconds = [0.01 + spp / speed for spp in counts]
    assert seconds[0] < 0.3
    assert all(budget < took < 1.15 * budget for budget, took in zip((1, 4, 16), seconds[1:], strict=True))
    assert worker.spent < 25, "16 s are foretold, not tried"
    assert samples_in(1.0, 64, 1000.0) == 1


def row(ratio: float, multijitter: float = 0.02) -> dict[str, Any]:
    """Return what :func:`bench_error.measured` gives of a scene, but for the turns."""
    times = (0.25, 1.1, 4.4, 17.5)
    points = {bench_error.OURS: [power_law(t, ratio * 0.02) for t in times]}
    points |= {
        who: [power_law(t, f) for t in times] for who, f in zip(bench_error.RIVALS, (0.04, multijitter), strict=True)
    }
    at = {f"{budget:g}": bench_error.compared(points, budget) for budget in bench_error.BUDGETS}
    return {
        "curves": {who: [vars(point) for point in line] for who, line in points.items()},
        "at": at, "apart": 1e-6, "means": [0.5, 0.5],
    }  # fmt: skip


def given(file: Path | None = None, **more: Any) -> argparse.Namespace:
    wishes = {
        "scenes": [], "rounds": 7, "size": 256, "spp": 64, "threads": None, "sampler": None, "compile": "auto",
        "budgets": bench_error.BUDGETS, "again": False, "plot": None, "json": file, "markdown": False, "quick": False,
        "cuda": False,
    }  # fmt: skip
    return argparse.Namespace(**(wishes | more))


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The scenes that were measured; nothing is rendered."""
    names: list[str] = []

    def measured(name: str, budgets: list[float], arguments: argparse.Namespace) -> dict[str, Any]:
        names.append(name)
        return row(0.25 if name == "clutter" else 0.5)

    monkeypatch.setattr(bench_error, "measured", measured)
    monkeypatch.setattr(bench_files, "machine", lambda: {"cores": 2})
    return names


def test_a_run_goes_on_where_another_stopped(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "contest.json"
    bench_error.contest(given(file, scenes=["clutter", "studio"]))
    bench_error.contest(given(file, markdown=True))
    assert sorted(asked) == sorted(bench_figures.SCENES) and asked[:2] == ["clutter", "studio"]
    printed = capsys.readouterr().out
    mean = 0.5 * 0.5**0.1
    assert (
        f"geometric mean of ratios, all, by seconds: 1 {mean:.3f}, 4 {mean:.3f}, 16 {mean:.3f}, all times {mean:.3f}"
        in printed
    )
    assert "| geometric mean of 10 (all) |" in printed and "worst: 0.500" in printed
    facts = json.loads(file.read_text())
    assert facts["geometric_means"]["all times"]["all"] == pytest.approx(mean)
    assert facts["settings"]["rounds"] == 7 and len(facts["scenes"]) == 10
    asked.clear()
    bench_error.contest(given(file, scenes=["studio"], again=True))
    assert asked == ["studio"] and len(json.loads(file.read_text())["scenes"]) == 10


def test_figures_of_other_settings_are_not_mixed(asked: list[str], tmp_path: Path) -> None:
    file = tmp_path / "contest.json"
    bench_error.contest(given(file, scenes=["clutter"]))
    before = file.read_text()
    with pytest.raises(SystemExit, match=r"contest\.json: measured otherwise \(size 256, now 64\)"):
        bench_error.contest(given(file, size=64))
    assert file.read_text() == before
    bench_error.contest(given(file, size=64, scenes=["studio"], again=True))
    assert set(json.loads(file.read_text())["scenes"]) == {"studio"}
    file.write_text("[]")
    with pytest.raises(SystemExit, match="no figures of this benchmark"):
        bench_error.contest(given(file))


@pytest.mark.parametrize("wrong", [{"budgets": [0.0]}, {"budgets": [1.0, 1.0]}, {"rounds": 2}, {"scenes": ["moon"]}])
def test_what_cannot_be_measured_is_refused(wrong: dict[str, Any], asked: list[str]) -> None:
    with pytest.raises(SystemExit):
        bench_error.contest(given(**wrong))
    assert asked == []


def test_times_that_no_point_brackets_are_marked() -> None:
    sides = row(0.5)
    assert "*" not in "".join(bench_error.lines("clutter", sides))
    sides["at"]["16"][MULTIJITTER]["within"] = False
    assert "beyond the times measured" in "\n".join(bench_error.lines("clutter", sides))


@pytest.mark.parametrize("suffix", few([".svg", ".png"], 1))
def test_the_curves_are_drawn(suffix: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="extra `bench`")
    file = tmp_path / f"curves{suffix}"
    bench_plot.plot({name: row(0.5) for name in list(bench_figures.SCENES)[:2]}, [1.0, 4.0, 16.0], file)
    assert file.stat().st_size > 10_000 and list(tmp_path.iterdir()) == [file]
    with pytest.raises(SystemExit, match="no scenes"):
        bench_plot.plot({}, [1.0], file)
    with pytest.raises(SystemExit, match="curves"):
        bench_plot.plot({"clutter": row(0.5)}, [1.0], tmp_path / "curves.nothing")


def test_contenders_are_told_apart() -> None:
    assert [str(Contender("llvm_ad_rgb", None, sampler)) for sampler in bench_error.THEIRS] == list(bench_error.RIVALS)
    assert str(Contender("torchpt", 2)) == "torchpt, 2 threads"
