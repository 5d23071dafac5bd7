"""Bad input: exit code 2, exactly one line on stderr that says what is accepted, nothing on stdout, no file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from few import few

from torchpt.cli.main import main

from .conftest import Renderer

S = "scene=s.yaml"
CASES = [
    (["paint"], "paint: expected one of the commands render, orbit, info, compare"),
    (["render"], "scene: expected scene=NAME"),
    (["render", "cornell_box"], "expected key=value, for example scene=cornell_box"),
    (["render", "scene=nowhere"], "cornell_box"),
    (["render", "scene=nowhere.yaml"], "nowhere.yaml"),
    (["render", "scene="], "scene: expected a name"),
    (["render", S, "scene=t.yaml"], "scene: given twice"),
    (["render", S, "film.widht=3"], "film.widht: unknown key (did you mean film.width?); known: film.width, film.height"),
    (["render", S, "film.filter.foo=3"], "film.filter.type"),
    (["render", S, "+film.foo=3"], "width, height"),
    (["render", S, "+foo=3"], "foo: unknown key; known: scene, out, film.*"),
    (["render", S, "spp=3"], "did you mean render.spp?"),
    (["render", S, "render.sp=3"], "did you mean render.spp?"),
    (["render", S, "camera.fv=3"], "camera.fv: expected a known key of camera type perspective (did you mean fov?)"),
    (["render", S, "camera.fov=wide"], "camera.fov: expected"),
    (["render", S, "camera.fov="], "camera.fov: expected"),
    (["render", S, "camera.fov"], "camera.fov: expected key=value"),
    (["render", S, "camera.fov=1,2"], "camera.fov=1,2: expected one value"),
    (["render", S, "camera.fov=[1"], "camera.fov=[1: expected key=value"),
    (["render", S, "camera.origin.3=1"], "camera.origin.3: expected an index 0..2 of this list"),
    (["render", S, "camera.fov=${film.width}"], "camera.fov: expected a value"),
    (["render", S, "shapes.bal.radius=2"], "shapes.bal: expected the name of a shape that is there (did you mean ball?)"),
    (["render", S, "shapes.ball.material=red"], "shapes.ball.material: expected the name of a material"),
    (["render", S, "+shapes.ball={type: cube}"], "shapes.ball: expected a key that is not there yet"),
    (["render", S, "~lights.sky"], "lights.sky: expected"),
    (["render", S, "~shapes.bal"], "did you mean ball?"),
    (["render", S, "+shapes.x={_target_: os.system}"], "`_target_`"),
    (["orbit", S, "camera.fov=3", "camera.fov=4"], "camera.fov: given twice"),
    (["info", S, "shape.ball.radius=2"], "did you mean shapes.ball.radius?"),
    (["stress", S, "shapes.ball.radius=1,2"], "shapes.ball.radius: expected one value"),
    (["render", S, "film.width=abc"], "film.width: expected a whole number"),
    (["render", S, "film.width="], "film.width: expected a whole number"),
    (["render", S, "film.width=-1"], "film.width: expected a whole number"),
    (["render", S, "film.width=1,2"], "film.width: expected one value"),
    (["render", S, "film.width=f(1)"], "film.width=f(1): expected key=value"),
    (["render", S, "film.crop=[1"], "film.crop=[1: expected key=value"),
    (["render", S, "film.width"], "film.width: expected key=value"),
    (["render", S, "=3"], "=3: expected key=value"),
    (["render", S, "film.width=${foo}"], "film.width: Interpolation key 'foo' not found"),
    (["render", S, "film.width=???"], "film.width"),
    (["render", S, "film=3"], "film: expected the name of a file"),
    (["render", S, "film="], "film: expected the name of a file"),
    (["render", S, "film=null"], "film: expected the name of a file"),
    (["render", S, "integrator=bogus"], "integrator: expected one of aov, bdpt, default, direct, ibl, path, vcm, got 'bogus'"),
    (["render", S, "film=../scene/cornell_box"], "expected the name of a file in configs/film"),
    (["render", S, "+scene@film=cornell_box"], "expected key=value"),
    (["render", S, "integrator.type=bogus"], "integrator.type"),
    (["render", S, "render.device=abacus"], "render.device: expected auto, cpu, cuda"),
    (["render", S, "~film.foo"], "film.foo"),
    (["render", S, "hydra.run=3"], "hydra.run"),
    (["render", S, "hydra/launcher=nowhere"], "hydra/launcher: expected one of basic"),
    (["render", S, "+film._target_=os.system"], "`_target_`"),
    (["render", S, "film.filter={_target_: os.system}"], "`_target_`"),
    (["render", S, "hydra.launcher._target_=os.system"], "`_target_`"),
    (["render", S, "+hydra.callbacks.x=3"], "callbacks"),
    (["render", S, "--frobnicate"], "--frobnicate: unknown option; known: --multirun"),
    (["render", S, "--cfg"], "--cfg: expected one of job, hydra, all"),
    (["render", S, "--cfg", "job", "-m"], "--multirun: cannot be combined"),
    (["render", S, "--json"], "--json: only `torchpt info`"),
    (["render", S, "out=a.bmp"], "a.bmp: cannot write the kind '.bmp'; accepted: .exr .hdr .png"),
    (["render", S, "out=~nobody_here/a.png"], "out: expected a path, without ~ or with one of a user who has a home"),
    (["render", S, "render.checkpoint=~nobody_here/a"], "render.checkpoint: expected a path, without ~"),
    (["orbit", S, "out=~nobody_here/a.gif"], "out: expected a path, without ~"),
    (["render", S, "camera.fov=range(20,50,0)"], "camera.fov: expected values a,b or choice(a,b) or range(a,b), got"),
    (["render", S, "-m", "camera.fov=range(nan,5)"], "camera.fov: expected values a,b"),
    (["render", S, "-m", "camera.fov=range(5,1)"], "camera.fov: expected at least one value, got 'range(5,1)'"),
    (["render", S, "-m", "render.spp=range(5,1)"], "render.spp: expected at least one value, got 'range(5,1)'"),
    (["render", S, "-m", "render.spp=range(1,5,1e-9)"], "render.spp: expected at most 10000 values"),
    (["render", S, "-m", "render.spp=range(1,5,0)"], "render.spp: expected values a,b"),
    (["render", S, "--config-dir"], "--config-dir: expected a value behind it"),
    (["render", S, "film.aovs=[nope]"], "torchpt: film.aovs.0: expected"),
    (["render", S, "render.target_error=1e-3", "integrator=bdpt"], "torchpt: render.target_error: expected an integrator"),
    (["render", S, "film.filter={type: tent, radius: 1e30}"], "film.filter.radius: expected a finite number > 0 and <= 1000"),
    (["render", S, "film.filter=tent", "film.filter.radius=2"], "film.filter.radius: expected film.filter.type= beside it"),
    (["stress", S, "render.spp=9"], "render.spp: expected none of film and render, which `torchpt stress` sets itself"),
    (["convert", S[6:], "a.yaml", "film.width=3"], "film.width=3: settings of renders are no part of a scene"),
    (["render", S, "film.width=65536", "film.height=1", "out=a.jpg"], "film.width: expected at most 65500 beside a.jpg"),
    (["render", S, "out=a"], "needs an ending"),
    (["render", S, "out=nowhere/a.png"], "there is no folder"),
    (["render", S, "out=[a.png,nowhere/b.png]"], "there is no folder"),
    (["render", S, "out=[a.png,a.png]"], "out: expected another file than 'a.png' of out, got 'a.png'"),
    (["render", S, "out=[a.png,b.png,./folder.png/../a.png]"], "out: expected another file than 'a.png' of out"),
    (["render", S, "out=[a.png,linked/a.png]"], "out: expected another file than 'a.png' of out, got 'linked/a.png'"),
    (["render", S, "out=y.exr", "render.checkpoint=y.exr"],
     "render.checkpoint: expected another file than 'y.exr' of out, got 'y.exr'"),
    (["render", S, "out=y.exr", "render.checkpoint=linked/y.exr"], "render.checkpoint: expected another file than 'y.exr'"),
    (["render", "-m", S, "render.spp=1,2", "out=y.exr", "render.checkpoint=./y.exr"],
     "render.checkpoint: expected another file than 'y_0.exr' of out, got 'y_0.exr'"),
    (["render", S, "out=a.png", "render.preview=./a.png"], "render.preview: expected another file than 'a.png' of out"),
    (["render", S, "out=p.normal.png", "render.preview=p.png"],
     "render.preview: expected another file than 'p.normal.png' of out, got 'p.normal.png'"),
    (["render", S, "out=a.png", "render.preview=p.exr", "render.checkpoint=p.albedo.exr"],
     "render.checkpoint: expected another file than 'p.albedo.exr' of render.preview"),
    (["orbit", S, "out=[a.gif,linked/a.gif]"], "out: expected another file than 'a.gif' of out, got 'linked/a.gif'"),
    (["orbit", S, "frames=2", "render.seed=9223372036854775807"],
     "render.seed: expected a whole number 0..9223372036854775806 where frames=2"),
    (["render", S, "out=[a.png,,b.png]"], "out: expected names between commas"),
    (["render", S, "out=[]"], "out: expected names between commas"),
    (["render", S, "out=folder.png"], "is a folder"),
    (["render", S, "render.preview=nowhere/a.png"], "there is no folder"),
    (["render", S, "render.preview=a.gif"], "accepted: .exr"),
    (["render", S, "out=a.png", "film.aovs=[albedo]"], "film.aovs: expected a picture ending in .exr"),
    (["render", "-m", S, "film.widht=1,2"], "film.widht: unknown key"),
    (["render", "-m", "scene=s.yaml,nowhere.yaml", "render.spp=x"], "render.spp"),
    (["render", "-m", "scene=s.yaml,,s.yaml"], "scene: expected names between commas"),
    (["render", "scene=target.yaml"], "_target_"),
    (["render", "scene=broken.yaml"], "broken.yaml"),
    (["info", S, "out=a.png"], "out: `torchpt info` writes no picture"),
    (["info", "scene=nowhere"], "cornell_box"),
    (["info", S, "film.widht=3"], "film.widht: unknown key"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "says"), few(CASES, 16), ids=[" ".join(words) for words, _ in CASES])
def test_bad_input(
    folder: Path, renderer: Renderer, capfd: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    (folder / "target.yaml").write_text("camera: {type: perspective, _target_: os.system}\n")
    (folder / "broken.yaml").write_text("camera: [\n")
    (folder / "folder.png").mkdir()
    (folder / "linked").symlink_to(folder)
    before = sorted(os.listdir(folder))
    assert main(words) == 2
    captured = capfd.readouterr()
    assert captured.out == "" and captured.err.endswith("\n")
    assert len(captured.err.splitlines()) == 1, captured.err
    assert captured.err.startswith("torchpt: ") and says in captured.err
    assert "Traceback" not in captured.err
    assert sorted(os.listdir(folder)) == before and renderer.settings == []
