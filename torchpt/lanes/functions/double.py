"""Sums and products of float64 with what rounding took from them (Dekker 1971). No flag allows to contract them."""

from __future__ import annotations

from torchpt.lanes.block import Block

__all__ = ["double_product", "once", "plain", "two_product", "two_sum"]


def plain(b: Block, op: str, x: str, y: str) -> str:
    """One operation on float64 that is never contracted."""
    return b.op(f"{op} {b.vector('d')} {x}, {y}")


def once(b: Block, x: str, y: str, z: str) -> str:
    """``x y + z`` rounded once on every machine."""
    return b.call("llvm.fma", "d", x, y, z)


def two_sum(b: Block, x: str, y: str) -> tuple[str, str]:
    """A sum and its rounding error, where ``x`` is the larger, or 0."""
    s = plain(b, "fadd", x, y)
    return s, plain(b, "fsub", y, plain(b, "fsub", s, x))


def two_product(b: Block, x: str, y: str) -> tuple[str, str]:
    """A product and its rounding error."""
    p = plain(b, "fmul", x, y)
    return p, once(b, x, y, b.negative("d", p))


def double_product(b: Block, x: tuple[str, str], y: tuple[str, str]) -> tuple[str, str]:
    """The product of two sums of two."""
    p, rest = two_product(b, x[0], y[0])
    rest = once(b, x[0], y[1], once(b, x[1], y[0], rest))
    return two_sum(b, p, rest)
