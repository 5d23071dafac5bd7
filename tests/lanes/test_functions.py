"""The elementary functions of the lane compiler: errors in units of the last place, special values, ends of their domains.

float32 is measured against numpy's float64, float64 against 80-bit floats where numpy has them, else against mpmath. An
error is the distance from the exact value in the spacing of floats there. Bounds are the measured maxima, rounded up to
the next half with room for other samples; ``docs/lanes.md`` has the same table, which a test compares.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from torchpt.lanes.function import lanewise
from torchpt.lanes.functions import FUNCTIONS

DENSE = np.finfo(np.longdouble).nmant >= 63
DOCS = Path(__file__).parents[2] / "docs" / "lanes.md"
Array = NDArray[Any]


@dataclass(frozen=True)
class Bound:
    """Largest errors in units of the last place, and where they hold.

    Attributes:
        single: of float32.
        double: of float64.
        domain: in words, as in the documentation.
        ranges: intervals from which arguments are drawn, evenly and by logarithm.
        near: arguments of special interest, with their neighbours.
    """

    single: float
    double: float
    domain: str
    ranges: tuple[tuple[float, float], ...]
    near: tuple[float, ...] = ()


#: Beyond this the reduction of sin, cos and tan loses digits.
TURNS = 2.0**20
QUARTERS = tuple(k * math.pi / 4 for k in (*range(-40, 41), 1001, 12345, 400001, 1048573))
ALL = "all"
BOUNDS = {
    "sin": Bound(9, 9, "abs(x) <= 2^20", ((-10, 10), (-TURNS, TURNS)), QUARTERS),
    "cos": Bound(9, 9, "abs(x) <= 2^20", ((-10, 10), (-TURNS, TURNS)), QUARTERS),
    "tan": Bound(9, 9, "abs(x) <= 2^20", ((-10, 10), (-TURNS, TURNS)), QUARTERS),
    "asin": Bound(9, 9, "[-1, 1]", ((-1, 1),), (0.5, 1.0, -1.0, math.sqrt(0.5))),
    "acos": Bound(9, 9, "[-1, 1]", ((-1, 1), (0.99, 1), (-1, -0.99)), (0.5, 1.0, -1.0, -0.5, math.sqrt(0.5))),
    "atan": Bound(9, 9, ALL, ((-5, 5), (-1e30, 1e30)), (math.sqrt(2) - 1, math.sqrt(2) + 1, 0.66, 1.0)),
    "atan2": Bound(9, 9, ALL, ((-5, 5), (-1e30, 1e30))),
    "exp": Bound(9, 9, ALL, ((-1, 1), (-746, 710)), tuple(k * math.log(2) / 2 for k in range(-300, 256))),
    "exp2": Bound(9, 9, ALL, ((-1, 1), (-1076, 1025)), tuple(k / 2 for k in range(-300, 258))),
    "expm1": Bound(9, 9, ALL, ((-2, 2), (-50, 710)), (1.0, -1.0, 1e-8, -1e-8)),
    "log": Bound(9, 9, ALL, ((0, 4), (0.9, 1.1), (0, 1e300)), (1.0, math.sqrt(0.5), math.sqrt(2), 2.0**-1022)),
    "log2": Bound(9, 9, ALL, ((0, 4), (0.9, 1.1), (0, 1e300)), (1.0, math.sqrt(0.5), math.sqrt(2), 2.0**-126)),
    "log10": Bound(9, 9, ALL, ((0, 4), (0.9, 1.1), (0, 1e300)), (1.0, math.sqrt(0.5), math.sqrt(2), 2.0**-126)),
    "log1p": Bound(9, 9, ALL, ((-1, 2), (-1, -0.99), (-0.1, 0.1), (0, 1e300)), (1e-8, -1e-8, math.sqrt(2) - 1, -0.5)),
    "pow": Bound(9, 9, ALL, ()),
    "sinh": Bound(9, 9, ALL, ((-2, 2), (-711, 711)), (20.0, 1.0)),
    "cosh": Bound(9, 9, ALL, ((-2, 2), (-711, 711)), (20.0, 1.0)),
    "tanh": Bound(9, 9, ALL, ((-2, 2), (-50, 50)), (20.0, 40.0, 0.5)),
    "sigmoid": Bound(9, 9, ALL, ((-2, 2), (-745, 50)), (-87.0, -709.0)),
}


def _sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


REFERENCES: dict[str, Callable[..., Array]] = {
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "pow": np.power,
    "sigmoid": _sigmoid,
}


def reference(name: str) -> Callable[..., Array]:
    return REFERENCES.get(name) or getattr(np, name)


def of_torch(name: str) -> Callable[..., torch.Tensor]:
    return getattr(torch, name)


def arguments(name: str, dtype: type, count: int) -> list[Array]:
    """Random arguments of the domain and the neighbours of its special places."""
    rng = np.random.default_rng(7)
    facts, bound = np.finfo(dtype), BOUNDS[name]
    lowest, highest = float(facts.smallest_subnormal), float(facts.max)
    if name == "pow":
        x = np.exp(rng.uniform(math.log(lowest), math.log(highest), count))
        x[::2] = 1 + rng.standard_normal(len(x[::2])) * 10 ** rng.uniform(-12, -1, len(x[::2]))
        with np.errstate(all="ignore"):
            y = rng.uniform(1.02 * math.log(lowest), 1.02 * math.log(highest), count) / np.log(x)
        y[::5] = rng.uniform(-3, 3, len(y[::5]))
        y = np.where(np.isfinite(y), y, 2.5)
        return [np.abs(x).astype(dtype), y.clip(-highest, highest).astype(dtype)]
    parts = []
    for low, high in bound.ranges:
        low, high = max(low, -highest), min(high, highest)
        parts.append(rng.uniform(low, high, count))
        for end in (low, high):
            if end:
                parts.append(math.copysign(1, end) * np.exp(rng.uniform(math.log(lowest), math.log(abs(end)), count)))
    near = np.array(bound.near, dtype).reshape(-1, 1)
    steps = np.arange(-8, 9).astype(dtype)
    parts.append((near + near * steps * facts.eps / 2).reshape(-1))
    with np.errstate(all="ignore"):
        x = np.concatenate([part.astype(dtype) for part in parts])
    if bound.ranges and name != "atan2":
        low, high = min(r[0] for r in bound.ranges), max(r[1] for r in bound.ranges)
        x = x[(x >= low) & (x <= high)]
    if name != "atan2":
        return [x]
    return [x, rng.permutation(x)]


def run(name: str, *given: Array) -> Array:
    x = [torch.from_numpy(np.ascontiguousarray(a)) for a in given]
    return lanewise(lambda *x: [of_torch(name)(*x)], x)(*x)[0].numpy()


def ulps(found: Array, exact: Array) -> Array:
    """Distances in the spacing of floats at the exact value; beyond the largest float infinity is right."""
    dtype = found.dtype.type
    facts = np.finfo(dtype)
    with np.errstate(all="ignore"):
        size = np.abs(exact)
        exponent = np.frexp(size)[1]
        gap = np.ldexp(exact.dtype.type(1), np.maximum(exponent - facts.nmant - 1, facts.minexp - facts.nmant))
        error = np.abs(found.astype(exact.dtype) - exact) / gap
        over = size > float(facts.max) * (1 + exact.dtype.type(facts.eps) / 4)
        near_over = size > float(facts.max) * (1 - 4 * exact.dtype.type(facts.eps))
        right = found == np.sign(exact) * np.inf
        error = np.where(over, np.where(right | near_over & (np.abs(found) == facts.max), 0, np.inf), error)
        error = np.where(near_over & right, 0, error)
    return np.where(np.isnan(exact) & np.isnan(found) | (found.astype(exact.dtype) == exact), 0, error)


def worst(name: str, dtype: type, count: int) -> tuple[float, tuple[float, ...]]:
    """The largest error, and where."""
    given = arguments(name, dtype, count)
    with np.errstate(all="ignore"):
        exact = reference(name)(*(a.astype(np.float64 if dtype is np.float32 else np.longdouble) for a in given))
    error = ulps(run(name, *given), exact)
    place = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
    return float(error[place]), tuple(float(a[place]) for a in given)
