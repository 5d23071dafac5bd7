"""The command line: words to a Hydra composition, to jobs, to an exit code. With `torchpt.cli.grammar` all that imports Hydra.

Hydra composes the *run* settings (groups ``film integrator sampler render``), sweeps over them (``--multirun``), shows
them (``--cfg job``) and launches the jobs. Scenes and file names stay outside (`torchpt.cli.arguments`). Whatever is
wrong with the input ends as one line on stderr and exit code 2.
"""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpt.cli import compare, converge, distributed, gc_pause, info, keys, orbit, render, stress
from torchpt.cli.arguments import GROUPS, Arguments, UsageError, parse
from torchpt.cli.hydra_process import hydra_process
from torchpt.cli.interrupt import Interrupt, Interrupted, interruption
from torchpt.cli.render import Job
from torchpt.cli.streams import flushed_stdout, open_streams
from torchpt.cli.sweep_folder import sweep_folder
from torchpt.cli.sweep_table import tell_jobs
from torchpt.core.errors import LostRankError, OtherRankError, TorchptError
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
#: What the help of commands says of a scene's own keys.
CHANGES = """\
camera.fov=20 materials.red.reflectance=[0,0,1] shapes.lamp.material=white
                      any key of the scene; + adds, ~ removes: +shapes.ball='{type: sphere, radius: .2}' ~lights.sky"""


@dataclass(frozen=True)
class Command:
    """A row of the table of commands.

    Attributes:
        name: the first word.
        example: words after it, for the list of commands.
        line: what it does, in a line.
        help: what ``--help`` prints; ``{scenes}``, ``{keys}`` and ``{changes}`` stand for what they are.
        run: called with the words after the name and the signals that came; returns the exit code.
    """

    name: str
    example: str
    line: str
    help: str
    run: Callable[[list[str], Interrupt], int]


def run() -> None:
    """The console script."""
    gc_pause.pause()
    open_streams()
    sys.exit(distributed.run_on_ranks(main, sys.argv[1:]) if distributed.is_distributed() else main())


def main(argv: list[str] | None = None) -> int:
    """Run ``torchpt`` with these words (default: those of the process) and return the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    with Interrupt() as interrupt:
        try:
            if argv[:1] in (["-h"], ["--help"], ["help"]):
                return _say(_help(HELP))
            if argv == ["--version"]:
                return _say(f"torchpt {__version__}\n")
            _check_place()
            command = _command(argv)
            if _asks_for_help(argv[1:]):
                return _say(_help(command.help))
            return command.run(argv[1:], interrupt)
        except Interrupted as interrupted:
            return interrupted.exit_code
        except Exception as error:
            wrapped = interruption(error)
            if wrapped is not None:
                return wrapped.exit_code
            return _refuse(str(error)) if isinstance(error, TorchptError) else _out_of_memory(error)


def _out_of_memory(error: Exception) -> int:
    """Refuse where memory ran out; any other error goes on its way."""
    from torchpt.core.memory import is_out_of_memory

    if not is_out_of_memory(error):
        raise error
    return _refuse("not enough memory: a smaller film, or render.max_memory, needs less")


def _command(argv: list[str]) -> Command:
    """Return the command of a command line.

    Raises:
        UsageError: there is no such one.
    """
    for command in COMMANDS:
        if argv[:1] == [command.name]:
            return command
    names = [command.name for command in COMMANDS]
    close = difflib.get_close_matches(argv[0], names, 1) if argv else []
    hint = f" (did you mean {close[0]}?)" if close else ""
    raise UsageError(f"{argv[0] if argv else 'no command'}: expected one of the commands {', '.join(names)}{hint}")


def _asks_for_help(words: list[str]) -> bool:
    options = words[: words.index("--")] if "--" in words else words
    return "--help" in options or "-h" in options


def _check_place() -> None:
    """Names on the command line begin at the working folder.

    Raises:
        UsageError: it is gone.
    """
    try:
        os.getcwd()
    except OSError:
        raise UsageError("the working folder is not there any more: change to one that is") from None


def _say(text: str) -> int:
    with flushed_stdout():
        print(text, end="")
    return 0


def _refuse(line: str) -> int:
    distributed.say("torchpt: " + " ".join(line.split("\n")))
    return 2


class JobFailedError(Exception):
    """A job of a sweep that did not end well, in a process of its own which said why; ``code`` is what that is to exit with."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class _Task:
    """What Hydra calls with every composed configuration. Plain data, so that launchers may send it elsewhere.

    Attributes:
        job: of the command, called with what the configuration came to.
        arguments: the command line.
        folder: where jobs of a sweep leave what came of them; None outside one.
        process: that made this.
    """

    job: Callable[[Job, Arguments, Interrupt], int]
    arguments: Arguments
    folder: str | None = None
    process: int = field(default_factory=os.getpid)

    def __call__(self, cfg: DictConfig) -> int:
        """Do one job. Where it does not end well it ends this process, or, in a launcher's own, lets jobs beside it finish."""
        code = self._run(cfg)
        if code:
            raise SystemExit(code) if os.getpid() == self.process else JobFailedError(code)
        return code

    def _run(self, cfg: DictConfig) -> int:
        """Run the job of a composed configuration and return the exit code."""
        with Interrupt() as interrupt:
            try:
                return self.job(self._job(cfg), self.arguments, interrupt)
            except (LostRankError, OtherRankError) as error:
                return distributed.report_lost_rank(error)
            except TorchptError as error:
                return _refuse(str(error))
            except Interrupted as interrupted:
                return interrupted.exit_code
            except Exception as error:
                return _out_of_memory(error)

    def _job(self, cfg: DictConfig) -> Job:
        """Return the job of a composed configuration.

        Raises:
            UsageError: a value that cannot be resolved, a block that does not exist.
        """
        from hydra.core.hydra_config import HydraConfig
        from hydra.types import RunMode
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        hydra = HydraConfig.get()
        try:
            composed = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        except OmegaConfBaseException as error:
            raise UsageError(f"{error.full_key or 'settings'}: {_first_line(error)}") from error
        assert isinstance(composed, dict)
        number = hydra.job.num if hydra.mode == RunMode.MULTIRUN else None
        scene = self.arguments.scenes[composed.pop("scene_number", 0)]
        chosen = {f"scene_key_{k}": key for k, key in enumerate(self.arguments.scene_keys)}
        changes = {key: values[composed.pop(name)] for name, (key, values) in chosen.items()}
        words = list(hydra.overrides.task)
        overrides = _given(composed, words)
        told = {"scene_number": f"scene={scene}"} if len(self.arguments.scenes) > 1 else {}
        if changes:
            from torchpt.scene.formats.overrides import told as words_for

            told |= dict(zip(chosen, words_for(changes), strict=True))
        words = [told.get(word.lstrip("+").partition("=")[0], word) for word in words]
        for key, path in self.arguments.paths.items():
            group, _, name = key.partition(".")
            overrides.setdefault(group, {})[name] = path
        return Job(
            scene,
            overrides,
            tuple(self.arguments.outs),
            number,
            tuple(words),
            changes,
            self.folder,
            self.arguments.config_dir,
        )


def _given(composed: dict[Any, Any], words: list[str]) -> dict[str, dict[str, Any]]:
    """The settings that somebody set: not null, or null by an explicit word of the command line.

    Raises:
        UsageError: a block that does not exist, or ``_target_`` anywhere.
    """
    unset = {word.lstrip("+").removesuffix("=null") for word in words if word.endswith("=null")}
    _refuse_targets(composed, "")
    given: dict[str, dict[str, Any]] = {}
    for group, block in composed.items():
        if group not in GROUPS:
            raise UsageError(keys.unknown(str(group)))
        if block is None:
            continue
        if not isinstance(block, dict):
            raise UsageError(f"{group}: expected a file of configs/{group} or keys below it, got {block!r}")
        kept = {key: _pruned(value) for key, value in block.items()}
        given[group] = {key: value for key, value in kept.items() if value is not None or f"{group}.{key}" in unset}
    return given


def _pruned(value: Any) -> Any:
    """A nested block without its nulls; None where nothing is left."""
    if not isinstance(value, dict):
        return value
    return {key: item for key, item in value.items() if item is not None} or None


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
    """Hand the words over to Hydra, which calls a task with each composition; returns the exit code."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    task = _Task(job, arguments)
    own = arguments.config_dir is not None or "--config-name" in arguments.options
    words = [*arguments.options, *(_QUIET if "--config-name" in arguments.options else ()), *arguments.overrides]
    single = not arguments.multirun and not any("hydra" in word for word in words)
    with sweep_folder() if arguments.multirun else nullcontext() as folder:
        if folder is not None:
            words.append(f"hydra.sweep.dir={_quoted(folder)}")
            task.folder = folder
        with hydra_process(words), _composed_once() if single else nullcontext(), _checked() if own else nullcontext():
            try:
                hydra.main(version_base="1.3", config_path=str(_configs()), config_name="config")(task)()
            except SystemExit as end:
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
                    tell_jobs(folder)
    interrupt.check()
    return 0


@contextmanager
def _composed_once() -> Iterator[None]:
    """Context in which Hydra is told that this is no sweep: to find out it composes all settings once more."""
    from hydra._internal.hydra import Hydra
    from hydra.types import RunMode

    before = Hydra.get_mode
    Hydra.get_mode = lambda *_, **__: RunMode.RUN
    try:
        yield
    finally:
        Hydra.get_mode = before


#: What configs/config.yaml says of Hydra itself: a configuration of the caller's own need not say it again.
_QUIET = (
    "hydra.run.dir=.", "hydra.output_subdir=null", "hydra.job.chdir=false",
    "hydra/job_logging=none", "hydra/hydra_logging=none",
)  # fmt: skip


@contextmanager
def _checked() -> Iterator[None]:
    """Context in which Hydra calls nobody back: files of the caller's own name no Python objects either."""
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
    """Name the word that Hydra cannot read: its own message shows a fragment of it.

    Raises:
        UsageError: a word that is no ``key=value`` of Hydra's grammar.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    from torchpt.cli.grammar import reason

    parser = OverridesParser.create()
    for word in words:
        try:
            parser.parse_override(word)
        except HydraException as error:
            raise UsageError(f"{word}: expected key=value ({reason(error)})") from error


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _came_from_job(error: BaseException) -> bool:
    """Whether an error is a defect inside a job, whose trace must not be lost, rather than a word Hydra refused."""
    if "RemoteTraceback" in type(error.__cause__).__name__:  # from a launcher's worker process
        return True
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code is _Task.__call__.__code__:
            return True
        trace = trace.tb_next
    return False


def _one_line(error: Exception, words: list[str]) -> str:
    """Hydra's and OmegaConf's errors, shortened to what was given and what is accepted."""
    text = str(error)
    if match := re.search(r"Could not override '([^']+)'", text):
        return keys.unknown(match[1], words)
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
    return _first_line(text) if text.strip() else type(error).__name__


def _first_line(error: object) -> str:
    lines = [" ".join(line.split()) for line in str(error).splitlines()]
    kept = [line for line in lines if line and not line.startswith(("See http", "full_key", "object_type", "^"))]
    return "; ".join(kept[:3])


def _configs() -> Path:
    from torchpt.core.files import configs

    return configs()


def help_of(name: str) -> str:
    """Return the help of a command, or of ``torchpt`` itself where the name is empty."""
    return _help(next(command.help for command in COMMANDS if command.name == name) if name else HELP)


def _help(text: str) -> str:
    wide = max(len(f"{command.name} {command.example}") for command in COMMANDS)
    lines = [f"  torchpt {f'{command.name} {command.example}':{wide}}   {command.line}" for command in COMMANDS]
    return text.format(
        scenes=keys.scenes(), keys=keys.listed().replace("\n", "\n  "), commands="\n".join(lines), changes=CHANGES
    )


def _composed(name: str, job: Callable[[Job, Arguments, Interrupt], int]) -> Callable[[list[str], Interrupt], int]:
    """Return a command whose words are settings: Hydra composes them, and ``job`` is called with what each job came to."""

    def command(words: list[str], interrupt: Interrupt) -> int:
        arguments = parse(name, words)
        if not arguments.scenes and not arguments.only_shows:
            ship = ", ".join(keys.options("scene"))
            raise UsageError(f"scene: expected scene=NAME or scene=FILE.yaml; scenes that ship: {ship}")
        return _compose_and_run(job, arguments, interrupt)

    return command


#: All commands, in the order of the help: a new one is a file in this folder and a row here.
COMMANDS = (
    Command(
        "render",
        "scene=cornell_box render.spp=64 out=cornell.exr",
        "render a picture",
        render.HELP,
        _composed("render", render.run),
    ),
    Command(
        "orbit",
        "scene=cornell_box frames=48 out=turn.gif",
        "turn the camera about it: .gif, .mp4",
        orbit.HELP,
        _composed("orbit", orbit.run),
    ),
    Command(
        "info",
        "scene=cornell_box",
        "what the scene holds, what was built, what left out",
        info.HELP,
        _composed("info", info.run),
    ),
    Command(
        "compare",
        "test.exr reference.exr",
        "how far a picture is from its reference",
        compare.HELP,
        compare.run,
    ),
    Command(
        "converge",
        "scene=cornell_box sampler=[independent,sobol]",
        "error against run time, as a report",
        converge.HELP,
        converge.run,
    ),
    Command("stress", "quick=true", "stiff and extreme cases, measured", stress.HELP, stress.run),
)
