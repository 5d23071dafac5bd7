"""Compare error at equal time with Mitsuba 3: ``python scripts/bench_mitsuba.py --error [scenes] [--json FILE] [--plot FILE]``.

Compared is the relMSE of pictures that take 1, 4 or 16 seconds of wall time, by torchpt with its defaults and by
Mitsuba's ``llvm_ad_rgb`` with ``independent`` and ``multijitter``. The ratio is ours to the better of Mitsuba's two at that
time. Scenes, size, depths and filter are those of ``bench_mitsuba.py``; no contender clamps, guides or denoises.

Method: every contender is a process that has loaded and warmed up. Its speed gives the numbers of samples a pixel to measure:
one takes a quarter of the first time, and one for each time takes a little longer than it. All contenders render them in turn,
round after round, with a new seed each. The seconds of a number of samples are the median over rounds, its error is the mean;
the error at exactly the time is interpolated linearly in logarithms between the two numbers that bracket it. ``multijitter``
rounds samples up: the samples that it really takes are timed and scored. The first turn of a number of samples is not timed, as
Mitsuba may compile for it.

Reference: each renderer has its own, the mean of its pictures of the longest time (Mitsuba's by ``multijitter``), and the
variance of that mean is subtracted. Each of these pictures is compared with the mean of the others. So only noise is compared,
divided by the same on both sides: the square of the mean of both references, plus 0.01. A common reference
would add the difference between the renderers to the error of one of them: light that passes an opacity or ``null`` is a
bounce in Mitsuba only, which makes its ``material_row`` 0.3 % darker, and its Cornell box is 0.05 to 0.09 % darker for an
unknown reason. The difference of the two references, both variances subtracted, is printed below the errors.

A scene takes 3 contenders x rounds x 23 s, ten scenes some 90 minutes at 7 rounds and 65 at 5. ``--json FILE`` saves each
scene when it is done; the next run with the same file resumes there, or only prints and plots. ``--again`` measures scenes
anew, as after a change of the program. ``--quick`` only shows that it works.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import bench_files
import numpy as np
from bench_figures import (
    GROUPS,
    SCENES,
    Point,
    Reference,
    at_time,
    better,
    between,
    geometric_means,
    samples_in,
    scale_of,
)
from bench_workers import DEPTH, LLVM, OURS, Contender, Turn, Workers, ask, replaced, started

THEIRS = ("independent", "multijitter")
RIVALS = tuple(f"{LLVM} {sampler}" for sampler in THEIRS)
#: The contender whose pictures make Mitsuba's reference: the one that converges faster.
REFEREE = RIVALS[1]
BUDGETS = (1.0, 4.0, 16.0)
#: Factor on each time, so that the measured point lies beyond the time and brackets it.
AIM = 1.08
#: Longest time, in seconds, that is rendered to measure the speed; longer times are extrapolated.
CALIBRATION = 5.0
#: First seeds of the calibration and of the rounds, far enough apart not to overlap.
CALIBRATED, ROUNDS = 1, 1_000_000
#: Fewest rounds: each picture is compared with the mean of at least two others.
FEWEST = 3


def add_arguments(group: Any) -> None:
    """Add the options that only this benchmark has."""
    group.add_argument("--budgets", type=float, nargs="+", default=BUDGETS, metavar="SECONDS", help="1 4 16 by default")
    group.add_argument("--again", action="store_true", help="measure anew what the file of --json holds")
    group.add_argument("--plot", type=Path, metavar="FILE", help="draw error against time (.svg, .png)")


def contest(arguments: argparse.Namespace) -> None:
    """Measure all scenes, or the named ones; print, save and plot the figures."""
    if arguments.quick:
        arguments.rounds, arguments.size = FEWEST, 48
        arguments.budgets = [budget / 16.0 for budget in arguments.budgets]
    budgets = sorted(arguments.budgets)
    if budgets[0] <= 0.0 or len(set(budgets)) < len(budgets) or arguments.rounds < FEWEST:
        raise SystemExit(f"--budgets: different times above 0; --rounds: {FEWEST} or more")
    wanted = arguments.scenes or SCENES
    if unknown := [name for name in wanted if name not in SCENES]:
        raise SystemExit(f"{unknown[0]}: not one of {', '.join(SCENES)}")
    names = ("rounds", "size", "threads", "sampler", "compile")
    settings = {name: getattr(arguments, name) for name in names}
    settings |= {"budgets": budgets, "max_depth": DEPTH, "rr_depth": 5}
    found = bench_files.resumed(arguments.json, settings, arguments.again)
    if arguments.again:
        found = {name: row for name, row in found.items() if name not in wanted}
    print(heading(budgets))
    failed = []
    for name in wanted:
        if name not in found:
            try:
                found[name] = measured(name, budgets, arguments)
            except ValueError as problem:  # the next scene may do better
                failed.append(name)
                print(f"{name}: {problem}", flush=True)
                continue
            if arguments.json is not None:
                kept = {"settings": settings, "machine": bench_files.machine(), "scenes": found}
                bench_files.write(arguments.json, kept | overall(found, budgets))
        print("\n".join(lines(name, found[name])), flush=True)
    shown = {name: found[name] for name in SCENES if name in found}
    print("\n".join(conclusions(overall(shown, budgets))))
    if arguments.markdown:
        print(markdown(shown, budgets))
    if arguments.plot is not None:
        from bench_plot import plot

        plot(shown, budgets, arguments.plot)
    if failed:
        raise SystemExit(f"not measured: {', '.join(failed)}")


def measured(name: str, budgets: list[float], arguments: argparse.Namespace) -> dict[str, Any]:
    """Measure all figures of a scene."""
    contenders = [Contender(OURS, arguments.threads, arguments.sampler)]
    contenders += [Contender(LLVM, arguments.threads, sampler) for sampler in THEIRS]
    with tempfile.TemporaryDirectory() as folder, started(name, contenders, arguments) as started_workers:
        picture = Path(folder) / "picture.npy"
        workers = dict(zip((OURS, *RIVALS), started_workers.values(), strict=True))
        counts = {who: calibrated(worker, budgets, arguments.spp) for who, worker in workers.items()}
        turns, pictures = rounds(workers, counts, arguments.rounds, picture)
    ours, theirs = (Reference.of(pictures[who][counts[who][-1]]) for who in (OURS, REFEREE))
    scale = scale_of(ours, theirs)
    for who, row in turns.items():
        for spp, taken in row.items():
            part = spp == counts[who][-1] and who in (OURS, REFEREE)
            facts = judged(ours if who == OURS else theirs, scale, pictures[who][spp], part)
            turns[who][spp] = [turn | more for turn, more in zip(taken, facts, strict=True)]
    points = {who: [point_of(turns[who][spp]) for spp in counts[who]] for who in workers}
    return {
        "curves": {who: [asdict(point) for point in line] for who, line in points.items()},
        "at": {f"{budget:g}": compared(points, budget) for budget in budgets},
        "apart": between(ours, theirs),
        "means": [float(ours.mean.mean()), float(theirs.mean.mean())],
        "turns": {who: {str(spp): rows for spp, rows in row.items()} for who, row in turns.items()},
        "load": os.getloadavg(),
        "replaced": replaced(name),
    }


def calibrated(worker: Any, budgets: list[float], spp: int) -> list[int]:
    """Find samples a pixel that take a quarter of the first time, and a little more than each time."""
    turn = ask(worker, spp, CALIBRATED)
    turn = warmed(worker, samples_in(budgets[0], turn.spp, turn.seconds))  # a few samples are too short to time
    found: list[int] = []
    for budget in budgets:
        if budget <= CALIBRATION:
            turn = warmed(worker, samples_in(AIM * budget, turn.spp, turn.seconds))
        if not found:
            found.append(samples_in(0.25 * budget, turn.spp, turn.seconds))
        found.append(max(samples_in(AIM * budget, turn.spp, turn.seconds), found[-1] + 1))
    return found


def warmed(worker: Any, spp: int) -> Turn:
    """Return a turn that is not a worker's first with this number of samples."""
    turn = ask(worker, spp, CALIBRATED)
    return ask(worker, spp, CALIBRATED) if turn.cold else turn


def shot(worker: Any, spp: int, seed: int, file: Path) -> tuple[Turn, np.ndarray]:
    """Return a turn and its picture ``(H, W, 3)``."""
    turn = ask(worker, spp, seed, file)
    return turn, np.load(file, allow_pickle=False)


#: Turns by contender and requested samples: seconds, samples taken, whether the turn was cold, result of :func:`judged`.
Turns = dict[str, dict[int, list[dict[str, Any]]]]
#: Pictures ``(H, W, 3)`` by contender and requested samples.
Pictures = dict[str, dict[int, list[np.ndarray]]]


def judged(reference: Reference, scale: np.ndarray, pictures: list[np.ndarray], part: bool) -> list[dict[str, Any]]:
    """Return the relMSE of pictures, against the reference and against it without each of its pictures in turn.

    Args:
        reference: the renderer's reference.
        scale: divisor of squared errors.
        pictures: the pictures to score.
        part: True if the reference is the mean of these pictures. Each is then compared with the mean of the others; an outlier
            hardly moves these errors, so their spread alone gives the standard error of their mean.
    """
    if part:
        pairs = zip(reference.without, pictures, strict=True)
        return [{"relmse": others.relmse(seen, scale), "without": []} for others, seen in pairs]
    return [
        {
            "relmse": reference.relmse(seen, scale),
            "without": [lacking.relmse(seen, scale) for lacking in reference.without],
        }
        for seen in pictures
    ]


def rounds(workers: Workers, counts: dict[str, list[int]], number: int, picture: Path) -> tuple[Turns, Pictures]:
    """Run rounds in which each contender takes its turn at each time, each round with another seed."""
    turns: Turns = {who: {spp: [] for spp in row} for who, row in counts.items()}
    pictures: Pictures = {who: {spp: [] for spp in row} for who, row in counts.items()}
    steps = len(next(iter(counts.values())))
    for seed in range(number):
        for step in range(steps):
            for who, worker in workers.items():
                spp = counts[who][step]
                turn, seen = shot(worker, spp, ROUNDS + seed * steps + step, picture)
                turns[who][spp].append({"seconds": turn.seconds, "spp": turn.spp, "cold": turn.cold})
                pictures[who][spp].append(seen)
    return turns, pictures


def point_of(turns: list[dict[str, Any]]) -> Point:
    """Combine the turns with a number of samples to a point; cold turns are timed only if there are no others."""
    warm = [turn["seconds"] for turn in turns if not turn["cold"]]
    seconds = warm or [turn["seconds"] for turn in turns]
    errors, without = ([turn[key] for turn in turns] for key in ("relmse", "without"))
    return Point.of(turns[0]["spp"], seconds, errors, without)


def compared(points: dict[str, list[Point]], budget: float) -> dict[str, Any]:
    """Compare errors at a time: that of each contender, and the ratio of ours to the better of Mitsuba's."""
    estimates = {who: at_time(line, budget) for who, line in points.items()}
    best = better({who: estimates[who].relmse for who in RIVALS})
    ratio = estimates[OURS].relmse / estimates[best].relmse
    return {**{who: asdict(estimate) for who, estimate in estimates.items()}, "better": best, "ratio": ratio}


def overall(found: dict[str, Any], budgets: list[float]) -> dict[str, Any]:
    """Return geometric means of the complete groups, by time and over all times, and the worst ratio."""
    ratios = {f"{b:g}": {name: row["at"][f"{b:g}"]["ratio"] for name, row in found.items()} for b in budgets}
    means = {budget: geometric_means(row) for budget, row in ratios.items()}
    every = {
        name: float(np.exp(np.mean([np.log(row[name]) for row in ratios.values()]))) for name in found
    }  # of the times
    worst = max(((ratio, name, b) for b, row in ratios.items() for name, ratio in row.items()), default=None)
    return {"geometric_means": means | {"all times": geometric_means(every)}, "by_scene": every, "worst": worst}


def heading(budgets: list[float]) -> str:
    """Return the heading of the table of :func:`lines`."""
    times = ", ".join(f"{budget:g}" for budget in budgets)
    columns = f"{OURS:>20s}" + "".join(f"{sampler:>20s}" for sampler in THEIRS)
    return f"relMSE x 1e3 of pictures of {times} s, ± standard error\n{'':22s}{'s':>6s}{columns}   ratio"


def lines(name: str, row: dict[str, Any]) -> list[str]:
    """Return the table rows of a scene: one for each time, and how far the references are apart."""
    made = []
    for budget, at in row["at"].items():
        cells = ""
        for who in (OURS, *RIVALS):
            error, spread = 1e3 * at[who]["relmse"], at[who]["deviation"]
            outside = " " if at[who]["within"] else "*"
            cells += f"{error:11.4f}{outside}" + (f"±{1e3 * spread:7.4f}" if spread is not None else " " * 8)
        made.append(f"{name if not made else '':22s}{budget:>6s}{cells}{at['ratio']:8.3f}")
    if not all(at[who]["within"] for at in row["at"].values() for who in (OURS, *RIVALS)):
        made.append("    *: beyond the times measured, as one over the time")
    ours, theirs = row["means"]
    made.append(f"    references: {ours:.5f} and {theirs:.5f} in the mean, {1e3 * row['apart']:.4f} apart")
    return made


def conclusions(facts: dict[str, Any]) -> list[str]:
    """Return lines with the geometric means and the worst ratio."""
    made = []
    for group in GROUPS:
        cells = [f"{time} {row[group]:.3f}" for time, row in facts["geometric_means"].items() if group in row]
        if cells:
            made.append(f"geometric mean of ratios, {group}, by seconds: {', '.join(cells)}")
    if facts["worst"] is not None:
        ratio, name, budget = facts["worst"]
        made.append(f"worst: {ratio:.3f} in {name} at {budget} s")
    return made


def markdown(found: dict[str, Any], budgets: list[float]) -> str:
    """Return the table for the documentation: errors x 1000 of ours and of the better of Mitsuba's, and their ratio."""
    times = [f"{budget:g}" for budget in budgets]
    made = ["| scene |" + "".join(f" {t} s: torchpt | Mitsuba | ratio |" for t in times) + " references apart |"]
    made.append("|---|" + "---|---|---|" * len(times) + "---|")
    for name, row in found.items():
        cells = ""
        for at in (row["at"][time] for time in times):
            errors = (with_spread(at[who]) for who in (OURS, at["better"]))
            cells += " {} | {} {} | {:.2f} |".format(*errors, at["better"][len(LLVM) + 1], at["ratio"])
        made.append(f"| `{name}` |{cells} {1e3 * row['apart']:.3g} |")
    means = overall(found, budgets)["geometric_means"]
    for group, mean in means["all times"].items():
        cells = "".join(f" | | {means[time][group]:.2f} |" for time in times)
        made.append(f"| geometric mean of {len(GROUPS[group])} ({group}) |{cells} |")
        made.append(f"| all times |{' |' * (3 * len(times) - 1)} {mean:.2f} | |")
    return "\n".join(made)


def with_spread(estimate: dict[str, Any]) -> str:
    """Format an error x 1000, with its standard error if it is known."""
    error = f"{1e3 * estimate['relmse']:.3g}"
    return error if estimate["deviation"] is None else f"{error} ± {1e3 * estimate['deviation']:.2g}"
