"""Double-double arithmetic: sums and products of float64 with their rounding errors (Dekker 1971).

A double-double number is a pair of float64 whose sum it is: the rounded number, and the rest that rounding leaves out.
"""

from __future__ import annotations

from torchpt.compiler.block import Block

__all__ = ["double_product", "two_product", "two_sum"]


def two_sum(b: Block, x: str, y: str) -> tuple[str, str]:
    """Return a sum and its rounding error; ``x`` must be the larger in magnitude, or 0."""
    s = b.add("d", x, y)
    return s, b.sub("d", y, b.sub("d", s, x))


def two_product(b: Block, x: str, y: str) -> tuple[str, str]:
    """Return a product and its rounding error."""
    p = b.mul("d", x, y)
    return p, b.fma("d", x, y, b.negative("d", p))


def double_product(b: Block, x: tuple[str, str], y: tuple[str, str]) -> tuple[str, str]:
    """Multiply two double-double numbers."""
    (x_high, x_low), (y_high, y_low) = x, y
    p, rest = two_product(b, x_high, y_high)
    rest = b.fma("d", x_high, y_low, b.fma("d", x_low, y_high, rest))
    return two_sum(b, p, rest)
