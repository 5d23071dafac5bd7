"""Helpers of the elementary functions; the type ``ty`` is "f" (float32) or "d" (float64)."""

from __future__ import annotations

from torchpt.compiler.block import Block

__all__ = ["absolute", "clamped", "narrow", "negative", "wide"]


def wide(b: Block, ty: str, x: str) -> str:
    """Convert either type to float64."""
    return b.convert("fpext", "f", "d", x) if ty == "f" else x


def narrow(b: Block, ty: str, x: str) -> str:
    """Convert float64 to type ``ty``."""
    return b.convert("fptrunc", "d", "f", x) if ty == "f" else x


def absolute(b: Block, ty: str, x: str) -> str:
    """Compute ``|x|``."""
    return b.call("llvm.fabs", ty, x)


def clamped(b: Block, ty: str, x: str, low: float, high: float) -> str:
    """Clamp to limits, beyond which the caller's result is 0 or infinite; NaN stays."""
    return b.extreme("max", ty, b.extreme("min", ty, x, b.constant(ty, high)), b.constant(ty, low))


def negative(b: Block, ty: str, x: str) -> str:
    """Return the mask of the lanes whose sign bit is set, -0 included."""
    integer_type = "i" if ty == "f" else "L"
    return b.compare("slt", integer_type, b.convert("bitcast", ty, integer_type, x), "zeroinitializer")
