"""Error at equal time beside Mitsuba 3: ``python scripts/bench_mitsuba.py --error [scenes] [--json FILE] [--plot FILE]``.

What is compared: the relMSE of a picture that takes 1, 4 or 16 seconds of wall time, of torchpt with its defaults and of
Mitsuba's ``llvm_ad_rgb`` with ``independent`` and ``multijitter``. The ratio is ours to the better of the two at that time.
Scenes, size, depths and filter are those of the throughput race; nobody clamps, guides or denoises.

How: every contender is a process that has loaded and warmed up. Its speed tells how many samples a pixel take a quarter of the
first time, and each time a little more than it; these are rendered in turn by all, round after round, with another seed each.
The seconds of a number of samples are the median over rounds, its error the mean over them; the error at exactly the time lies
on the straight line in logarithms between the two numbers that bracket it. ``multijitter`` rounds samples up: those that it
takes are what is timed and scored. The first turn of a number is left out of its seconds, as Mitsuba may compile for it.

The reference: each renderer has its own, the mean of its pictures of the longest time (Mitsuba's by ``multijitter``), and the
variance of that mean is subtracted. Each of these pictures is held against the mean of the others. So it is noise that is
compared, and divided by the same on both sides: the square of the mean of both references, plus 0.01. A common reference
would add what the renderers differ by to the error of one of them: light that passes an opacity or ``null`` is a bounce in
Mitsuba only, which makes its ``material_row`` 0.3 % darker, and its Cornell box is 0.05 to 0.09 % darker for a reason not
known. How far the two references are apart, both variances subtracted, stands below the errors, so that it is seen where it
matters.

A long run: a scene takes 3 contenders x rounds x 23 s, ten scenes some 90 minutes at 7 rounds and 65 at 5.
``--json FILE`` keeps each scene as it is done, and the next run with the same file goes on from there, or only prints and
draws; ``--again`` measures scenes anew, as after a change of the program. ``--quick`` only shows that it works.
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
#: Whose seeds make Mitsuba's reference: the one that converges faster.
REFEREE = RIVALS[1]
BUDGETS = (1.0, 4.0, 16.0)
#: Times as long as this are aimed at, so that the point lies beyond the time and brackets it.
AIM = 1.08
#: What the speed is measured by, at most: more is foretold, as it takes as long as a round.
CALIBRATION = 5.0
#: Seeds are apart: of the calibration and of rounds.
CALIBRATED, ROUNDS = 1, 1_000_000
#: Rounds it takes at least: each picture is held against two others.
FEWEST = 3


def add_arguments(group: Any) -> None:
    """Those that only this benchmark has."""
    group.add_argument("--budgets", type=float, nargs="+", default=BUDGETS, metavar="SECONDS", help="1 4 16 by default")
    group.add_argument("--again", action="store_true", help="measure anew what the file of --json holds")
    group.add_argument("--plot", type=Path, metavar="FILE", help="draw error against time (.svg, .png)")


def contest(arguments: argparse.Namespace) -> None:
    """All scenes, or those that are named; prints, keeps and draws."""
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
    """All figures of a scene."""
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
    """Samples a pixel that take a quarter of the first time, and a little more than each time."""
    turn = ask(worker, spp, CALIBRATED)
    turn = warmed(worker, samples_in(budgets[0], turn.spp, turn.seconds))  # a few samples tell little
    found: list[int] = []
    for budget in budgets:
        if budget <= CALIBRATION:
            turn = warmed(worker, samples_in(AIM * budget, turn.spp, turn.seconds))
        if not found:
            found.append(samples_in(0.25 * budget, turn.spp, turn.seconds))
        found.append(max(samples_in(AIM * budget, turn.spp, turn.seconds), found[-1] + 1))
    return found


def warmed(worker: Any, spp: int) -> Turn:
    """A turn that is not the first with as many samples."""
    turn = ask(worker, spp, CALIBRATED)
    return ask(worker, spp, CALIBRATED) if turn.cold else turn


def shot(worker: Any, spp: int, seed: int, file: Path) -> tuple[Turn, np.ndarray]:
    """A turn and its picture ``(H, W, 3)``."""
    turn = ask(worker, spp, seed, file)
    return turn, np.load(file, allow_pickle=False)


#: Turns by contender and by samples that were asked for: seconds, samples that were taken, whether it was cold, :func:`judged`.
Turns = dict[str, dict[int, list[dict[str, Any]]]]
#: Pictures ``(H, W, 3)`` by contender and by samples that were asked for.
Pictures = dict[str, dict[int, list[np.ndarray]]]


def judged(reference: Reference, scale: np.ndarray, pictures: list[np.ndarray], part: bool) -> list[dict[str, Any]]:
    """The relMSE of pictures, and what it would be without each of the reference's pictures.

    Args:
        reference: of the renderer.
        scale: what squared errors are divided by.
        pictures: to be judged.
        part: whether they are those that the reference is made of. Each is then held against the others; as one that errs
            much hardly moves these errors, their spread alone tells how sure their mean is.
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
    """Rounds in which all contenders take their turn at each time, with another seed each."""
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
    """What the turns of a number of samples come to; cold ones are timed only where there are no others."""
    warm = [turn["seconds"] for turn in turns if not turn["cold"]]
    seconds = warm or [turn["seconds"] for turn in turns]
    errors, without = ([turn[key] for turn in turns] for key in ("relmse", "without"))
    return Point.of(turns[0]["spp"], seconds, errors, without)


def compared(points: dict[str, list[Point]], budget: float) -> dict[str, Any]:
    """Everyone's error at a time, and the ratio of ours to the better of theirs."""
    estimates = {who: at_time(line, budget) for who, line in points.items()}
    best = better({who: estimates[who].relmse for who in RIVALS})
    ratio = estimates[OURS].relmse / estimates[best].relmse
    return {**{who: asdict(estimate) for who, estimate in estimates.items()}, "better": best, "ratio": ratio}


def overall(found: dict[str, Any], budgets: list[float]) -> dict[str, Any]:
    """Geometric means of the groups that are complete, by time and over all times, and the worst ratio."""
    ratios = {f"{b:g}": {name: row["at"][f"{b:g}"]["ratio"] for name, row in found.items()} for b in budgets}
    means = {budget: geometric_means(row) for budget, row in ratios.items()}
    every = {
        name: float(np.exp(np.mean([np.log(row[name]) for row in ratios.values()]))) for name in found
    }  # of the times
    worst = max(((ratio, name, b) for b, row in ratios.items() for name, ratio in row.items()), default=None)
    return {"geometric_means": means | {"all times": geometric_means(every)}, "by_scene": every, "worst": worst}


def heading(budgets: list[float]) -> str:
    """Of :func:`lines`."""
    times = ", ".join(f"{budget:g}" for budget in budgets)
    columns = f"{OURS:>20s}" + "".join(f"{sampler:>20s}" for sampler in THEIRS)
    return f"relMSE x 1e3 of pictures of {times} s, ± standard error\n{'':22s}{'s':>6s}{columns}   ratio"


def lines(name: str, row: dict[str, Any]) -> list[str]:
    """Of a scene: one for each time, and how far references are apart."""
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
    """The geometric means, and the worst ratio."""
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
    """The table for the documentation: errors x 1000 of ours and of the better of theirs, and their ratio."""
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
    """An error x 1000, with its standard error where that is known."""
    error = f"{1e3 * estimate['relmse']:.3g}"
    return error if estimate["deviation"] is None else f"{error} ± {1e3 * estimate['deviation']:.2g}"
