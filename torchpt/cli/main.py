"""The command line: words to a Hydra composition, to jobs, to an exit code. The only file that imports Hydra.

Hydra composes the *run* settings (groups ``film integrator sampler render``), sweeps over them (``--multirun``), shows
them (``--cfg job``) and launches the jobs. Scenes and file names stay outside (`torchpt.cli.arguments`). Whatever is
wrong with the input ends as one line on stderr and exit code 2.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpt.cli import collector, keys, ranked
from torchpt.cli.arguments import GROUPS, Arguments, UsageError, parse
from torchpt.cli.compare import HELP as HELP_COMPARE
from torchpt.cli.compare import compare
from torchpt.cli.converge import HELP as HELP_CONVERGE
from torchpt.cli.converge import converge
from torchpt.cli.hydra_process import hydra_process
from torchpt.cli.interrupt import Interrupt, Interrupted
from torchpt.cli.orbit import HELP as HELP_ORBIT
from torchpt.cli.streams import ready, speaking
from torchpt.cli.stress import HELP as HELP_STRESS
from torchpt.cli.stress import stress
from torchpt.cli.sweep_folder import sweep_folder
from torchpt.core.errors import LostRankError, OtherRankError, TorchptError
from torchpt.core.version import __version__

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from torchpt.cli.render import Job

__all__ = ["HELP_COMPARE", "HELP_STRESS", "main", "run"]

HELP = """\
torchpt: a wavefront path tracer that is a PyTorch program

  torchpt render scene=cornell_box render.spp=64 out=cornell.exr    render a picture
  torchpt orbit  scene=cornell_box frames=48 out=turn.gif           turn the camera about it: .gif, .mp4
  torchpt info   scene=cornell_box                                  what the scene holds, what was built, what left out
  torchpt compare test.exr reference.exr                            how far a picture is from its reference
  torchpt converge scene=cornell_box sampler=[independent,sobol]    error against run time, as a report
  torchpt stress quick=true                                         stiff and extreme cases, measured

torchpt COMMAND --help says more. Scenes that ship:
{scenes}
"""
HELP_RENDER = """\
torchpt render scene=NAME|FILE.yaml [out=FILE] [key=value ...]

  scene=   a file ending in .yaml, or a scene that ships:
{scenes}
  out=     .exr .hdr .png .jpg .ppm; several as out=[a.exr,a.png]; NAME.png where nothing is said
  {keys}
  debug.pixel=[x,y] debug.sample=k [--json]
                      print that path vertex by vertex, in place of a picture: [0,0] is at the upper left of the film

  integrator=NAME, sampler=NAME, ... take a group's file from configs/: integrator=direct sampler=independent
  --multirun, -m      one render for every combination: sampler=sobol,independent render.spp=16,64 scene=a,b out=x.exr
                      writes x_0.exr, x_1.exr, ...; stderr and the summaries say which job has which settings
  --cfg job           print the composed settings and stop (null: the scene's own wish, else the built-in default)

  torchrun --nproc-per-node N -m torchpt render ...   N processes share the picture, to the same bits (docs/ranks.md)

A sentence on stdout says what came of it; the last line is a summary in JSON. Samples that are not finite count as
black, and stderr says why.
Exit codes: 0; 2 bad input; 130 after Ctrl-C and 143 after SIGTERM, with the partial picture saved.
"""
HELP_INFO = """\
torchpt info scene=NAME|FILE.yaml [--json] [key=value ...]

  What the scene holds, what was built for it, and what was left out because nothing needs it.
  scene=   a file ending in .yaml, or a scene that ships:
{scenes}
  {keys}
"""

_HELPS = {"render": HELP_RENDER, "orbit": HELP_ORBIT, "info": HELP_INFO, "converge": HELP_CONVERGE}


def run() -> None:
    """The console script."""
    collector.pause()
    ready()
    sys.exit(ranked.main_of_ranks(main, sys.argv[1:]) if ranked.several() else main())


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
            if argv[:1] == ["compare"]:  # takes files, and no scene
                return compare(argv[1:])
            if argv[:1] == ["stress"]:
                return stress(argv[1:])
            arguments = parse(argv)
            if arguments.help:
                return _say(_help(_HELPS[arguments.command]))
            if arguments.command == "converge":
                return _converge(arguments, interrupt)
            if not arguments.scenes and not arguments.only_shows:
                ship = ", ".join(keys.options("scene"))
                raise UsageError(f"scene: expected scene=NAME or scene=FILE.yaml; scenes that ship: {ship}")
            return _compose_and_run(arguments, interrupt)
        except TorchptError as error:
            return _refuse(str(error))
        except Interrupted as interrupted:
            return interrupted.exit_code
        except Exception as error:
            return _out_of_memory(error)


def _out_of_memory(error: Exception) -> int:
    """Refuse where memory ran out; any other error goes on its way."""
    from torchpt.core.memory import is_out_of_memory

    if not is_out_of_memory(error):
        raise error
    return _refuse("not enough memory: a smaller film, or render.max_memory, needs less")


def _converge(arguments: Arguments, interrupt: Interrupt) -> int:
    if not {"scene", "study"} & arguments.study.keys():
        ship = ", ".join(keys.options("scene"))
        raise UsageError(f"scene: expected scene=NAME, scene=FILE.yaml or study=FILE.yaml; scenes that ship: {ship}")
    return converge(arguments.study, interrupt)


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
    with speaking():
        print(text, end="")
    return 0


def _refuse(line: str) -> int:
    ranked.say("torchpt: " + " ".join(line.split("\n")))
    return 2


class JobFailedError(Exception):
    """A job of a sweep that did not end well, in a process of its own which said why; ``code`` is what that is to exit with."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class _Task:
    """What Hydra calls with every composed configuration. Plain data, so that launchers may send it elsewhere."""

    command: str
    scenes: list[str]
    outs: list[str]
    paths: dict[str, str | None]
    json: bool
    turn: dict[str, str]
    debug: dict[str, str]
    process: int = field(default_factory=os.getpid)

    def __call__(self, cfg: DictConfig) -> int:
        """Do one job. Where it does not end well it ends this process, or, in a launcher's own, lets jobs beside it finish."""
        code = self._run(cfg)
        if code:
            raise SystemExit(code) if os.getpid() == self.process else JobFailedError(code)
        return code

    def _run(self, cfg: DictConfig) -> int:
        """Run the job of a composed configuration and return the exit code."""
        from torchpt.cli.debug import Wish, debug
        from torchpt.cli.info import info
        from torchpt.cli.orbit import Turn, orbit
        from torchpt.cli.render import render

        with Interrupt() as interrupt:
            try:
                job = self._job(cfg)
                if self.command == "orbit":
                    return orbit(job, Turn.read(self.turn), interrupt)
                if self.debug:
                    return debug(job, Wish.read(self.debug), interrupt, self.json)
                return info(job, interrupt, self.json) if self.command == "info" else render(job, interrupt)
            except (LostRankError, OtherRankError) as error:
                return ranked.parted(error)
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

        from torchpt.cli.render import Job

        hydra = HydraConfig.get()
        try:
            composed = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
        except OmegaConfBaseException as error:
            raise UsageError(f"{error.full_key or 'settings'}: {_first_line(error)}") from error
        assert isinstance(composed, dict)
        number = hydra.job.num if hydra.mode == RunMode.MULTIRUN else None
        scene = self.scenes[composed.pop("scene_number", 0)]
        words = list(hydra.overrides.task)
        overrides = _given(composed, words)
        words = [f"scene={scene}" if word.startswith("+scene_number=") else word for word in words]
        for key, path in self.paths.items():
            group, _, name = key.partition(".")
            overrides.setdefault(group, {})[name] = path
        return Job(scene, overrides, tuple(self.outs), number, () if number is None else tuple(words))


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


def _compose_and_run(arguments: Arguments, interrupt: Interrupt) -> int:
    """Hand the words over to Hydra, which calls a task with each composition; returns the exit code."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    task = _Task(
        arguments.command,
        arguments.scenes,
        arguments.outs,
        arguments.paths,
        arguments.json,
        arguments.turn,
        arguments.debug,
    )
    words = [*arguments.options, *arguments.overrides]
    single = not arguments.multirun and not any("hydra" in word for word in words)
    with sweep_folder() if arguments.multirun else nullcontext() as folder:
        if folder is not None:
            words.append(f"hydra.sweep.dir={_quoted(folder)}")
        with hydra_process(words), _composed_once() if single else nullcontext():
            try:
                hydra.main(version_base="1.3", config_path=str(_configs()), config_name="config")(task)()
            except SystemExit as end:
                return end.code if isinstance(end.code, int) and end.code != 1 else 2 if end.code else 0
            except JobFailedError as end:
                return end.code
            except Exception as error:
                if _came_from_job(error):
                    raise
                _check_grammar(arguments.overrides)
                raise UsageError(_one_line(error, arguments.overrides)) from error
            finally:
                GlobalHydra.instance().clear()
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


def _check_grammar(words: list[str]) -> None:
    """Name the word that Hydra cannot read: its own message shows a fragment of it.

    Raises:
        UsageError: a word that is no ``key=value`` of Hydra's grammar.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    for word in words:
        try:
            parser.parse_override(word)
        except HydraException as error:
            reason = next((line for line in str(error).splitlines() if "evaluating" in line), "")
            reason = reason.partition(": ")[2] or "quote what holds blanks, brackets or commas, as in key='a b'"
            raise UsageError(f"{word}: expected key=value ({reason})") from error


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
    if match := re.search(r"Ambiguous value for argument '(\w.*?)=(.*)'", text):
        return f"{match[1]}: expected one value or a list [..,..], got {match[2]!r} (--multirun sweeps over several)"
    cause = error.__cause__
    if cause is not None and str(cause) not in text:
        text = f"{text.splitlines()[0]}: {cause}"
    return _first_line(text) if text.strip() else type(error).__name__


def _first_line(error: object) -> str:
    lines = [" ".join(line.split()) for line in str(error).splitlines()]
    kept = [line for line in lines if line and not line.startswith(("See http", "full_key", "object_type", "^"))]
    return "; ".join(kept[:3])


def _configs() -> Path:
    from torchpt.core.files import configs

    return configs()


def _help(text: str) -> str:
    return text.format(scenes=keys.scenes(), keys=keys.listed().replace("\n", "\n  "))
