"""Compare gradients with true values.

    python scripts/gradient_pairs.py [pairs] [--wish edges=true] [--json FILE] [--markdown]

The pairs of a scene and a parameter are those of ``tests/references/known_gradients.py``, their true derivatives
those of ``known_gradients.json`` beside it. Each gradient is the mean over independent seeds: ``--seeds`` of them at
first, then twice as many, until its standard error is at most 2 % of the true value, ``--most`` is reached or ``--seconds``
are spent. A pair passes if the mean is off by at most 2 % of the true value + 3 standard errors (of both combined)
and the standard error is at most 3 %.

``--wish KEY=VALUE`` passes arguments to ``torchpt.render``, values as JSON: ``--wish edges=false --wish
adjoint=autograd``.

``python scripts/gradient_pairs.py --truths`` computes the true values, in twelve minutes on one core: central
differences of compiled float32 renders with common random numbers, ``--truth-spp`` samples a pixel, at two steps,
``h`` and ``2 h``. The true value is Richardson's ``(4 D(h) - D(2 h)) / 3``, averaged over as many seeds as bring
its standard error to 0.5 % (at least 8, at most 256). Sums over the picture are float64. Steps are a fraction of a
pixel: edges along the border of two pixels put kinks into the loss, which larger steps would miss.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import bench_files
import from_tests  # noqa: F401
import known_gradients
import torch

import torchpt

PAIRS = known_gradients.PAIRS
TRUTHS = Path(known_gradients.__file__).with_name("known_gradients.json")
#: How far a gradient may be off beside 3 standard errors, and how large its standard error may be, as fractions of the truth.
OFF, KNOWN = 0.02, 0.03
#: Standard errors, as fractions, at which the rounds stop: of a gradient, and of a true value.
ENOUGH, TRUE = 0.02, 0.005


def main() -> None:
    """Compare gradients with the true values, or compute these."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="*", help=f"of {', '.join(PAIRS)}")
    parser.add_argument("--truths", action="store_true", help="make the file of truths anew, or some of it")
    parser.add_argument("--truth-spp", type=int, default=4096)
    parser.add_argument("--seeds", type=int, default=8, help="of the first round")
    parser.add_argument("--most", type=int, default=256, help="seeds")
    parser.add_argument("--seconds", type=float, default=60.0, help="after which a pair gets no further round")
    parser.add_argument("--spp", type=int, help="samples a pixel of a gradient, in place of the pair's own")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--wish", action="append", default=[], metavar="KEY=VALUE", help="for torchpt.render")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the figures go")
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table as well")
    arguments = parser.parse_args()
    unknown = set(arguments.pairs) - set(PAIRS)
    if unknown:
        parser.error(f"no such pair: {', '.join(sorted(unknown))}")
    torch.set_num_threads(arguments.threads)
    names = arguments.pairs or list(PAIRS)
    if arguments.truths:
        make_truths(names, arguments)
    else:
        judge(names, arguments)


def make_truths(names: Iterable[str], arguments: argparse.Namespace) -> None:
    """Compute central differences and save them pair by pair."""
    for name in names:
        begin = time.perf_counter()
        found = difference(name, arguments.truth_spp, arguments.threads)
        # Other processes may be computing other pairs.
        kept = truths() if TRUTHS.exists() else {}
        kept[name] = found
        TRUTHS.write_text(json.dumps({key: kept[key] for key in PAIRS if key in kept}, indent=1) + "\n")
        error = found["error"] / abs(found["truth"])
        seconds = time.perf_counter() - begin
        print(
            f"{name:26s}{found['truth']:12.6f} ± {error:6.2%}  h {found['fine']:10.6f}  2h {found['coarse']:10.6f}"
            f"{found['seeds']:5d} seeds {seconds:6.1f} s",
            flush=True,
        )


def difference(name: str, spp: int, threads: int) -> dict[str, Any]:
    """Return the true derivative of a pair, with its standard error and what it was computed from."""
    pair = PAIRS[name]
    scene = known_gradients.loaded(pair)
    base = scene.params[pair.parameter]

    def slope(step: float, seed: int) -> float:
        def loss(by: float) -> float:
            given = {pair.parameter: pair.at(base, by)}
            return float(
                known_gradients.loss_of(torchpt.render(scene, params=given, spp=spp, seed=seed, threads=threads))
            )

        return (loss(step) - loss(-step)) / (2 * step)

    fine: list[float] = []
    coarse: list[float] = []
    while True:
        for seed in range(len(fine), len(fine) + 8):
            fine.append(slope(pair.step, seed))
            coarse.append(slope(2 * pair.step, seed))
        mean, error = mean_of([(4 * a - b) / 3 for a, b in zip(fine, coarse, strict=True)])
        if error <= TRUE * abs(mean) or len(fine) >= 256:
            break
    return {
        "truth": mean, "error": error, "step": pair.step, "fine": mean_of(fine)[0], "fine_error": mean_of(fine)[1],
        "coarse": mean_of(coarse)[0], "coarse_error": mean_of(coarse)[1], "spp": spp, "seeds": len(fine),
    }  # fmt: skip


def truths() -> dict[str, Any]:
    """Return the true derivatives by name of the pair."""
    return json.loads(TRUTHS.read_text())


def judge(names: Sequence[str], arguments: argparse.Namespace) -> None:
    """Compare the gradients of all pairs with the true values."""
    wishes = {key: json.loads(value) for key, value in (wish.split("=", 1) for wish in arguments.wish)}
    true, found = truths(), {}
    print(f"{'pair':26s}{'truth':>12s}{'gradient':>12s}{'off':>9s}{'SE':>8s}{'seeds':>7s}{'s':>8s}")
    for name in names:
        found[name] = measured(
            name,
            true[name],
            wishes,
            arguments.spp,
            arguments.seeds,
            arguments.most,
            arguments.seconds,
            arguments.threads,
        )
        row = found[name]
        print(
            f"{name:26s}{row['truth']:12.6f}{row['gradient']:12.6f}{row['off']:9.2%}{row['error']:8.2%}{row['seeds']:7d}"
            f"{row['seconds']:8.1f}  {verdict(row)}",
            flush=True,
        )
        if arguments.json is not None:
            bench_files.write(arguments.json, {"wishes": wishes, "machine": bench_files.machine(), "pairs": found})
    passed = sum(row["passes"] for row in found.values())
    print(f"{passed} of {len(found)} pass")
    if arguments.markdown:
        print(markdown(found))


def measured(
    name: str,
    true: dict[str, Any],
    wishes: dict[str, Any],
    spp: int | None = None,
    seeds: int = 8,
    most: int = 256,
    seconds: float = 60.0,
    threads: int = 1,
) -> dict[str, Any]:
    """Measure the gradient of a pair; ``off`` and ``error`` are fractions of the true value."""
    pair = PAIRS[name]
    scene = known_gradients.loaded(pair)
    base = scene.params[pair.parameter]
    direction = pair.along(base)
    samples = pair.spp if spp is None else spp
    gradients: list[float] = []
    rounds = seeds
    begin = time.perf_counter()
    while True:
        for seed in range(len(gradients), rounds):
            leaf = base.clone().requires_grad_()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", torchpt.EdgeWarning)
                picture = torchpt.render(
                    scene, params={pair.parameter: leaf}, spp=1, spp_grad=samples, seed=seed, threads=threads, **wishes
                )
            (gradient,) = torch.autograd.grad(known_gradients.loss_of(picture), leaf)
            gradients.append(float((gradient.double() * direction.double()).sum()))
        finite = [value for value in gradients if math.isfinite(value)]
        mean, error = mean_of(finite)
        rounds = min(2 * rounds, most)
        spent = time.perf_counter() - begin
        if error <= ENOUGH * abs(true["truth"]) or rounds == len(gradients) or spent > seconds:
            break
    size = abs(true["truth"])
    off, known = (mean - true["truth"]) / size, error / size
    close = abs(off) <= OFF + 3 * math.hypot(known, true["error"] / size) and known <= KNOWN
    passes = close and len(finite) == len(gradients)
    return {
        "truth": true["truth"], "gradient": mean, "off": off, "error": known, "passes": passes, "spp": samples,
        "seeds": len(gradients), "not_finite": len(gradients) - len(finite), "seconds": spent,
        "seconds_each": spent / len(gradients),
    }  # fmt: skip


def verdict(row: dict[str, Any]) -> str:
    """Return the verdict as text."""
    if row["not_finite"]:
        return f"fails: {row['not_finite']} gradients are not finite"
    return "ok" if row["passes"] else "fails"


def mean_of(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean and its standard error, which is NaN for fewer than two values."""
    if len(values) < 2:
        return math.nan, math.nan
    return statistics.fmean(values), statistics.stdev(values) / math.sqrt(len(values))


def markdown(found: dict[str, Any]) -> str:
    """Return the table for the documentation."""
    lines = ["| pair | truth | gradient | off | SE | samples | s | |", "|---|---:|---:|---:|---:|---:|---:|---|"]
    for name, row in found.items():
        lines.append(
            f"| `{name}` | {row['truth']:.5f} | {row['gradient']:.5f} | {row['off']:.1%} | {row['error']:.1%} | "
            f"{row['spp']} x {row['seeds']} | {row['seconds']:.1f} | {verdict(row)} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
