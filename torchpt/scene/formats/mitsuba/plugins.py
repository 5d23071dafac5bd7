"""Entries of the tables of plugins: what becomes of a plugin, how near that is, and the function that does it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer
    from torchpt.scene.formats.mitsuba.properties import Properties

__all__ = ["Build", "Plugin", "Twin", "exact", "left_out", "nearest"]

#: Turns the properties of a plugin into the description of its twin; None: nothing.
Build = Callable[["Properties", "Importer"], Any]


class Twin(Enum):
    """How near the twin of a plugin is."""

    EXACT = "exact"
    NEAREST = "nearest"
    LEFT_OUT = "left out"


@dataclass(frozen=True)
class Plugin:
    """An entry of a table of plugins.

    Attributes:
        twin: how near its twin is; for all but exact ones an import warns.
        becomes: the type that it becomes here, or "nothing".
        build: makes the twin.
        note: what differs; for exact twins in the docs only.
    """

    twin: Twin
    becomes: str
    build: Build
    note: str = ""


def exact(becomes: str, build: Build, note: str = "") -> Plugin:
    """Return the entry of a plugin that has an exact twin."""
    return Plugin(Twin.EXACT, becomes, build, note)


def nearest(becomes: str, build: Build, note: str) -> Plugin:
    """Return the entry of a plugin of which only the nearest twin is taken."""
    return Plugin(Twin.NEAREST, becomes, build, note)


def left_out(note: str) -> Plugin:
    """Return the entry of a plugin in whose place there is nothing."""
    return Plugin(Twin.LEFT_OUT, "nothing", lambda _properties, _importer: None, note)
