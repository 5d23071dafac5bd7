"""Elementary functions as LLVM IR, without branches and calls: argument reduction and a polynomial.

The polynomials are those of Moshier's Cephes library (*Methods and Programs for Mathematical Functions*, 1989) unless
stated otherwise. ``tests/compiler/test_functions.py`` bounds the error of each in units of the last place (ulp).
"""

from __future__ import annotations

from collections.abc import Callable

from torchpt.compiler.functions.exponential import cosh, exp, exp2, expm1, sigmoid, sinh, tanh
from torchpt.compiler.functions.logarithm import log, log1p, log_by
from torchpt.compiler.functions.power import power
from torchpt.compiler.functions.trigonometric import acos, asin, atan, atan2, tan, trigonometric

__all__ = ["FUNCTIONS"]

#: Functions of one or two values: ``function(block, type, *arguments)``.
FUNCTIONS: dict[str, Callable[..., str]] = {
    "sin": trigonometric(0),
    "cos": trigonometric(1),
    "tan": tan,
    "asin": asin,
    "acos": acos,
    "atan": atan,
    "atan2": atan2,
    "exp": exp,
    "exp2": exp2,
    "expm1": expm1,
    "log": log,
    "log2": log_by(1.4426950408889634, 2.0355273740931033e-17),
    "log10": log_by(0.4342944819032518, 1.098319650216765e-17),
    "log1p": log1p,
    "pow": power,
    "sinh": sinh,
    "cosh": cosh,
    "tanh": tanh,
    "sigmoid": sigmoid,
}
