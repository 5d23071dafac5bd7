"""Tables of the docs are what the kinds declare, and Python in them is Python."""

from __future__ import annotations

import re

import pytest
from make_tables import DOCS, MARKED, page, written


@pytest.mark.parametrize("name", sorted(file.name for file in DOCS.glob("*.md")))
def test_tables_are_as_they_would_be_written(name: str) -> None:
    text = (DOCS / name).read_text(encoding="utf-8")
    assert page(text) == text, "run scripts/make_tables.py"


@pytest.mark.parametrize("name", ["README.md", *sorted(f"docs/{file.name}" for file in DOCS.glob("*.md"))])
def test_python_blocks_compile(name: str) -> None:
    text = (DOCS.parent / name).read_text(encoding="utf-8")
    for block in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        compile("\n" * text.count("\n", 0, block.start(1)) + block[1], name, "exec")


def test_a_changed_table_is_noticed() -> None:
    text = (DOCS / "lights.md").read_text(encoding="utf-8")
    assert page(text.replace("power per solid angle", "power")) == text
    assert any(MARKED.search((DOCS / name).read_text(encoding="utf-8")) for name in ("materials.md", "scenes.md"))
    assert "`exponent`" in written("materials.phong") and "`opacity`" not in written("materials.phong")
