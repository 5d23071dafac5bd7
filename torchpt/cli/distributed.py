"""`torchpt render` by several processes: who speaks, and with which exit code all of them end.

torchrun starts them, or whatever else sets RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT. The first rank does all that one
process would do; the others help it to sample, and say nothing. What goes wrong is said once, by the first that says it. One
process never imports anything of this.
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

__all__ = ["group", "is_distributed", "run_on_ranks", "say"]

#: Words that ask for more than one render, or for something else.
_SWEEPS, _SHOWN = ("-m", "--multirun"), ("-h", "--help", "help", "--version")

_started: LaunchedProcess | None = None
_stderr: Any = None


def is_distributed() -> bool:
    """Whether this process was started as one of several."""
    return os.environ.get("WORLD_SIZE", "1").strip() not in ("", "0", "1")


def group() -> Group | None:
    """The ranks of this process; None where it is alone."""
    return None if _started is None else _started.group


def say(line: str, about: str = "") -> None:
    """A line on stderr, by one rank only; of several lines ``about`` one matter the first."""
    if _started is None or _started.first_to_say(about or line):
        print(line, file=_stderr or sys.stderr, flush=True)


def report_lost_rank(error: LostRankError | OtherRankError) -> int:
    """What there is to say where ranks do not end together; returns the exit code."""
    if isinstance(error, OtherRankError):
        return error.code  # that rank says what happened
    say(f"torchpt: {error}", about="lost")
    return 2


def run_on_ranks(main: Callable[[list[str]], int], words: list[str]) -> int:
    """Run a command line as one rank of several, and return the exit code, which all have in common.

    Args:
        main: the command line.
        words: its words.
    """
    global _started, _stderr
    first = os.environ.get("RANK", "0") == "0"
    try:
        with Interrupt() as interrupt:
            from torchpt.ranks.launch import LaunchedProcess

            _started = LaunchedProcess()
            _started.connect(interrupt.check)
    except LostRankError as error:
        _leave(report_lost_rank(error))
    except TorchptError as error:  # of the environment, which is the same for all
        if first:
            print(f"torchpt: {error}", file=sys.stderr)
        return 2
    except BaseException as error:
        interrupted = interruption(error)
        if interrupted is None:
            raise
        say("torchpt: stopped by a signal, before all ranks were there", about="lost")
        _leave(interrupted.exit_code)
    _stderr = sys.stderr
    if not first:
        sys.stdout = sys.stderr = open(os.devnull, "w")  # to the end of the process
    try:
        return _ended(main, words)
    except BaseException:
        traceback.print_exc(file=_stderr)
        _leave(1)


def _ended(main: Callable[[list[str]], int], words: list[str]) -> int:
    """The exit code of all ranks, once they are done."""
    assert _started is not None
    problem = _not_for_ranks(words)
    if problem is not None:
        say(f"torchpt: {problem}")
    code = 2 if problem is not None else main(words)
    own = _started.group
    if not own.over:
        try:
            code = own.end(code)
            _started.disconnect()
            return code
        except LostRankError as error:  # while it wrote the picture, say
            code = report_lost_rank(error)
    _leave(code)


def _leave(code: int) -> NoReturn:
    """End the process at once: threads of connections that are broken might keep it."""
    for stream in (sys.stdout, sys.stderr, _stderr):
        if stream is not None:
            stream.flush()
    os._exit(code)


def _not_for_ranks(words: list[str]) -> str | None:
    """Why several processes cannot do what is asked for."""
    if words[:1] != ["render"] and words[:1] and words[0] not in _SHOWN:
        return f"{words[0]}: runs in one process; `torchpt render` alone is shared by several"
    for word in words:
        if word in _SWEEPS or word.replace(" ", "") == "hydra.mode=MULTIRUN":
            return f"{word}: a sweep runs in one process, or by a launcher of Hydra; several share one render"
        if word.lstrip("+").startswith("debug."):
            return f"{word}: one path is traced by one process"
    return None
