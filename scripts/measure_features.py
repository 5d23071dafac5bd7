"""Measure the cost of a feature in a scene with it and in one without: kernel nodes, rows, tables, time.

Print a table in Markdown for ``docs/benchmarks/performance.md``: ``python scripts/measure_features.py``. A plain scene of three
rectangles (``tests/references/features.py``) gets one feature at a time. Times are of one thread, the least of several renders.
"""

from __future__ import annotations

import argparse

import from_tests  # noqa: F401
from features import FEATURES, Feature, kernels, with_feature

import torchpt
from torchpt.engines.kernels.programs import Kernels
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

REPEATS = 15


def _counts(made: Kernels, feature: Feature | None) -> tuple[int, int, int, int]:
    """Return the numbers of nodes in all kernels, nodes from the feature's files, rows of a path, and tables."""
    programs = [kernel.program for kernel in made._made.values()]
    mine = () if feature is None else feature.files
    nodes = sum(program.nodes.get(file, 0) for program in programs for file in mine)
    whole = sum(max(program.nodes.values(), default=0) for program in programs)
    leaves = {leaf for program in programs for leaf in program.leaves()}
    return whole, nodes, made.state.count, len(leaves)


def _time(scene: torchpt.Scene) -> float:
    """Return nanoseconds per camera sample."""
    wish = settings(scene.description, {"render": {"spp": 64, "threads": 1, "compile": "on"}})
    best = float("inf")
    for _ in range(REPEATS):
        done = render_scene(scene, wish)
        best = min(best, done.render_seconds / done.paths)
    return 1e9 * best


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    made, scene = kernels(with_feature(None))
    plain, rows = _counts(made, None)[0], _counts(made, None)
    print("| feature | nodes of its files without it | with it | all nodes | rows of a path | tables | ns a sample |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    print(f"| (plain) | | | {plain} | {rows[2]} | {rows[3]} | {_time(scene):.0f} |")
    for name, feature in FEATURES.items():
        without = _counts(made, feature)[1]
        more, with_it = kernels(with_feature(name))
        whole, nodes, state, tables = _counts(more, feature)
        print(f"| {name} | {without} | {nodes} | {whole} | {state} | {tables} | {_time(with_it):.0f} |", flush=True)
    print(f"\nthe plain scene again: {_time(kernels(with_feature(None))[1]):.0f} ns a sample")


if __name__ == "__main__":
    main()
