"""Every package that pyproject.toml asks for is used by something, and everything that is imported is asked for."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Collection, Iterator
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from torchpt.scene.meshes import PARSERS

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
#: Extras of users; the others are the developers'.
FEATURES = ("formats", "video", "compare", "denoise")
#: Distribution -> what it is imported as, where that is another name.
MODULES = {"pillow": "PIL", "pyyaml": "yaml", "hydra-core": "hydra", "pycollada": "collada", "scikit-image": "skimage"}
#: Tools of developers that nothing imports -> the words that use them.
TOOLS = {
    "pytest-xdist": ("Makefile", "-n 2"),
    "ruff": ("Makefile", "-m ruff check"),
    "pyright": ("Makefile", "-m pyright"),
    "import-linter": ("Makefile", "lint-imports"),
    "hatchling": ("pyproject.toml", 'build-backend = "hatchling.build"'),
    "editables": ("Makefile", '-e ".['),  # hatchling's editable installs
}


def modules(requirements: list[str]) -> set[str]:
    names = [Requirement(text).name for text in requirements]
    return {MODULES.get(name, name.replace("-", "_")) for name in names}


def imports(folder: str, wanted: Collection[str] = ()) -> Iterator[tuple[str, bool]]:
    """Top-level packages that the files of a folder import or look for, and whether they do so as they are imported.

    With ``wanted`` only of these: a file is read on as long as one of them that was not found yet is named in it.
    """
    left = set(wanted)
    for path in (ROOT / folder).rglob("*.py"):
        text = path.read_text()
        if wanted and not any(name in text for name in left):
            continue
        tree = ast.parse(text, str(path))
        at_once = {id(node) for node in tree.body}
        for node in ast.walk(tree):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                names = [node.module]
            elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
                called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                if called in ("find_spec", "importorskip", "import_module") and isinstance(node.args[0].value, str):
                    names = [node.args[0].value]
            tops = [name.partition(".")[0] for name in names]
            left -= set(tops)
            yield from ((name, id(node) in at_once) for name in tops)


@cache
def used() -> frozenset[tuple[str, bool]]:
    return frozenset(imports("torchpt"))


THROUGH_TRIMESH = {name for names in PARSERS.values() for name in names}


def test_every_dependency_is_imported_by_the_package() -> None:
    assert modules(PROJECT["dependencies"]) - {name for name, _ in used()} == set()


@pytest.mark.parametrize("extra", FEATURES)
def test_every_extra_is_imported_by_a_feature_when_it_is_asked_for(extra: str) -> None:
    wanted = modules(EXTRAS[extra])
    assert wanted - {name for name, _ in used()} - THROUGH_TRIMESH == set()
    assert wanted & {name for name, at_once in used() if at_once} == set()


def test_what_developers_install_is_used() -> None:
    assert set(EXTRAS) == {*FEATURES, "sweep", "bench", "cuda-dev", "docs", "dev"}
    dev = {Requirement(text).name for text in EXTRAS["dev"]}
    wanted = modules(EXTRAS["bench"]) | modules([name for name in dev if name not in TOOLS])
    found = {name for folder in ("scripts", "tests") for name, _ in imports(folder, wanted)}
    assert wanted - found == set()
    for name, (file, words) in TOOLS.items():
        assert name in dev and words in (ROOT / file).read_text()


def test_the_launcher_of_sweeps_is_tested() -> None:
    """Hydra finds it by itself: nothing of ours imports it."""
    (name,) = (Requirement(text).name for text in EXTRAS["sweep"])
    assert (
        name == "hydra-joblib-launcher" and "hydra/launcher=joblib" in (ROOT / "tests/cli/test_sweeps.py").read_text()
    )


def test_the_assembler_of_gpu_kernels_is_run() -> None:
    assert [Requirement(text).name for text in EXTRAS["cuda-dev"]] == ["nvidia-cuda-nvcc"]
    assert "bin/ptxas" in (ROOT / "tests/references/ptx_assembler.py").read_text()


def test_the_makers_of_the_site_are_named_by_its_settings() -> None:
    """They are run, not imported: mkdocs by make, its theme and plugin by name; ruff formats the signatures."""
    assert {Requirement(text).name for text in EXTRAS["docs"]} == {"mkdocs", "mkdocs-material", "mkdocstrings", "ruff"}
    settings = (ROOT / "mkdocs.yml").read_text()
    assert "mkdocs build --strict" in (ROOT / "Makefile").read_text()
    assert "name: material" in settings and "- mkdocstrings:" in settings


def test_install_says_what_every_dependency_is_for() -> None:
    text = (ROOT / "docs" / "getting-started" / "install.md").read_text()
    rows = re.findall(r"^\| `([\w-]+)` \| .+ \| .+ \|$", text, re.MULTILINE)
    assert sorted(name.lower() for name in rows) == sorted(
        Requirement(text).name.lower() for text in PROJECT["dependencies"]
    )
    extras = re.findall(r"^\| `([\w-]+)` \| [^|]+ \|$", text, re.MULTILINE)
    assert set(extras) == set(EXTRAS)


def test_install_states_the_ranges_and_the_versions_that_are_tested() -> None:
    text = (ROOT / "docs" / "getting-started" / "install.md").read_text()
    asked = {Requirement(text).name: Requirement(text).specifier for text in PROJECT["dependencies"]}
    pins = dict(re.findall(r"^([\w.-]+)==(.+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    for name in ("torch", "llvmlite", "numpy"):
        low = next(bound.version for bound in asked[name] if bound.operator == ">=")
        assert f"{low} up to {next(bound.version for bound in asked[name] if bound.operator == '<')}" in text, name
        assert pins[name].rpartition(".")[0] in text, name
    assert PROJECT["requires-python"] == ">=3.11" and "| Python | 3.11 and newer |" in text


def test_everything_imported_is_asked_for() -> None:
    everything = modules(PROJECT["dependencies"]) | {"torchpt", "omegaconf", "flip_evaluator"}
    optional = set().union(*(modules(EXTRAS[extra]) for extra in FEATURES))
    at_once = {name for name, now in used() if now} - set(sys.stdlib_module_names)
    later = {name for name, _ in used()} - set(sys.stdlib_module_names)
    assert at_once - everything == set()
    assert later - everything - optional == set()


def test_what_is_asked_for_is_pinned() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line]
    pins = {name.lower().replace("_", "-"): version for name, _, version in (line.partition("==") for line in lines)}
    for text in [*PROJECT["dependencies"], *(text for extra in EXTRAS.values() for text in extra)]:
        requirement = Requirement(text)
        assert requirement.specifier.contains(pins[requirement.name.lower().replace("_", "-")]), text
