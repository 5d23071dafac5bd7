"""Numbers as a reader wants them."""

from __future__ import annotations

import math

from torchpt.reports.statistics import Estimate

__all__ = ["count", "interval", "number", "seconds", "span", "times"]


def number(value: float | None, digits: int = 3) -> str:
    """With so many digits that count; small and large ones by powers of ten."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value and not 1e-4 <= abs(value) < 1e6:
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        return f"{mantissa} × 10{_raised(int(exponent))}".replace("-", "−")
    text = f"{value:.{digits}g}"
    if "e" in text:
        text = f"{float(text):.0f}"
    return text.replace("-", "−")


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def seconds(value: float | None) -> str:
    """A duration."""
    if value is None:
        return "–"
    if value < 1:
        return f"{number(value * 1e3)} ms"
    if value < 120:
        return f"{number(value)} s"
    if value < 7200:
        return f"{value / 60:.3g} min"
    return f"{value / 3600:.3g} h" if value < 1e6 else f"{number(value / 3600)} h"


def times(value: float) -> str:
    """A ratio."""
    return f"{number(value)} ×"


def count(value: int) -> str:
    """A whole number in groups of three."""
    return f"{value:,}".replace(",", " ")


def interval(found: Estimate) -> str:
    """The bounds of an estimate; empty where there are none."""
    return "" if found.low is None or found.high is None else f"{number(found.low)} … {number(found.high)}"


def span(low: float | None, high: float | None) -> str:
    """Two durations in one unit; empty where they are not known."""
    if low is None or high is None:
        return ""
    unit, name = (1e-3, "ms") if high < 1 else (1.0, "s")
    return f"{number(low / unit)} … {number(high / unit)} {name}"
