"""The faults of ``scripts/planted_faults.py`` still apply: code that they are anchored to has not moved away from them."""

from __future__ import annotations

from pathlib import Path

import planted_faults
import pytest
from planted_faults_table import FAULTS, Fault


def fault(function: str, before: str, after: str = "0") -> Fault:
    return Fault("one", "room.py", "math", function, before, after, "why")


def tree_of(tmp_path: Path, **files: str) -> planted_faults.Tree:
    (tmp_path / "torchpt").mkdir()
    for name, text in files.items():
        (tmp_path / "torchpt" / f"{name}.py").write_text(text, encoding="utf-8")
    return planted_faults.Tree(tmp_path)


def test_there_are_some_sixty():
    assert len(FAULTS) == 62
    assert len({fault.name for fault in FAULTS}) == len({(fault.function, fault.before) for fault in FAULTS}) == 62


def test_they_all_apply():
    assert planted_faults.problems(planted_faults.TREE) == []


def test_they_name_folders_of_tests():
    names = {name for fault in FAULTS for name in fault.tests.split()}
    assert {name for name in names if not (planted_faults.TREE / "tests" / name).is_dir()} == set()


def test_an_expression_is_found_whatever_it_looks_like(tmp_path: Path):
    text = (
        "class A:\n    def f(self, α, b):\n        ö = 'ß' + (α\n            * b) ** 2  # αβ\n        return ö, α * 2\n"
    )
    site = tree_of(tmp_path, one=text).site(fault("A.f", "α*b"))
    assert site.planted("α + b") == text.replace("α\n            * b", "(α + b)")


@pytest.mark.parametrize(
    ("one", "two", "found"),
    [
        ("def f(a): return a + 2", "def g(a): return a + 1", "it nowhere; there are 1 functions"),
        ("def g(a): return a + 1", "x = 1", "it nowhere; there are 0 functions"),
        ("def f(a): return a + 1", "def f(a): return (a +\n 1)", "it at torchpt/one.py:1, torchpt/two.py:1"),
    ],
)
def test_what_is_not_found_once_is_refused(tmp_path: Path, one: str, two: str, found: str):
    with pytest.raises(planted_faults.MissingError, match="one: expected 'a.1' once in f") as error:
        tree_of(tmp_path, one=one, two=two).site(fault("f", "a+1"))
    assert found in str(error.value)


def test_a_fault_that_changes_nothing_is_refused(tmp_path: Path):
    tree_of(tmp_path, one="def f(a): return a + 1")
    assert planted_faults.problems(tmp_path, [fault("f", "a + 1", "(a) + 1")]) == ["one: changes nothing"]


@pytest.mark.slow
def test_a_test_that_fails_without_the_fault_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    tree_of(tmp_path, __init__="", one="def f(a): return a + 1\n\ndef g(a): return a + 1\n")
    (tmp_path / "tests" / "math").mkdir(parents=True)
    (tmp_path / "pyproject.toml").write_text(
        '[tool.pytest.ini_options]\naddopts = "--import-mode=importlib"\n'
        'markers = ["slow: not here", "long: not here", "gpu: not here"]\n'
    )
    (tmp_path / "tests" / "math" / "test_one.py").write_text(
        "from torchpt.one import f, g\n\ndef test_wrong(): assert False\n\ndef test_right(): assert f(1) == 2 and g\n"
    )
    faults = [fault("f", "a + 1", "a"), Fault("two", "one.py", "math", "g", "a + 1", "a", "nobody asks for it")]
    found = planted_faults.run(tmp_path, faults, 1, 60.0, tmp_path / "report.json")
    assert [result.verdict for result in found] == ["caught", "survived"]
    assert found[0].test == "tests/math/test_one.py::test_right" and "assert" in found[0].message
    assert found[0].invalid == found[1].invalid == ["tests/math/test_one.py::test_wrong"]
    assert '"caught": 1' in (tmp_path / "report.json").read_text()
    assert "caught   one" in capsys.readouterr().out
