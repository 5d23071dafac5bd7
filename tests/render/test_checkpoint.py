"""A render that was stopped or killed goes on from its checkpoint, to the bits of one that nobody touched."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from textured_quad import repeated, textured_quad
from trials import film_of

import torchpt
from torchpt.errors import AssetError, OutputError, SceneError, TorchptError
from torchpt.format.description import settings
from torchpt.forward import checkpoint
from torchpt.forward.result import Progress
from torchpt.rendering import Rendering, render_scene


@pytest.fixture(scope="module")
def box() -> torchpt.Scene:
    return torchpt.load("cornell_box", device="cpu")


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A checkpoint after every pass."""
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    monkeypatch.setattr(checkpoint, "PATIENCE", 0.0)


def shot(
    scene: torchpt.Scene, stop: int | None = None, film: Any = None, sampler: Any = "sobol", **render: Any
) -> Rendering:
    """A render; with ``stop`` it is ended from outside once so many camera samples were taken."""
    wishes = {"film": {"filter": "box", **(film or film_of(24))}, "sampler": sampler, "render": {"spp": 40, **render}}

    def on_progress(state: Progress) -> bool:
        return stop is not None and state.done >= stop

    return render_scene(scene, settings(scene.description, wishes), on_progress)


def equal(a: Rendering, b: Rendering) -> bool:
    """In all but seconds."""
    assert a.layers.keys() == b.layers.keys()
    numbers = (
        "spp",
        "paths",
        "rays",
        "nonfinite_samples",
        "truncated_paths",
        "clamped",
        "relmse",
        "relmse_interval",
        "stopped_by",
    )
    same = [getattr(a, name) == getattr(b, name) for name in numbers]
    same += [torch.equal(a.image, b.image), *(torch.equal(a.layers[name], b.layers[name]) for name in a.layers)]
    return a.complete and b.complete and all(same)


CASES: dict[str, dict[str, Any]] = {
    "plain": {},
    "eager": {"compile": "off", "spp": 12},
    "pilots": {"pilots": True},
    "adaptive": {"sampler": {"type": "sobol", "adaptive": True}, "spp": 100},
    "target": {"target_error": 2e-2, "spp": 1000},
    "variance": {"film": film_of(24) | {"aovs": ["variance", "albedo", "object_id", "samples"]}},
    "stratified": {"sampler": "stratified"},
    "crop": {"film": film_of(24) | {"crop": [3, 5, 11, 9]}, "threads": 2},
}


@pytest.mark.parametrize("case", CASES)
def test_the_bits_of_a_render_that_nobody_stopped(case: str, box: torchpt.Scene, tmp_path: Path) -> None:
    whole, stopped = shot(box, **CASES[case]), []
    for number, part in enumerate((0.02, 0.3, 0.6, 0.97)):
        file = str(tmp_path / f"{number}.ckpt")
        stopped.append(not shot(box, int(part * whole.paths), checkpoint=file, **CASES[case]).complete)
        again = shot(box, checkpoint=file, resume=True, **CASES[case])
        assert equal(again, whole), part
        once_more = shot(box, checkpoint=file, resume=True, **CASES[case])  # the checkpoint of a finished render
        assert equal(once_more, whole), part
    assert any(stopped), "a render that is whole at once tells nothing"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.ckpt", "1.ckpt", "2.ckpt", "3.ckpt"]


def test_passes_are_short_enough_for_checkpoints(box: torchpt.Scene, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(checkpoint, "EVERY", 0.05)
    monkeypatch.setattr("torchpt.forward.run.EVERY", 0.05)
    written: list[float] = []
    write = checkpoint.Keeper.write
    monkeypatch.setattr(checkpoint.Keeper, "write", lambda *given: (written.append(time.perf_counter()), write(*given)))
    shot(box, film=film_of(128), spp=256, checkpoint=str(tmp_path / "a.ckpt"))
    apart = np.diff(written)
    assert len(written) > 4 and float(np.median(apart)) < 0.3


def test_seconds_of_both_parts_are_told_and_count(box: torchpt.Scene, tmp_path: Path) -> None:
    file = str(tmp_path / "a.ckpt")
    first = shot(box, 24 * 24 * 16, checkpoint=file)
    facts = json.loads(np.load(file)["facts"].tobytes())
    assert 0.0 < facts["seconds"] <= first.render_seconds
    limited = shot(box, checkpoint=file, resume=True, time_limit=0.5 * facts["seconds"])
    assert limited.stopped_by == "time_limit" and limited.spp == facts["taken"]


def kept(scene: torchpt.Scene, tmp_path: Path) -> Path:
    file = tmp_path / "kept.ckpt"
    shot(scene, 24 * 24 * 8, checkpoint=str(file))
    return file


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"spp": 41}, "render.spp: 40 there, 41 here"),
        ({"seed": 1}, "render.seed: 0 there, 1 here"),
        ({"film": film_of(25)}, "film.width: 24 there, 25 here"),
        ({"sampler": "independent"}, 'sampler.type: "sobol" there, "independent" here'),
        ({"pilots": True}, 'render.pilots: "auto" there, true here'),
    ],
)
def test_a_checkpoint_of_other_settings_is_refused(changed: Any, says: str, box: torchpt.Scene, tmp_path: Path) -> None:
    file = kept(box, tmp_path)
    before = file.read_bytes()
    with pytest.raises(AssetError, match="another render") as caught:
        shot(box, checkpoint=str(file), resume=True, **changed)
    assert says in str(caught.value) and str(file) in str(caught.value)
    assert file.read_bytes() == before


def test_a_checkpoint_of_another_scene_is_refused(tmp_path: Path, box: torchpt.Scene) -> None:
    file = kept(box, tmp_path)
    other = torchpt.load("cornell_specular", device="cpu")
    with pytest.raises(AssetError, match=r"another render \(its scene\.materials are others\)"):
        shot(other, checkpoint=str(file), resume=True)


def test_what_a_mesh_file_says_of_its_texture_is_part_of_the_scene(tmp_path: Path) -> None:
    file, where = textured_quad(tmp_path), str(tmp_path / "a.ckpt")
    shot(torchpt.load(str(file), device="cpu"), 24 * 24 * 8, checkpoint=where)
    repeated(tmp_path, 3)
    with pytest.raises(AssetError, match=r"another render \(its scene\.parts are others\)"):
        shot(torchpt.load(str(file), device="cpu"), checkpoint=where, resume=True)
    repeated(tmp_path, 1)
    assert shot(torchpt.load(str(file), device="cpu"), checkpoint=where, resume=True).complete


def test_settings_that_no_sample_depends_on_may_differ(box: torchpt.Scene, tmp_path: Path) -> None:
    file = kept(box, tmp_path)
    film = film_of(24) | {"exposure": 1.0, "tonemap": "aces", "gamma": 2.2}
    again = shot(box, film=film, checkpoint=str(file), resume=True, threads=1, max_memory="8GB")
    assert torch.equal(again.image, shot(box).image)


@pytest.mark.parametrize("damage", ["cut", "cut short", "flipped", "empty", "text", "picture", "folder"])
def test_a_damaged_checkpoint_is_refused_in_a_line(damage: str, box: torchpt.Scene, tmp_path: Path) -> None:
    file = kept(box, tmp_path)
    content = file.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 0x10
    other = {"cut": content[: len(content) // 2], "cut short": content[:-5], "flipped": bytes(flipped), "empty": b""}
    file.unlink()
    if damage == "picture":
        torchpt.write_image(tmp_path / "a.png", torch.zeros(3, 3, 3))
        (tmp_path / "a.png").rename(file)
    elif damage == "folder":
        file.mkdir()
    else:
        file.write_bytes(other.get(damage, b"no checkpoint at all"))
    with pytest.raises(TorchptError) as caught:
        shot(box, checkpoint=str(file), resume=True)
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)
    assert "whole checkpoint" in str(caught.value) or damage == "folder"


def test_a_checkpoint_that_is_there_is_not_written_over(box: torchpt.Scene, tmp_path: Path) -> None:
    file = kept(box, tmp_path)
    before = file.read_bytes()
    with pytest.raises(OutputError, match=r"is there already; render\.resume=true"):
        shot(box, checkpoint=str(file))
    assert file.read_bytes() == before


def test_without_a_checkpoint_it_starts_anew_and_says_so(
    box: torchpt.Scene, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    again = shot(box, checkpoint=str(tmp_path / "none.ckpt"), resume=True)
    assert equal(again, shot(box)) and "starts anew" in capfd.readouterr().err


def test_what_cannot_be_kept_is_refused(box: torchpt.Scene, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="there is no folder"):
        shot(box, checkpoint=str(tmp_path / "nowhere" / "a.ckpt"))
    with pytest.raises(SceneError, match=r"render\.resume: expected false without render\.checkpoint"):
        shot(box, resume=True)
    albedo = box.params["materials.red.reflectance"].clone().requires_grad_()
    with pytest.raises(SceneError, match="null where gradients are wanted"):
        torchpt.render(box, spp=1, params={"materials.red.reflectance": albedo}, checkpoint=str(tmp_path / "a.ckpt"))


def test_parameters_are_part_of_a_render(box: torchpt.Scene, tmp_path: Path) -> None:
    file, name = str(tmp_path / "a.ckpt"), "materials.red.reflectance"
    film = film_of(16)
    red, blue = (torch.tensor(c) for c in ([0.5, 0.1, 0.1], [0.1, 0.1, 0.5]))
    whole = torchpt.render(box, spp=8, film=film, params={name: red}, checkpoint=file)
    assert torch.equal(torchpt.render(box, spp=8, film=film, params={name: red}, checkpoint=file, resume=True), whole)
    with pytest.raises(AssetError, match=rf"params\.{name}"):
        torchpt.render(box, spp=8, film=film, params={name: blue}, checkpoint=file, resume=True)


# -- killed

COMMAND = """
import sys
from torchpt.forward import checkpoint
import torchpt.forward.run
checkpoint.EVERY = torchpt.forward.run.EVERY = 0.1
checkpoint.PATIENCE = 1.0
from torchpt.cli import run
sys.exit(run())
"""


def killed(folder: Path, kills: int, spp: int) -> tuple[int, int]:
    """A command that is killed again and again at random times, then left to end; kills, and those after a first checkpoint."""
    chance = random.Random(kills)
    words = [
        "render",
        "scene=cornell_box",
        "film.width=96",
        "film.height=96",
        f"render.spp={spp}",
        "film.aovs=[albedo]",
    ]
    words += ["render.checkpoint=a.ckpt", "out=a.exr"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = after = 0
    while done < kills:
        more = ["render.resume=true"] if (folder / "a.ckpt").exists() else []
        work = subprocess.Popen([sys.executable, "-c", COMMAND, *words, *more], cwd=folder, env=environment,
                                stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip
        while done and not (folder / "a.ckpt").exists() and work.poll() is None:
            time.sleep(0.02)
        try:
            work.wait(chance.uniform(0.0, 2.0))
            break
        except subprocess.TimeoutExpired:
            work.send_signal(signal.SIGKILL)
            work.communicate()
            done += 1
            after += (folder / "a.ckpt").exists()  # this one's own, perhaps
    else:
        subprocess.run([sys.executable, "-c", COMMAND, *words, "render.resume=true"], cwd=folder, env=environment, check=True,
                       capture_output=True)  # fmt: skip
    return done, after


@pytest.mark.parametrize("kills", [2, pytest.param(200, marks=pytest.mark.slow)])
def test_the_bits_after_kills(kills: int, tmp_path: Path) -> None:
    """At random times; no file is lost, and none of those that were being written comes to be taken for whole."""
    spp = 300 * kills + 500
    done, after = killed(tmp_path, kills, spp)
    film = {"width": 96, "height": 96, "aovs": ["albedo"]}
    whole = torchpt.render(torchpt.load("cornell_box", "cpu"), spp=spp, film=film, pilots=True, full=True)
    found = torchpt.read_layers(tmp_path / "a.exr")
    assert torch.equal(found["image"], whole.image) and torch.equal(found["albedo"], whole.layers["albedo"])
    assert done >= min(kills, 3) and after >= done // 2
    left = [path.name for path in tmp_path.iterdir() if not path.name.startswith(".torchpt-")]
    assert sorted(left) == ["a.ckpt", "a.exr"]
