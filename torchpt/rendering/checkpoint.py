"""Checkpoints: films and counts in one file, what may go on from which, and checks of what was read."""

from __future__ import annotations

import ast
import json
import os
import struct
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import AssetError, OutputError
from torchpt.core.files import check_regular
from torchpt.core.tree import fingerprint
from torchpt.core.version import __version__
from torchpt.images.write import check_writable, output_path, temporary_beside, write_error
from torchpt.paths.nonfinite import NonFinite, SampleId
from torchpt.rendering.error import FIRST_ROUND
from torchpt.rendering.stopping import BLOCK, StopRules
from torchpt.scene.fingerprint import fingerprints
from torchpt.scene.scene import Scene
from torchpt.scene.settings import Settings, settings_with
from torchpt.spec import Role

if TYPE_CHECKING:
    from torchpt.rendering.run import Run

__all__ = [
    "EVERY",
    "FREE",
    "CheckpointFile",
    "RenderState",
    "check_plausible",
    "check_samples",
    "ends_a_pass",
    "identity",
    "read_arrays",
]


# ---- Arrays out of an ``.npz`` archive that may be anybody's: numbers only, none larger than the bytes that are there


_MAGIC = b"\x93NUMPY"


def read_arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    """The arrays by name, as ``numpy.savez`` wrote them.

    NumPy's own reader trusts a header that declares any size, and runs a tokenizer over one that is malformed.

    Raises:
        ValueError: no such archive, a member that is compressed (it could unfold to anything) or no array of numbers.
        zipfile.BadZipFile: a damaged one.
    """
    found: dict[str, np.ndarray] = {}
    whole = file.seek(0, 2)
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if sum(member.compress_size for member in members) > whole:
            raise ValueError("its members overlap")
        for member in members:
            name = member.filename
            if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
                raise ValueError(f"{name[:80]!r} is compressed or encrypted")
            if member.file_size != member.compress_size:
                raise ValueError(f"{name[:80]!r} has two sizes")
            if not name.endswith(".npy"):
                raise ValueError(f"{name[:80]!r} is no array")
            try:
                found[name.removesuffix(".npy")] = _array(archive.read(member))
            except (ValueError, SyntaxError, MemoryError, RecursionError, LookupError, TypeError, struct.error):
                raise ValueError(f"{name[:80]!r} is no array of numbers") from None
    return found


def _array(data: bytes) -> np.ndarray:
    """An array from the bytes of a ``.npy`` file (NumPy enhancement proposal 1)."""
    if not data.startswith(_MAGIC):
        raise ValueError("no array")
    size, start = (
        (struct.unpack_from("<H", data, 8)[0], 10) if data[6] == 1 else (struct.unpack_from("<I", data, 8)[0], 12)
    )
    if size > 10_000:
        raise ValueError("a header that long")
    header = ast.literal_eval(data[start : start + size].decode("latin-1").strip())
    kind, shape = np.dtype(header["descr"]), header["shape"]
    if kind.kind not in "biuf" or not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("no numbers")
    values = np.frombuffer(data, kind, offset=start + size).reshape(
        shape, order="F" if header["fortran_order"] else "C"
    )
    return np.array(values, kind.newbyteorder("="), order="C")


# ---- The state of a render on disk, so that one that was killed goes on where it was
#
# A checkpoint holds the films between two passes and what decides what comes next. Samples are functions of their numbers, so
# the finished picture has the bits of one that nobody killed. The file is an ``.npz`` archive of numbers and one JSON text, of
# which nothing is executed; it is written beside its place and moved there, so there is always a whole one.


#: Seconds between two checkpoints, at least; and at least so many times as long as it takes to write one.
EVERY, PATIENCE = 5.0, 20.0
#: Settings that may differ between a checkpoint and the render that goes on from it: no sample depends on them.
FREE = settings_with(Role.FREE)
#: Name of the JSON text among the arrays.
_FACTS = "facts"
_FORMAT = 3


@dataclass
class RenderState:
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


class CheckpointFile:
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

    def write(self, state: RenderState) -> None:
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

    def _write(self, state: RenderState) -> None:
        destination = output_path(self.path, (self.path.suffix.lower(),))
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
            raise OutputError(self.path, write_error(problem, destination)) from None
        finally:
            with suppress(OSError):  # it is only there after a failure
                temporary.unlink()

    def read(self, like: RenderState, check: Callable[[RenderState], None] | None = None) -> RenderState | None:
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
        state = RenderState(facts, {name: torch.from_numpy(value) for name, value in arrays.items()})
        _check_facts(state, like, self.path)
        if check is not None:
            check(state)
        _check_arrays(state, like, self.path)
        return state


def _check_facts(state: RenderState, like: RenderState, path: Path) -> None:
    """Refuse facts of other kinds."""
    for name, value in like.facts.items():
        there: Any = state.facts.get(name)
        if name == "lost":
            try:
                NonFinite.read(there)
            except ValueError as problem:
                raise AssetError(path, f"is no whole checkpoint ({problem})") from None
            continue
        kind = isinstance(there, int | type(value)) and not isinstance(there, bool)
        if not kind or not 0 <= there < 2**62:
            raise AssetError(path, f"is no whole checkpoint ({name} is {str(there)[:40]})")


def _check_arrays(state: RenderState, like: RenderState, path: Path) -> None:
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


# ---- What a checkpoint has to hold for a render to go on from it, and when that render may take more samples than it was of


def check_samples(run: Run, state: RenderState, path: Path) -> None:
    """Refuse a checkpoint of another ``render.spp`` where the picture would not have the bits of one that is taken at once.

    Raises:
        AssetError: says why.
    """
    settings, there, taken = run.settings, state.facts["spp"], state.facts["taken"]
    here, reason = settings.render.spp, ""
    if here == there:
        return
    before = replace(settings, render=settings.render.but(spp=there))
    if settings.sampler.kind.needs_count:
        reason = f"where {settings.sampler.name} points lie depends on how many there are"
    elif before.streams != settings.streams:
        reason = f"the variance is of {before.streams} streams there, of {settings.streams} here"
    elif taken > here:
        reason = f"it holds {taken} samples a pixel already"
    elif settings.adaptive and taken >= FIRST_ROUND and (here < there or state.facts["cut"]):
        reason = "a round of adaptive sampling was as long as spp let it be"
    elif settings.render.target_error is not None and not ends_a_pass(run, taken):
        reason = f"with render.target_error no pass ends at {taken} samples"
    if reason:
        raise AssetError(
            path, f"is the checkpoint of another render (render.spp: {there} there, {here} here; {reason})"
        )


def ends_a_pass(run: Run, taken: int) -> bool:
    """Return True if a render that ends by its error, and is not short of time, asks for that at so many samples."""
    stop = StopRules(run.settings.render.but(spp=taken + BLOCK, time_limit=None), run.picture.streams.count)
    end = taken - taken % (4 * BLOCK)  # from there on passes are whole blocks
    while end < taken:
        end += stop.step(end)
    return end == taken


def check_plausible(run: Run, state: RenderState, path: Path) -> None:
    """Refuse numbers that no render of these settings comes to.

    Sums may be negative: those of signed filters are. Layers may hold what is not finite, as models of a user's own may.

    Raises:
        AssetError: names the first one.
    """
    facts, arrays = state.facts, state.arrays
    taken, done, lost = facts["taken"], facts["done"], NonFinite.read(facts["lost"])
    counts = {name: arrays[f"{name}.counts"] for name in run.films()}
    rounds = run.settings.adaptive and taken >= FIRST_ROUND
    problems: dict[str, bool] = {
        "taken": not (taken <= facts["spp"] and (taken == FIRST_ROUND or not rounds)),
        "cut": facts["cut"] > 1,
        "light": not _finite([arrays["light"]]),
    }
    for name, film in run.films().items():
        light = not name.startswith("layers.")
        samples = taken if run.integrator.light or not light else 0
        least = torch.tensor([len(range(k, samples, film.randomizations)) for k in range(film.randomizations)])[:, None]
        problems[f"{name}.counts"] = bool((counts[name] < least).any() if rounds else (counts[name] != least).any())
        problems[f"{name}.sums"] = light and not _finite(arrays[f"{name}.{key}"] for key in ("sums", "first"))
    seen = counts["picture"] if run.integrator.light else next(iter(c for n, c in counts.items() if n != "picture"))
    total = int(seen.sum())
    if rounds:
        assert run.probes is not None and run.probes.pixel_set.places is not None
        pilots = seen.sum(0)[run.probes.pixel_set.places.cpu()]
        problems["pilots.counts"] |= bool((counts["pilots"].sum(0) != pilots).any())
        for name in run.picture.layers:
            problems[f"layers.{name}.counts"] |= bool((counts[f"layers.{name}"].sum(0) != seen.sum(0)).any())
        problems["picture.counts"] |= total > (facts["spp"] + BLOCK) * seen.shape[1]
    if run.probes is not None:
        total += int(counts["pilots"].sum())
    problems["done"] = done != total
    problems["truncated"] = facts["truncated"] > done
    problems["lost"] = lost.count > done or not all(_is_taken(run, place, int(seen.max())) for place in lost.places)
    for name, wrong in problems.items():
        if wrong:
            raise AssetError(path, f"is no whole checkpoint (no render comes to its {name})")


def _finite(values: Iterable[Tensor]) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in values)


def _is_taken(run: Run, place: SampleId, samples: int) -> bool:
    """Return True for a sample that a plate of the render takes."""
    x, y, width, height = run.wave.crop
    pixel_sets = [run.picture] if run.probes is None else [run.picture, run.probes.pixel_set]
    inside = x <= place.x < x + width and y <= place.y < y + height and place.sample < samples
    return inside and (place.first, place.streams) in [
        (pixel_set.streams.first, pixel_set.streams.count) for pixel_set in pixel_sets
    ]
