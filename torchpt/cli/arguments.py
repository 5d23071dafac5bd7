"""Parse a command line: separate torchpt's own words from the overrides that Hydra parses.

File names may hold blanks, brackets, commas and ``=``, which have a meaning in Hydra's grammar. So ``scene=``, ``out=``
and the settings that are file names (:func:`path_keys`) are parsed here and kept as written.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
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

#: Config groups: the blocks of run settings.
GROUPS = ("film", "integrator", "sampler", "render")
#: Blocks of a scene that are not run settings; their keys depend on the scene. The last two are of imported scenes.
SCENE_BLOCKS = ("version", "camera", "textures", "materials", "shapes", "lights", "import", "scene_params")
#: Keys of `torchpt orbit` only.
TURN_KEYS = ("frames", "degrees", "fps", "keep")
_TURN_WORD = re.compile(rf"({'|'.join(TURN_KEYS)})=(.*)\Z", re.DOTALL)
#: Keys of `torchpt render` only: print one path instead of rendering a picture.
DEBUG_KEYS = ("debug.pixel", "debug.sample")
_DEBUG_WORD = re.compile(r"\+{0,2}(debug\.[^=]*)=(.*)\Z", re.DOTALL)
# KEY=VALUE with an optional + or ++.
_KEY_VALUE = re.compile(r"\+{0,2}([\w.]+)=(.*)\Z", re.DOTALL)
# A sign (+, ++, ~ or none) and a block of a scene, alone or with a key or a value behind it.
_SCENE_WORD = re.compile(rf"(?:\+\+|\+|~|)(?:{'|'.join(SCENE_BLOCKS)})(?:[.=]|\Z)")
#: A line of a config file that ``scripts/make_configs.py`` writes for a setting that is a file name.
_PATH_SETTING = re.compile(r"^(\w+): .*\(null or a file path\)$", re.MULTILINE)

# option -> (its other name, whether a value follows)
_OPTIONS = {
    "--multirun": ("-m", False),
    "--cfg": ("-c", True),
    "--package": ("-p", True),
    "--config-dir": ("-cd", True),
    "--config-name": ("-cn", True),
    "--resolve": ("", False),
    "--json": ("", False),
    "--help": ("-h", False),  # handled in main.py
    "--hydra-help": ("", False),
}
# What may follow the name of a config group: file names between commas, a list of them, or a mapping.
_FILE_CHOICE = re.compile(r"[A-Za-z_][\w,-]*\Z|\[[\w,-]+\]\Z|\{")
#: What ``--cfg`` shows: settings, those of Hydra, or both.
_CFG_VALUES = ("job", "hydra", "all")


class UsageError(TorchptError):
    """An invalid command line."""

    def __init__(self, text: str) -> None:
        super().__init__("".join(letter if letter.isprintable() else " " for letter in text))


@dataclass
class Arguments:
    """A parsed command line.

    Attributes:
        command: name of the command.
        scenes: names or paths of scenes; several only with ``multirun``.
        outs: files to write, as given; empty without ``out=``.
        paths: values of the settings that are file names, by key.
        turn: values of the keys in `TURN_KEYS`, as written.
        debug: values of the keys in `DEBUG_KEYS`, as written.
        scene_keys: overrides of scene keys in the order given: key and its values, several only with ``multirun``.
        overrides: ``key=value`` overrides for Hydra. A sweep over scenes adds ``+scene_number=0,1``, indices into ``scenes``;
            entry K of ``scene_keys`` adds ``+scene_key_K=0,1``, indices into its values.
        options: options for Hydra, such as ``--multirun`` or ``--cfg job``.
        config_dir: the user's folder of config groups, scenes and configurations.
        multirun: True for a sweep.
        json: print the result of `info`, or the path of `render debug.pixel=...`, as JSON.
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
        """True if Hydra only prints settings or its help, and no job runs."""
        return any(option in ("--cfg", "--hydra-help") for option in self.options)


@cache
def path_keys() -> tuple[str, ...]:
    """Return the dotted keys of the settings that are file names, read from the config files as in `torchpt.cli.keys`."""
    files = [(group, configs() / group / "default.yaml") for group in GROUPS]
    return tuple(
        f"{group}.{key}" for group, file in files for key in _PATH_SETTING.findall(file.read_text(encoding="utf-8"))
    )


def parse(command: str, words: list[str]) -> Arguments:
    """Parse the words after the name of a command.

    Raises:
        UsageError: an unknown option, a word that is not ``key=value``, or a key given twice.
    """
    arguments = Arguments(command)
    value_of_key: dict[str, str] = {}
    swept_words: list[str] = []
    remaining_words = iter(words)
    for word in remaining_words:
        if word.startswith("-"):
            _add_option(arguments, word, remaining_words)
            continue
        if is_scene_word(word):
            swept_words += _add_scene_key(arguments, word)
            continue
        match = _KEY_VALUE.match(word)
        if match is None or match[1] not in (
            "scene",
            "out",
            *path_keys(),
        ):  # else a word of this command alone, or Hydra's
            match = _TURN_WORD.match(word) if arguments.command == "orbit" else _DEBUG_WORD.match(word)
        if match is None:
            _add_override(arguments, word)
            continue
        key, value = match.groups()
        if key in value_of_key:
            raise UsageError(f"{key}: given twice, as {value_of_key[key]!r} and {value!r}")
        if not value:
            raise UsageError(f"{key}: expected a name, got nothing")
        value_of_key[key] = value
        if key == "scene":
            arguments.overrides.append("scene")  # placeholder: the order of overrides is the order of the sweep
    arguments.multirun |= any(word.replace(" ", "") == "hydra.mode=MULTIRUN" for word in arguments.overrides)
    if swept_words and not arguments.multirun:
        raise UsageError(f"{swept_words[0]}: expected one value or a list [..,..] (--multirun sweeps over several)")
    if arguments.multirun and arguments.only_shows:
        raise UsageError("--multirun: cannot be combined with --cfg or --hydra-help")
    arguments.debug = _checked_debug_keys(arguments, value_of_key)
    if arguments.json and arguments.command != "info" and not arguments.debug:
        raise UsageError(
            "--json: only `torchpt info`, `torchpt compare` and `torchpt render debug.pixel=[x,y]` take it; "
            f"the last line of `torchpt {arguments.command}` is JSON anyway"
        )
    if arguments.command == "info" and "out" in value_of_key:
        raise UsageError("out: `torchpt info` writes no picture")
    arguments.scenes = _split_scenes(value_of_key.get("scene"), multirun=arguments.multirun)
    arguments.outs = _split_names("out", value_of_key.get("out"))
    arguments.paths = {
        key: None if value_of_key[key] == "null" else value_of_key[key] for key in path_keys() if key in value_of_key
    }
    arguments.turn = {key: value_of_key[key] for key in TURN_KEYS if key in value_of_key}
    sweep = f"+scene_number={','.join(map(str, range(len(arguments.scenes))))}"
    arguments.overrides = [sweep if word == "scene" else word for word in arguments.overrides]
    if arguments.only_shows:  # Hydra does not show scenes
        arguments.overrides = [word for word in arguments.overrides if not word.startswith("+scene_key_")]
    if len(arguments.scenes) < 2:
        arguments.overrides = [word for word in arguments.overrides if word != sweep]
    return arguments


def _add_scene_key(arguments: Arguments, word: str) -> list[str]:
    """Add an override of a scene key to `arguments`; return ``[word]`` if it sweeps, else ``[]``."""
    from torchpt.cli.grammar import read_word

    key, values, sweeps = read_word(word)
    if any(key == other for other, _ in arguments.scene_keys):
        raise UsageError(f"{key}: given twice")
    numbers = ",".join(map(str, range(len(values))))
    arguments.overrides.append(f"+scene_key_{len(arguments.scene_keys)}={numbers}")
    arguments.scene_keys.append((key, values))
    return [word] if sweeps else []


def is_scene_word(word: str) -> bool:
    """Return True if `word` overrides a key of a block in `SCENE_BLOCKS`."""
    return _SCENE_WORD.match(word) is not None


def _checked_debug_keys(arguments: Arguments, value_of_key: dict[str, str]) -> dict[str, str]:
    """Return the ``debug.*`` values among `value_of_key`, after a check that they fit the other words."""
    found = {key: value for key, value in value_of_key.items() if key.startswith("debug.")}
    for key in found:
        if key not in DEBUG_KEYS:
            raise UsageError(f"{key}: unknown key; known: {', '.join(DEBUG_KEYS)}")
        if arguments.command != "render":
            raise UsageError(f"{key}: only `torchpt render` takes it")
    if "debug.sample" in found and "debug.pixel" not in found:
        raise UsageError("debug.sample: expected debug.pixel=[x,y] beside it, whose sample it is")
    if found and "out" in value_of_key:
        raise UsageError("out: no picture is rendered where debug.pixel is given")
    return found


def parse_study(words: list[str]) -> tuple[dict[str, str], list[str]]:
    """Return the settings of `torchpt converge` by key, as written, and its overrides of scene keys.

    `torchpt converge` does not use Hydra: a list of values is an axis of the study.

    Raises:
        UsageError: an option, a word that is not ``key=value``, or a key given twice.
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


def _add_option(arguments: Arguments, word: str, remaining_words: Iterator[str]) -> None:
    """Add an option to ``arguments``; its value may be the next of ``remaining_words``."""
    name, _, value = word.partition("=")
    option = next((option for option, (short, _) in _OPTIONS.items() if name in (option, short)), None)
    if option is None:
        raise UsageError(f"{word}: unknown option; known: {', '.join(_OPTIONS)}")
    _, takes_value = _OPTIONS[option]
    if takes_value:
        value = value or next(remaining_words, "")
        if not value and option != "--cfg":
            raise UsageError(f"{option}: expected a value behind it")
        if option == "--cfg" and value not in _CFG_VALUES:
            raise UsageError(f"--cfg: expected one of {', '.join(_CFG_VALUES)}, got {value!r}")
        if option == "--config-dir":
            if not Path(value).is_dir():
                raise UsageError(f"--config-dir: expected a folder that is there, got {value!r}")
            arguments.config_dir = value = os.path.abspath(value)
        if option == "--config-name" and not re.match(r"[\w-]+\Z", value):
            raise UsageError(
                f"--config-name: expected the name of a .yaml file in the folder of --config-dir, got {value!r}"
            )
        arguments.options += [option, value]
    elif value:
        raise UsageError(f"{word}: {option} takes no value")
    elif option == "--json":
        arguments.json = True
    else:
        arguments.multirun |= option == "--multirun"
        arguments.options.append(option)


def _add_override(arguments: Arguments, word: str) -> None:
    """Add a word to the overrides for Hydra, after checks that Hydra does not make."""
    if "=" not in word and not word.startswith("~"):
        raise UsageError(
            f"{word}: expected key=value, for example scene={word if word.isidentifier() else 'cornell_box'}"
        )
    if "_target_" in word or word.lstrip("+").startswith("hydra.callbacks"):
        raise UsageError(f"{word}: no setting names a Python object to call: `_target_` and callbacks are refused")
    key, _, value = word.lstrip("+~").partition("=")
    if not key.strip() or key == "out" or re.match(r"scene(\b|_number|_key_)", key):
        raise UsageError(f"{word}: expected key=value")
    if key in GROUPS and (value == "null" or not _FILE_CHOICE.match(value)):  # no path out of the group's folder
        raise UsageError(f"{key}: expected the name of a file in configs/{key}, got {value!r}")
    if "range(" in value:
        from torchpt.cli.grammar import read_value

        read_value(key, value)  # Hydra does nothing for no values, and does not count many
    arguments.overrides.append(word)


def _split_scenes(value: str | None, *, multirun: bool) -> list[str]:
    """Return the names of scenes in the value of ``scene=``; commas separate them in a sweep only."""
    if value is None:
        return []
    if not multirun or "," not in value or Path(value).exists():
        return [value]
    return _split_names("scene", f"[{value}]")


def _split_names(key: str, value: str | None) -> list[str]:
    """Split a value into names: ``a b.exr`` is one, ``[a.exr, 'b,c.png']`` is a list; names with commas are quoted."""
    if value is None:
        return []
    if not (value.startswith("[") and value.endswith("]")):
        return [value]
    # Text in double or single quotes, or without commas; then a comma or the end.
    parts = re.findall(r"""\s*("[^"]*"|'[^']*'|[^,]*?)\s*(?:,|\Z)""", value[1:-1])
    names = [part[1:-1] if part[:1] in "'\"" and part[:1] == part[-1:] and len(part) > 1 else part for part in parts]
    if len(names) > 1 and not names[-1]:
        names.pop()  # the pattern also matches the empty end of the text
    if not all(names):
        raise UsageError(f"{key}: expected names between commas, got {value!r}")
    return names
