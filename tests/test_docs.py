"""Tables of the docs are what the kinds declare, Python in them is Python, and the glossary names what is in the code."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from docs_hooks import as_page, on_page_content
from make_tables import DOCS, MARKED, page, written

import torchpt

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


@pytest.mark.parametrize("name", ["architecture.md", "gradients.md", "lanes.md"])
def test_explanations_name_what_is_in_the_code(name: str) -> None:
    package = DOCS.parent / "torchpt"
    sources = {str(path.relative_to(DOCS.parent)): path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    tests = [
        str(path.relative_to(DOCS.parent))
        for folder in ("tests", "scripts")
        for path in (DOCS.parent / folder).rglob("*.py")
    ]
    found = 0
    for word in re.findall(r"`([^`\s]+)`", (DOCS / "explanations" / name).read_text(encoding="utf-8")):
        if re.fullmatch(r"[\w/]+\.py", word):
            assert any(f"/{path}".endswith(f"/{word}") for path in [*sources, *tests]), (
                f"{name}: there is no file {word}"
            )
        elif member := re.fullmatch(r"([A-Z]\w+)\.(\w+)", word):
            owners = [code for code in sources.values() if re.search(rf"^class {member[1]}\b", code, re.MULTILINE)]
            assert any(re.search(rf"\b{member[2]}\b", code) for code in owners), f"{name}: there is no {word}"
        elif re.fullmatch(r"_?[a-z]+(_[a-z]+)+", word):
            assert any(re.search(rf"\b{word}\b", code) for code in sources.values()), (
                f"{name}: {word} is not in the code"
            )
        else:
            continue
        found += 1
    assert found > 10


def test_a_changed_table_is_noticed() -> None:
    text = (DOCS / "reference/lights.md").read_text(encoding="utf-8")
    assert page(text.replace("power per solid angle", "power")) == text
    marked = ("reference/materials.md", "reference/scenes.md")
    assert any(MARKED.search((DOCS / name).read_text(encoding="utf-8")) for name in marked)
    assert "`exponent`" in written("materials.phong") and "`opacity`" not in written("materials.phong")


def test_the_version_is_the_same_everywhere() -> None:
    root = DOCS.parent
    heading = re.search(r"^## (\S+)", (root / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    citation = re.search(r"^version: (\S+)$", (root / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert heading and citation
    assert torchpt.__version__ == project["version"] == heading[1] == citation[1]


def test_every_public_name_stands_in_the_reference() -> None:
    text = (DOCS / "reference/python.md").read_text(encoding="utf-8")
    stands = (DOCS / "reference/compatibility.md").read_text(encoding="utf-8")
    for name in torchpt.__all__:
        value = getattr(torchpt, name)
        if not isinstance(value, ModuleType):
            assert f"\n::: torchpt.{name}\n" in text, name
            continue
        assert f"`torchpt.{name}`" in stands and f"`torchpt.{name}`" in text, name
        for inner in value.__all__:
            assert f"| `{inner}` |" in text or f"\n::: torchpt.{name}.{inner}\n" in text, f"{name}.{inner}"


def test_every_page_is_in_the_site_and_says_what_it_is_for() -> None:
    settings = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    listed = set(re.findall(r": ([\w/-]+\.md)$", settings, re.MULTILINE))
    assert listed - {"changelog.md", "contributing.md"} == set(PAGES)
    for name in PAGES:
        lines = (DOCS / name).read_text(encoding="utf-8").split("\n## ", 1)[0]
        assert "After this page you" in lines, name
        text = re.sub(r"^```.*?^```", "", (DOCS / name).read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        headings = re.findall(r"^#+ .+$", text, re.MULTILINE)
        assert len(headings) == len(set(headings)), name


def test_every_scene_and_texture_that_ships_is_listed() -> None:
    text = (DOCS / "reference/shipped.md").read_text(encoding="utf-8")
    scenes = {path.stem for path in (DOCS.parent / "configs/scene").glob("*.yaml")}
    assert set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) == scenes
    for path in (DOCS.parent / "scenes").iterdir():
        assert path.suffix == ".mtl" or f"`{path.name}`" in text, path.name


@pytest.mark.slow
@pytest.mark.skipif(find_spec("material") is None, reason="mkdocs-material is not installed (extra `docs`)")
def test_the_site_builds_without_warnings_and_asks_no_server(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=DOCS.parent, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(PAGES)
    for path in pages:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r'<(script|link|img|iframe)[^>]+(src|href)="?(https?:)?//', text), path.name


def test_hosted_checks_run_what_is_run_here() -> None:
    workflow = (DOCS.parent / ".github/workflows/ci.yml").read_text(encoding="utf-8")
    jobs = yaml.safe_load(workflow)["jobs"]
    steps = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert steps == [".ci/run", "make docs"]
    script = (DOCS.parent / ".ci/run").read_text(encoding="utf-8")
    assert "make check" in script and "make test" in script


def test_pages_from_the_root_and_docstrings_are_turned_for_the_site() -> None:
    text = "[a](docs/glossary.md#y) [b](tests/README.md) [c](https://d.e) [f](CITATION.cff)"
    assert as_page(text) == "[a](glossary.md#y) b [c](https://d.e) f"
    html = "<td><code>\\|x\\|</code></td><p>:func:<code>a\\|b</code></p>"
    assert on_page_content(html, None, None, None) == "<td><code>|x|</code></td><p><code>a\\|b</code></p>"
