"""Compose the settings of one job from plain words, as Hydra would: importing Hydra takes longer than a small render.

Only what cannot mean anything else is taken: a group's file by name, and numbers, words and flat lists of them for keys
that the group's file has. Whatever is left (sweeps, ``+`` and ``~``, quotes, interpolations, every mistake) is Hydra's.
"""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchpt.commands.arguments import GROUPS

__all__ = ["compose_plainly"]

#: What `config.yaml` must hold for this to be all of the composition.
_CONFIG = {
    "defaults": [
        *({group: "default"} for group in GROUPS),
        {"override hydra/job_logging": "none"},
        {"override hydra/hydra_logging": "none"},
        "_self_",
    ],
    "hydra": {
        "run": {"dir": "."},
        "sweep": {"dir": ".", "subdir": "."},
        "output_subdir": None,
        "job": {"chdir": False},
    },
}
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_INT = re.compile(r"-?(?:0|[1-9][0-9]*)\Z")
_FLOAT = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?\Z")
_LONGEST = 300  # digits; Python refuses to read an int of thousands
_CONSTANTS = {"true": True, "false": False, "null": None}


#: Plugins of Hydra that start jobs, and change nothing else.
LAUNCHERS = {"hydra_joblib_launcher", "hydra_submitit_launcher", "hydra_ray_launcher"}


class _NotPlain(Exception):
    """Something that is left to Hydra."""


def compose_plainly(words: list[str], folder: Path) -> dict[str, Any] | None:
    """The composed settings; None where Hydra has to look.

    Args:
        words: ``key=value`` each.
        folder: the config groups.
    """
    if not _plugins() <= LAUNCHERS:  # may add to the search path
        return None
    chosen, given = dict.fromkeys(GROUPS, "default"), {}
    try:
        for word in words:
            key, _, text = word.partition("=")
            if key in given or not text or (key in GROUPS and not _NAME.match(text)):
                return None
            given[key] = text
        chosen |= {key: text for key, text in given.items() if key in GROUPS}
        if _read(folder / "config.yaml") != _CONFIG:
            return None
        composed = {group: _block(folder / group / f"{name}.yaml") for group, name in chosen.items()}
        for key, text in given.items():
            if key not in GROUPS:
                _set(composed, key, _value(text))
    except (_NotPlain, OSError, ValueError):
        return None
    return composed


def _plugins() -> set[str]:
    """Names of Hydra's plugins that are installed."""
    found = find_spec("hydra_plugins")
    if found is None:
        return set()
    names = {path.stem for place in found.submodule_search_locations or () for path in Path(place).glob("*")}
    return {name for name in names if not name.startswith("__")}


def _read(path: Path) -> Any:
    import yaml

    text = path.read_text(encoding="utf-8")
    if "@package" in text:
        raise _NotPlain
    try:
        return yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise _NotPlain from error


def _block(path: Path) -> dict[str, Any]:
    """A group's file, which may hold mappings, nulls and words: OmegaConf reads other YAML its own way."""
    block = _read(path)
    if not isinstance(block, dict) or "defaults" in block:
        raise _NotPlain
    rows = [block]
    for row in rows:
        for key, value in row.items():
            if not isinstance(key, str) or not _NAME.match(key):
                raise _NotPlain
            if isinstance(value, dict):
                rows.append(value)
            elif value is not None and not (isinstance(value, str) and _NAME.match(value)):
                raise _NotPlain
    return block


def _set(composed: dict[str, Any], key: str, value: Any) -> None:
    """Give a key that is there another value."""
    *parents, last = key.split(".")
    place: Any = composed
    for parent in parents:
        if not isinstance(place, dict):
            raise _NotPlain
        place = place.get(parent)
    if not parents or not isinstance(place, dict) or last not in place:
        raise _NotPlain
    if isinstance(place[last], dict) and isinstance(value, list):  # an error, whose words are Hydra's
        raise _NotPlain
    place[last] = value


def _value(text: str) -> Any:
    if text.startswith("[") and text.endswith("]"):
        return [_scalar(item) for item in text[1:-1].split(",")] if len(text) > 2 else []
    return _scalar(text)


def _scalar(text: str) -> Any:
    if len(text) > _LONGEST:
        raise _NotPlain
    if _INT.match(text):
        return int(text)
    if _FLOAT.match(text):
        return float(text)
    if _NAME.match(text) and text.lower() not in ("inf", "nan"):
        return _CONSTANTS.get(text.lower(), text)
    raise _NotPlain
