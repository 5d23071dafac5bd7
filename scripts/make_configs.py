"""Write the config groups in configs/ (film, integrator, sampler, render) from the parameters that their types declare.

    python scripts/make_configs.py            # writes configs/*/*.yaml, and removes groups' files of kinds that are gone
    python scripts/make_configs.py --check    # exit code 1 where a file is not what would be written

``default.yaml`` of a group has the keys of all its types, the file of a type has its own keys. null keeps the scene's value.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from torchpt.scene.settings import BLOCKS, TYPED_BLOCKS, UNTYPED_BLOCKS
from torchpt.spec import Choice, Spec, parameters_of

CONFIGS = Path(__file__).parents[1] / "configs"
#: Key that the example command in a file's first line sets, where it is not the first key with a default.
EXAMPLES = {
    "film": {"width": "512", "height": "512", "aovs": "[albedo,normal]"},
    "render": {"spp": "256", "seed": "1", "preview": "preview.png"},
}


def accepted(spec: Spec) -> str:
    """Return the words that a parameter accepts, if they are few."""
    return ", ".join(spec.names) if isinstance(spec, Choice) else spec.words


def comment(spec: Spec, owners: Iterable[str] = ()) -> str:
    """Describe a parameter, and name the types that have it if not all do."""
    words, of = accepted(spec), ", ".join(owners)
    text = f"{spec.doc} ({words})" if words else spec.doc
    return (f"of {of}: {text}" if of else text).replace("`", "")


def first_line(group: str, kind: str | None, specs: Mapping[str, Spec]) -> str:
    """Return the example command in the first line of a file."""
    chosen = {key: spec.default for key, spec in specs.items() if spec.default is not None}
    example = EXAMPLES.get(group) or {key: str(value).lower() for key, value in list(chosen.items())[:1]}
    words = [f"{group}={kind}"] if kind else [f"{group}.type={TYPED_BLOCKS[group][1]}"] if group in TYPED_BLOCKS else []
    words += [f"{group}.{key}={value}" for key, value in example.items()]
    return f"# {' '.join(['torchpt render scene=cornell_box', *words])}\n"


def summary(kind: Any) -> str:
    """Return the first sentence of a type's docstring."""
    text = " ".join((kind.__doc__ or "").strip().split("\n\n")[0].split())
    return text.removesuffix(".").replace("`", "")


def every(table: Mapping[str, Any]) -> dict[str, tuple[Spec, tuple[str, ...]]]:
    """Return all parameters of a table's types, each with the types that have it; an empty list if all do."""
    found: dict[str, tuple[Spec, tuple[str, ...]]] = {}
    for name in table:
        for key, spec in parameters_of(table[name]).items():
            first, owners = found.get(key, (spec, ()))
            found[key] = first, (*owners, name)
    return {key: (spec, owners if len(owners) < len(table) else ()) for key, (spec, owners) in found.items()}


Rows = list[tuple[str, str, str]]


def rows_of(table: Mapping[str, Any], kind: str | None) -> Rows:
    """Return lines ``key, value, comment`` of a block with types, for one type or for all."""
    if kind is not None:
        own = [(key, "null", comment(spec)) for key, spec in parameters_of(table[kind]).items()]
        return [("type", kind, summary(table[kind])), *own]
    shared = [(key, "null", comment(spec, owners)) for key, (spec, owners) in every(table).items()]
    return [("type", "null", ", ".join(table)), *shared]


def block(rows: Rows, indent: str = "") -> str:
    """Format lines with their comments aligned in a column."""
    wide = max(len(f"{key}: {value}".rstrip()) for key, value, _ in rows)
    lines = [(f"{key}: {value}".rstrip(), says) for key, value, says in rows]
    return "".join(f"{indent}{line:{wide}}{f'  # {says}' if says else ''}".rstrip() + "\n" for line, says in lines)


def typed(group: str, kind: str | None) -> str:
    """Return the file of a type, or of all types of a group."""
    table, default = TYPED_BLOCKS[group]
    head = first_line(group, kind, parameters_of(table[kind or default]))
    return head + block(rows_of(table, kind))


def plain(group: str, record: Any) -> str:
    """Return the file of a group without types."""
    specs = parameters_of(record)
    text = first_line(group, None, specs)
    rows: Rows = []
    for key, spec in specs.items():
        if key in TYPED_BLOCKS:
            text += block(rows) + block([(key, "", comment(spec))]) + block(rows_of(TYPED_BLOCKS[key][0], None), "  ")
            rows = []
        else:
            rows.append((key, "null", comment(spec)))
    return text + block(rows)


def written() -> dict[str, str]:
    """Return the text of each file by its path below configs/."""
    files = {f"{group}/default.yaml": plain(group, record) for group, record in UNTYPED_BLOCKS.items()}
    for group in BLOCKS:
        if group in TYPED_BLOCKS:
            files |= {
                f"{group}/{kind or 'default'}.yaml": typed(group, kind) for kind in (None, *TYPED_BLOCKS[group][0])
            }
    return files


def main() -> int:
    """Write the files, or check them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    files = written()
    there = {str(path.relative_to(CONFIGS)) for group in BLOCKS for path in (CONFIGS / group).glob("*.yaml")}
    stale = sorted(there - files.keys())
    for name in stale:
        if not check:
            (CONFIGS / name).unlink()
    for name, text in files.items():
        path = CONFIGS / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            stale.append(name)
            if not check:
                path.write_text(text, encoding="utf-8")
    print(f"{'stale' if check else 'written'}: {', '.join(stale) or 'none'}")
    return 1 if check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
