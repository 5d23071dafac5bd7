"""Each operator that the lane compiler lowers, against torch on the same numbers.

What IEEE 754 rounds in one way only (sums, products, quotients, square roots, comparisons, selections, bits, casts,
look-ups) must agree bit by bit, signs of zeros and places of NaN included. Where torch rounds several times, or calls a
function of its own, a case states how many units in the last place lie between; ``test_functions.py`` judges the functions
themselves. Lengths are such that the last vector is empty, full and anything between.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from forms import differing, one_lane
from torch import Tensor, nn

from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.tracing import LOWERINGS

N = 1000
LENGTHS = (N, 1, 15, 16, 17)
Form = Callable[[Any], Tensor]


def _pairs(special: Sequence[Any], fill: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Each special value with each, shuffled among random ones: N pairs."""
    pairs = torch.tensor(list(itertools.product(special, repeat=2)), dtype=dtype).T
    both = torch.cat([pairs, fill[:, : N - pairs.shape[1]].to(dtype)], 1)
    both = both[:, torch.randperm(N, generator=torch.Generator().manual_seed(3))]
    return both[0].clone(), both[1].clone()


def _inputs() -> dict[str, Tensor]:
    """``f g`` float32, ``d e`` float64, ``i j`` int32, ``l m`` int64 of 31 bits, ``b c`` bool, ``u v`` uint8."""
    rng = torch.Generator().manual_seed(1)
    found: dict[str, Tensor] = {}
    for names, dtype in (("fg", torch.float32), ("de", torch.float64)):
        facts = torch.finfo(dtype)
        special = [0.0, -0.0, math.inf, -math.inf, math.nan, 1.0, -1.0, 0.5, -0.5, 1.5, -2.5, 3.0]
        special += [facts.tiny, -facts.tiny, facts.smallest_normal * facts.eps, facts.max, -facts.max]
        special += [facts.tiny * 0.3, 1 / facts.eps + 1, -0.5 / facts.eps + 0.5, 16777217.0, 1.0 - facts.eps / 2]
        fill = torch.randn(2, N, generator=rng, dtype=torch.float64)
        fill = torch.where(torch.rand(2, N, generator=rng) < 0.3, fill * torch.exp(8 * fill), fill)
        found |= zip(names, _pairs(special, fill, dtype), strict=True)
    # An int64 input is an index: sums of two have 32 bits.
    for names, dtype, top in (("ij", torch.int32, (1 << 31) - 1), ("lm", torch.int64, (1 << 30) - 1)):
        special = [0, 1, -1, 2, -2, 7, -7, 31, 32, 33, 65537, top, -top - 1, -top, 12345678]
        fill = torch.randint(-top - 1, top, (2, N), generator=rng)
        fill = torch.where(torch.rand(2, N, generator=rng) < 0.5, fill % 1000 - 500, fill)
        found |= zip(names, _pairs(special, fill, dtype), strict=True)
    special = [0, 1, 2, 7, 8, 127, 128, 129, 254, 255]
    found |= zip("uv", _pairs(special, torch.randint(0, 256, (2, N), generator=rng), torch.uint8), strict=True)
    found |= zip("bc", _pairs([False, True], torch.randint(0, 2, (2, N), generator=rng), torch.bool), strict=True)
    # Numbers of ordinary size, three to a lane, and indices of tables below.
    found["p"] = torch.randn(3, N, generator=rng)
    found["q"] = torch.randn(3, N, generator=rng)
    found["w"] = torch.randn(2, 3, N, generator=rng, dtype=torch.float64)
    found["k"] = torch.randint(0, 77, (N,), generator=rng)
    found["n"] = torch.randint(0, 5, (2, N), generator=rng)
    found["r"] = torch.rand(N, generator=rng)
    return found


INPUTS = _inputs()
NAMES = tuple(INPUTS)
_rng = torch.Generator().manual_seed(2)
TABLE = torch.randn(77, generator=_rng)
WIDE = torch.randn(3, 77, generator=_rng, dtype=torch.float64)
WHOLE = torch.randint(-(1 << 31), (1 << 31) - 1, (77, 2), generator=_rng)
MARKS = torch.rand(77, generator=_rng) < 0.5
BYTES = torch.randint(0, 256, (77,), generator=_rng, dtype=torch.uint8)
GRID = torch.randn(5, 7, 2, 3, generator=_rng)
SORTED = torch.sort(torch.randint(-20, 20, (77,), generator=_rng)).values  # with ties
MATRIX = torch.randn(4, 3, generator=_rng)


@dataclass(frozen=True)
class Case:
    """Forms of some operators.

    Attributes:
        operators: by the names of their handlers; each must have been called.
        forms: functions of :data:`INPUTS`.
        ulps: units in the last place between torch and the kernel.
        near: or this difference in numbers of the size of 1, where sums cancel.
        inference: torch takes these operators apart unless it is in inference mode.
    """

    operators: str
    forms: Sequence[Form]
    ulps: float = 0
    near: float = 0.0
    inference: bool = False


def floats(function: Callable[..., Tensor]) -> list[Form]:
    """Of float32 and of float64, and of both."""
    return [lambda x: function(x.f, x.g), lambda x: function(x.d, x.e), lambda x: function(x.f, x.e)]


def each(function: Callable[..., Tensor], names: str) -> list[Form]:
    return [lambda x, name=name: function(getattr(x, name)) for name in names]


def pairs(function: Callable[..., Tensor], *names: str) -> list[Form]:
    return [lambda x, a=a, b=b: function(getattr(x, a), getattr(x, b)) for a, b in names]


NUMBERS = ("fg", "de", "ij", "lm", "fe", "fi", "fl", "du", "bf", "bi", "iu", "il", "uf", "ui")
COMPARED = (*NUMBERS, "uv", "bc")


def _mended(divisor: Tensor) -> Tensor:
    """No zeros, for torch raises an error of whole quotients by 0; no -1, for -(-2^31) is no int32."""
    return torch.where((divisor == 0) | (divisor == -1), 3, divisor)


def _near(a: Tensor, b: Tensor) -> Tensor:
    """Divisors of which torch's own vector form still finds the remainder: beyond that it gives NaN."""
    size = (a.double() / b.double()).abs()
    return torch.where((size > 1e12) & torch.isfinite(a) & (b != 0), 1.5, b)


def compared(op: Callable[..., Tensor]) -> list[Form]:
    forms = [*pairs(op, *COMPARED), lambda x: op(x.f, 0.5), lambda x: op(x.d, 0.1), lambda x: op(x.f, math.nan)]
    return [*forms, lambda x: op(x.i, 7), lambda x: op(x.u, 128), lambda x: op(x.l, -7), lambda x: op(x.i, 0.5)]


def function_of(name: str, ulps: float) -> Case:
    """An elementary function on ordinary numbers; its error is that of both sides."""
    op = getattr(torch, name)
    forms = [lambda x: op(x.p), lambda x: op(x.w)]
    if name in ("log", "log2", "log10", "log1p"):
        forms = [lambda x: op(x.p.abs()), lambda x: op(x.w.abs())]
    elif name in ("asin", "acos"):
        forms = [lambda x: op(x.p * 0.25), lambda x: op(x.w * 0.25)]
    return Case(name, [*forms, lambda x: op(x.n), lambda x: op(x.b)], ulps)


aten = torch.ops.aten

CASES = [
    Case(
        "add",
        [*pairs(torch.add, *NUMBERS, "uv", "bc"), *each(lambda x: x + 1, "fdilub"), *each(lambda x: 0.1 + x, "fdi")],
    ),
    Case(
        "add sub",
        [
            lambda x: torch.add(x.i, x.j, alpha=3),
            lambda x: torch.sub(x.l, x.i, alpha=-1),
            lambda x: torch.add(x.b, x.c, alpha=True),
            lambda x: x.u + x.v > x.u,  # the sum has eight bits
            lambda x: (x.u - x.v).float(),
        ],
    ),
    Case("add sub", [lambda x: torch.add(x.p, x.q, alpha=0.3), lambda x: torch.sub(x.w, x.p, alpha=0.3)], 2, 1e-7),
    Case("sub", [*pairs(torch.sub, *NUMBERS[:-6], "iu", "il", "uv"), *each(lambda x: x - 2.5, "fdi")]),
    Case("rsub", [*each(lambda x: 1 - x, "fdilu"), lambda x: 2.5 - x.i, lambda x: torch.rsub(x.f, x.g)]),
    Case(
        "mul",
        [*pairs(torch.mul, *NUMBERS, "uv", "bc"), *each(lambda x: x * 3, "fdilu"), *each(lambda x: 0.1 * x, "fdi")],
    ),
    Case("mul", [lambda x: (x.u * x.v).int(), lambda x: x.i.long() * x.j, lambda x: x.i.long() * x.j.long() >> 32]),
    Case(
        "div", [*pairs(torch.div, *COMPARED), *each(lambda x: x / 3, "fdilu"), *each(lambda x: 1.0 / (x + 0.5), "fdi")]
    ),
    Case("div", [lambda x: x.f / 8.0, lambda x: x.d / -0.25, lambda x: x.f / 2.0**-130, lambda x: 0.1 / x.f]),
    Case(
        "select_backward slice_backward",
        [
            lambda x: aten.select_backward(x.f, [3, x.f.shape[0]], 0, 1),
            lambda x: aten.select_backward(x.w[0], list(x.w.shape), 0, -1),
            lambda x: aten.slice_backward(x.p[:2], list(x.p.shape), 0, 1, 3, 1),
            lambda x: aten.slice_backward(x.p, list(x.p.shape), 1, 0, 1 << 62, 1),
        ],
    ),
    Case("sgn", each(torch.sgn, "fdi")),
    Case("threshold_backward", [lambda x: aten.threshold_backward(x.f, x.g, 0.0)]),
    Case(
        "tanh_backward sigmoid_backward",
        [lambda x: aten.tanh_backward(x.p, x.q), lambda x: aten.sigmoid_backward(x.p, x.q)],
        2,
        1e-6,
    ),
    Case("true_divide", [lambda x: aten.true_divide(x.f, x.g), lambda x: aten.true_divide(x.i, x.j)], inference=True),
    Case(
        "div floor_divide remainder fmod",
        [
            *pairs(lambda a, b: torch.div(a, _mended(b), rounding_mode="floor"), "ij", "lm", "uv", "iu"),
            *pairs(lambda a, b: torch.div(a, _mended(b), rounding_mode="trunc"), "ij", "lm", "uv"),
            *pairs(lambda a, b: torch.floor_divide(a, _mended(b)), "ij", "lm", "uv"),
            *pairs(lambda a, b: torch.remainder(a, _mended(b)), "ij", "lm", "uv", "ui"),
            *pairs(lambda a, b: torch.fmod(a, _mended(b)), "ij", "lm", "uv"),
            *each(lambda x: x // 7, "ilu"),
            *each(lambda x: x % -7, "il"),
            *each(lambda x: torch.fmod(x, 7), "ilu"),
        ],
    ),
    Case(  # 64 bits: made of int32 lanes
        "div floor_divide remainder fmod",
        [
            lambda x, op=op, a=a, b=b: op(a(x), _mended(b(x)))
            for op in (
                torch.floor_divide,
                torch.remainder,
                torch.fmod,
                lambda p, q: torch.div(p, q, rounding_mode="trunc"),
            )
            for a in (lambda x: x.i.long(), lambda x: x.i.long() * x.j + x.i)
            for b in (lambda x: x.j.long(), lambda x: x.j.long() * 65539, lambda x: x.j.long() * x.i)
        ],
    ),
    Case(
        "div floor_divide remainder fmod",
        [
            *floats(lambda a, b: torch.div(a, _near(a, b), rounding_mode="floor")),
            *floats(lambda a, b: torch.div(a, b, rounding_mode="trunc")),
            *floats(lambda a, b: torch.floor_divide(a, _near(a, b))),
            *floats(lambda a, b: torch.remainder(a, _near(a, b))),
            *floats(lambda a, b: torch.fmod(a, _near(a, b))),
            *each(lambda x: x.clamp(-1e9, 1e9) % 0.1, "fdi"),
            *each(lambda x: x.clamp(-1e9, 1e9) // 0.1, "fdi"),
            *each(lambda x: torch.fmod(x.clamp(-1e9, 1e9), -0.3), "fd"),
            *each(lambda x: 2.5 % torch.where(x.abs() < 1e-9, 0.0, x), "fd"),
        ],
    ),
    Case("minimum", pairs(torch.minimum, *COMPARED)),
    Case("maximum", pairs(torch.maximum, *COMPARED)),
    Case(
        "clamp",
        [
            *each(lambda x: x.clamp(-0.5, 1.5), "fdi"),
            *each(lambda x: x.clamp(math.nan, 1.0), "fd"),
            *each(lambda x: x.clamp(1.5, -0.5), "fd"),
            *each(lambda x: x.clamp(-7, 31), "fdil"),
            *each(lambda x: x.clamp(3, 130), "u"),
            lambda x: torch.clamp(x.f, x.g, torch.tensor(1.0)),
            lambda x: torch.clamp(x.f, x.g, x.g + 1),
            lambda x: torch.clamp(x.i, x.j),
            lambda x: torch.clamp(x.i, max=x.j),
            lambda x: torch.clamp(x.d, x.f, None),
        ],
    ),
    Case(
        "clamp_min clamp_max",
        [
            *[lambda x, v=v: x.f.clamp_min(v) for v in (0.0, 1e-6, -math.inf, math.nan)],
            *[lambda x, v=v: x.d.clamp_max(v) for v in (1.0, 1e-6, math.inf, math.nan)],
            lambda x: x.i.clamp_min(3),
            lambda x: x.f.clamp_min(x.g),
            lambda x: x.d.clamp_max(x.e),
            lambda x: x.u.clamp_max(9),
        ],
    ),
    Case("clip", [lambda x: aten.clip(x.f, -1.0, 1.0), lambda x: aten.clip(x.i, None, 4)], inference=True),
    Case("relu", each(torch.relu, "fdilu")),
    *(Case(name, compared(getattr(torch, name))) for name in ("gt", "lt", "ge", "le", "eq", "ne")),
    Case(
        "where masked_fill",
        [
            *pairs(lambda a, b: torch.where(a > b, a, b), "fg", "de", "ij", "fe", "iu", "fi"),
            lambda x: torch.where(x.b, x.f, 0.1),
            lambda x: torch.where(x.b, 2, x.f),
            lambda x: torch.where(x.b, x.c, x.b ^ x.c),
            lambda x: torch.where(x.b, x.p, x.d),
            lambda x: torch.where(x.b, 1, 0),
            lambda x: x.f.masked_fill(x.b, math.inf),
            lambda x: x.i.masked_fill(x.b, 3),
            lambda x: x.p.masked_fill(x.b, torch.tensor(0.25)),
            lambda x: x.u.masked_fill(x.b, 255),
        ],
    ),
    Case(
        "bitwise_and bitwise_or bitwise_xor bitwise_not",
        [
            *pairs(torch.bitwise_and, "ij", "lm", "bc", "uv", "iu", "bi"),
            *pairs(torch.bitwise_or, "ij", "lm", "bc", "uv", "il"),
            *pairs(torch.bitwise_xor, "ij", "lm", "bc", "uv"),
            *each(torch.bitwise_not, "ilbu"),
            *each(lambda x: x & 0x55, "ilu"),
            *each(lambda x: 0x7FFFFFFF ^ x, "il"),
            *each(lambda x: x | 1, "ilu"),
            lambda x: (~x.u).int(),
            lambda x: x.i.long() & 0xFFFFFFFF,
            lambda x: ~(x.i.long() * x.j),
        ],
    ),
    Case(
        "logical_and logical_or logical_xor logical_not",
        [
            *pairs(torch.logical_and, "fg", "ij", "bc", "uv", "fi"),
            *pairs(torch.logical_or, "de", "ij", "bc", "uf"),
            *pairs(torch.logical_xor, "fg", "lm", "bc"),
            *each(torch.logical_not, "fdilbu"),
        ],
    ),
    Case(
        "logical_and_",
        [
            lambda x: (x.f > 0).logical_and_(x.g < 1),
            lambda x: torch.where((x.f > 0).logical_and_(x.g < 1), x.f, x.g),
        ],
    ),
    Case(
        "masked_fill_",
        [
            lambda x: (x.f * 2.0).masked_fill_(x.g < 1, 0.5),
            lambda x: (x.f * 2.0).masked_fill_(x.g < 1, 0.5) + x.g,
        ],
    ),
    Case(
        "__and__ __or__ __xor__",
        [
            lambda x: aten.__and__(x.i, x.j),
            lambda x: aten.__or__(x.b, x.c),
            lambda x: aten.__xor__(x.u, 255),
        ],
        inference=True,
    ),
    Case(
        "__lshift__ __rshift__ bitwise_left_shift bitwise_right_shift",
        [
            *[lambda x, n=n: x.i << n for n in (0, 1, 16, 31)],
            *[lambda x, n=n: x.i >> n for n in (0, 1, 16, 31)],
            *[lambda x, n=n: x.u << n for n in (1, 7)],
            *[lambda x, n=n: x.u >> n for n in (1, 7)],
            *[lambda x, n=n: (x.i.long() & 0xFFFFFFFF) >> n for n in (1, 16, 31, 32, 40)],
            *[lambda x, n=n: x.i.long() << n for n in (1, 31, 32, 40)],
            lambda x: x.l >> 40,
            lambda x: (x.u << 1).int(),
            lambda x: torch.bitwise_left_shift(x.i, x.j & 31),
            lambda x: torch.bitwise_right_shift(x.i, x.j & 31),
            lambda x: torch.bitwise_left_shift(x.i, x.j),
            lambda x: torch.bitwise_right_shift(x.i, x.j),
            lambda x: torch.bitwise_left_shift(x.u, x.v),
            lambda x: torch.bitwise_right_shift(x.u, x.v),
            lambda x: torch.bitwise_left_shift(x.i, 3),
            lambda x: aten.__lshift__(x.i, 3),
            lambda x: aten.__rshift__(x.i, x.j & 15),
        ],
    ),
    Case(
        "copysign", [*floats(torch.copysign), lambda x: torch.copysign(x.f, -0.0), lambda x: torch.copysign(x.i, x.f)]
    ),
    Case("neg", [*each(torch.neg, "fdilu"), lambda x: (-x.u).int()]),
    Case("abs", [*each(torch.abs, "fdilu"), lambda x: (x.i.long() * x.j).abs()]),
    Case("sign", each(torch.sign, "fdilub")),
    Case("sqrt", each(torch.sqrt, "fdiub"), 1),  # torch's is MKL's; see test_square_root
    Case("rsqrt", each(torch.rsqrt, "fdiub"), 1),
    Case("reciprocal", each(torch.reciprocal, "fdiub")),
    Case("square", each(aten.square, "fdil"), inference=True),
    Case(
        "floor ceil trunc round",
        [f for op in (torch.floor, torch.ceil, torch.trunc, torch.round) for f in each(op, "fdilu")],
    ),
    Case("isnan isinf", [f for op in (torch.isnan, torch.isinf, torch.isfinite) for f in each(op, "fdilu")]),
    Case("isfinite", each(aten.isfinite, "fdilu"), inference=True),
    *(
        function_of(name, 4)
        for name in "sin cos tan asin acos atan exp exp2 expm1 log log2 log10 log1p sinh cosh tanh sigmoid".split()
    ),
    Case(
        "atan2",
        [lambda x: torch.atan2(x.p, x.q), lambda x: torch.atan2(x.w, x.w.flip(0)), lambda x: torch.atan2(x.n, x.r)],
        4,
    ),
    Case(
        "softplus",
        [
            lambda x: nn.functional.softplus(x.p * 5),
            lambda x: nn.functional.softplus(x.w, beta=2.0, threshold=1.0),
            lambda x: nn.functional.softplus(x.f),
        ],
        8,
    ),
    Case(
        "pow",
        [
            lambda x: x.p.abs() ** x.q,
            lambda x: x.w.abs() ** 2.2,
            lambda x: 2.0**x.p,
            lambda x: x.p**3,
            lambda x: x.w**5,
            lambda x: x.p ** (-1),
            lambda x: x.p ** (-2),
            lambda x: x.p.abs() ** torch.tensor(2.5),
            lambda x: x.r.double() ** x.p,
            lambda x: x.n**x.r,
        ],
        8,
    ),
    Case(
        "pow",
        [
            *each(lambda x: x**2, "fdilu"),
            *each(lambda x: x**1, "fdi"),
            *each(lambda x: x**0, "fdil"),
            lambda x: (x.i.long() % 1000) ** 4,
            lambda x: x.i**3,
        ],
    ),
    Case("pow", each(lambda x: x**0.5, "fd"), 1),  # a square root
    Case(
        "pow",  # special values alone, whose powers are exact
        [lambda x: torch.where(torch.isfinite(x.f) & (x.f != 0) & (x.f.abs() != 1), 0.0, x.f) ** torch.round(x.g)],
    ),
    Case(
        "addcmul", [lambda x: torch.addcmul(x.p, x.q, x.r), lambda x: torch.addcmul(x.w, x.p, x.q, value=-1)], 0, 3e-7
    ),
    Case(
        "addcmul", [lambda x: torch.addcmul(x.i, x.j, x.i), lambda x: torch.addcmul(x.p, x.q, x.r, value=0.5)], 0, 3e-7
    ),
    Case("addcmul", [lambda x: torch.addcmul(x.i.long(), x.j.long(), x.i.long(), value=3)]),
    Case("lerp", [lambda x: torch.lerp(x.p, x.q, x.r), lambda x: torch.lerp(x.w, x.w + 1, 0.7)], 0, 5e-7),
    Case("lerp", [lambda x: torch.lerp(x.f, x.g, (x.r > 0.5).float())], 0, 1e-300),  # but for signs of zeros
    Case(
        "_to_copy",
        [
            *[
                lambda x, a=a, t=t: getattr(x, a).to(t)
                for a in "fdilbu"
                for t in (torch.float32, torch.float64, torch.bool)
            ],
            *[lambda x, a=a, t=t: getattr(x, a).to(t) for a in "ilbu" for t in (torch.int32, torch.int64, torch.uint8)],
            *[lambda x, a=a, t=t: (getattr(x, a) * 100).to(t) for a in "pw" for t in (torch.int32, torch.int64)],
            *[lambda x, a=a: (x.r * 255.99).to(torch.uint8) for a in "pw"],
            lambda x: (x.i.long() * x.j).to(torch.int32),
            lambda x: (x.i.long() * x.j).to(torch.uint8),
            lambda x: (x.i.long() * x.j).to(torch.float64),
            lambda x: (x.i.long() * x.j).to(torch.float32),
            lambda x: (x.i.long() * x.j).to(torch.bool),
        ],
    ),
    Case("to", [lambda x: aten.to(x.f, torch.float64), lambda x: aten.to(x.p, torch.int32)], inference=True),
    Case(
        "ones_like zeros_like full_like new_ones new_zeros new_full",
        [
            lambda x: torch.ones_like(x.f),
            lambda x: torch.zeros_like(x.p, dtype=torch.int64),
            lambda x: torch.full_like(x.w, 0.1),
            lambda x: torch.full_like(x.i, 3.0),
            lambda x: x.f.new_ones(x.p.shape),
            lambda x: x.d.new_zeros(2, *x.f.shape),
            lambda x: x.f.new_full(x.f.shape, math.nan),
            lambda x: torch.ones(x.f.shape) + x.f,
            lambda x: torch.full((3, *x.f.shape), 2.5) * x.p,
            lambda x: torch.zeros(x.f.shape, dtype=torch.bool) | x.b,
            lambda x: torch.arange(x.f.shape[0]),
            lambda x: torch.arange(x.f.shape[0], dtype=torch.float64) * x.d,
        ],
    ),
    Case(
        "amax amin",
        [
            *[lambda x, op=op, k=k: op(x.p, k) for op in (torch.amax, torch.amin) for k in (0, -2)],
            lambda x: torch.stack([x.f, x.g, x.f.abs()]).amax(0),
            lambda x: torch.stack([x.d, x.e]).amin(0, keepdim=True),
            lambda x: x.w.amax((0, 1)),
            lambda x: torch.stack([x.i, x.j]).amax(0),
            lambda x: torch.stack([x.b, x.c]).amax(0),
            lambda x: torch.stack([x.u, x.v]).amin(0),
        ],
    ),
    Case(
        "all any",
        [
            lambda x: torch.stack([x.b, x.c, x.f > 0]).all(0),
            lambda x: torch.stack([x.f, x.g]).any(0, keepdim=True),
            lambda x: torch.isfinite(x.w).all(0).all(0),
            lambda x: (x.w > 0).any((0, 1)),
            lambda x: torch.stack([x.i, x.j]).all(0),
            lambda x: torch.stack([x.u, x.v]).any(0),  # of bytes torch gives bytes
        ],
    ),
    Case(
        "sum prod mean cumsum",
        [
            lambda x: x.p.sum(0),
            lambda x: x.w.sum((0, 1)),
            lambda x: x.w.sum(-2, keepdim=True),
            lambda x: x.p.prod(0),
            lambda x: x.p.mean(0),
            lambda x: x.w.mean((0, 1), keepdim=True),
            lambda x: x.n.sum(0, dtype=torch.float32),
            lambda x: x.n.mean(0, dtype=torch.float64),
            lambda x: x.p.cumsum(0),
            lambda x: x.w.cumsum(-2),
            lambda x: x.p[:0].sum(0),
            lambda x: x.p.sum(0, dtype=torch.float64),
        ],
        4,
        1e-6,
    ),
    Case(
        "sum prod cumsum",
        [
            lambda x: torch.stack([x.i, x.j, x.i]).sum(0),
            lambda x: torch.stack([x.i, x.j]).prod(0),
            lambda x: torch.stack([x.i, x.j, x.j]).cumsum(0),
            lambda x: torch.stack([x.b, x.c]).sum(0),
            lambda x: torch.stack([x.u, x.v]).sum(0),
            lambda x: torch.stack([x.u, x.v, x.u]).prod(0),
            lambda x: torch.stack([x.b, x.c, x.b]).cumsum(0),
            lambda x: torch.stack([x.i, x.j]).sum(0, dtype=torch.int32),
            lambda x: x.n[:0].prod(0),
        ],
    ),
    Case(
        "detach alias clone lift_fresh",
        [
            lambda x: x.f.detach(),
            lambda x: aten.alias(x.p),
            lambda x: x.i.clone(),
            lambda x: aten.lift_fresh(x.b),
        ],
    ),
    Case("contiguous", [lambda x: aten.contiguous(x.p)], inference=True),
    Case(
        "select slice unbind split split_with_sizes unsqueeze squeeze stack cat",
        [
            lambda x: x.p[1],
            lambda x: x.w[-1, 0],
            lambda x: x.p[1:],
            lambda x: x.p[:-1],
            lambda x: x.p[::2],
            lambda x: x.w[:, -2:],
            lambda x: x.p[..., :],
            lambda x: torch.stack(x.p.unbind()[::-1]),
            lambda x: torch.cat(torch.split(x.p, 2)[::-1]),
            lambda x: torch.cat(torch.split(x.p, [1, 2])[::-1]),
            lambda x: torch.cat([x.f[None], x.p, x.d[None]]),
            lambda x: torch.stack([x.f, x.i, x.d], -2),
            lambda x: torch.stack([x.l, x.i.long() * x.j]),
            lambda x: x.f[:, None].squeeze(1),
            lambda x: x.f[None, None].squeeze(),
            lambda x: x.p[None].squeeze((0, 1)),
            lambda x: x.p.unsqueeze(-2).unsqueeze(0),
            lambda x: torch.cat([x.w, x.w], 1),
            lambda x: torch.stack([x.f, torch.tensor(0.25).expand_as(x.f)]),
        ],
    ),
    Case(
        "narrow chunk concat",
        [
            lambda x: aten.narrow(x.p, 0, 1, 2),
            lambda x: aten.narrow(x.w, -2, 2, 1),
            lambda x: aten.chunk(x.p, 2)[0],
            lambda x: aten.concat([x.p, x.q]),
        ],
        inference=True,
    ),
    Case(
        "permute t transpose flip roll expand view _unsafe_view",
        [
            lambda x: x.w.permute(1, 0, 2),
            lambda x: x.p.t().t(),
            lambda x: x.w.transpose(0, 1),
            lambda x: x.p.T.mT,
            lambda x: x.p.flip(0),
            lambda x: x.w.flip((0, -2)),
            lambda x: x.p.roll(1, 0),
            lambda x: x.w.roll((1, -1), (0, 1)),
            lambda x: x.f.expand(4, -1) + 0,
            lambda x: x.w.reshape(6, -1),
            lambda x: x.w.view(3, 2, x.f.shape[0]),
            lambda x: x.p.reshape(-1).reshape(3, -1),
            lambda x: aten._unsafe_view(x.w, [6, x.f.shape[0]]),
            lambda x: x.w.flatten(0, 1),
            lambda x: x.p.movedim(0, -1).movedim(-1, 0),
        ],
    ),
    Case(
        "reshape numpy_T",
        [lambda x: aten.reshape(x.w, [6, -1]), lambda x: aten.numpy_T(aten.numpy_T(x.p))],
        inference=True,
    ),
    Case(
        "index_select",
        [
            lambda x: torch.index_select(TABLE, 0, x.k),
            lambda x: torch.index_select(WIDE, 1, x.k),
            lambda x: torch.index_select(WHOLE, 0, x.k).T,
            lambda x: torch.index_select(MARKS, 0, x.k),
            lambda x: torch.index_select(BYTES, 0, x.k),
            lambda x: torch.index_select(TABLE, 0, x.k.int()),
            lambda x: torch.index_select(GRID, 0, x.n[0]).permute(1, 2, 3, 0),
            lambda x: torch.index_select(WIDE, 1, x.n.reshape(-1)).reshape(3, 2, -1),
            lambda x: torch.index_select(x.p, 1, torch.arange(x.f.shape[0])),
            lambda x: torch.index_select(TABLE * 2, 0, x.k),
        ],
    ),
    Case(
        "index",
        [
            lambda x: TABLE[x.k],
            lambda x: TABLE[x.n],
            lambda x: WIDE[:, x.k],
            lambda x: WIDE[:, x.n],
            lambda x: WHOLE[x.k].T,
            lambda x: GRID[x.n[0], x.n[1]].permute(1, 2, 0),
            lambda x: GRID[x.n[0], x.n[1], 1].T,
            lambda x: GRID[x.n[0], x.k % 7, x.n[1] % 2, x.k % 3],
            lambda x: GRID[0][x.n].permute(2, 3, 0, 1),
            lambda x: MARKS[x.k] & x.b,
        ],
    ),
    Case("take", [lambda x: torch.take(TABLE, x.k), lambda x: torch.take(WIDE, x.n), lambda x: torch.take(MARKS, x.k)]),
    Case(
        "gather",
        [
            lambda x: torch.gather(x.p, 0, x.n % 3),
            lambda x: torch.gather(x.w, 1, (x.n % 3)[:, None]),
            lambda x: torch.gather(x.p, 0, x.n[:1] % 3),
            lambda x: torch.gather(torch.stack([x.i, x.j]), 0, (x.n % 2)[:1]),
            lambda x: torch.gather(TABLE[:5, None].expand(-1, x.f.shape[0]), 0, x.n),
        ],
    ),
    Case(
        "searchsorted bucketize",
        [
            lambda x, table=table, right=right, op=op: op(table, x, right)
            for table in (SORTED.float(), SORTED[:2].float(), SORTED[:1].float(), SORTED[:0].float())
            for right in (False, True)
            for op in (
                lambda table, x, right: torch.searchsorted(table, x.p * 10, right=right),
                lambda table, x, right: torch.searchsorted(table, torch.round(x.f), right=right),
                lambda table, x, right: torch.searchsorted(table.double(), x.d, side="right" if right else "left"),
                lambda table, x, right: torch.searchsorted(table.long(), x.l, right=right, out_int32=True),
                lambda table, x, right: torch.searchsorted(table.int(), x.i, right=right),
                lambda table, x, right: torch.bucketize(x.f, table, right=right),
            )
        ],
    ),
    Case(
        "mm addmm",
        [
            lambda x: MATRIX @ x.p,
            lambda x: (x.p.T @ MATRIX.T).T,
            lambda x: torch.addmm(torch.ones(4, 1), MATRIX, x.p),
            lambda x: nn.functional.linear(x.p.T, MATRIX, torch.arange(4.0)).T,
            lambda x: torch.mm(MATRIX[:, :0], x.p[:0]),
        ],
        0,
        2e-6,
    ),
    Case("mm", [lambda x: torch.mm(torch.tensor([[1, -3], [2, 65537]]), x.n.int().long() + x.i.long())]),
    Case("matmul", [lambda x: aten.matmul(MATRIX, x.p)], 0, 2e-6, inference=True),
]


def _ordered(x: Tensor) -> Tensor:
    """Floats by their place in the order of all floats."""
    bits = x.view(torch.int32 if x.dtype == torch.float32 else torch.int64).long()
    low = torch.tensor(-(1 << 31) if x.dtype == torch.float32 else -(1 << 63))
    return torch.where(bits < 0, low - bits, bits)


def compare(found: Tensor, wanted: Tensor, ulps: float = 0, near: float = 0.0, what: str = "") -> None:
    """See :class:`Case`."""
    assert found.dtype == wanted.dtype and found.shape == wanted.shape, what
    if not wanted.dtype.is_floating_point:
        wrong = found != wanted
    else:
        nan = torch.isnan(wanted)
        away = (_ordered(found) - _ordered(wanted)).abs()
        wrong = away > ulps
        if ulps == near == 0:
            wrong |= torch.signbit(found) != torch.signbit(wanted)
        elif near:
            wrong &= ~((found - wanted).abs() <= near * wanted.abs().clamp_min(1.0))
        wrong = (wrong & ~nan) | (torch.isnan(found) != nan)
    if wrong.any():
        first = tuple(torch.nonzero(wrong)[0].tolist())
        raise AssertionError(
            f"{what}: {int(wrong.sum())} of {wrong.numel()} differ; at {first} {found[first]!r}, torch {wanted[first]!r}, "
            f"lane {[(name, x[..., first[-1]].tolist()) for name, x in INPUTS.items() if x.dim() == 1]}"
        )


def _namespace(arguments: Sequence[Tensor]) -> Any:
    return SimpleNamespace(**dict(zip(NAMES, arguments, strict=True)))


@pytest.mark.parametrize("number", range(len(CASES)), ids=lambda k: CASES[k].operators.replace(" ", "+"))
def test_operators(number, monkeypatch):
    case = CASES[number]
    called: set[str] = set()
    for name in case.operators.split():
        monkeypatch.setitem(LOWERINGS, name, _noted(name, called))

    def function(*arguments: Tensor) -> list[Tensor]:
        return [form(_namespace(arguments)) for form in case.forms]

    with torch.inference_mode(case.inference), torch.no_grad():
        wanted = function(*INPUTS.values())
        kernel = compile_lanewise(function, list(INPUTS.values()))
    assert called == set(case.operators.split())
    for n in LENGTHS:
        found = kernel(*(x[..., :n] for x in INPUTS.values()))
        for k, (a, b) in enumerate(zip(found, wanted, strict=True)):
            if n == N or b.shape[-1] == N:
                compare(a, b[..., :n], case.ulps, case.near, f"{case.operators}, form {k}, {n} lanes")


@pytest.mark.parametrize("number", few(range(len(CASES)), 40), ids=lambda k: CASES[k].operators.replace(" ", "+"))
def test_one_lane_at_a_time(number):
    """The same bits at any width, of ordinary numbers and extreme ones; sums of products among them."""
    case = CASES[number]

    def function(*arguments: Tensor) -> list[Tensor]:
        x = _namespace(arguments)
        found = [form(x) for form in case.forms]
        # Results behind and before sums, where a product may be rounded with one.
        real = [y for y in found if y.dtype.is_floating_point and y.shape[-1] == x.f.shape[0]]
        return [*found, *(y * x.f + x.g for y in real), *(x.f - y * y * 0.3 for y in real)]

    with torch.inference_mode(case.inference), torch.no_grad():
        given = list(INPUTS.values())
        vectors, single = (compile_lanewise(function, given, target)(*given) for target in (None, one_lane()))
    for k, (a, b) in enumerate(zip(vectors, single, strict=True)):
        assert not differing(a, b).any(), f"{case.operators}, result {k}"


def _noted(name: str, called: set[str]) -> Any:
    handler = LOWERINGS[name]

    def noted(*args: Any, **kwargs: Any) -> None:
        called.add(name)
        handler(*args, **kwargs)

    return noted


def test_square_root_is_rounded_once():
    x = INPUTS["f"].abs()
    found, inverse = compile_lanewise(lambda x: [torch.sqrt(x), torch.rsqrt(x)], [x])(x)
    wanted = torch.from_numpy(np.sqrt(x.numpy()))
    compare(found, wanted)
    compare(inverse, 1.0 / wanted)


def test_every_operator_has_a_case():
    covered = {name for case in CASES for name in case.operators.split()}
    assert covered == set(LOWERINGS)
