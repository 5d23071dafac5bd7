"""The state of a render on disk, so that one that was killed goes on where it was.

A checkpoint holds the films between two passes and what decides what comes next. Samples are functions of their numbers, so the
finished picture has the bits of one that nobody killed. The file is an ``.npz`` archive of numbers and one JSON text, of which
nothing is executed; it is written beside its place and moved there, so there is always a whole one.
"""

from __future__ import annotations

import json
import os
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt import __version__
from torchpt.core.tree import fingerprint
from torchpt.errors import AssetError, OutputError
from torchpt.files import check_regular
from torchpt.forward.archive import read_arrays
from torchpt.images.write import check_writable, place_of, reason_of, temporary_beside
from torchpt.integrators.lost import Lost
from torchpt.scene.fingerprint import fingerprints
from torchpt.scene.scene import Scene
from torchpt.settings import Settings, having
from torchpt.spec import Role

__all__ = ["EVERY", "FREE", "Keeper", "State", "identity"]

#: Seconds between two checkpoints, at least; and at least so many times as long as it takes to write one.
EVERY, PATIENCE = 5.0, 20.0
#: Settings that may differ between a checkpoint and the render that goes on from it: no sample depends on them.
FREE = having(Role.FREE)
#: Name of the JSON text among the arrays.
_FACTS = "facts"
_FORMAT = 3


@dataclass
class State:
    """Of a render between two passes.

    Attributes:
        facts: plain values.
        arrays: numbers by name.
    """

    facts: dict[str, Any]
    arrays: dict[str, Tensor]


def identity(
    scene: Scene, settings: Settings, params: Mapping[str, Tensor] | None, dtype: torch.dtype
) -> dict[str, Any]:
    """Return what a render is of: where two have the same, one goes on from the other's checkpoint."""
    return {
        "torchpt": __version__,
        "scene": fingerprints(scene),
        "params": {name: fingerprint(value).hex() for name, value in (params or {}).items()},
        "dtype": str(dtype).removeprefix("torch."),
        "device": scene.device.type,
        **({"integrator_code": fingerprint(settings.integrator).hex()} if settings.integrator.foreign else {}),
        **json.loads(json.dumps(settings.plain(FREE))),
    }


class Keeper:
    """Writes and reads the checkpoints of one render.

    Args:
        path: of the file.
        of: the render's :func:`identity`; None where its place is only checked.

    Attributes:
        seconds: spent on writing.
    """

    def __init__(self, path: str, of: Mapping[str, Any] | None = None) -> None:
        self.path, self.seconds = Path(path).expanduser(), 0.0
        self._of = dict(of or {})
        self._last, self._took = time.perf_counter(), 0.0

    def check(self, resume: bool) -> None:
        """Find out before a long render whether there is a place for its checkpoints.

        Raises:
            OutputError: there is none, or a file is there that nobody wishes to go on from.
        """
        check_writable(self.path, (self.path.suffix.lower(),))
        if not resume and self.path.exists():
            raise OutputError(self.path, "is there already; render.resume=true goes on from it, or remove it first")

    def due(self) -> bool:
        """Return True where it is time for another."""
        return time.perf_counter() - self._last >= max(EVERY, PATIENCE * self._took)

    def write(self, state: State) -> None:
        """Replace the checkpoint.

        Raises:
            OutputError: it cannot be written; the one that was there is still whole.
        """
        begun = time.perf_counter()
        try:
            self._write(state)
        finally:
            self._last = time.perf_counter()
            self._took = self._last - begun
            self.seconds += self._took

    def _write(self, state: State) -> None:
        destination = place_of(self.path, (self.path.suffix.lower(),))
        temporary = temporary_beside(destination)
        text = json.dumps({"format": _FORMAT, "of": self._of, **state.facts})
        arrays = {name: value.detach().cpu().numpy() for name, value in state.arrays.items()}
        try:
            with open(temporary, "xb") as file:
                np.savez(file, allow_pickle=False, **{_FACTS: np.frombuffer(text.encode(), np.uint8), **arrays})
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, destination)
        except (OSError, ValueError) as problem:
            raise OutputError(self.path, reason_of(problem, destination)) from None
        finally:
            with suppress(OSError):  # it is only there after a failure
                temporary.unlink()

    def read(self, like: State, check: Callable[[State], None] | None = None) -> State | None:
        """Return the checkpoint, with ``render.spp`` as it was among its facts; None where there is none.

        Args:
            like: a state of this render: facts and arrays of the same names, kinds and sizes are there, or it is refused.
            check: looks at the facts before the arrays, and may refuse them.

        Raises:
            AssetError: a file that is no whole checkpoint, or one of another render.
        """
        if not self.path.exists():
            return None
        try:
            check_regular(self.path)
            with open(self.path, "rb") as file:
                arrays = read_arrays(file)
            facts = json.loads(arrays.pop(_FACTS).tobytes())
            if facts["format"] != _FORMAT or not isinstance(facts["of"], dict):
                raise ValueError("another format")
            facts["spp"] = facts["of"]["render"].pop("spp")
            if type(facts["spp"]) is not int or not 1 <= facts["spp"] < 2**62:
                raise ValueError("spp")
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            EOFError,
            RecursionError,
            RuntimeError,
            zipfile.BadZipFile,
        ) as problem:
            raise AssetError(self.path, f"is no whole checkpoint ({_said(problem)})") from None
        of = {**self._of, "render": {name: value for name, value in self._of["render"].items() if name != "spp"}}
        for key, there, here in _differences(facts.pop("of"), of):
            said = f"its {key} are others" if key.startswith("scene.") else f"{key}: {there} there, {here} here"
            raise AssetError(self.path, f"is the checkpoint of another render ({said})")
        state = State(facts, {name: torch.from_numpy(value) for name, value in arrays.items()})
        _check_facts(state, like, self.path)
        if check is not None:
            check(state)
        _check_arrays(state, like, self.path)
        return state


def _check_facts(state: State, like: State, path: Path) -> None:
    """Refuse facts of other kinds."""
    for name, value in like.facts.items():
        there: Any = state.facts.get(name)
        if name == "lost":
            try:
                Lost.read(there)
            except ValueError as problem:
                raise AssetError(path, f"is no whole checkpoint ({problem})") from None
            continue
        kind = isinstance(there, int | type(value)) and not isinstance(there, bool)
        if not kind or not 0 <= there < 2**62:
            raise AssetError(path, f"is no whole checkpoint ({name} is {str(there)[:40]})")


def _check_arrays(state: State, like: State, path: Path) -> None:
    """Refuse arrays that the render could not hold."""
    for name, value in like.arrays.items():
        found = state.arrays.get(name)
        if found is None or found.shape != value.shape or found.dtype != value.dtype:
            raise AssetError(path, f"is no whole checkpoint (the numbers {name} are missing, or others)")


def _said(problem: Exception) -> str:
    return str(problem).split("\n", 1)[0] or type(problem).__name__


def _differences(a: Any, b: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Return where two nests of plain values differ: dotted key, and both values in JSON."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in dict.fromkeys((*a, *b)):
            yield from _differences(a.get(name), b.get(name), f"{key}.{name}" if key else name)
    elif a != b:
        yield key, json.dumps(a), json.dumps(b)
