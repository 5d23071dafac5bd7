"""Tables of the docs are what the kinds declare, Python in them is Python, and the glossary names what is in the code."""

from __future__ import annotations

import re

import pytest
from make_tables import DOCS, MARKED, page, written

PAGES = sorted(file.relative_to(DOCS).as_posix() for file in DOCS.rglob("*.md"))


@pytest.mark.parametrize("name", PAGES)
def test_tables_are_as_they_would_be_written(name: str) -> None:
    text = (DOCS / name).read_text(encoding="utf-8")
    assert page(text) == text, "run scripts/make_tables.py"


@pytest.mark.parametrize("name", ["README.md", *(f"docs/{name}" for name in PAGES)])
def test_python_blocks_compile(name: str) -> None:
    text = (DOCS.parent / name).read_text(encoding="utf-8")
    for block in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        compile("\n" * text.count("\n", 0, block.start(1)) + block[1], name, "exec")


def test_the_last_column_of_the_glossary_is_in_the_code() -> None:
    rows = [line for line in (DOCS / "glossary.md").read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    found = 0
    for row in rows:
        names = re.findall(r"`([^`]+)`", row.removesuffix(" |").rsplit("|", 1)[-1])
        files = [name for name in names if name.endswith(".py")]
        code = "".join((DOCS.parent / "torchpt" / file).read_text(encoding="utf-8") for file in files)
        for name in names if files else ():
            assert name in files or re.search(rf"\b{name}\b", code), f"glossary.md: {name} is not in {files}"
            found += 1
    assert found > 100


def test_a_changed_table_is_noticed() -> None:
    text = (DOCS / "reference/lights.md").read_text(encoding="utf-8")
    assert page(text.replace("power per solid angle", "power")) == text
    marked = ("reference/materials.md", "reference/scenes.md")
    assert any(MARKED.search((DOCS / name).read_text(encoding="utf-8")) for name in marked)
    assert "`exponent`" in written("materials.phong") and "`opacity`" not in written("materials.phong")
