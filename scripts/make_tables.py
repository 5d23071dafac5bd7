"""Write the tables of the docs from declared parameters, between ``<!-- generated: NAME -->`` and ``<!-- end -->``.

    python scripts/make_tables.py            # writes pages of docs/
    python scripts/make_tables.py --check    # exit code 1 where a page is not what would be written

A NAME is a table of types (``lights``, ``materials``, ...), one type of it (``lights.spot``), ``common.lights`` (the
parameters of all its types), or ``summary.lights`` (a row for each type). ``bounds`` is the table of :mod:`bounds`,
``arguments`` that of ``render``'s arguments, ``mitsuba.TAG`` lists what becomes of Mitsuba's plugins, ``help`` and
``help.render`` are help texts, ``public.cameras`` lists the names of ``torchpt.cameras``.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import bounds

from torchpt.scene.settings import RenderOptions
from torchpt.spec import REQUIRED, Color, Index, Scalar, Spec, parameters_of
from torchpt.spec.arguments import arguments_of

DOCS = Path(__file__).parents[1] / "docs"
MARKED = re.compile(r"(<!-- generated: ([\w.]+) -->\n).*?(<!-- end -->)", re.DOTALL)
#: NAME -> module and attribute of the table of types.
TABLES = {
    "materials": ("torchpt.physics.bsdfs", "KINDS"),
    "lights": ("torchpt.physics.lights", "KINDS"),
    "cameras": ("torchpt.physics.cameras", "KINDS"),
    "filters": ("torchpt.physics.film", "FILTERS"),
    "integrators": ("torchpt.paths.integrators", "KINDS"),
    "layers": ("torchpt.paths.layers", "LAYERS"),
    "settings": ("torchpt.scene.settings", "UNTYPED_BLOCKS"),
    "shapes": ("torchpt.physics.shapes", "KINDS"),
    "studies": ("torchpt.reports.study", "UNTYPED_BLOCKS"),
    "textures": ("torchpt.physics.textures", "KINDS"),
}


@cache
def kinds(name: str) -> Mapping[str, Any]:
    """Return the classes of a table by name."""
    module, attribute = TABLES[name]
    return getattr(import_module(module), attribute)


def common(table: Mapping[str, Any]) -> dict[str, Spec]:
    """Return the parameters that the base class of a table declares for all types."""
    every = [table[name] for name in table]
    roots = [base for base in every[0].__mro__ if all(issubclass(kind, base) for kind in every)]
    return parameters_of(roots[0]) if len(every) > 1 else {}


def shown(value: Any) -> str:
    """Format a default value as a user would write it."""
    if value is REQUIRED:
        return "required"
    if value is None:
        return ""
    if callable(value):
        return "from the others"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return shown(value[0]) if len(set(value)) == 1 else f"[{', '.join(map(shown, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def accepted(spec: Spec) -> str:
    """Describe in few words what a parameter accepts."""
    if isinstance(spec, Index):
        words = "an index, or a medium's name"
    elif isinstance(spec, Color | Scalar) and not spec.words:
        words = spec.accepted.replace("[r, g, b] or one number, each finite", "a colour").replace(
            "a finite number", "a number"
        )
        words = words.replace("colour and", "colour")
    else:
        words = spec.words or spec.accepted
    if len(words) > LONGEST:
        words = words[: words.rfind(",", 0, LONGEST)] + ", ..."
    return words + (", or a texture" if spec.texture else "")


#: Largest width of a cell that lists the accepted values, in characters.
LONGEST = 110


def row(key: str, spec: Spec) -> str:
    """Return the table row of a parameter."""
    cells = (f"`{key}`", shown(spec.default), accepted(spec), spec.doc)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


HEAD = "| key | default | accepted | what it is |\n|---|---|---|---|\n"


def rows(specs: Mapping[str, Spec]) -> str:
    """Return parameters as a table."""
    return HEAD + "".join(row(key, spec) + "\n" for key, spec in specs.items())


def arguments(form: Any) -> str:
    """Return keyword arguments as a table: their Python defaults, and the meaning of None."""
    text = "| argument | what it is | accepted | default |\n|---|---|---|---|\n"
    for name, item in arguments_of(form).items():
        default = f"`{item.default}`{item.stands_for.removeprefix(str(item.default))}"
        text += f"| `{name}` | {item.spec.doc} | {item.accepted} | {default} |\n"
    return text


def about(kind: Any) -> str:
    """Return the first paragraph of a type's docstring, as Markdown."""
    return " ".join((kind.__doc__ or "").strip().split("\n\n")[0].split()).replace("``", "`")


def summary(table: Mapping[str, Any]) -> str:
    """Return a table with a row for each type: its keys with their defaults."""
    shared: dict[str, Spec] = common(table)
    lines: list[tuple[str, str, str]] = []
    for name in table:
        own = {key: spec for key, spec in parameters_of(table[name]).items() if key not in shared}
        keys = [f"`{key}`{f' {shown(spec.default)}' if _plain(spec) else ''}" for key, spec in own.items()]
        lines.append((f"`{name}`", ", ".join(keys), about(table[name]).replace("||", "\\|\\|")))
    if not any(keys for _, keys, _ in lines):
        return "| name | what it is |\n|---|---|\n" + "".join(f"| {name} | {text} |\n" for name, _, text in lines)
    rows = (f"| {name} | {keys or 'none'} | {text} |\n" for name, keys, text in lines)
    return "| type | keys (default) | what it is |\n|---|---|---|\n" + "".join(rows)


def _plain(spec: Spec) -> bool:
    return spec.default is not REQUIRED and spec.default is not None and not callable(spec.default)


def said(command: str) -> str:
    """Return the help of a command, or of ``torchpt`` itself, as a code block."""
    from torchpt.cli.main import help_of

    return f"```text\n{help_of(command).rstrip()}\n```\n"


def public(module: str) -> str:
    """List the names that a public module exports, with the first lines of their docstrings."""
    room = import_module(f"torchpt.{module}")
    lines = []
    for name in room.__all__:
        value = getattr(room, name)
        own = value.__doc__ if getattr(value, "__module__", "").startswith("torchpt.") else None
        text = " ".join((own or "").strip().split("\n\n")[0].split()).replace("``", "`").replace("|", "\\|")
        text = re.sub(r":[a-z]+:`~?([^`]+)`", r"`\1`", text)
        lines.append(f"| `{name}` | {text} |\n")
    return "| name | what it is |\n|---|---|\n" + "".join(lines)


def plugins(tag: str) -> str:
    """Return a table of what becomes of Mitsuba's plugins of a tag, plugins of one fate in one row."""
    from torchpt.scene.formats.mitsuba.importer import PLUGINS

    rows: dict[tuple[str, str, str], list[str]] = {}
    for name, plugin in PLUGINS[tag].items():
        rows.setdefault((plugin.twin.value, plugin.becomes, plugin.note), []).append(f"`{name}`")
    lines = (f"| {' '.join(names)} | {' | '.join(fate)} |\n" for fate, names in rows.items())
    return f"| {tag} | twin | becomes | what differs |\n|---|---|---|---|\n" + "".join(lines)


def written(name: str) -> str:
    """Return the generated text for NAME."""
    first, _, second = name.partition(".")
    if name == "bounds":
        return bounds.table()
    if name == "arguments":
        return arguments(RenderOptions)
    if first == "mitsuba":
        return plugins(second)
    if first == "help":
        return said(second)
    if first == "public":
        return public(second)
    if first == "summary":
        return summary(kinds(second))
    if first == "common":
        return rows(common(kinds(second)))
    if second:
        table = kinds(first)
        return rows({key: spec for key, spec in parameters_of(table[second]).items() if key not in common(table)})
    table, parts = kinds(first), []
    for kind in table:
        own = {key: spec for key, spec in parameters_of(table[kind]).items() if key not in common(table)}
        parts.append(f"**`{kind}`**: {about(table[kind])}\n\n{rows(own) if own else ''}")
    return "\n".join(parts)


def page(text: str, make: Callable[[str], str] = written) -> str:
    """Return a page with its tables up to date."""
    return MARKED.sub(lambda match: match[1] + make(match[2]) + match[3], text)


def main() -> int:
    """Write the pages, or check them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    stale = []
    for file in sorted(DOCS.rglob("*.md")):
        text = file.read_text(encoding="utf-8")
        fresh = page(text)
        if fresh != text:
            stale.append(file.relative_to(DOCS).as_posix())
            if not check:
                file.write_text(fresh, encoding="utf-8")
    print(f"{'stale' if check else 'written'}: {', '.join(stale) or 'none'}")
    return 1 if check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
