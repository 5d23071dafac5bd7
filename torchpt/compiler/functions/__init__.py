"""Elementary functions as LLVM IR, without branches and calls: argument reduction and a polynomial.

The polynomials and their coefficients are those of Moshier's Cephes library (*Methods and Programs for Mathematical Functions*,
1989) unless stated otherwise, and so are the parts of ln 2 and pi / 2 by which arguments are reduced.
``tests/compiler/test_functions.py`` bounds the error of each in units of the last place (ulp).

In all files here ``b`` is the :class:`~torchpt.compiler.block.Block` to which instructions are appended, ``ty`` the type, ``f``
(float32) or ``d`` (float64), and other arguments and results are registers of LLVM that hold values.
"""

from __future__ import annotations

from collections.abc import Callable

from torchpt.compiler.functions.exponential import cosh, exp, exp2, expm1, sigmoid, sinh, tanh
from torchpt.compiler.functions.logarithm import log, log1p, log_by
from torchpt.compiler.functions.power import power
from torchpt.compiler.functions.trigonometric import acos, asin, atan, atan2, tan, trigonometric

__all__ = ["FUNCTIONS"]

#: Functions of one or two values: ``function(block, type, *arguments)`` adds instructions to a block and returns the result.
FUNCTIONS: dict[str, Callable[..., str]] = {
    "sin": trigonometric(shift=0),
    "cos": trigonometric(shift=1),  # the sine a quarter of a turn further
    "tan": tan,
    "asin": asin,
    "acos": acos,
    "atan": atan,
    "atan2": atan2,
    "exp": exp,
    "exp2": exp2,
    "expm1": expm1,
    "log": log,
    # 1 / ln 2 and 1 / ln 10, each as a double and the rest that it leaves out.
    "log2": log_by(factor=1.4426950408889634, rest=2.0355273740931033e-17),
    "log10": log_by(factor=0.4342944819032518, rest=1.098319650216765e-17),
    "log1p": log1p,
    "pow": power,
    "sinh": sinh,
    "cosh": cosh,
    "tanh": tanh,
    "sigmoid": sigmoid,
}
