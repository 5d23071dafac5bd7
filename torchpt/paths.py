"""Where the files lie that ship with torchpt: `configs/` and `scenes/`, in an installed wheel or in a checkout."""

from __future__ import annotations

from pathlib import Path

__all__ = ["configs", "scenes"]

_PACKAGE = Path(__file__).resolve().parent


def _shipped(name: str) -> Path:
    installed = _PACKAGE / "share" / name
    return installed if installed.is_dir() else _PACKAGE.parent / name


def configs() -> Path:
    """The folder with the config groups (`scene/`, ...)."""
    return _shipped("configs")


def scenes() -> Path:
    """The folder with the assets that the project made itself."""
    return _shipped("scenes")
