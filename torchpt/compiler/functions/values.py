"""Small steps that the elementary functions share; a type is "f" or "d"."""

from __future__ import annotations

from torchpt.compiler.block import Block

__all__ = ["absolute", "clamped", "narrow", "negative", "wide"]


def wide(b: Block, ty: str, x: str) -> str:
    """A number of either type as float64."""
    return b.convert("fpext", "f", "d", x) if ty == "f" else x


def narrow(b: Block, ty: str, x: str) -> str:
    """A float64 as a number of the type."""
    return b.convert("fptrunc", "d", "f", x) if ty == "f" else x


def absolute(b: Block, ty: str, x: str) -> str:
    """``|x|``."""
    return b.call("llvm.fabs", ty, x)


def clamped(b: Block, ty: str, x: str, low: float, high: float) -> str:
    """Within limits beyond which the result is 0 or infinite; NaN stays."""
    return b.extreme("max", ty, b.extreme("min", ty, x, b.constant(ty, high)), b.constant(ty, low))


def negative(b: Block, ty: str, x: str) -> str:
    """Whether the sign bit is set."""
    integer_type = "i" if ty == "f" else "L"
    return b.compare("slt", integer_type, b.convert("bitcast", ty, integer_type, x), "zeroinitializer")
