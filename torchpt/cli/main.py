"""Entry point of ``torchpt``: parse the command line, compose the settings with Hydra, run the jobs, return the exit code.

Hydra composes the *run* settings (groups ``film integrator sampler render``), sweeps over them (``--multirun``), shows
them (``--cfg job``) and launches the jobs. Scenes and file names never enter Hydra (see `torchpt.cli.arguments`). Bad input
prints one line on stderr and exits with code 2. Hydra is imported here and in `torchpt.cli.grammar` only.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpt.cli import compare, converge, convert, distributed, gc_pause, info, keys, orbit, render, stress
from torchpt.cli.arguments import GROUPS, Arguments, UsageError, parse
from torchpt.cli.hydra_process import hydra_process
from torchpt.cli.interrupt import Interrupt, Interrupted, interruption
from torchpt.cli.render import Job
from torchpt.cli.streams import flushed_stdout, open_streams
from torchpt.cli.sweep_folder import sweep_folder
from torchpt.cli.sweep_table import print_jobs
from torchpt.core.errors import LostRankError, OtherRankError, TorchptError, did_you_mean
from torchpt.core.version import __version__

if TYPE_CHECKING:
    from omegaconf import DictConfig

__all__ = ["COMMANDS", "HELP", "Command", "help_of", "main", "run"]

HELP = """\
torchpt: a wavefront path tracer that is a PyTorch program

{commands}

torchpt COMMAND --help says more. Scenes that ship:
{scenes}
"""
#: Help text about overrides of scene keys.
CHANGES = """\
camera.fov=20 materials.red.reflectance=[0,0,1] shapes.lamp.material=white
                      any key of the scene; + adds, ~ removes: +shapes.ball='{type: sphere, radius: .2}' ~lights.sky"""


@dataclass(frozen=True)
class Command:
    """A command of ``torchpt``.

    Attributes:
        name: first word of the command line.
        example: example arguments, for the list of commands.
        line: one-line description.
        help: text of ``--help``; ``{scenes}``, ``{keys}`` and ``{changes}`` are filled in.
        run: takes the arguments after the name and the signal handler, returns the exit code.
    """

    name: str
    example: str
    line: str
    help: str
    run: Callable[[list[str], Interrupt], int]


def run() -> None:
    """Run the console script."""
    gc_pause.pause()
    open_streams()
    sys.exit(distributed.run_on_ranks(main, sys.argv[1:]) if distributed.is_distributed() else main())


def main(argv: list[str] | None = None) -> int:
    """Run ``torchpt`` with the arguments `argv` (default: ``sys.argv[1:]``) and return the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    with Interrupt() as interrupt:
        try:
            if argv[:1] in ([], ["-h"], ["--help"], ["help"]):
                return _print_text(_filled_help(HELP))
            if argv == ["--version"]:
                return _print_text(f"torchpt {__version__}\n")
            _check_working_folder()
            command = _command(argv)
            if _asks_for_help(argv[1:]):
                return _print_text(_filled_help(command.help))
            return command.run(argv[1:], interrupt)
        except Interrupted as interrupted:
            return interrupted.exit_code
        except Exception as error:
            wrapped = interruption(error)
            if wrapped is not None:
                return wrapped.exit_code
            return _print_error(str(error)) if isinstance(error, TorchptError) else _out_of_memory(error)


def _out_of_memory(error: Exception) -> int:
    """Return exit code 2 for an out-of-memory error, and raise any other error again."""
    from torchpt.core.memory import is_out_of_memory

    if not is_out_of_memory(error):
        raise error
    return _print_error("not enough memory: a smaller film, or render.max_memory, needs less")


def _command(argv: list[str]) -> Command:
    """Return the command that a command line names.

    Raises:
        UsageError: no such command.
    """
    for command in COMMANDS:
        if argv[:1] == [command.name]:
            return command
    names = [command.name for command in COMMANDS]
    hint = did_you_mean(argv[0], names)
    raise UsageError(f"{argv[0]}: expected one of the commands {', '.join(names)}{hint}")


def _asks_for_help(words: list[str]) -> bool:
    options = words[: words.index("--")] if "--" in words else words
    return "--help" in options or "-h" in options


def _check_working_folder() -> None:
    """Check that the working folder exists: relative paths start there.

    Raises:
        UsageError: the working folder was deleted.
    """
    try:
        os.getcwd()
    except OSError:
        raise UsageError("the working folder is not there any more: change to one that is") from None


def _print_text(text: str) -> int:
    """Print text on stdout and return exit code 0."""
    with flushed_stdout():
        print(text, end="")
    return 0


def _print_error(line: str) -> int:
    """Print an error on stderr as one line and return exit code 2."""
    distributed.print_once("torchpt: " + " ".join(line.split("\n")))
    return 2


class JobFailedError(Exception):
    """A sweep job that failed in a launcher's worker process, which has printed the reason; ``code`` is the exit code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class _Task:
    """The task function that Hydra calls with each composed configuration. It holds plain data, so launchers can pickle it.

    Attributes:
        job: function of the command that runs a job.
        arguments: the parsed command line.
        folder: folder in which the jobs of a sweep write their results; None outside a sweep.
        process: id of the process that created the task.
    """

    job: Callable[[Job, Arguments, Interrupt], int]
    arguments: Arguments
    folder: str | None = None
    process: int = field(default_factory=os.getpid)

    def __call__(self, cfg: DictConfig) -> int:
        """Run one job. A failed job exits this process; in a launcher's worker it raises, so that other jobs can finish."""
        code = self._run(cfg)
        if code:
            raise SystemExit(code) if os.getpid() == self.process else JobFailedError(code)
        return code

    def _run(self, cfg: DictConfig) -> int:
        """Run one job, print its errors and return the exit code."""
        with Interrupt() as interrupt:
            try:
                return self.job(self._job(cfg), self.arguments, interrupt)
            except (LostRankError, OtherRankError) as error:
                return distributed.report_lost_rank(error)
            except TorchptError as error:
                return _print_error(str(error))
            except Interrupted as interrupted:
                return interrupted.exit_code
            except Exception as error:
                return _out_of_memory(error)

    def _job(self, cfg: DictConfig) -> Job:
        """Convert a composed configuration to a job.

        Raises:
            UsageError: a value that cannot be resolved, or an unknown block.
        """
        from hydra.core.hydra_config import HydraConfig
        from hydra.types import RunMode
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        hydra = HydraConfig.get()
        try:
            composed = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        except OmegaConfBaseException as error:
            raise UsageError(f"{error.full_key or 'settings'}: {_shortened(error)}") from error
        assert isinstance(composed, dict)
        number = hydra.job.num if hydra.mode == RunMode.MULTIRUN else None
        scene = self.arguments.scenes[composed.pop("scene_number", 0)]
        chosen = {f"scene_key_{k}": key for k, key in enumerate(self.arguments.scene_keys)}
        changes = {key: values[composed.pop(name)] for name, (key, values) in chosen.items()}
        words = list(hydra.overrides.task)
        overrides = _chosen_settings(composed, words)
        word_of_key = {"scene_number": f"scene={scene}"} if len(self.arguments.scenes) > 1 else {}
        if changes:
            from torchpt.scene.formats.overrides import override_words

            word_of_key |= dict(zip(chosen, override_words(changes), strict=True))
        words = [word_of_key.get(word.lstrip("+").partition("=")[0], word) for word in words]
        for key, path in self.arguments.paths.items():
            group, _, name = key.partition(".")
            overrides.setdefault(group, {})[name] = path
        return Job(
            scene=scene,
            overrides=overrides,
            outs=tuple(self.arguments.outs),
            number=number,
            words=tuple(words),
            changes=changes,
            folder=self.folder,
            config_dir=self.arguments.config_dir,
        )


def _chosen_settings(composed: dict[Any, Any], words: list[str]) -> dict[str, dict[str, Any]]:
    """Return the settings that are not null, or that the command line sets to null explicitly.

    Raises:
        UsageError: an unknown block, or a key ``_target_``.
    """
    unset = _keys_set_to_null(words)
    _refuse_targets(composed, "")
    given: dict[str, dict[str, Any]] = {}
    for group, block in composed.items():
        if group not in GROUPS:
            raise UsageError(keys.unknown_key_error(str(group)))
        if block is None:
            continue
        if not isinstance(block, dict):
            raise UsageError(f"{group}: expected a file of configs/{group} or keys below it, got {block!r}")
        given[group] = _without_nulls(block, group, unset) or {}
    return given


def _keys_set_to_null(words: list[str]) -> set[str]:
    """Return the dotted keys that words set to null, in the spellings of Hydra's grammar and within mappings."""
    found: set[str] = set()
    for word in words:
        key, _, text = word.lstrip("+").partition("=")
        if text.strip().lower() == "null":
            found.add(key)
        elif text.lstrip().startswith("{") and "null" in text.lower():
            from torchpt.cli.grammar import read_value

            (value, *_), _ = read_value(key, text)
            found |= set(_nulls_within(value, key))
    return found


def _nulls_within(value: Any, key: str) -> Iterator[str]:
    """Yield the dotted keys of the nulls in nested mappings."""
    if value is None:
        yield key
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _nulls_within(item, f"{key}.{name}")


def _without_nulls(value: Any, key: str, unset: set[str]) -> Any:
    """Return a nested block without its nulls, but for those of keys that are ``unset``; None if nothing is left."""
    if not isinstance(value, dict):
        return value
    kept = {name: _without_nulls(item, f"{key}.{name}", unset) for name, item in value.items()}
    return {name: item for name, item in kept.items() if item is not None or f"{key}.{name}" in unset} or None


def _refuse_targets(value: Any, where: str) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            if key == "_target_":
                raise UsageError(f"{where}_target_: no setting names a Python object to call: `_target_` is refused")
            _refuse_targets(item, f"{where}{key}.")
    elif isinstance(value, list):
        for index, item in enumerate(value):
            _refuse_targets(item, f"{where}{index}.")


def _compose_and_run(
    job: Callable[[Job, Arguments, Interrupt], int], arguments: Arguments, interrupt: Interrupt
) -> int:
    """Let Hydra compose the settings and run each job; return the exit code."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    task = _Task(job, arguments)
    has_user_config = arguments.config_dir is not None or "--config-name" in arguments.options
    words = [
        *arguments.options,
        *(_HYDRA_SETTINGS if "--config-name" in arguments.options else ()),
        *arguments.overrides,
    ]
    is_single_run = not arguments.multirun and not any("hydra" in word for word in words)
    with sweep_folder() if arguments.multirun else nullcontext() as folder:
        if folder is not None:
            words.append(f"hydra.sweep.dir={_quoted(folder)}")
            task.folder = folder
        with (
            hydra_process(words),
            _composed_once() if is_single_run else nullcontext(),
            _callbacks_refused() if has_user_config else nullcontext(),
        ):
            try:
                hydra.main(version_base="1.3", config_path=str(_configs()), config_name="config")(task)()
            except (
                SystemExit
            ) as end:  # by a job that failed, with its code; Hydra exits with 1 for what it cannot parse
                return end.code if isinstance(end.code, int) and end.code != 1 else 2 if end.code else 0
            except JobFailedError as end:
                return end.code
            except Exception as error:
                if _came_from_job(error):
                    raise
                if isinstance(error, TorchptError):
                    raise
                _check_grammar(arguments.overrides)
                raise UsageError(_one_line(error, arguments.overrides)) from error
            finally:
                GlobalHydra.instance().clear()
                if folder is not None:
                    print_jobs(folder)  # the results that jobs have recorded there
    interrupt.check()
    return 0


@contextmanager
def _composed_once() -> Iterator[None]:
    """Skip Hydra's test for a sweep inside the context: it would compose all settings a second time."""
    from hydra._internal.hydra import Hydra
    from hydra.types import RunMode

    before = Hydra.get_mode
    Hydra.get_mode = lambda *_, **__: RunMode.RUN
    try:
        yield
    finally:
        Hydra.get_mode = before


#: Hydra's own settings in configs/config.yaml, also applied to a user's configuration.
_HYDRA_SETTINGS = (
    "hydra.run.dir=.", "hydra.output_subdir=null", "hydra.job.chdir=false",
    "hydra/job_logging=none", "hydra/hydra_logging=none",
)  # fmt: skip


@contextmanager
def _callbacks_refused() -> Iterator[None]:
    """Refuse Hydra callbacks inside the context: a user's configuration must not name Python objects to call."""
    from hydra._internal.callbacks import Callbacks

    before: Any = Callbacks.__init__

    def init(self: Callbacks, config: Any = None) -> None:
        if config is not None and config.hydra.get("callbacks"):
            raise UsageError("hydra.callbacks: no setting names a Python object to call: callbacks are refused")
        before(self, config)

    Callbacks.__init__ = init
    try:
        yield
    finally:
        Callbacks.__init__ = before


def _check_grammar(words: list[str]) -> None:
    """Find the word that Hydra cannot parse: Hydra's own message shows only a fragment of it.

    Raises:
        UsageError: a word that is not ``key=value`` in Hydra's grammar.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    from torchpt.cli.grammar import parse_failure

    parser = OverridesParser.create()
    for word in words:
        try:
            parser.parse_override(word)
        except HydraException as error:
            raise UsageError(f"{word}: expected key=value ({parse_failure(error)})") from error


def _quoted(text: str) -> str:
    """Return text in quotes, as Hydra's grammar has them."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _came_from_job(error: BaseException) -> bool:
    """Return True if an error was raised by a job (its traceback must be kept), and not by Hydra's parser."""
    if "RemoteTraceback" in type(error.__cause__).__name__:  # from a launcher's worker process
        return True
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code is _Task.__call__.__code__:
            return True
        trace = trace.tb_next
    return False


def _one_line(error: Exception, words: list[str]) -> str:
    """Shorten an error of Hydra or OmegaConf to one line: the key, its value and what is accepted."""
    text = str(error)
    if match := re.search(r"Could not override '([^']+)'", text):
        return keys.unknown_key_error(match[1], words)
    if match := re.search(r"Could not (?:find|load) '(.+?)/([^/']+)'", text):
        group, name = match[1], match[2]
        options = re.findall(r"^\t([\w-]+)$", text, re.MULTILINE) or keys.options(group)
        return f"{group}: expected one of {', '.join(options)}, got {name!r}"
    if match := re.search(r"Cannot find primary config '(.+?)'", text):
        return f"--config-name: expected the name of a .yaml file in the folder of --config-dir, got {match[1]!r}"
    if match := re.search(r"Ambiguous value for argument '(\w.*?)=(.*)'", text):
        return f"{match[1]}: expected one value or a list [..,..], got {match[2]!r} (--multirun sweeps over several)"
    cause = error.__cause__
    if cause is not None and str(cause) not in text:
        text = f"{(text.splitlines() or [type(error).__name__])[0]}: {cause}"
    return _shortened(text) if text.strip() else type(error).__name__


def _shortened(error: object) -> str:
    """Return the first three lines of an error of Hydra or OmegaConf that say something, joined to one line."""
    lines = [" ".join(line.split()) for line in str(error).splitlines()]
    kept = [line for line in lines if line and not line.startswith(("See http", "full_key", "object_type", "^"))]
    return "; ".join(kept[:3])


def _configs() -> Path:
    from torchpt.core.files import configs

    return configs()


def help_of(name: str) -> str:
    """Return the help of a command, or of ``torchpt`` itself if `name` is empty."""
    return _filled_help(next(command.help for command in COMMANDS if command.name == name) if name else HELP)


def _filled_help(text: str) -> str:
    width = max(len(f"{command.name} {command.example}") for command in COMMANDS)
    lines = [f"  torchpt {f'{command.name} {command.example}':{width}}   {command.line}" for command in COMMANDS]
    return text.format(
        scenes=keys.scenes_help(),
        keys=keys.keys_help().replace("\n", "\n  "),
        commands="\n".join(lines),
        changes=CHANGES,
    )


def _command_with_settings(
    name: str, job: Callable[[Job, Arguments, Interrupt], int]
) -> Callable[[list[str], Interrupt], int]:
    """Return the ``run`` of a command whose settings Hydra composes; `job` runs each composed job."""

    def command(words: list[str], interrupt: Interrupt) -> int:
        arguments = parse(name, words)
        if not arguments.scenes and not arguments.only_shows:
            ship = ", ".join(keys.options("scene"))
            raise UsageError(f"scene: expected scene=NAME or scene=FILE.yaml; scenes that ship: {ship}")
        return _compose_and_run(job, arguments, interrupt)

    return command


#: All commands, in the order of the help. To add one, add a file to this folder and a row here.
COMMANDS = (
    Command(
        name="render",
        example="scene=cornell_box render.spp=64 out=cornell.exr",
        line="render a picture",
        help=render.HELP,
        run=_command_with_settings("render", render.run),
    ),
    Command(
        name="orbit",
        example="scene=cornell_box frames=48 out=turn.gif",
        line="turn the camera about it: .gif, .mp4",
        help=orbit.HELP,
        run=_command_with_settings("orbit", orbit.run),
    ),
    Command(
        name="info",
        example="scene=cornell_box",
        line="what the scene holds, what was built, what left out",
        help=info.HELP,
        run=_command_with_settings("info", info.run),
    ),
    Command(
        name="compare",
        example="test.exr reference.exr",
        line="how far a picture is from its reference",
        help=compare.HELP,
        run=compare.run,
    ),
    Command(
        name="convert",
        example="scene.xml scene.yaml",
        line="a scene of Mitsuba as a YAML file",
        help=convert.HELP,
        run=convert.run,
    ),
    Command(
        name="converge",
        example="scene=cornell_box sampler=[independent,sobol]",
        line="error against run time, as a report",
        help=converge.HELP,
        run=converge.run,
    ),
    Command(
        name="stress", example="quick=true", line="stiff and extreme cases, measured", help=stress.HELP, run=stress.run
    ),
)
