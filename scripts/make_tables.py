"""Write the tables of the docs from what kinds declare, between ``<!-- generated: NAME -->`` and ``<!-- end -->``.

    python scripts/make_tables.py            # writes docs/*.md
    python scripts/make_tables.py --check    # exit code 1 where a page is not what would be written

A NAME is a table of kinds (``lights``, ``materials``, ...), one kind of it (``lights.spot``), or ``common.lights``: what all kinds of
it have.
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

from torchpt.spec import REQUIRED, Spec, parameters_of

DOCS = Path(__file__).parents[1] / "docs"
MARKED = re.compile(r"(<!-- generated: ([\w.]+) -->\n).*?(<!-- end -->)", re.DOTALL)
#: NAME -> where the table of kinds is.
TABLES = {
    "materials": ("torchpt.bsdfs", "KINDS"),
    "lights": ("torchpt.lights", "KINDS"),
    "cameras": ("torchpt.cameras", "KINDS"),
    "samplers": ("torchpt.samplers", "KINDS"),
    "filters": ("torchpt.film", "FILTERS"),
    "integrators": ("torchpt.integrators", "KINDS"),
    "shapes": ("torchpt.shapes", "KINDS"),
    "textures": ("torchpt.textures", "KINDS"),
}


@cache
def kinds(name: str) -> Mapping[str, Any]:
    """A table of kinds."""
    module, attribute = TABLES[name]
    return getattr(import_module(module), attribute)


def common(table: Mapping[str, Any]) -> dict[str, Spec]:
    """What the base of a table's kinds declares for all of them."""
    every = [table[name] for name in table]
    roots = [base for base in every[0].__mro__ if all(issubclass(kind, base) for kind in every)]
    return parameters_of(roots[0]) if len(every) > 1 else {}


def shown(value: Any) -> str:
    """A default as one would write it."""
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


def row(key: str, spec: Spec) -> str:
    """One parameter."""
    cells = (f"`{key}`", shown(spec.default), spec.brief, spec.doc)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


HEAD = "| key | default | accepted | what it is |\n|---|---|---|---|\n"


def rows(specs: Mapping[str, Spec]) -> str:
    """Parameters as a table."""
    return HEAD + "".join(row(key, spec) + "\n" for key, spec in specs.items())


def written(name: str) -> str:
    """What stands between the marks of NAME."""
    first, _, second = name.partition(".")
    if first == "common":
        return rows(common(kinds(second)))
    if second:
        table = kinds(first)
        return rows({key: spec for key, spec in parameters_of(table[second]).items() if key not in common(table)})
    table, parts = kinds(first), []
    for kind in table:
        own = {key: spec for key, spec in parameters_of(table[kind]).items() if key not in common(table)}
        summary = (table[kind].__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
        parts.append(f"**`{kind}`**: {' '.join(summary.split())}\n\n{rows(own) if own else ''}")
    return "\n".join(parts)


def page(text: str, make: Callable[[str], str] = written) -> str:
    """A page with its tables as they should be."""
    return MARKED.sub(lambda match: match[1] + make(match[2]) + match[3], text)


def main() -> int:
    """Write, or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    stale = []
    for file in sorted(DOCS.glob("*.md")):
        text = file.read_text(encoding="utf-8")
        fresh = page(text)
        if fresh != text:
            stale.append(file.name)
            if not check:
                file.write_text(fresh, encoding="utf-8")
    print(f"{'stale' if check else 'written'}: {', '.join(stale) or 'none'}")
    return 1 if check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
