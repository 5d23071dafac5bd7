"""Take a command line apart: what belongs to torchpt itself, and what is left for Hydra.

File names never enter Hydra's grammar, in which blanks, brackets, commas and ``=`` mean something: ``scene=``, ``out=``
and the settings that are files (:func:`path_keys`) are taken out here, as they are written.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from torchpt.core.errors import TorchptError
from torchpt.core.files import configs

__all__ = [
    "DEBUG_KEYS",
    "GROUPS",
    "SCENE_BLOCKS",
    "Arguments",
    "UsageError",
    "is_scene_word",
    "parse",
    "parse_study",
    "path_keys",
]

GROUPS = ("film", "integrator", "sampler", "render")
#: Blocks of a scene that are no run settings: what their keys are is for the scene to say.
SCENE_BLOCKS = ("version", "camera", "textures", "materials", "shapes", "lights")
#: Keys of `torchpt orbit` alone.
TURN_KEYS = ("frames", "degrees", "fps", "keep")
_TURN = re.compile(rf"({'|'.join(TURN_KEYS)})=(.*)\Z", re.DOTALL)
#: Keys of `torchpt render` alone: one path in place of a picture. No scene file has them.
DEBUG_KEYS = ("debug.pixel", "debug.sample")
_DEBUG = re.compile(r"\+{0,2}(debug\.[^=]*)=(.*)\Z", re.DOTALL)
_TAKEN = re.compile(r"\+{0,2}([\w.]+)=(.*)\Z", re.DOTALL)
_SCENE_WORD = re.compile(rf"(?:\+\+|\+|~|)(?:{'|'.join(SCENE_BLOCKS)})(?:[.=]|\Z)")
#: A line of a group's file, as ``scripts/make_configs.py`` writes it of a setting that is a file.
_PATH = re.compile(r"^(\w+): .*\(null or a file path\)$", re.MULTILINE)

# option -> (its other name, whether a value follows)
_OPTIONS = {
    "--multirun": ("-m", False),
    "--cfg": ("-c", True),
    "--package": ("-p", True),
    "--config-dir": ("-cd", True),
    "--config-name": ("-cn", True),
    "--resolve": ("", False),
    "--json": ("", False),
    "--help": ("-h", False),  # which main knows
    "--hydra-help": ("", False),
}
_CHOICE = re.compile(r"[A-Za-z_][\w,-]*\Z|\[[\w,-]+\]\Z|\{")
_CONFIGS = ("job", "hydra", "all")


class UsageError(TorchptError):
    """A command line that cannot be understood."""

    def __init__(self, text: str) -> None:
        super().__init__("".join(letter if letter.isprintable() else " " for letter in text))


@dataclass
class Arguments:
    """A command line in parts.

    Attributes:
        command: its name.
        scenes: names or paths; several only with ``multirun``.
        outs: pictures to write, as given; empty where nothing was said.
        paths: values of the settings that are files.
        turn: values of the keys in `TURN_KEYS`, as written.
        debug: values of the keys in `DEBUG_KEYS`, as written.
        scene_keys: overrides of scene keys in the order given: key and its values, several only with ``multirun``.
        overrides: what Hydra gets: ``key=value``; for a sweep over scenes also ``+scene_number=0,1``, into ``scenes``, and for
            each of ``scene_keys`` ``+scene_key_K=0,1``, into its values.
        options: what Hydra gets besides, such as ``--multirun`` or ``--cfg job``.
        config_dir: a folder with groups, scenes and configurations of the caller's own.
        multirun: whether this is a sweep.
        json: print `info`, or the path of `render debug.pixel=...`, as JSON.
    """

    command: str
    scenes: list[str] = field(default_factory=list)
    outs: list[str] = field(default_factory=list)
    paths: dict[str, str | None] = field(default_factory=dict)
    turn: dict[str, str] = field(default_factory=dict)
    debug: dict[str, str] = field(default_factory=dict)
    scene_keys: list[tuple[str, list[Any]]] = field(default_factory=list)
    overrides: list[str] = field(default_factory=list)
    options: list[str] = field(default_factory=list)
    config_dir: str | None = None
    multirun: bool = False
    json: bool = False

    @property
    def only_shows(self) -> bool:
        """Hydra prints something and no job runs."""
        return any(option in ("--cfg", "--hydra-help") for option in self.options)


@cache
def path_keys() -> tuple[str, ...]:
    """Return the settings that are files, by the groups' files: importing what declares them would take seconds."""
    files = [(group, configs() / group / "default.yaml") for group in GROUPS]
    return tuple(f"{group}.{key}" for group, file in files for key in _PATH.findall(file.read_text(encoding="utf-8")))


def parse(command: str, words: list[str]) -> Arguments:
    """Take the words after the name of a command apart.

    Raises:
        UsageError: an unknown option, a word that is no ``key=value``, a key that is given twice.
    """
    arguments = Arguments(command)
    taken: dict[str, str] = {}
    swept: list[str] = []
    rest = iter(words)
    for word in rest:
        if word.startswith("-"):
            _option(arguments, word, rest)
            continue
        if is_scene_word(word):
            swept += _scene_word(arguments, word)
            continue
        match = _TAKEN.match(word)
        if match is None or match[1] not in ("scene", "out", *path_keys()):
            match = _TURN.match(word) if arguments.command == "orbit" else _DEBUG.match(word)
        if match is None:
            _override(arguments, word)
            continue
        key, value = match.groups()
        if key in taken:
            raise UsageError(f"{key}: given twice, as {taken[key]!r} and {value!r}")
        if not value:
            raise UsageError(f"{key}: expected a name, got nothing")
        taken[key] = value
        if key == "scene":
            arguments.overrides.append("scene")  # keeps its place among the sweeps
    arguments.multirun |= any(word.replace(" ", "") == "hydra.mode=MULTIRUN" for word in arguments.overrides)
    if swept and not arguments.multirun:
        raise UsageError(f"{swept[0]}: expected one value or a list [..,..] (--multirun sweeps over several)")
    if arguments.multirun and arguments.only_shows:
        raise UsageError("--multirun: cannot be combined with --cfg or --hydra-help")
    arguments.debug = _debug(arguments, taken)
    if arguments.json and arguments.command != "info" and not arguments.debug:
        raise UsageError(
            "--json: only `torchpt info`, `torchpt compare` and `torchpt render debug.pixel=[x,y]` take it; "
            f"the last line of `torchpt {arguments.command}` is JSON anyway"
        )
    if arguments.command == "info" and "out" in taken:
        raise UsageError("out: `torchpt info` writes no picture")
    arguments.scenes = _scenes(taken.get("scene"), arguments.multirun)
    arguments.outs = _names("out", taken.get("out"))
    arguments.paths = {key: None if taken[key] == "null" else taken[key] for key in path_keys() if key in taken}
    arguments.turn = {key: taken[key] for key in TURN_KEYS if key in taken}
    sweep = f"+scene_number={','.join(map(str, range(len(arguments.scenes))))}"
    arguments.overrides = [sweep if word == "scene" else word for word in arguments.overrides]
    if arguments.only_shows:  # no scene is a part of what is shown
        arguments.overrides = [word for word in arguments.overrides if not word.startswith("+scene_key_")]
    if len(arguments.scenes) < 2:
        arguments.overrides = [word for word in arguments.overrides if word != sweep]
    return arguments


def _scene_word(arguments: Arguments, word: str) -> list[str]:
    """Take an override of a scene key; returns it where it sweeps."""
    from torchpt.cli.grammar import read_word

    key, values, sweeps = read_word(word)
    if any(key == other for other, _ in arguments.scene_keys):
        raise UsageError(f"{key}: given twice")
    numbers = ",".join(map(str, range(len(values))))
    arguments.overrides.append(f"+scene_key_{len(arguments.scene_keys)}={numbers}")
    arguments.scene_keys.append((key, values))
    return [word] if sweeps else []


def is_scene_word(word: str) -> bool:
    """Return True for an override of a scene's key that is no run setting."""
    return _SCENE_WORD.match(word) is not None


def _debug(arguments: Arguments, taken: dict[str, str]) -> dict[str, str]:
    """The words about one path."""
    found = {key: value for key, value in taken.items() if key.startswith("debug.")}
    for key in found:
        if key not in DEBUG_KEYS:
            raise UsageError(f"{key}: unknown key; known: {', '.join(DEBUG_KEYS)}")
        if arguments.command != "render":
            raise UsageError(f"{key}: only `torchpt render` takes it")
    if "debug.sample" in found and "debug.pixel" not in found:
        raise UsageError("debug.sample: expected debug.pixel=[x,y] beside it, whose sample it is")
    if found and "out" in taken:
        raise UsageError("out: no picture is rendered where debug.pixel is given")
    return found


def parse_study(words: list[str]) -> tuple[dict[str, str], list[str]]:
    """Return the words of `torchpt converge` by key, as written, and overrides of scene keys.

    Its lists are axes, which Hydra has no part in.

    Raises:
        UsageError: an option, a word that is no ``key=value``, a key that is given twice.
    """
    study: dict[str, str] = {}
    changes: list[str] = []
    for word in words:
        key, equals, value = word.partition("=")
        if is_scene_word(word):
            changes.append(word)
        elif word in ("--multirun", "-m"):
            raise UsageError(f"{word}: `torchpt converge` takes lists without it, such as sampler=[independent,sobol]")
        elif word.startswith("-"):
            raise UsageError(f"{word}: unknown option; `torchpt converge` knows --help")
        elif not equals or not re.match(r"[A-Za-z_][\w.]*\Z", key) or "_target_" in key:
            raise UsageError(f"{word}: expected key=value, for example sampler=[independent,sobol]")
        elif key in study:
            raise UsageError(f"{key}: given twice, as {study[key]!r} and {value!r}")
        elif not value:
            raise UsageError(f"{key}: expected a value, got nothing")
        else:
            study[key] = value
    return study, changes


def _option(arguments: Arguments, word: str, rest: object) -> None:
    name, _, value = word.partition("=")
    long = next((option for option, (short, _) in _OPTIONS.items() if name in (option, short)), None)
    if long is None:
        raise UsageError(f"{word}: unknown option; known: {', '.join(_OPTIONS)}")
    if _OPTIONS[long][1]:
        value = value or next(rest, "")  # type: ignore[call-overload]
        if long == "--cfg" and value not in _CONFIGS:
            raise UsageError(f"--cfg: expected one of {', '.join(_CONFIGS)}, got {value!r}")
        if long == "--config-dir":
            if not Path(value).is_dir():
                raise UsageError(f"--config-dir: expected a folder that is there, got {value!r}")
            arguments.config_dir = value = os.path.abspath(value)
        if long == "--config-name" and not re.match(r"[\w-]+\Z", value):
            raise UsageError(
                f"--config-name: expected the name of a .yaml file in the folder of --config-dir, got {value!r}"
            )
        arguments.options += [long, value]
    elif value:
        raise UsageError(f"{word}: {long} takes no value")
    elif long == "--json":
        arguments.json = True
    else:
        arguments.multirun |= long == "--multirun"
        arguments.options.append(long)


def _override(arguments: Arguments, word: str) -> None:
    if "=" not in word and not word.startswith("~"):
        raise UsageError(
            f"{word}: expected key=value, for example scene={word if word.isidentifier() else 'cornell_box'}"
        )
    if "_target_" in word or word.lstrip("+").startswith("hydra.callbacks"):
        raise UsageError(f"{word}: no setting names a Python object to call: `_target_` and callbacks are refused")
    key, _, value = word.lstrip("+~").partition("=")
    if not key.strip() or key == "out" or re.match(r"scene(\b|_number|_key_)", key):
        raise UsageError(f"{word}: expected key=value")
    if key in GROUPS and (value == "null" or not _CHOICE.match(value)):  # nor a way out of the group's folder
        raise UsageError(f"{key}: expected the name of a file in configs/{key}, got {value!r}")
    arguments.overrides.append(word)


def _scenes(value: str | None, multirun: bool) -> list[str]:
    if value is None:
        return []
    if not multirun or "," not in value or Path(value).exists():
        return [value]
    return _names("scene", f"[{value}]")


def _names(key: str, value: str | None) -> list[str]:
    """``a b.exr`` is one name; ``[a.exr, 'b,c.png']`` is a list, whose names are quoted where they hold a comma."""
    if value is None:
        return []
    if not (value.startswith("[") and value.endswith("]")):
        return [value]
    parts = re.findall(r"""\s*("[^"]*"|'[^']*'|[^,]*?)\s*(?:,|\Z)""", value[1:-1])
    names = [part[1:-1] if part[:1] in "'\"" and part[:1] == part[-1:] and len(part) > 1 else part for part in parts]
    if len(names) > 1 and not names[-1]:
        names.pop()  # what the pattern finds at the very end
    if not all(names):
        raise UsageError(f"{key}: expected names between commas, got {value!r}")
    return names
