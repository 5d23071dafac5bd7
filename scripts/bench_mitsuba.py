"""Compare throughput or error with Mitsuba 3.

    python scripts/bench_mitsuba.py [scenes] [--error] [--json FILE] [--markdown]

Both render the same ten scenes, those of ``configs/scene`` under :func:`mitsuba_scene.nearest`: 256 x 256, 64 samples a pixel,
max_depth 8, rr_depth 5, box filter. Every contender is a separate process that has loaded and warmed up; they render in
turn, round after round, each time with a new seed. The table shows medians, and the median of the ratios within a round, which
is robust on a machine with varying load. It also shows the means of both pictures, and their difference in standard
errors (from five rounds on); ``compare_mitsuba.py`` compares pictures in detail.

Light that passes an opacity or ``null`` counts as a bounce in Mitsuba only, and Mitsuba's shadow rays stop there. At equal
max_depth it traces less in such scenes, and less light arrives: 0.3 % in ``material_row``, next to nothing in the others.

``--error`` compares errors at equal time, see ``bench_error.py``.

``--busy`` compares an idle machine with one where two other processes are busy, ``--scaling`` one thread with two (or
``--threads``), both on the Cornell box. ``--cuda`` compares on a GPU. Needs the extra ``bench``; the bunny and the teapot
need ``$TORCHPT_ASSETS``, else their stand-ins are rendered.
"""

from __future__ import annotations

import argparse
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import bench_error
import bench_files
from bench_figures import GROUPS, SCENES, geometric_means
from bench_workers import CUDA, DEPTH, LLVM, OURS, SCALAR, Contender, Turn, Workers, ask, replaced, started

#: Number of busy processes.
BUSY = 2
#: Fewest rounds from which the variance of the means is estimated.
ENOUGH = 5


@dataclass
class Record:
    """The turns of a contender.

    Attributes:
        rates: millions of camera paths a second.
        means: means of the pictures, by channel.
    """

    rates: list[float] = field(default_factory=list)
    means: list[list[float]] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Return the median rate."""
        return statistics.median(self.rates)

    @property
    def mean(self) -> float:
        """Return the mean over all pictures and channels."""
        return statistics.fmean(statistics.fmean(mean) for mean in self.means)


def main() -> None:
    """Run the chosen benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(SCENES)}")
    parser.add_argument("--rounds", "--seeds", type=int, default=7, help="each with another seed")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--threads", type=int, help="of every contender; by default as many as it likes")
    parser.add_argument("--sampler", help="ours, by default the program's own; Mitsuba's is independent")
    parser.add_argument("--compile", default="auto", choices=("auto", "on", "off"), help="off: eager")
    parser.add_argument("--scalar", action="store_true", help=f"{SCALAR} too")
    parser.add_argument(
        "--cuda", action="store_true", help=f"both on a GPU, ours by kernels: {CUDA}; take a --size of 1024"
    )
    parser.add_argument("--quick", action="store_true", help="one round of small pictures: that it works, no more")
    parser.add_argument("--busy", action="store_true", help=f"the same with {BUSY} other processes busy")
    parser.add_argument("--scaling", action="store_true", help="one thread beside two, or --threads")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the figures go")
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table as well")
    parser.add_argument("--error", action="store_true", help="the error of pictures that take as long")
    bench_error.add_arguments(parser.add_argument_group("with --error"))
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.rounds, arguments.size, arguments.spp = 1, 64, 4
    if arguments.cuda:
        if arguments.error or arguments.busy or arguments.scaling or arguments.scalar:
            parser.error("--cuda compares throughput with cuda_ad_rgb alone")
        arguments.compile = "on"
    if arguments.error:
        bench_error.contest(arguments)
    elif arguments.busy:
        busy(arguments)
    elif arguments.scaling:
        scaling(arguments)
    else:
        race(arguments)


def race(arguments: argparse.Namespace) -> None:
    """Time all scenes, torchpt beside Mitsuba."""
    rivals = (CUDA,) if arguments.cuda else (LLVM, SCALAR) if arguments.scalar else (LLVM,)
    contenders = entered((OURS, *rivals), arguments)
    found: dict[str, Any] = {}
    overall: dict[str, dict[str, float]] = {}
    print(f"{'Mpaths/s':22s}{OURS:>9s}" + "".join(f"{rival:>13s}   ratio" for rival in rivals) + "    means, z")
    for scene in arguments.scenes or SCENES:
        with started(scene, contenders, arguments) as workers:
            records = compete(workers, arguments)
        ours, *others = records.values()
        found[scene] = {
            "torchpt": vars(ours) | {"rate": ours.rate},
            **{rival: beside(ours, theirs) for rival, theirs in zip(rivals, others, strict=True)},
            "replaced": replaced(scene),
        }
        cells = "".join(f"{found[scene][r]['rate']:13.3f}{found[scene][r]['ratio']:8.3f}" for r in rivals)
        z = found[scene][rivals[0]]["z"]
        means = f"{ours.mean:.5f} {others[0].mean:.5f}" + ("" if z is None else f" {z:5.1f}")
        print(f"{scene:22s}{ours.rate:9.3f}{cells}    {means}", flush=True)
        for name, instead in found[scene]["replaced"].items():
            print(f"    {name}: {instead}")
        overall = {
            rival: geometric_means({name: row[rival]["ratio"] for name, row in found.items()}) for rival in rivals
        }
        save(arguments, {"scenes": found, "geometric_means": overall})
    for group in GROUPS:
        cells = "".join(f"{means[group]:21.3f}" for means in overall.values() if group in means)
        if cells:
            print(f"{'geometric mean, ' + group:31s}{cells}")
    if arguments.markdown:
        print(markdown(found, rivals))


def beside(ours: Record, theirs: Record) -> dict[str, Any]:
    """Return a contender's figures: rate and mean, and the ratio of ours to it within rounds."""
    ratios = [a / b for a, b in zip(ours.rates, theirs.rates, strict=True)]
    facts = {"rate": theirs.rate, "ratio": statistics.median(ratios), "ratios": ratios}
    return {**vars(theirs), **facts, "z": deviate(ours.means, theirs.means)}


def deviate(ours: list[list[float]], theirs: list[list[float]]) -> float | None:
    """Return by how many standard errors the means of pictures differ, in the channel where they differ most."""
    if len(ours) < ENOUGH:
        return None
    found = []
    for a, b in zip(zip(*ours, strict=True), zip(*theirs, strict=True), strict=True):
        error = math.sqrt((statistics.variance(a) + statistics.variance(b)) / len(a))
        found.append((statistics.fmean(a) - statistics.fmean(b)) / max(error, 1e-12))
    return max(found, key=abs)


def markdown(found: dict[str, Any], rivals: tuple[str, ...]) -> str:
    """Return the table for the documentation, with geometric means of the complete groups."""
    lines = ["| scene | torchpt |" + "".join(f" `{rival}` | ratio |" for rival in rivals)]
    lines.append("|---|---|" + "---|---|" * len(rivals))
    columns = [(OURS, "rate"), *((rival, key) for rival in rivals for key in ("rate", "ratio"))]
    for name, row in found.items():
        lines.append(f"| `{name}` | " + " | ".join(f"{row[who][key]:.2f}" for who, key in columns) + " |")
    means = [geometric_means({name: row[who][key] for name, row in found.items()}) for who, key in columns]
    for group in means[0]:
        title = f"geometric mean of {len(GROUPS[group])} ({group})"
        lines.append(f"| {title} | " + " | ".join(f"{mean[group]:.2f}" for mean in means) + " |")
    return "\n".join(lines)


def busy(arguments: argparse.Namespace) -> None:
    """Measure how much busy processes slow each contender down."""
    contenders = entered((OURS, LLVM), arguments)
    found: dict[str, Any] = {}
    for scene in arguments.scenes or ("cornell_box",):
        with started(scene, contenders, arguments) as workers:
            quiet, slowed = ({name: Record() for name in workers} for _ in range(2))
            seeds = count(1)
            for _ in range(arguments.rounds):
                for name, worker in workers.items():
                    note(quiet[name], ask(worker, arguments.spp, next(seeds)))
                    with spinning(BUSY):
                        note(slowed[name], ask(worker, arguments.spp, next(seeds)))
        found[scene] = {}
        for name, record in quiet.items():
            ratios = [b / a for a, b in zip(record.rates, slowed[name].rates, strict=True)]
            found[scene][name] = {"quiet": record.rates, "busy": slowed[name].rates, "ratio": statistics.median(ratios)}
            rates = f"quiet {record.rate:7.3f}, busy {slowed[name].rate:7.3f} Mpaths/s"
            print(f"{scene:22s}{name:24s}{rates}, ratio {found[scene][name]['ratio']:.3f}", flush=True)
    save(arguments, {"busy": found})


def scaling(arguments: argparse.Namespace) -> None:
    """Time one thread beside several."""
    several = arguments.threads or 2
    pairs = [(engine, threads) for engine in (OURS, LLVM) for threads in (1, several)]
    contenders = [entered((engine,), arguments, threads)[0] for engine, threads in pairs]
    found: dict[str, Any] = {}
    for scene in arguments.scenes or ("cornell_box",):
        with started(scene, contenders, arguments) as workers:
            records = list(compete(workers, arguments).values())
        found[scene] = {}
        for engine, one, more in zip((OURS, LLVM), records[::2], records[1::2], strict=True):
            gain = statistics.median(b / a for a, b in zip(one.rates, more.rates, strict=True))
            found[scene][engine] = {"1": one.rates, str(several): more.rates, "ratio": gain}
            rates = f"1 thread {one.rate:7.3f}, {several} threads {more.rate:7.3f} Mpaths/s"
            print(f"{scene:22s}{engine:14s}{rates}, ratio {gain:.3f}", flush=True)
    save(arguments, {"scaling": found})


def save(arguments: argparse.Namespace, facts: dict[str, Any]) -> None:
    """Write the figures measured so far, with the settings of the run."""
    if arguments.json is None:
        return
    names = ("rounds", "size", "spp", "threads", "sampler", "compile")
    settings = {name: getattr(arguments, name) for name in names} | {"max_depth": DEPTH, "rr_depth": 5}
    bench_files.write(arguments.json, {"settings": settings, "machine": bench_files.machine(), **facts})


@contextmanager
def spinning(number: int) -> Iterator[None]:
    """Run busy processes inside the context."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        time.sleep(0.2)  # they have to start
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def entered(engines: tuple[str, ...], arguments: argparse.Namespace, threads: int | None = None) -> list[Contender]:
    """Return the contenders with the chosen threads and sampler."""
    samplers = {OURS: arguments.sampler}
    return [Contender(engine, threads or arguments.threads, samplers.get(engine)) for engine in engines]


def compete(workers: Workers, arguments: argparse.Namespace) -> dict[str, Record]:
    """Run rounds in which each contender takes its turn."""
    records = {name: Record() for name in workers}
    for seed in range(1, 1 + arguments.rounds):
        for name, worker in workers.items():
            note(records[name], ask(worker, arguments.spp, seed))
    return records


def note(record: Record, turn: Turn) -> None:
    """Add a turn to a record."""
    record.rates.append(turn.rate)
    record.means.append(turn.mean)


if __name__ == "__main__":
    main()
