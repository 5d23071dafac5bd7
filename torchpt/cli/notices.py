"""Print warnings on stderr, one line each."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from torchpt.core.errors import EnergyWarning, ImportedSceneWarning

if TYPE_CHECKING:
    from torchpt.cli.render import Job

__all__ = ["print_job", "printed_scene_warnings", "warn_nonfinite", "warn_unknown_error"]

#: Warnings about scenes.
_KINDS = (EnergyWarning, ImportedSceneWarning)


@contextmanager
def printed_scene_warnings() -> Iterator[None]:
    """Collect warnings about scenes (:data:`_KINDS`) inside the context and print them at its end, unless it raised.

    Other warnings are shown by Python as usual.
    """
    lines: list[str] = []
    with warnings.catch_warnings():
        for kind in _KINDS:
            warnings.simplefilter("always", kind)
        show = warnings.showwarning

        def collect_or_show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, _KINDS):
                lines.append(f"torchpt: warning: {' '.join(str(message).split())}")
            else:
                show(message, category, filename, lineno, file, line)

        warnings.showwarning = collect_or_show
        yield
    for text in dict.fromkeys(lines):
        print(text, file=sys.stderr)


def print_job(job: Job, outs: Sequence[str] = ()) -> None:
    """Print the number, overrides and output files of a sweep job on stderr; nothing outside a sweep."""
    if job.number is not None:
        files = f" -> {', '.join(outs)}" if outs else ""
        print(f"torchpt: job {job.number}: {' '.join(job.words)}{files}", file=sys.stderr)


def warn_nonfinite(facts: Mapping[str, Any]) -> None:
    """Warn on stderr about samples that are not finite: how many, their causes, and where the first is.

    Args:
        facts: result of :meth:`torchpt.Rendering.summary`.
    """
    causes = facts.get("nonfinite_causes")
    if not causes:
        return
    listed = "; ".join(f"{count:,} {name}" for name, count in causes.items())
    print(
        f"torchpt: warning: {facts['nonfinite_samples']:,} samples are not finite and count as black ({listed}); the first is "
        f"{facts['nonfinite_first']}; debug.pixel=[x,y] debug.sample=k prints a path",
        file=sys.stderr,
    )


def warn_unknown_error(facts: Mapping[str, Any]) -> None:
    """Warn on stderr that the error of a picture was requested but is not known, and why.

    Args:
        facts: result of :meth:`torchpt.Rendering.summary`.
    """
    if facts.get("relmse_unknown"):
        print(f"torchpt: warning: the picture's error is not known: {facts['relmse_unknown']}", file=sys.stderr)
