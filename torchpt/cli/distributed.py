"""Run `torchpt render` on several ranks: start-up, messages and a common exit code.

torchrun starts the processes, or any launcher that sets RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT. Rank 0 does the work of
a single process; the other ranks trace samples for it and print nothing. An error is printed once, by the first rank that
reports it. A run in one process does not import `torchpt.ranks`.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

from torchpt.cli.interrupt import Interrupt, interruption
from torchpt.core.errors import LostRankError, OtherRankError, TorchptError

if TYPE_CHECKING:
    from torchpt.ranks import Group
    from torchpt.ranks.launch import LaunchedProcess

__all__ = ["group", "is_distributed", "print_once", "run_on_ranks"]

#: Words that ask for a sweep, and those that only print a help or a version.
_SWEEP_OPTIONS, _HELP_WORDS = ("-m", "--multirun"), ("-h", "--help", "help", "--version")

#: This process as one of several ranks, and its stderr before that was silenced; None in a run of one process.
_started: LaunchedProcess | None = None
_stderr: Any = None


def is_distributed() -> bool:
    """Return True if this process is one of several ranks (WORLD_SIZE > 1)."""
    return os.environ.get("WORLD_SIZE", "1").strip() not in ("", "0", "1")


def group() -> Group | None:
    """Return the process group, or None in a run of one process."""
    return None if _started is None else _started.group


def print_once(line: str, about: str = "") -> None:
    """Print a line on stderr from one rank only: the first rank that reports on the topic ``about`` (default: the line)."""
    if _started is None or _started.is_first_to_say(about or line):
        print(line, file=_stderr or sys.stderr, flush=True)


def report_lost_rank(error: LostRankError | OtherRankError) -> int:
    """Report that a rank was lost, unless another rank has reported its own error; return the exit code."""
    if isinstance(error, OtherRankError):
        return error.code  # that rank says what happened
    print_once(f"torchpt: {error}", about="lost")
    return 2


def run_on_ranks(main: Callable[[list[str]], int], words: list[str]) -> int:
    """Run a command line as one of several ranks and return the exit code, which is the same on all ranks.

    Args:
        main: runs a command line and returns its exit code.
        words: the command line.
    """
    global _started, _stderr
    is_first_rank = os.environ.get("RANK", "0") == "0"
    try:
        with Interrupt() as interrupt:
            from torchpt.ranks.launch import LaunchedProcess

            _started = LaunchedProcess()
            _started.connect(interrupt.check)
    except LostRankError as error:
        _exit_now(report_lost_rank(error))
    except TorchptError as error:  # a bad environment variable, the same on all ranks
        if is_first_rank:
            print(f"torchpt: {error}", file=sys.stderr)
        return 2
    except BaseException as error:
        interrupted = interruption(error)
        if interrupted is None:
            raise
        print_once("torchpt: stopped by a signal, before all ranks were there", about="lost")
        _exit_now(interrupted.exit_code)
    _stderr = sys.stderr
    if not is_first_rank:
        sys.stdout = sys.stderr = open(os.devnull, "w")  # to the end of the process
    try:
        return _run_and_agree(main, words)
    except BaseException:
        traceback.print_exc(file=_stderr)
        _exit_now(1)


def _run_and_agree(main: Callable[[list[str]], int], words: list[str]) -> int:
    """Run the command line, wait for all ranks and return their common exit code."""
    assert _started is not None
    problem = _why_not_on_ranks(words)
    if problem is not None:
        print_once(f"torchpt: {problem}")
    code = 2 if problem is not None else main(words)
    ranks = _started.group
    if not ranks.has_ended:
        try:
            code = ranks.end(code)
            _started.disconnect()
            return code
        except LostRankError as error:  # for example while rank 0 wrote the picture
            code = report_lost_rank(error)
    _exit_now(code)


def _exit_now(code: int) -> NoReturn:
    """Exit the process at once: threads of broken connections could keep it alive."""
    for stream in (sys.stdout, sys.stderr, _stderr):
        if stream is not None:
            stream.flush()
    os._exit(code)


def _why_not_on_ranks(words: list[str]) -> str | None:
    """Return why a command line cannot run on several ranks, or None if it can."""
    if words[:1] != ["render"] and words[:1] and words[0] not in _HELP_WORDS:
        return f"{words[0]}: runs in one process; `torchpt render` alone is shared by several"
    for word in words:
        if word in _SWEEP_OPTIONS or word.replace(" ", "") == "hydra.mode=MULTIRUN":
            return f"{word}: a sweep runs in one process, or by a launcher of Hydra; several share one render"
        if word.lstrip("+").startswith("debug."):
            return f"{word}: one path is traced by one process"
    return None
