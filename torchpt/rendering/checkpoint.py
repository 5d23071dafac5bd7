"""Checkpoints: write films and counts to a file, read and validate them, and decide which renders may resume from it.

:class:`~torchpt.rendering.run.Run` writes one between passes (a pass takes some samples of every pixel), and the first of
several ranks does it for all. The state of a render is its films (sums and counts of samples by pixel)
and a few facts (numbers).
"""

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
from torchpt.core.files import check_regular, written_path
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


# ---- Read an ``.npz`` archive from an untrusted source: arrays of numbers only, none larger than the file


#: First bytes of every ``.npy`` file.
_MAGIC = b"\x93NUMPY"
#: Most bytes of the header of one; NumPy writes about a hundred.
_LONGEST_HEADER = 10_000


def read_arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    """Return the arrays of an archive by name, as ``numpy.savez`` wrote them.

    NumPy's own reader trusts a header that declares any size, and runs a tokenizer over one that is malformed.

    Raises:
        ValueError: a member is compressed, encrypted, overlaps others, or is no array of numbers.
        zipfile.BadZipFile: the archive is damaged.
    """
    found: dict[str, np.ndarray] = {}
    file_bytes = file.seek(0, os.SEEK_END)
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if sum(member.compress_size for member in members) > file_bytes:
            raise ValueError("its members overlap")
        for member in members:
            name = member.filename
            if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:  # bit 0: encrypted
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
    """Return the array in the bytes of a ``.npy`` file (NumPy enhancement proposal 1)."""
    if not data.startswith(_MAGIC):
        raise ValueError("no array")
    # Byte 6 is the format's version; the length of the header follows it in two bytes, from version 2 on in four.
    size, start = (
        (struct.unpack_from("<H", data, 8)[0], 10) if data[6] == 1 else (struct.unpack_from("<I", data, 8)[0], 12)
    )
    if size > _LONGEST_HEADER:
        raise ValueError("a header that long")
    header = ast.literal_eval(data[start : start + size].decode("latin-1").strip())
    dtype, shape = np.dtype(header["descr"]), header["shape"]
    # Booleans, integers, unsigned integers, floats.
    if dtype.kind not in "biuf" or not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("no numbers")
    values = np.frombuffer(data, dtype, offset=start + size).reshape(
        shape, order="F" if header["fortran_order"] else "C"
    )
    return np.array(values, dtype.newbyteorder("="), order="C")  # in this machine's byte order


# ---- Save the state of a render between passes, and resume from it
#
# A checkpoint holds the films and the counts on which the next pass depends. Random numbers are functions of pixel and sample,
# so a resumed render ends with the bits of an uninterrupted one. The file is an ``.npz`` archive of arrays and one JSON text;
# nothing in it is executed. It is written to a temporary file and renamed, so there is always a whole checkpoint.


#: Seconds between two checkpoints are at least ``EVERY``, and ``PATIENCE`` times as long as writing the last one took.
EVERY, PATIENCE = 5.0, 20.0
#: Settings that may differ between a checkpoint and the render that resumes from it: samples do not depend on them.
FREE = settings_with(Role.FREE)
#: Name of the JSON text among the arrays.
_FACTS = "facts"
#: Version of the file format; files of others are refused.
_FORMAT = 3
#: Counts and seconds below this are plausible.
_HUGE = 2**62


@dataclass
class RenderState:
    """The state of a render between two passes.

    Attributes:
        facts: numbers, text and nested dicts, as JSON holds them.
        arrays: tensors by name, such as ``picture.sums``.
    """

    facts: dict[str, Any]
    arrays: dict[str, Tensor]


def identity(
    scene: Scene, settings: Settings, params: Mapping[str, Tensor] | None, dtype: torch.dtype
) -> dict[str, Any]:
    """Return all that samples depend on, ready for JSON: renders of equal identity may resume each other's checkpoints."""
    return {
        "torchpt": __version__,
        "scene": fingerprints(scene),
        "params": {name: fingerprint(value).hex() for name, value in (params or {}).items()},
        "dtype": str(dtype).removeprefix("torch."),
        "device": scene.device.type,
        **({"integrator_code": fingerprint(settings.integrator).hex()} if settings.integrator.is_foreign else {}),
        **json.loads(json.dumps(settings.plain(FREE))),
    }


class CheckpointFile:
    """The checkpoint file of one render.

    Args:
        path: of the file.
        render_identity: the render's :func:`identity`; None where only the path is checked.

    Attributes:
        seconds: spent on writing so far.
    """

    def __init__(self, path: str, render_identity: Mapping[str, Any] | None = None) -> None:
        self.path, self.seconds = written_path(str(path), "render.checkpoint"), 0.0
        self._identity = dict(render_identity or {})
        self._last_write_at, self._last_write_seconds = time.perf_counter(), 0.0

    def check(self, resume: bool) -> None:
        """Check before a long render that its checkpoints can be written.

        Raises:
            OutputError: the path cannot be written, or a file is there and ``resume`` is False.
        """
        check_writable(self.path, (self.path.suffix.lower(),))
        if not resume and self.path.exists():
            raise OutputError(self.path, "is there already; render.resume=true goes on from it, or remove it first")

    def is_due(self) -> bool:
        """Return True if it is time for another checkpoint."""
        return time.perf_counter() - self._last_write_at >= max(EVERY, PATIENCE * self._last_write_seconds)

    def write(self, state: RenderState) -> None:
        """Replace the checkpoint.

        Raises:
            OutputError: the file cannot be written; the previous checkpoint is still whole.
        """
        begun = time.perf_counter()
        try:
            self._write(state)
        finally:
            self._last_write_at = time.perf_counter()
            self._last_write_seconds = self._last_write_at - begun
            self.seconds += self._last_write_seconds

    def _write(self, state: RenderState) -> None:
        destination = output_path(self.path, (self.path.suffix.lower(),))
        temporary = temporary_beside(destination)
        text = json.dumps({"format": _FORMAT, "of": self._identity, **state.facts})
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

    def read(self, like: RenderState, check: Callable[[RenderState], object] | None = None) -> RenderState | None:
        """Return the checkpoint, its ``render.spp`` among the facts; None if there is no file.

        Args:
            like: a state of this render, whose names, types and shapes the checkpoint must have.
            check: called with the state before its arrays are compared with ``like``; may raise.

        Raises:
            AssetError: the file is damaged, or is the checkpoint of another render.
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
            if type(facts["spp"]) is not int or not 1 <= facts["spp"] < _HUGE:
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
            raise AssetError(self.path, f"is no whole checkpoint ({_first_line(problem)})") from None
        # The samples a pixel may differ: check_samples decides.
        here = {
            **self._identity,
            "render": {name: value for name, value in self._identity["render"].items() if name != "spp"},
        }
        for key, in_file, of_render in _differences(facts.pop("of"), here):
            is_hash = key.startswith("scene.")
            said = f"its {key} are others" if is_hash else f"{key}: {in_file} there, {of_render} here"
            raise AssetError(self.path, f"is the checkpoint of another render ({said})")
        state = RenderState(facts, {name: torch.from_numpy(value) for name, value in arrays.items()})
        _check_facts(state, like, self.path)
        if check is not None:
            check(state)
        _check_arrays(state, like, self.path)
        return state


def _check_facts(state: RenderState, like: RenderState, path: Path) -> None:
    """Raise AssetError where a fact is missing or has another type than in ``like``."""
    for name, value in like.facts.items():
        there: Any = state.facts.get(name)
        if name == "lost":  # the non-finite samples, a nested list
            try:
                NonFinite.read(there)
            except ValueError as problem:
                raise AssetError(path, f"is no whole checkpoint ({problem})") from None
            continue
        has_type = isinstance(there, int | type(value)) and not isinstance(there, bool)
        if not has_type or not 0 <= there < _HUGE:
            raise AssetError(path, f"is no whole checkpoint ({name} is {str(there)[:40]})")


def _check_arrays(state: RenderState, like: RenderState, path: Path) -> None:
    """Raise AssetError where an array is missing or has another shape or dtype than in ``like``."""
    for name, value in like.arrays.items():
        found = state.arrays.get(name)
        if found is None or found.shape != value.shape or found.dtype != value.dtype:
            raise AssetError(path, f"is no whole checkpoint (the numbers {name} are missing, or others)")


def _first_line(problem: Exception) -> str:
    """Return the first line of an error's text, or its type."""
    return str(problem).split("\n", 1)[0] or type(problem).__name__


def _differences(a: Any, b: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield the differences of two nested dicts: dotted key, and both values in JSON."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in dict.fromkeys((*a, *b)):
            yield from _differences(a.get(name), b.get(name), f"{key}.{name}" if key else name)
    elif a != b:
        yield key, json.dumps(a), json.dumps(b)


# ---- Decide whether a render may resume from a checkpoint


def check_samples(run: Run, state: RenderState, path: Path) -> None:
    """Refuse a checkpoint of another ``render.spp`` from which the picture would not get the bits of an uninterrupted render.

    Raises:
        AssetError: gives the reason.
    """
    settings, there, taken = run.settings, state.facts["spp"], state.facts["taken"]  # samples a pixel
    here, reason = settings.render.spp, ""
    if here == there:
        return
    settings_there = replace(settings, render=settings.render.but(spp=there))
    if settings.sampler.kind.needs_count:
        reason = f"where {settings.sampler.name} points lie depends on how many there are"
    elif settings_there.streams != settings.streams:
        reason = f"the variance is of {settings_there.streams} streams there, of {settings.streams} here"
    elif taken > here:
        reason = f"it holds {taken} samples a pixel already"
    # `cut`: spp or the time limit made a round less than double.
    elif settings.adaptive and taken >= FIRST_ROUND and (here < there or state.facts["cut"]):
        reason = "a round of adaptive sampling was as long as spp let it be"
    elif settings.render.target_error is not None and not ends_a_pass(run, taken):
        reason = f"with render.target_error no pass ends at {taken} samples"
    if reason:
        raise AssetError(
            path, f"is the checkpoint of another render (render.spp: {there} there, {here} here; {reason})"
        )


def ends_a_pass(run: Run, taken: int) -> bool:
    """Return True if ``target_error`` is checked after ``taken`` samples a pixel in a render without a time limit."""
    stop_rules = StopRules(
        run.settings.render.but(spp=taken + BLOCK, time_limit=None), run.picture.randomizations.count
    )
    # A pass is at most a quarter of the samples before it, so from 4 * BLOCK on passes are whole blocks.
    end = taken - taken % (4 * BLOCK)
    while end < taken:
        end += stop_rules.next_pass_spp(end)
    return end == taken


def check_plausible(run: Run, state: RenderState, path: Path) -> None:
    """Refuse a checkpoint whose numbers no render of these settings can have.

    Sums may be negative (signed filters); AOVs of a user's models may be non-finite.

    Raises:
        AssetError: names the first such number.
    """
    facts, arrays = state.facts, state.arrays
    taken, done, nonfinite = facts["taken"], facts["done"], NonFinite.read(facts["lost"])
    counts = {name: arrays[f"{name}.counts"] for name in run.films()}
    adaptive = run.settings.adaptive and taken >= FIRST_ROUND  # pixels differ in their number of samples
    problems: dict[str, bool] = {
        "taken": not (taken <= facts["spp"] and (taken == FIRST_ROUND or not adaptive)),
        "cut": facts["cut"] > 1,
        "light": not _finite([arrays["light"]]),
    }
    for name, film in run.films().items():
        is_light = not name.startswith("layers.")
        samples = taken if run.integrator.light or not is_light else 0
        # Sample i of a pixel belongs to randomization i modulo their number.
        least = torch.tensor([len(range(k, samples, film.randomizations)) for k in range(film.randomizations)])[:, None]
        problems[f"{name}.counts"] = bool((counts[name] < least).any() if adaptive else (counts[name] != least).any())
        problems[f"{name}.sums"] = is_light and not _finite(arrays[f"{name}.{key}"] for key in ("sums", "first"))
    # Integrators without light leave the picture's film empty; films of AOVs have the counts then.
    seen = counts["picture"] if run.integrator.light else next(iter(c for n, c in counts.items() if n != "picture"))
    total = int(seen.sum())
    if adaptive:
        assert run.probes is not None and run.probes.pixel_set.indices is not None
        pilots = seen.sum(0)[run.probes.pixel_set.indices.cpu()]
        problems["pilots.counts"] |= bool((counts["pilots"].sum(0) != pilots).any())
        for name in run.picture.layers:
            problems[f"layers.{name}.counts"] |= bool((counts[f"layers.{name}"].sum(0) != seen.sum(0)).any())
        problems["picture.counts"] |= total > (facts["spp"] + BLOCK) * seen.shape[1]
    if run.probes is not None:
        total += int(counts["pilots"].sum())
    problems["done"] = done != total
    problems["truncated"] = facts["truncated"] > done
    problems["lost"] = nonfinite.count > done or not all(
        _is_taken(run, sample_id, int(seen.max())) for sample_id in nonfinite.samples
    )
    for name, wrong in problems.items():
        if wrong:
            raise AssetError(path, f"is no whole checkpoint (no render comes to its {name})")


def _finite(values: Iterable[Tensor]) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in values)


def _is_taken(run: Run, sample_id: SampleId, samples: int) -> bool:
    """Return True if the render takes this sample, in the picture or in its error probes."""
    x, y, width, height = run.wave.crop  # pixels
    pixel_sets = [run.picture] if run.probes is None else [run.picture, run.probes.pixel_set]
    inside = x <= sample_id.x < x + width and y <= sample_id.y < y + height and sample_id.sample < samples
    return inside and (sample_id.first_randomization, sample_id.randomizations) in [
        (pixel_set.randomizations.first, pixel_set.randomizations.count) for pixel_set in pixel_sets
    ]
