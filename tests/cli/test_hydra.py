from __future__ import annotations

import json
import os
from importlib import import_module
from pathlib import Path

import pytest
import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.hydra import Hydra

from torchpt.cli import render
from torchpt.cli.main import GROUPS, main
from torchpt.cli.render import Job
from torchpt.core.files import configs
from torchpt.scene.settings import TYPED_BLOCKS
from torchpt.spec import parameters_of

from .conftest import Renderer


def test_cfg_job_prints_the_composed_settings(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "--cfg", "job", "scene=s.yaml", "out=x y=[z].exr", "integrator=direct", "render.spp=7"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert set(shown) == set(GROUPS)
    assert shown["integrator"]["type"] == "direct" and shown["render"]["spp"] == 7 and shown["film"]["width"] is None
    assert main(["render", "--cfg=job", "--package", "film"]) == 0
    assert "width: null" in capsys.readouterr().out
    assert os.listdir(folder) == ["s.yaml"]


def test_group_files_are_made_of_what_kinds_declare(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "scripts")
    there = {
        str(path.relative_to(configs())): path.read_text(encoding="utf-8")
        for group in GROUPS
        for path in (configs() / group).glob("*.yaml")
    }
    assert there == import_module("make_configs").written(), "run scripts/make_configs.py"


def test_a_types_file_holds_its_own_keys_and_no_values() -> None:
    """Said without the script: every key of a file is read by its type, and every key of its type is there."""
    for group in ("integrator", "sampler"):
        table, _ = TYPED_BLOCKS[group]
        keys = {name: set(parameters_of(table[name])) for name in table}
        for name, own in {**keys, "default": set().union(*keys.values())}.items():
            block = yaml.safe_load((configs() / group / f"{name}.yaml").read_text())
            assert block.pop("type") == (None if name == "default" else name)
            assert set(block) == own and set(block.values()) <= {None}, (group, name)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["integrator=direct", "integrator.max_depth=8"], "expected only keys of integrator=direct"),
        (["integrator=aov", "integrator.clamp=8"], "clamp belongs to direct, ibl, path"),
        (["integrator.type=direct", "integrator.max_depth=8"], "max_depth belongs to path"),
        pytest.param(
            ["-m", "integrator=path,direct", "integrator.max_depth=8"],
            "expected only keys of integrator=direct",
            marks=pytest.mark.slow,
        ),
        (
            ["integrator=direct", "integrator.depth=8"],
            "depth: unknown key (did you mean integrator.rr_depth?); known: integrator.type",
        ),
    ],
)
def test_keys_of_another_type_are_refused(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    assert main(["render", "scene=s.yaml", *words]) == 2
    said = capsys.readouterr().err
    assert says in said and len(said.splitlines()) == 1
    assert not renderer.settings


@pytest.mark.parametrize(
    ("words", "kinds"),
    [
        (["integrator=path", "integrator.max_depth=8"], ["path"]),
        (["integrator.max_depth=8"], ["path"]),
        (["integrator=direct"], ["direct"]),
        (["integrator.type=direct", "integrator.strategy=light"], ["direct"]),
        pytest.param(["-m", "integrator=path,direct,ibl"], ["path", "direct", "ibl"], marks=pytest.mark.slow),
        pytest.param(["-m", "integrator.type=path,ibl", "integrator.clamp=3"], ["path", "ibl"], marks=pytest.mark.slow),
    ],
)
def test_types_are_chosen_by_file_or_by_key(
    folder: Path, renderer: Renderer, words: list[str], kinds: list[str]
) -> None:
    assert main(["render", "scene=s.yaml", *words]) == 0
    assert [settings.integrator.name for settings in renderer.settings] == kinds


@pytest.mark.parametrize(
    ("words", "overrides"),
    [
        ([], {}),
        (["film.width=16", "film.exposure=-1", "film.gamma=-0.0", "film.aovs=[albedo,normal]", "film.crop=[0,1,-2,3.5]",
          "film.filter=box", "film.tonemap='a, b'", "integrator.clamp=null", "integrator.strict=TRUE",
          "integrator.strategy=yes", "sampler.adaptive=False", "render.seed=1e3", "render.compile=off",
          "render.preview=a=b.png"],
         {"film": {"width": 16, "exposure": -1, "gamma": -0.0, "aovs": ["albedo", "normal"], "crop": [0, 1, -2, 3.5],
                   "filter": "box", "tonemap": "a, b"},
          "integrator": {"clamp": None, "strict": True, "strategy": "yes"}, "sampler": {"adaptive": False},
          "render": {"seed": 1000.0, "compile": "off", "preview": "a=b.png"}}),
        (["film.filter.radius=NULL", "film.filter.type=null"], {"film": {"filter": {"type": None, "radius": None}}}),
    ],
)  # fmt: skip
def test_words_become_settings_of_their_types(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], overrides: dict
) -> None:
    jobs: list[Job] = []
    monkeypatch.setattr(render, "render", lambda job, interrupt: jobs.append(job) or 0)
    assert main(["render", "scene=s.yaml", "out=a.png", *words]) == 0
    found, wanted = (  # by text: 1 is not 1.0, nor 0.0 -0.0
        {(group, key): repr(value) for group, block in each.items() for key, value in block.items()}
        for each in (jobs[0].overrides, overrides)
    )
    assert found == wanted
    assert (jobs[0].scene, jobs[0].outs, jobs[0].number) == ("s.yaml", ("a.png",), None)


@pytest.mark.parametrize(
    ("words", "composed", "files"),
    [
        (["render.spp=1"], 1, {"s.png"}),
        (["hydra.mode=RUN"], 2, {"s.png"}),
        pytest.param(["hydra.mode=MULTIRUN", "render.spp=1,2"], 6, {"s_0.png", "s_1.png"}, marks=pytest.mark.slow),
    ],
)
def test_a_single_job_is_composed_once(
    folder: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch, words: list[str], composed: int, files: set[str]
) -> None:
    calls: list[object] = []
    load = ConfigLoaderImpl.load_configuration
    monkeypatch.setattr(
        ConfigLoaderImpl, "load_configuration", lambda *given, **named: calls.append(0) or load(*given, **named)
    )
    before = Hydra.get_mode
    assert main(["render", "scene=s.yaml", *words]) == 0
    assert len(calls) == composed and Hydra.get_mode is before
    assert set(os.listdir(folder)) - {"s.yaml"} == files


def test_no_litter_even_in_a_folder_that_cannot_be_written(folder: Path, renderer: Renderer, tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for words in ([], ["hydra.mode=MULTIRUN", "render.spp=1,2"]):
        assert main(["render", "scene=s.yaml", f"out={pictures}/a.png", *words]) == 0
    assert sorted(os.listdir(folder)) == ["pictures", "s.yaml"]
    assert sorted(os.listdir(pictures)) == ["a.png", "a_0.png", "a_1.png"]


def test_the_environment_is_left_alone(
    folder: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    before = dict(os.environ)
    assert main(["render", "scene=s.yaml"]) == 0
    assert main(["render", "scene=s.yaml", "film.foo=3"]) == 2
    assert dict(os.environ) == before


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    for words, says in [
        (["--help"], "torchpt render"),
        (["render", "-h"], "--multirun"),
        (["info", "--help"], "--json"),
    ]:
        assert main(words) == 0
        captured = capsys.readouterr()
        assert says in captured.out and "cornell_box" in captured.out and captured.err == ""
        assert max(map(len, captured.out.splitlines())) <= 150
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("torchpt 0.")


def test_jobs_of_a_sweep_of_info_are_told_apart(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "-m", "scene=s.yaml", "integrator=path,direct", "film.width=4", "--json"]) == 0
    captured = capsys.readouterr()
    facts = [json.loads(line) for line in captured.out.splitlines()]
    words = [[f"integrator={name}", "film.width=4"] for name in ("path", "direct")]
    assert [(one["job"], one["overrides"]) for one in facts] == list(enumerate(words))
    assert captured.err.splitlines() == [f"torchpt: job {n}: {' '.join(each)}" for n, each in enumerate(words)]


def test_info_says_that_no_render_could_run_in_so_little_memory(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", "scene=s.yaml", "render.max_memory=1", "--json"]) == 0
    captured = capsys.readouterr()
    memory = json.loads(captured.out)["memory"]
    assert memory["enough"] is False and memory["refused"].startswith("render.max_memory: expected at least ")
    assert captured.err == f"torchpt: warning: no render could run: {memory['refused']}\n"
    assert main(["info", "scene=s.yaml", "render.max_memory=32GB", "render.checkpoint=there/is/none.ckpt"]) == 0
    captured = capsys.readouterr()
    assert "memory:\n  enough: yes" in captured.out and captured.err == ""


def test_no_words_print_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    printed = capsys.readouterr()
    assert printed.err == "" and all(f"torchpt {name} " in printed.out for name in ("render", "info", "compare"))


def test_info(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "scene=s.yaml"]) == 0
    plain = capsys.readouterr()
    assert plain.err == "" and "\x1b" not in plain.out and len(plain.out.splitlines()) > 3
    assert main(["info", "scene=s.yaml", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert isinstance(facts, dict) and all(f"{key}:" in plain.out for key in facts)
    assert f"left_out: {len(facts['left_out'])} features" in plain.out and len(facts["left_out"]) > 20
    assert os.listdir(folder) == ["s.yaml"]


def test_keys_of_the_scene_sweep_with_settings(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["shapes.ball.radius=.5,2", "render.spp=1,2", "+shapes.b={type: cube}", "camera.fov=range(20,31,10)"]
    assert main(["render", "-m", "scene=s.yaml", *words, "out=x.exr"]) == 0
    captured = capsys.readouterr()
    facts = [json.loads(line) for line in captured.out.splitlines()[1::2]]
    expected = [
        [f"shapes.ball.radius={radius}", f"render.spp={spp}", "+shapes.b={type:cube}", f"camera.fov={fov}"]
        for radius in ("0.5", "2") for spp in (1, 2) for fov in (20, 30)
    ]  # fmt: skip
    assert [fact["overrides"] for fact in facts] == expected
    assert [fact["job"] for fact in facts] == list(range(8)) == [int(fact["out"][2]) for fact in facts]
    assert [settings.render.spp for settings in renderer.settings] == [1, 1, 2, 2, 1, 1, 2, 2]
    table = captured.err.splitlines()[-9:]
    assert table[0].split() == ["job", "overrides", "out", "error", "seconds"]
    assert table[3].split() == ["2", "shapes.ball.radius=0.5", "render.spp=2", "camera.fov=20", "x_2.exr", "-", "1.5"]


def test_keys_of_the_scene_reach_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["shapes.ball.radius=2", "~shapes.ball", "+shapes.b={type: cube}", "film.width=4"]
    assert main(["info", "scene=s.yaml", "--json", *words[:1], words[3]]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["overrides"] == ["shapes.ball.radius=2", "film.width=4"]
    assert facts["settings"]["film"]["width"] == 4 and facts["settings"]["film"]["height"] == 3
    assert main(["info", "scene=s.yaml", "--json", *words[1:3]]) == 0
    assert list(json.loads(capsys.readouterr().out)["shapes"]) == ["b"]
    assert main(["render", "scene=s.yaml", "camera.fov=20", "--cfg", "job"]) == 0  # the scene is no part of it
    assert "scene_key" not in capsys.readouterr().out
    for words, line in (
        (["camra.fov=20"], "did you mean camera.fov?"), (["material.m.alpha=1"], "did you mean materials.m.alpha?"),
        (["shapes.bal.radius=1"], "torchpt: shapes.bal: expected the name of a shape that is there (did you mean ball?)"),
        (["-m", "camera.fov=range(0,1e9)"], "expected at most 10000 values"), (["+scene_key_0=1"], "expected key=value"),
        (["-m", "camera.fov=20,wide"], "torchpt: camera.fov: expected"),
    ):  # fmt: skip
        assert main(["info", "scene=s.yaml", *words]) == 2
        error = capsys.readouterr().err
        assert line in error and "Traceback" not in error


@pytest.fixture
def own(folder: Path) -> Path:
    """A folder with a group's files, scenes and configurations of one's own."""
    for name, text in {
        "render/quick": "defaults: [default]\nspp: 2\n",
        "render/bare": "spp: 3\n",
        "scene/room": "defaults: [../../s, lights/studio]\n",
        "scene/lights/studio": "lights: {sky: {type: constant}}\n",
        "small": "defaults: [config, _self_]\nfilm: {width: 4}\n",
        "calls": "defaults: [config, _self_]\nhydra: {callbacks: {a: {_target_: os.getcwd}}}\n",
        "targets": "defaults: [config, _self_]\nfilm: {filter: {_target_: os.getcwd}}\n",
    }.items():
        file = folder / "own" / f"{name}.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder / "own"


def test_groups_scenes_and_configurations_of_ones_own(
    own: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]
) -> None:
    (own.parent / "t.yaml").write_text("defaults: [s, lights/studio]\n")  # what it names lies in own/scene
    words = ["render", "--config-dir", "own"]
    for more, spp, width in (
        (["scene=room", "render=quick"], 2, 8), (["scene=room", "render=bare", "+render.threads=1"], 3, 8),
        (["scene=t.yaml", "-cn", "small"], 4, 4), (["scene=room", "--config-name=small", "render=quick", "film.width=6"], 2, 6),
    ):  # fmt: skip
        assert main([*words, *more]) == 0, capsys.readouterr().err
        assert (renderer.settings[-1].render.spp, renderer.settings[-1].film.width) == (spp, width)
    assert main([*words, "-m", "-cn", "small", "scene=room", "render=quick,bare"]) == 0
    assert [settings.render.spp for settings in renderer.settings[-2:]] == [2, 3]
    assert not (own.parent / "outputs").exists() and not (own.parent / "multirun").exists()
    for more, line in (
        (["scene=room", "-cn", "calls"], "hydra.callbacks: no setting names a Python object"),
        (["scene=room", "-cn", "targets"], "film.filter._target_: no setting names a Python object"),
        (["scene=rom"], "scene: expected one of"), (["scene=rom"], "did you mean room?"),
        (["scene=room", "render=qick"], "render: expected one of bare, default, quick, got 'qick'"),
        (["scene=room", "render=bare", "render.threads=1"], "+render.threads= adds it"),
        (["scene=room", "-cn", "none"], "--config-name: expected the name of a .yaml file"),
        (["scene=room", "-cn", "../small"], "--config-name: expected the name of a .yaml file"),
        (["scene=room", "-cd", "nowhere"], "--config-dir: expected a folder that is there, got 'nowhere'"),
    ):  # fmt: skip
        capsys.readouterr()
        assert main([*words, *more]) == 2
        error = capsys.readouterr().err
        assert line in error and len(error.splitlines()) == 1
