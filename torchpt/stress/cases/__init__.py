"""The cases by topic: each module is a topic and has a tuple ``CASES``; names that begin with ``_`` are no topics."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from torchpt.stress.case import Case

__all__ = ["all_cases"]


def all_cases() -> dict[str, tuple[Case, ...]]:
    """Return the cases of all topics."""
    names = sorted(module.name for module in iter_modules(__path__) if not module.name.startswith("_"))
    return {name: import_module(f"{__name__}.{name}").CASES for name in names}
