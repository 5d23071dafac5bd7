"""The stress command: its cases (a few places of each sweep here, all of them by every backend in the slow form), its words."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from few import few

from torchpt.cli.main import main
from torchpt.core.errors import SceneError
from torchpt.stress import Case, Harness, Measurement, Outcome, outcome_of
from torchpt.stress.cases import all_cases
from torchpt.stress.scene_cases import cases_of, moved
from torchpt.stress.table import line

CASES = {f"{topic}/{case.name}": case for topic, cases in all_cases().items() for case in cases}
BACKENDS = {
    f"{accel} {compiled}": Harness(accel=accel, compile=compiled)
    for accel, compiled in (("numba", "on"), ("numba", "off"), ("torch", "off"), ("brute", "off"))
}


def told(outcome: Outcome) -> str:
    return "; ".join(f"{one.at:g}: {one.figure:.3g} {one.problem}" for one in outcome.readings)


@pytest.mark.parametrize("name", few(CASES, 6))
def test_quickly(name: str) -> None:
    outcome = outcome_of(CASES[name], Harness(), quick=True)
    assert outcome.passed, told(outcome)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", CASES)
def test_whole_sweeps_by_every_backend(name: str, backend: str) -> None:
    if not CASES[name].uses_backend and backend != "numba on":
        pytest.skip("the same for all")
    outcome = outcome_of(CASES[name], BACKENDS[backend])
    assert outcome.passed, told(outcome)


@pytest.mark.parametrize("scene", ["cornell_box", pytest.param("material_row", marks=pytest.mark.slow)])
def test_a_scene_of_ones_own(scene: str) -> None:
    for case in cases_of(scene, {}):
        outcome = outcome_of(case, Harness(), quick=True)
        assert outcome.passed, f"{case.name}: {told(outcome)}"


def test_a_moved_scene_is_moved() -> None:
    raw = {
        "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 30},
        "shapes": {"it": {"type": "sphere", "transform": [{"scale": 2}]}},
        "lights": {
            "p": {"type": "point", "position": [1, 0, 0], "intensity": 2.0},
            "d": {"type": "directional", "direction": [1, 0, 0]},
        },
    }
    by = np.array([[0, -3.0, 0, 1], [3.0, 0, 0, 2], [0, 0, 3.0, 3], [0, 0, 0, 1]])
    camera = np.eye(4)
    camera[:3, 3] = [0, 0, 4]
    found = moved(raw, by, camera)
    assert found["lights"]["p"]["position"] == pytest.approx([1, 5, 3]) and found["lights"]["p"][
        "intensity"
    ] == pytest.approx(18)
    assert found["lights"]["d"]["direction"] == pytest.approx([0, 1, 0])
    pose = np.array(found["camera"]["to_world"])
    assert pose[:3, 3] == pytest.approx([1, 2, 15]) and np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert found["shapes"]["it"]["transform"][0] == {"scale": 2} and "origin" not in found["camera"]
    assert raw["lights"]["p"]["position"] == [1, 0, 0], "what was written is left as it is"


# -- the verdict


def case(**keys: object) -> Case:
    return Case(**{"name": "it", "measures": "a thing", "bound": 1.0, "figure": lambda b, at: at, **keys})  # type: ignore[arg-type]


def failing(harness: Harness, at: float) -> float:
    raise ValueError("two\nlines")


def test_the_largest_figure_decides() -> None:
    good = outcome_of(case(axis="x", sweep=(0.1, 0.9, 0.5)), Harness())
    assert good.passed and good.worst == Measurement(0.9, 0.9)
    bad = outcome_of(case(axis="x", sweep=(0.1, 1.1)), Harness())
    assert not bad.passed and bad.worst.at == 1.1
    assert not outcome_of(case(figure=lambda b, at: float("nan")), Harness()).passed
    broken = outcome_of(case(figure=failing), Harness())
    assert not broken.passed and broken.worst.problem == "ValueError: two lines"


def refusing(harness: Harness, at: float) -> float:
    if at < 1.0:
        raise SceneError("render.accel", "brute", "numba")
    return 0.5


def test_a_search_may_refuse_a_scene() -> None:
    partly = outcome_of(case(figure=refusing, sweep=(0.1, 1.0)), Harness(accel="brute"))
    assert partly.passed and partly.refusals == 1 and partly.worst == Measurement(1.0, 0.5)
    assert line(partly).endswith("passed, refused at 1 of 2 places")
    wholly = outcome_of(case(figure=refusing, sweep=(0.1,)), Harness(accel="brute"))
    assert wholly.passed and "refused: SceneError: render.accel: expected numba" in line(wholly)
    beyond = outcome_of(case(figure=refusing, sweep=(0.1, 1.0), bound=0.1), Harness(accel="brute"))
    assert not beyond.passed and "FAILED, refused at 1 of 2 places" in line(beyond)


def test_places_of_a_quick_run() -> None:
    sweep = case(sweep=tuple(float(k) for k in range(9)))
    assert sweep.points(quick=True) == (0.0, 4.0, 8.0) and len(sweep.points(quick=False)) == 9
    assert case(sweep=(1.0, 2.0), quick_sweep=(2.0,)).points(quick=True) == (2.0,)


# -- the command


def test_the_table_the_files_and_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["stress", "quick=true", "case=numbers", f"out={tmp_path / 'found'}"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "sums of many samples" in printed and "passed" in printed and printed.rstrip().endswith("3 cases, 0 failed")
    facts = json.loads((tmp_path / "found" / "stress.json").read_text())
    assert facts["failed"] == 0 and facts["cases"] == 3
    assert sorted(path.name for path in (tmp_path / "found").iterdir()) == ["numbers.svg", "stress.json", "stress.md"]
    monkeypatch.setattr("torchpt.stress.cases.all_cases", lambda: {"mine": (case(), case(name="other"))})
    assert main(["stress", "quick=true", "case=mine", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cases"] == 2


def test_a_failure_is_told_by_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("torchpt.stress.cases.all_cases", lambda: {"mine": (case(figure=failing), case(name="other"))})
    assert main(["stress"]) == 1
    assert "FAILED: ValueError: two lines" in (printed := capsys.readouterr().out) and "2 cases, 1 failed" in printed


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (
            ["case=nonsense"],
            "case: expected a topic (gradients, light, materials, numbers, places, surfaces) or a case",
        ),
        (["accel=fast"], "accel: expected one of auto, numba, torch, brute, got 'fast'"),
        (["dtype=float16"], "dtype: expected one of float32, float64"),
        (["device=tpu"], "device: expected cpu, cuda or cuda:N"),
        (
            ["compile=[auto,on]", "dtype=float64"],
            "compile: expected auto or off (there are no kernels for float64 on cpu)",
        ),
        (["film.width=3"], "film: settings are of a scene"),
        (["scene=nowhere"], "scene: expected one of"),
        (["paint"], "paint: expected one of quick="),
        (["quick=true", "quick=true"], "quick: given twice"),
    ],
)
def test_bad_words(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stress", *words]) == 2
    said = capsys.readouterr().err
    assert says in said and len(said.strip().splitlines()) == 1
