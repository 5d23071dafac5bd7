"""Names of settings and of their config files, for help texts and error messages.

They are read from the files in ``configs/``, which ``scripts/make_configs.py`` writes from the declared parameters: importing
the classes that declare them would take seconds.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from functools import cache
from typing import Any

from torchpt.cli.arguments import GROUPS, SCENE_BLOCKS
from torchpt.core.errors import did_you_mean
from torchpt.core.files import configs

__all__ = ["keys_help", "known_keys", "options", "scenes_help", "types", "unknown_key_error"]


def options(group: str) -> list[str]:
    """Return the names of the files of a config group, or of the shipped scenes (``scene``), sorted."""
    return sorted(path.stem for path in (configs() / group).glob("*.yaml"))


@cache
def known_keys(group: str, name: str = "default") -> tuple[str, ...]:
    """Return the keys in a file of a config group, nested keys dotted; ``default`` has the keys of all types."""
    import yaml

    block: dict[str, Any] = yaml.safe_load((configs() / group / f"{name}.yaml").read_text(encoding="utf-8"))
    nested = {key: value if isinstance(value, dict) else {"": None} for key, value in block.items()}
    return tuple(f"{key}.{inner}" if inner else key for key, inners in nested.items() for inner in inners)


def types(group: str) -> list[str]:
    """Return the types of a config group that have a file: ``path``, ``direct``, ... of ``integrator``."""
    return [name for name in options(group) if name != "default"]


def keys_help() -> str:
    """List all keys for the help, group by group; where types have different keys, a line for each type."""
    lines: list[str] = []
    for group in GROUPS:
        # Keys by type, without the first, which is `type` itself.
        own = {name: " ".join(known_keys(group, name)[1:]) for name in types(group)}
        if len(set(own.values())) > 1:
            width = max(map(len, own))
            rows = [f"type={name:{width}}  {keys}" for name, keys in own.items()]
        else:
            rows = [" ".join(known_keys(group)) + (f" (type: {', '.join(own)})" if own else "")]
        lines += [f"{group + '.' if k == 0 else '':12}{row}".rstrip() for k, row in enumerate(rows)]
    return "\n".join(lines)


def unknown_key_error(key: str, words: Iterable[str] = ()) -> str:
    """Return the error message for a key that is unknown, or unknown to the type that the command line chooses.

    Args:
        key: dotted key.
        words: words of the command line, which may choose types.
    """
    group, _, name = key.partition(".")
    if group in GROUPS:
        chosen = next((word.partition("=")[2] for word in words if word.startswith(f"{group}=")), "default")
        for kind in chosen.split(","):
            if kind in types(group) and name not in known_keys(group, kind) and name in known_keys(group):
                own = ", ".join(known_keys(group, kind))
                owners = ", ".join(other for other in types(group) if name in known_keys(group, other))
                return f"{key}: expected only keys of {group}={kind} ({own}); {name} belongs to {owners}"
        outer = key.rpartition(".")[0]
        if outer != group and any(word.startswith(f"{outer}=") for word in words):
            return f"{key}: expected {outer}.type= beside it, or both as {outer}={{type: ..., {key.rpartition('.')[2]}: ...}}"
        if name in known_keys(group):
            how = f"+{key}= adds it, as does `defaults: [default]` there"
            return f"{key}: expected a key of the file of {group} that is chosen; {how}"
        known = [f"{group}.{name}" for name in known_keys(group)]
        return f"{key}: unknown key{did_you_mean(key, known)}; known: {', '.join(known)}"
    every = [f"{group}.{known}" for group in GROUPS for known in known_keys(group)]
    in_some_group = next((known for known in every if known.endswith(f".{key}")), None)
    of_command = did_you_mean(key, [*every, *GROUPS, "scene", "out"])
    of_scene = did_you_mean(group, SCENE_BLOCKS, lambda block: f"{block}.{name}" if name else block)
    if in_some_group:
        hint = f" (did you mean {in_some_group}?)"
    elif name and not did_you_mean(group, GROUPS):  # the last part may be a key of both
        hint = of_scene or of_command
    else:
        hint = of_command or of_scene
    ours = ", ".join(f"{group}.*" for group in GROUPS)
    _version, *blocks = SCENE_BLOCKS  # nobody overrides the version of the format
    return f"{key}: unknown key{hint}; known: scene, out, {ours}, and the scene's own: {', '.join(blocks)}"


def scenes_help() -> str:
    """Return the names of the shipped scenes, wrapped for the help."""
    names = ", ".join(options("scene"))
    return textwrap.fill(names, 110, initial_indent=" " * 11, subsequent_indent=" " * 11, break_on_hyphens=False)
