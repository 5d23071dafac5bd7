"""Exceptions and warnings for users. Each message is one line: where, what was found, what is accepted.

Exceptions define ``__reduce__`` where their arguments are not their message, so that they can be sent between processes
(pickled). A *rank* is one of several processes that share a render (``torch.distributed``).
"""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any

__all__ = [
    "ArgumentTypeError",
    "ArgumentValueError",
    "AssetError",
    "EdgeWarning",
    "EmptyMeshError",
    "EnergyWarning",
    "ImportedSceneWarning",
    "LostRankError",
    "NoLightWarning",
    "NotBuiltError",
    "OtherRankError",
    "OutputError",
    "RenderError",
    "SceneError",
    "TorchptError",
    "closest_names",
    "did_you_mean",
    "example_names",
    "warn_caller",
    "warn_once",
]


# Most characters that a message shows of a value, of any other text, and of what a key accepts.
_VALUE_LENGTH, _TEXT_LENGTH, _EXPECTED_LENGTH = 80, 500, 1000


def _shown(value: object) -> str:
    """Return a value as a message shows it: its ``repr``, cut to one short line."""
    try:
        shape = getattr(value, "shape", ())
        text = repr(value)
        if len(shape) > 1:  # says the shape first, as most rows of numbers are cut off
            text = f"an array of shape {tuple(shape)}: {text}"
    except Exception:  # integers of more than 4300 digits, and objects whose repr fails
        text = f"a value of type {type(value).__name__} that cannot be shown"
    return _one_line(text, _VALUE_LENGTH)


def _one_line(text: str, max_length: int = _TEXT_LENGTH) -> str:
    """Return text as one printable line of at most ``max_length`` characters."""
    text = "".join(letter if letter.isprintable() else " " for letter in text[: max_length + 1])
    return text if len(text) <= max_length else text[: max_length - 3] + "..."


def _where(key: str, file: str | None) -> str:
    """Return the scene file, if any, and the dotted key. A path is never cut: it is to be copied."""
    return f"{_one_line(file, len(file))}: {_one_line(key)}" if file else _one_line(key)


#: Stands for an argument of an error that is made of its message alone.
_NONE: Any = object()
#: The line of a traceback that names one of these errors.
_OWN_LINE = re.compile(r"torchpt\.[\w.]+: (.*)")


class TorchptError(Exception):
    """Base of all errors caused by input. ``str()`` is always a single line.

    Each of them can be made of a message alone, so that a data loader of torch, which raises the errors of its workers again by
    their type and text, keeps the type. Text of several lines, as such a loader makes it of a traceback, becomes a note.
    """

    def __init__(self, *arguments: object) -> None:
        text = arguments[0] if len(arguments) == 1 else None
        if not isinstance(text, str) or "\n" not in text:
            super().__init__(*arguments)
            return
        lines = text.strip().splitlines()
        own = [found[1] for found in map(_OWN_LINE.match, lines) if found]
        super().__init__(own[-1] if own else _one_line(lines[-1]))
        self.add_note(text)


class SceneError(TorchptError):
    """A scene or setting that cannot be used.

    Attributes:
        key: dotted key, e.g. ``materials.red.reflectance``.
        value: what was found there.
        expected: what is accepted.
        file: the scene file, where the scene came from one.
    """

    def __init__(self, key: str, value: object = _NONE, expected: str = "", file: str | None = None) -> None:
        if value is _NONE:
            self._init_by_message(key)
            return
        self.key, self.value, self.expected, self.file = key, value, expected, file
        super().__init__(f"{_where(key, file)}: expected {_one_line(expected, _EXPECTED_LENGTH)}, got {_shown(value)}")

    def _init_by_message(self, text: str) -> None:
        """Set all of a message; the value is then the text that shows it."""
        TorchptError.__init__(self, text)
        self.message_alone, (where, _, said) = True, str(self).partition(": expected ")
        file, separator, key = where.rpartition(": ")
        self.expected, _, self.value = said.rpartition(", got ")
        self.key, self.file = key, file if separator else None

    #: True for an error that was made of its message.
    message_alone: bool = False

    def __reduce__(self) -> tuple:
        if self.message_alone:
            return type(self), (str(self),)
        return type(self), (self.key, self.value, self.expected, self.file)


class ArgumentTypeError(SceneError, TypeError):
    """An argument of a function that is of another type."""


class ArgumentValueError(SceneError, ValueError):
    """An argument of a function with a value that is not accepted."""


class NotBuiltError(SceneError):
    """A value of the scene format that this version does not build yet; ``expected`` lists the values that it does."""

    def __init__(self, key: str, value: object = _NONE, expected: str = "", file: str | None = None) -> None:
        if value is _NONE:
            self._init_by_message(key)
            return
        TorchptError.__init__(
            self,
            f"{_where(key, file)}: {_shown(value)} is not built yet" + (f"; available: {expected}" if expected else ""),
        )
        self.key, self.value, self.expected, self.file = key, value, expected, file


class AssetError(TorchptError):
    """A file that a scene reads (mesh, image) and that is missing, unreadable or malformed."""

    file: str
    problem: str

    def __init__(self, file: object, problem: str | None = None) -> None:
        _init_of_file(self, file, None if problem is None else _one_line(problem))

    def __reduce__(self) -> tuple:
        return type(self), (self.file, self.problem)


class EmptyMeshError(AssetError):
    """A mesh file without a face."""


class OutputError(TorchptError):
    """A file that cannot be written."""

    file: str
    problem: str

    def __init__(self, file: object, problem: str | None = None) -> None:
        _init_of_file(self, file, None if problem is None else problem.replace("\n", " "))

    def __reduce__(self) -> tuple:
        return type(self), (self.file, self.problem)


def _init_of_file(error: AssetError | OutputError, file: object, problem: str | None) -> None:
    """Set file, problem and message; without a problem ``file`` is the message."""
    if problem is None:
        TorchptError.__init__(error, str(file))
        error.file, _, error.problem = str(error).partition(": ")
        return
    error.file, error.problem = str(file), problem
    TorchptError.__init__(error, f"{_one_line(error.file, len(error.file))}: {error.problem}")


class RenderError(TorchptError):
    """A render that cannot be carried out as requested (device, compiler, strict mode)."""


class LostRankError(RenderError):
    """A rank of the render has ended, or cannot be reached."""


class OtherRankError(RenderError):
    """Another rank of the render failed; its own error says why. ``code`` is its exit code: 2 for an error of input."""

    def __init__(self, text: str, code: int = 2) -> None:
        self.code = code
        super().__init__(text)

    def __reduce__(self) -> tuple:
        return type(self), (str(self), self.code)


class EdgeWarning(UserWarning):
    """A gradient with respect to geometry leaves out visibility edges: all, or some of the scene's."""


class EnergyWarning(UserWarning):
    """Energy may not be conserved: a material reflects more than it receives, or refracting shapes touch."""


class ImportedSceneWarning(UserWarning):
    """A scene of another renderer has what this one lacks; the message says what was done instead."""


class NoLightWarning(UserWarning):
    """No sample met the light of a picture or a part of it, so that its error is not known."""


@cache
def warn_once(text: str) -> None:
    """Write a line to stderr, once a process."""
    print(text, file=sys.stderr, flush=True)


def warn_caller(message: str, category: type[Warning]) -> None:
    """Warn at the line that called this package, directly or through torch (``nn.Module``, a data loader)."""
    frame, level = sys._getframe(), 1  # level: as warnings.warn counts, 1 for this function
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in ("torchpt", "torch"):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def did_you_mean(name: object, known: Iterable[str], show: Callable[[str], str] = str) -> str:
    """Return `` (did you mean X?)`` with the known name closest to ``name``, as ``show`` writes it; "" if none is close."""
    close = closest_names(name, known, 1)
    return f" (did you mean {show(close[0])}?)" if close else ""


def closest_names(name: object, known: Iterable[str], count: int) -> list[str]:
    """Return up to ``count`` known names that look like ``name``, the closest first; none where ``name`` is no text."""
    import difflib

    return difflib.get_close_matches(name, list(known), count) if isinstance(name, str) else []


def example_names(name: object, known: Sequence[str]) -> str:
    """Return names to try in place of the unknown ``name``, with commas: the closest three, or else the first eight."""
    return ", ".join(closest_names(name, known, 3) or known[:8])
