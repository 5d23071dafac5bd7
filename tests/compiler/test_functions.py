"""The elementary functions of the lane compiler: errors in units of the last place, special values, ends of their domains.

float32 is measured against numpy's float64, float64 against 80-bit floats where numpy has them (skipped elsewhere), and these
against mpmath. An error is the distance from the exact value in the spacing of floats there. Bounds are the measured maxima,
rounded up to the next half with room for other samples; ``docs/explanations/lanes.md`` has the same table, and a test compares
them.
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
from few import few
from forms import differing, one_lane
from numpy.typing import NDArray

from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.functions import FUNCTIONS
from torchpt.compiler.target import Target

DENSE = np.finfo(np.longdouble).nmant >= 63
DOCS = Path(__file__).parents[2] / "docs" / "explanations" / "lanes.md"
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
    "sin": Bound(2, 3, "abs(x) <= 2^20", ((-10, 10), (-TURNS, TURNS)), QUARTERS),
    "cos": Bound(2, 3, "abs(x) <= 2^20", ((-10, 10), (-TURNS, TURNS)), QUARTERS),
    "tan": Bound(4, 4.5, "abs(x) <= 2^20", ((-10, 10), (-TURNS, TURNS)), QUARTERS),
    "asin": Bound(4, 2.5, "[-1, 1]", ((-1, 1),), (0.5, 1.0, -1.0, math.sqrt(0.5))),
    "acos": Bound(4, 2.5, "[-1, 1]", ((-1, 1), (0.99, 1), (-1, -0.99)), (0.5, 1.0, -1.0, -0.5, math.sqrt(0.5))),
    "atan": Bound(3, 1.5, ALL, ((-5, 5), (-1e30, 1e30)), (math.sqrt(2) - 1, math.sqrt(2) + 1, 0.66, 1.0)),
    "atan2": Bound(3.5, 2, ALL, ((-5, 5), (-1e30, 1e30))),
    "exp": Bound(1.5, 1, ALL, ((-1, 1), (-746, 710)), tuple(k * math.log(2) / 2 for k in range(-300, 256))),
    "exp2": Bound(1.5, 1, ALL, ((-1, 1), (-1076, 1025)), tuple(k / 2 for k in range(-300, 258))),
    "expm1": Bound(1, 2, ALL, ((-2, 2), (-50, 710)), (1.0, -1.0, 1e-8, -1e-8)),
    "log": Bound(1, 1, ALL, ((0, 4), (0.9, 1.1), (0, 1e300)), (1.0, math.sqrt(0.5), math.sqrt(2), 2.0**-1022)),
    "log2": Bound(1, 1, ALL, ((0, 4), (0.9, 1.1), (0, 1e300)), (1.0, math.sqrt(0.5), math.sqrt(2), 2.0**-126)),
    "log10": Bound(1, 1, ALL, ((0, 4), (0.9, 1.1), (0, 1e300)), (1.0, math.sqrt(0.5), math.sqrt(2), 2.0**-126)),
    "log1p": Bound(1, 1, ALL, ((-1, 2), (-1, -0.99), (-0.1, 0.1), (0, 1e300)), (1e-8, -1e-8, math.sqrt(2) - 1, -0.5)),
    "pow": Bound(1, 1.5, ALL, ()),
    "sinh": Bound(4, 3, ALL, ((-2, 2), (-711, 711)), (20.0, 1.0)),
    "cosh": Bound(4, 3, ALL, ((-2, 2), (-711, 711)), (20.0, 1.0)),
    "tanh": Bound(2.5, 3, ALL, ((-2, 2), (-50, 50)), (20.0, 40.0, 0.5)),
    "sigmoid": Bound(3, 2.5, ALL, ((-2, 2), (-745, 50)), (-87.0, -709.0)),
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
    with np.errstate(all="ignore"):
        near = np.array(bound.near, dtype).reshape(-1, 1)
        steps = np.arange(-8, 9).astype(dtype)
        parts.append((near + near * steps * facts.eps / 2).reshape(-1))
        x = np.concatenate([part.astype(dtype) for part in parts])
    if bound.ranges and name != "atan2":
        low = max(min(r[0] for r in bound.ranges), -highest)
        high = min(max(r[1] for r in bound.ranges), highest)
        x = x[(x >= low) & (x <= high)]
    if name != "atan2":
        return [x]
    return [x, rng.permutation(x)]


def run(name: str, *given: Array, target: Target | None = None) -> Array:
    x = [torch.from_numpy(np.ascontiguousarray(a)) for a in given]
    return compile_lanewise(lambda *x: [of_torch(name)(*x)], x, target)(*x)[0].numpy()


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


TYPES = [
    np.float32,
    pytest.param(np.float64, marks=pytest.mark.skipif(not DENSE, reason="numpy has no wider floats here")),
]


@pytest.mark.parametrize("dtype", TYPES, ids=["float32", "float64"])
@pytest.mark.parametrize("name", few(FUNCTIONS, 10))
def test_error(name, dtype, record_property):
    error, place = worst(name, dtype, 20_000)
    record_property("ulp", error)
    print(f"{name} {dtype.__name__}: {error:.3f} at {place}")
    assert error <= (BOUNDS[name].single if dtype is np.float32 else BOUNDS[name].double), place


@pytest.mark.slow
@pytest.mark.parametrize("dtype", TYPES, ids=["float32", "float64"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_error_dense(name, dtype):
    error, place = worst(name, dtype, 1_000_000)
    assert error <= (BOUNDS[name].single if dtype is np.float32 else BOUNDS[name].double), place


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", few(FUNCTIONS, 8))
def test_one_lane_at_a_time(name, dtype):
    """The same bits at any width, of random arguments and of special ones."""
    given = [*arguments(name, dtype, 2_000)]
    ends = np.array(SPECIAL, dtype)
    special = [ends] if len(given) == 1 else [a.reshape(-1) for a in np.meshgrid(ends, ends)]
    given = [np.concatenate([a, b]) for a, b in zip(given, special, strict=True)]
    vectors, single = (torch.from_numpy(run(name, *given, target=target)) for target in (None, one_lane()))
    wrong = differing(vectors, single).numpy()
    assert not wrong.any(), [a[wrong][:3] for a in given]


@pytest.mark.skipif(not DENSE, reason="numpy has no wider floats here")
def test_references():
    """80-bit floats are what they should be: as good as 40 digits on a few arguments."""
    mpmath = pytest.importorskip("mpmath")
    names = {
        "asin": "asin",
        "acos": "acos",
        "atan": "atan",
        "exp2": None,
        "log2": None,
        "sigmoid": None,
        "pow": "power",
    }
    with mpmath.workdps(40):
        for name in FUNCTIONS:
            given = [a[:: max(len(a) // 60, 1)][:60] for a in arguments(name, np.float64, 1000)]
            if names.get(name, name) is None:
                continue
            function = getattr(mpmath, names.get(name, name))
            with np.errstate(all="ignore"):
                exact = [function(*map(mpmath.mpf, map(float, x))) for x in zip(*given, strict=True)]
                found = run(name, *given)
                real = np.array([np.longdouble(mpmath.nstr(x, 30)) for x in exact])
                assert np.nanmax(ulps(found, real)) <= BOUNDS[name].double, name


SPECIAL = [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, -2.0, 3.0, -3.0, 2.5, -2.5, 1e-30, -1e-30, 1e30, -1e30]
SPECIAL += [math.inf, -math.inf, math.nan]


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_special_values(name, dtype):
    """NaN, infinities and zeros with their signs where C has them, and no number where C has none."""
    facts = np.finfo(dtype)
    ends = [facts.max, -facts.max, facts.tiny, facts.smallest_subnormal, -facts.smallest_subnormal]
    one = np.array([*SPECIAL, *ends], dtype)
    given = [one] if name not in ("atan2", "pow") else [a.reshape(-1).copy() for a in np.meshgrid(one, one)]
    if name in ("sin", "cos", "tan"):
        given = [np.where((np.abs(one) > TURNS) & np.isfinite(one), dtype(7.0), one)]
    with np.errstate(all="ignore"):
        wanted = reference(name)(*given)
    found = run(name, *given)
    bound = BOUNDS[name].single if dtype is np.float32 else BOUNDS[name].double
    with np.errstate(all="ignore"):
        close = np.abs(found - wanted) <= (bound + 4) * np.spacing(np.abs(wanted))
    same = (found == wanted) & (np.signbit(found) == np.signbit(wanted)) | np.isnan(found) & np.isnan(wanted)
    wrong = ~(same | close & (wanted != 0) & np.isfinite(wanted))
    assert not wrong.any(), [(*(a[wrong] for a in given), found[wrong], wanted[wrong])]


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
def test_huge_angles(dtype):
    """Beyond the domain a sine loses digits, but stays a sine."""
    x = np.exp(np.random.default_rng(1).uniform(0, math.log(np.finfo(dtype).max), 20_000)).astype(dtype)
    x = np.concatenate([x, -x, np.array([np.finfo(dtype).max], dtype)])
    s, c = run("sin", x), run("cos", x)
    assert np.abs(s).max() <= 1 and np.abs(c).max() <= 1
    assert (
        np.abs(s.astype(np.float64) ** 2 + c.astype(np.float64) ** 2 - 1).max() < 0.02
    )  # the rest of the angle is cut off
    assert np.isnan(run("sin", np.array([np.inf, -np.inf, np.nan], dtype))).all()


def test_powers_of_bases_are_exact():
    """log2 of powers of two and log10 of those of ten are whole."""
    k = np.arange(-1074, 1024)
    assert np.array_equal(run("log2", np.ldexp(1.0, k)), k)
    assert np.array_equal(run("exp2", k.astype(np.float64)), np.ldexp(1.0, k))
    k = np.arange(0, 23)
    assert np.array_equal(run("log10", np.array([float(f"1e{j}") for j in k])), k)


def test_documentation():
    """The table in docs/explanations/lanes.md says what is asserted here."""
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \| (.+?) \|$", DOCS.read_text(encoding="utf-8"), re.M)
    said = {name: (float(single), float(double), domain) for name, single, double, domain in rows}
    assert said == {name: (b.single, b.double, b.domain) for name, b in BOUNDS.items()}
    assert set(said) == set(FUNCTIONS)
