"""Hooks of mkdocs: add CHANGELOG and CONTRIBUTING as pages, and adapt Markdown that mkdocs renders differently from GitHub."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

__all__ = ["on_files", "on_page_content"]

ROOT = Path(__file__).resolve().parents[1]
#: Page of the site -> file of the repository.
PAGES = {"changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}


def as_page(text: str) -> str:
    """Return a file of the repository as a page: links into ``docs/`` are relative, links to other files plain text."""
    text = re.sub(r"\]\(docs/", "](", text)
    outside = r"\[([^\]]+)\]\((?!https?:|#|[\w/-]+\.md\b)[^)]+\)|\[([^\]]+)\]\((?:tests|scripts)/[^)]+\)"
    return re.sub(outside, lambda match: match[1] or match[2], text)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that lie outside ``docs/``."""
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]  # of the extra `docs`

    for page, name in PAGES.items():
        files.append(File.generated(config, page, content=as_page((ROOT / name).read_text(encoding="utf-8"))))
    return files


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Remove roles of docstrings (``:func:`` and others) before code, and backslashes before bars in table cells."""
    html = re.sub(r":(?:func|class|meth|mod|attr|data|exc|ref):(?=<code|`)", "", html)
    return re.sub(r"<td.*?</td>", lambda cell: cell[0].replace("\\|", "|"), html, flags=re.DOTALL)
