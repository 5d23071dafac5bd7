"""Wide trees: everything is in them once, within its box, and no other choice of nodes and leaves costs less."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from torchpt.search.tree_build import WIDTH, WideTree, build_binary, wide_tree

#: Of tests beside one of eight triangles: of a leaf's rectangles together, and of each other primitive.
RECTANGLES, OTHER = 1.3, 2.0


def boxes(n: int, rng: np.random.Generator, size: float = 0.1) -> Any:
    low = rng.random((n, 3)).astype(np.float32)
    return np.concatenate([low, low + np.float32(size) * rng.random((n, 3)).astype(np.float32)], 1)


def same(n: int, rng: np.random.Generator) -> Any:
    return np.tile(np.array([0, 0, 0, 1, 1, 1], np.float32), (n, 1))


def points(n: int, rng: np.random.Generator) -> Any:
    return np.repeat(boxes(n, rng)[:, :3], 2, 0).reshape(n, 6)


def line(n: int, rng: np.random.Generator) -> Any:
    found = boxes(n, rng)
    found[:, [1, 2, 4, 5]] = 0
    return found


def huge(n: int, rng: np.random.Generator) -> Any:
    return boxes(n, rng) * np.float32(3e38)


def twins(n: int, rng: np.random.Generator) -> Any:
    return np.repeat(boxes(-(-n // 12), rng), 12, 0)[:n]


def half_area(box: Any) -> float:
    x, y, z = (box[3:] - box[:3]).astype(np.float64)
    return float(x * y + y * z + z * x)


def children(tree: WideTree) -> Any:
    return tree.child.reshape(-1, WIDTH)


@pytest.mark.parametrize("made", [boxes, same, points, line, huge, twins])
@pytest.mark.parametrize("kinds", ["triangles", "rectangles", "mixed"])
def test_all_are_there_once_within_their_boxes(made: Any, kinds: str) -> None:
    for n in (1, 2, 7, 8, 9, 64, 65, 1000):
        _all_are_there_once(made, n, kinds)


def _all_are_there_once(made: Any, n: int, kinds: str) -> None:
    given, ids = made(n, np.random.default_rng(n)), np.arange(n, dtype=np.int32)
    counts = {"triangles": (n, 0), "rectangles": (0, n), "mixed": (n // 2, n // 4)}[kinds]
    with np.errstate(over="ignore", invalid="ignore"):
        tree = wide_tree(given.copy(), ids.copy(), counts)
    leaves, of_node, found, seen = tree.ids.reshape(-1, WIDTH), children(tree), [], 0
    sides, todo, depth = tree.boxes.reshape(-1, 6, WIDTH), [(0, 1)], 0
    while todo:
        node, level = todo.pop()
        seen, depth = seen + 1, max(depth, level)
        for k, code in enumerate(of_node[node]):
            if code > 0:
                todo.append((code, level + 1))
            elif code < 0:
                held = [one for one in leaves[~code] if one >= 0]
                found += held
                assert held == sorted(held)
                assert (sides[node, :3, k] <= given[held, :3]).all() and (sides[node, 3:, k] >= given[held, 3:]).all()
    assert sorted(found) == ids.tolist() and seen == len(of_node) and depth == tree.depth


@pytest.mark.parametrize("seed", range(12))
def test_no_other_tree_over_the_same_binary_one_costs_less(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(9, 120))
    triangles = int(rng.integers(0, n + 1))
    plane = triangles + int(rng.integers(0, n - triangles + 1))
    given, ids = boxes(n, rng, 1.0) ** np.float32(2), np.arange(n, dtype=np.int32)
    tree = wide_tree(given.copy(), ids.copy(), (triangles, plane - triangles))

    def of_leaf(held: Any) -> float:
        return 1 + OTHER * sum(held >= plane) + RECTANGLES * bool(((held >= triangles) & (held < plane)).any())

    def around(held: Any) -> Any:
        return np.concatenate([given[held, :3].min(0), given[held, 3:].max(0)])

    def written(node: int) -> tuple[list[int], float]:
        every: list[int] = []
        cost = 0.0
        for code in children(tree)[node]:
            if code > 0:
                held, more = written(code)
            elif code < 0:
                held = [one for one in tree.ids.reshape(-1, WIDTH)[~code] if one >= 0]
                more = half_area(around(held)) * of_leaf(np.array(held))
            else:
                continue
            every, cost = every + held, cost + more
        return every, cost + half_area(around(every))

    root = half_area(around(ids))
    assert written(0)[1] / root == pytest.approx(tree.cost, rel=1e-5)

    order = ids.copy()
    nodes, spans = build_binary(given.copy(), order, triangles)

    @functools.cache
    def least(node: int, places: int) -> float:
        """Return what is below a node, as so many children at most."""
        start, stop, left = spans[node]
        area, best = half_area(nodes[node]), np.inf
        if stop - start <= WIDTH:
            best = area * of_leaf(order[start:stop])
        if left > 0:
            best = min(best, area + shared(left, WIDTH))
            if places > 1:
                best = min(best, shared(left, places))
        return float(best)

    @functools.cache
    def shared(left: int, places: int) -> float:
        return min(least(left, k) + least(left + 1, places - k) for k in range(1, places))

    assert least(0, 1) / root == pytest.approx(tree.cost, rel=1e-5)
