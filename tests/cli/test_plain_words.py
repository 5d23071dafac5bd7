"""Plain words composed without Hydra come to the job that Hydra makes of them; all others are left to Hydra."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from torchpt import cli
from torchpt.cli import main
from torchpt.commands import render
from torchpt.commands.plain_words import compose_plainly
from torchpt.commands.render import Job
from torchpt.files import configs

PLAIN = [
    [],
    ["film.width=16", "film.height=1", "render.spp=0"],
    ["film.exposure=-1", "film.gamma=1.0", "film.tonemap=reinhard"],
    ["film.exposure=-0", "film.gamma=-0.0", "render.seed=1e3", "render.spp=2.5E-1", "film.width=12345678901234567890"],
    ["film.aovs=[albedo,normal]", "film.crop=[0,1,-2,3.5]"],
    ["film.aovs=[]", "film.crop=[true,NULL,e5]"],
    ["film.filter.type=box"],
    ["film.filter=box"],
    ["film.filter=null"],
    ["film.filter=gaussian", "film.width=3"],
    ["film.filter.radius=null", "integrator.clamp=null"],
    ["integrator=path", "sampler=independent", "render=default", "integrator.max_depth=3"],
    ["integrator.strategy=light", "integrator=direct", "integrator.type=path"],
    ["integrator.strict=true", "sampler.adaptive=False", "render.resume=TRUE", "render.compile=on"],
    ["render.compile=off", "integrator.strict=yes", "integrator.clamp=Null", "render.device=none"],
    ["render.preview=a=b.png", "render.spp=1"],
]
NOT_PLAIN = [
    "film.widht=3", "film.filter.foo=3", "film.filter.type.x=3", "+film.width=3", "++film.width=3", "~film.width",
    "film.width=", "film.width=1,2", "film.width=1_000", "film.width=01", "film.width=+1", "film.width=.5", "film.width=5.",
    "film.width=nan", "film.width=Inf", "film.width='3'", "film.width=a b", "film.width=a-b", "film.width=4GB",
    "film.width=${render.spp}", "film.width=???", "film.width=int(3)", "film.width={a: 1}", "film.filter=[box]",
    "film.crop=[[1]]", "film.crop=[1, 2]", "film.crop=[1,]", "film.width=1" + "0" * 400, "render.device=cuda:0",
    "film.width=ü", "film.width=1\n", "film.x.y=3", "film",
    "integrator.bogus=3",
    "integrator=bogus", "integrator=[path]", "integrator@x=path", "spp=3", "scene_number=1", "hydra.run.dir=x", "defaults=3",
]  # fmt: skip


def job(words: list[str], monkeypatch: pytest.MonkeyPatch) -> str:
    jobs: list[Job] = []
    monkeypatch.setattr(render, "render", lambda job, interrupt: jobs.append(job) or 0)
    assert main(["render", "scene=s.yaml", "out=a.png", *words]) == 0
    return repr(jobs[0])  # 1 is not 1.0 here


@pytest.mark.parametrize("words", PLAIN, ids=" ".join)
def test_the_job_is_hydras(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def counted(*arguments: object) -> object:
        tried.append(compose_plainly(*arguments))  # type: ignore[arg-type]
        return tried[-1]

    monkeypatch.setattr(cli, "compose_plainly", counted)
    plain = job(words, monkeypatch)
    assert tried and tried[0] is not None
    monkeypatch.setattr(cli, "compose_plainly", lambda *_: None)
    assert plain == job(words, monkeypatch)


@pytest.mark.parametrize("word", NOT_PLAIN)
def test_other_words_are_hydras(word: str) -> None:
    assert compose_plainly([word], configs()) is None


@pytest.mark.parametrize(
    "words", [["integrator=direct", "integrator.max_depth=3"], ["integrator.strict=true", "integrator=aov"]]
)
def test_keys_of_another_type_are_hydras(words: list[str]) -> None:
    assert compose_plainly(words, configs()) is None


def test_a_key_given_twice_is_hydras() -> None:
    assert compose_plainly(["render.spp=1", "render.spp=2"], configs()) is None


def test_plugins_of_hydra_are_hydras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert compose_plainly([], configs()) is not None
    (tmp_path / "hydra_plugins" / "hydra_joblib_launcher").mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path)
    assert compose_plainly([], configs()) is not None  # it starts jobs, and changes no composition
    (tmp_path / "hydra_plugins" / "another").mkdir()
    assert compose_plainly([], configs()) is None


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.yaml", "hydra: {job: {chdir: true}}\n"),
        ("film/default.yaml", "# @package _global_\nwidth: null\n"),
        ("film/default.yaml", "defaults: [other]\n"),
        ("film/default.yaml", "width: 3\n"),
        ("film/default.yaml", "width: ${render.spp}\n"),
        ("film/default.yaml", "width: [\n"),
        ("film/default.yaml", "{? [a] : b}\n"),
        ("film/default.yaml", "- a\n"),
        ("film/default.yaml", ""),
    ],
)
def test_settings_files_with_more_in_them_are_hydras(tmp_path: Path, name: str, text: str) -> None:
    folder = tmp_path / "configs"
    shutil.copytree(configs(), folder)
    assert compose_plainly([], folder) is not None
    (folder / name).write_text(text)
    assert compose_plainly([], folder) is None
