"""Every relative link and anchor in the repository's pages resolves, and so does every page that code and texts name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from docs_hooks import PAGES as SITE

ROOT = Path(__file__).parents[1]
PAGES = [
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("*.md")),
    *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md")),
    "tests/README.md",
]
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def prose(text: str) -> str:
    """A page without its blocks and spans of code."""
    text = re.sub(r"^( *)(```+).*?^\1\2 *$", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]+`", "`code`", text)


def anchors(text: str) -> set[str]:
    """The anchors that GitHub gives a page's headings, and those that the page states itself."""
    text = re.sub(r"^( *)(```+).*?^\1\2 *$", "", text, flags=re.DOTALL | re.MULTILINE)
    found: set[str] = set(re.findall(r'<a id="([^"]+)"', text))
    for heading in re.findall(r"^#+ (.+?)\s*$", text, re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        same = sum(1 for name in found if re.fullmatch(rf"{re.escape(slug)}(-\d+)?", name))
        found.add(f"{slug}-{same}" if slug in found else slug)
    return found


@pytest.mark.parametrize("name", PAGES)
def test_links_resolve(name: str) -> None:
    page = ROOT / name
    for target in LINK.findall(prose(page.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        at = (page.parent / file) if file else page
        if not at.exists() and at.parent.resolve() == ROOT / "docs":
            at = ROOT / SITE.get(at.name, at.name)
        assert at.exists(), f"{name}: {target}"
        if anchor:
            assert anchor in anchors(at.read_text(encoding="utf-8")), f"{name}: {target}"


def test_pages_and_pictures_that_are_named_exist() -> None:
    """Docstrings, errors, comments and pages name files of ``docs/`` by their paths."""
    found = 0
    for folder in ("torchpt", "scripts", "configs", "scenes", "tests", "docs"):
        for path in (ROOT / folder).rglob("*"):
            if path.suffix in (".py", ".md", ".yaml"):
                for named in re.findall(r"\bdocs/[\w/.-]+\.(?:md|png|svg)\b", path.read_text(encoding="utf-8")):
                    found += 1
                    assert (ROOT / named).is_file(), f"{path.relative_to(ROOT)}: {named}"
    assert found > 20


def test_wrong_links_are_found() -> None:
    text = "# A `b`, [c](d.md)\n\n## A\n\n## A\n```\n# no\n```\n[x](y.md#z) ![p](q.png) `[n](m.md)`\n"
    assert anchors(text) == {"a-b-c", "a", "a-1"}
    assert LINK.findall(prose(text)) == ["d.md", "y.md#z", "q.png"]
