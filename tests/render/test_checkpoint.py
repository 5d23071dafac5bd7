"""A render that was stopped or killed goes on from its checkpoint, to the bits of one that nobody touched."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from textured_quad import repeated, textured_quad
from trials import film_of

import torchpt
from torchpt.cli.main import main
from torchpt.core.errors import AssetError, OutputError, SceneError, TorchptError
from torchpt.rendering import checkpoint
from torchpt.rendering.api import Rendering, render_scene
from torchpt.rendering.checkpoint import ends_a_pass
from torchpt.rendering.result import Progress
from torchpt.rendering.run import Run
from torchpt.scene.formats.description import settings


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


@pytest.mark.parametrize("case", few(CASES, 4))
def test_the_bits_of_a_render_that_nobody_stopped(case: str, box: torchpt.Scene, tmp_path: Path) -> None:
    whole, stopped = shot(box, **CASES[case]), []
    for number, part in enumerate((0.02, 0.6)):
        file = str(tmp_path / f"{number}.ckpt")
        stopped.append(not shot(box, int(part * whole.paths), checkpoint=file, **CASES[case]).complete)
        again = shot(box, checkpoint=file, resume=True, **CASES[case])
        assert equal(again, whole), part
        once_more = shot(box, checkpoint=file, resume=True, **CASES[case])  # the checkpoint of a finished render
        assert equal(once_more, whole), part
    assert any(stopped), "a render that is whole at once tells nothing"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.ckpt", "1.ckpt"]


@pytest.mark.slow
def test_passes_are_short_enough_for_checkpoints(box: torchpt.Scene, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(checkpoint, "EVERY", 0.05)
    monkeypatch.setattr("torchpt.rendering.run.EVERY", 0.05)
    written: list[float] = []
    write = checkpoint.CheckpointFile.write
    monkeypatch.setattr(
        checkpoint.CheckpointFile, "write", lambda *given: (written.append(time.perf_counter()), write(*given))
    )
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


def changed(file: Path, change: Any) -> None:
    """Change what a checkpoint holds, and write it as a render would."""
    arrays = dict(np.load(file))
    facts = json.loads(arrays["facts"].tobytes())
    change(facts, arrays)
    arrays["facts"] = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    with open(file, "wb") as out:
        np.savez(out, **arrays)


def put(name: str, value: Any, place: Any = 0) -> Any:
    def change(facts: dict[str, Any], arrays: dict[str, Any]) -> None:
        if name in arrays:
            arrays[name].reshape(-1)[place] = value
        else:
            facts[name] = value

    return change


LOST = [[3, 0, 0, 0, 1, True]]
WRONG: dict[str, tuple[Any, str]] = {
    "sums that are no numbers": (put("picture.sums", np.nan), "picture.sums"),
    "infinite sums": (put("picture.sums", np.inf, 99), "picture.sums"),
    "first samples that are none": (put("picture.first", np.nan), "picture.sums"),
    "pilots that are none": (put("pilots.sums", -np.inf), "pilots.sums"),
    "light that is none": (put("light", np.nan, 1), "light"),
    "negative counts": (put("picture.counts", -1), "picture.counts"),
    "counts of none": (put("picture.counts", 0, slice(None)), "picture.counts"),
    "a count too many": (put("picture.counts", 9, 5), "picture.counts"),
    "other pilots": (put("pilots.counts", 9), "pilots.counts"),
    "other layers": (put("layers.albedo.counts", 7), "layers.albedo.counts"),
    "nothing taken": (put("taken", 0), "picture.counts"),
    "more taken than there is": (put("taken", 39), "picture.counts"),
    "far too much taken": (put("taken", 10**9), "taken"),
    "half a sample taken": (put("taken", 7.5), "taken is 7.5"),
    "a negative number taken": (put("taken", -8), "taken is -8"),
    "other paths": (put("done", 17), "done"),
    "more truncated than there are": (put("truncated", 10**9), "truncated"),
    "seconds that are none": (put("seconds", float("nan")), "seconds"),
    "a cut of two": (put("cut", 2), "cut"),
    "lost ones of another pixel": (put("lost", {"nan": 1, "infinite": 0, "places": [[3, 24, 0, 0, 1, True]]}), "lost"),
    "lost ones of another sample": (put("lost", {"nan": 1, "infinite": 0, "places": [[8, 0, 0, 0, 1, True]]}), "lost"),
    "lost ones of another stream": (put("lost", {"nan": 1, "infinite": 0, "places": [[3, 0, 0, 9, 1, True]]}), "lost"),
    "more lost than taken": (put("lost", {"nan": 10**9, "infinite": 0, "places": LOST}), "lost"),
    "no spp": (lambda facts, arrays: facts["of"]["render"].pop("spp"), "spp"),
    "another spp": (lambda facts, arrays: facts["of"]["render"].update(spp="4"), "spp"),
    "no settings": (lambda facts, arrays: facts["of"].update(render="4"), "whole checkpoint"),
}


@pytest.fixture(scope="module")
def rich(box: torchpt.Scene, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A checkpoint with pilots, a layer and a sum of light after 8 samples."""
    file = tmp_path_factory.mktemp("rich") / "kept.ckpt"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "EVERY", 0.0)
        patch.setattr(checkpoint, "PATIENCE", 0.0)
        shot(box, 8 * (24 * 24 + 36), checkpoint=str(file), **RICH)
    return file.read_bytes()


RICH: dict[str, Any] = {"pilots": True, "film": film_of(24) | {"aovs": ["albedo"]}}


@pytest.mark.parametrize("case", ["as it was", *WRONG])
def test_numbers_that_no_render_comes_to_are_refused(
    case: str, rich: bytes, box: torchpt.Scene, tmp_path: Path
) -> None:
    file = tmp_path / "kept.ckpt"
    file.write_bytes(rich)
    if case == "as it was":
        changed(file, lambda facts, arrays: facts.update(lost={"nan": 1, "infinite": 0, "places": LOST}))
        again = shot(box, checkpoint=str(file), resume=True, **RICH)
        assert again.complete and again.nonfinite_samples == 1
        return
    change, says = WRONG[case]
    changed(file, change)
    before = file.read_bytes()
    with pytest.raises(AssetError) as caught:
        shot(box, checkpoint=str(file), resume=True, **RICH)
    assert says in str(caught.value) and "whole checkpoint" in str(caught.value) and "\n" not in str(caught.value)
    assert file.read_bytes() == before


@pytest.mark.parametrize("name", ["picture.counts", "pilots.counts"])
def test_counts_of_adaptive_sampling_go_together(name: str, box: torchpt.Scene, tmp_path: Path) -> None:
    file, wishes = tmp_path / "kept.ckpt", {**CASES["adaptive"], "checkpoint": str(tmp_path / "kept.ckpt")}
    shot(box, **wishes)
    changed(file, lambda facts, arrays: arrays[name].__iadd__(1))
    with pytest.raises(AssetError, match=r"no render comes to its pilots\.counts"):
        shot(box, resume=True, **wishes)


# -- more samples than it was of

MORE: dict[str, tuple[int, int, dict[str, Any]]] = {
    "plain": (4, 8, {}),
    "odd": (5, 12, {"film": film_of(24) | {"aovs": ["albedo"]}}),
    "eager": (3, 7, {"compile": "off"}),
    "independent": (4, 9, {"sampler": "independent"}),
    "pilots": (6, 40, {"pilots": True}),
    "weights": (6, 40, {"film": film_of(24) | {"filter": "mitchell"}}),
    "variance": (20, 41, {"film": film_of(24) | {"aovs": ["variance"]}}),
    "target": (8, 1000, {"target_error": 2e-2}),
    "time": (7, 12, {"time_limit": 1e6}),
    "adaptive, not yet": (10, 100, {"sampler": {"type": "sobol", "adaptive": True}}),
    "adaptive": (16, 100, {"sampler": {"type": "sobol", "adaptive": True}}),
    "adaptive target": (32, 100, {"sampler": {"type": "sobol", "adaptive": True}, "target_error": 1e-3}),
}


@pytest.mark.parametrize("case", few(MORE, 5))
def test_more_samples_later_are_the_bits_of_all_at_once(case: str, box: torchpt.Scene, tmp_path: Path) -> None:
    few, many, wishes = MORE[case]
    file = str(tmp_path / "a.ckpt")
    first = shot(box, checkpoint=file, **{**wishes, "spp": few})
    again = shot(box, checkpoint=file, resume=True, **{**wishes, "spp": many})
    whole = shot(box, **{**wishes, "spp": many})
    assert first.complete and first.spp < again.spp and equal(again, whole)
    once_more = shot(box, checkpoint=file, resume=True, **{**wishes, "spp": many})
    assert equal(once_more, whole)


def test_fewer_samples_do_where_no_more_are_there(box: torchpt.Scene, tmp_path: Path) -> None:
    file = kept(box, tmp_path)
    assert equal(shot(box, checkpoint=str(file), resume=True, spp=20), shot(box, spp=20))


ADAPTIVE = {"sampler": {"type": "sobol", "adaptive": True}}


@pytest.mark.parametrize(
    ("few", "many", "wishes", "says"),
    [
        (4, 8, {"sampler": "stratified"}, "where stratified points lie depends on how many there are"),
        (4, 8, {"sampler": "hammersley"}, "where hammersley points lie depends on how many there are"),
        (4, 8, {"sampler": "zsobol"}, "where zsobol points lie depends on how many there are"),
        (8, 4, {}, "it holds 8 samples a pixel already"),
        (1, 2, {"film": film_of(8) | {"aovs": ["variance"]}}, "the variance is of 1 streams there, of 2 here"),
        (255, 256, {"film": film_of(8) | {"aovs": ["variance"]}}, "the variance is of 2 streams there, of 4 here"),
        (40, 100, ADAPTIVE, "a round of adaptive sampling was as long as spp let it be"),
        (64, 32, ADAPTIVE, "a round of adaptive sampling was as long as spp let it be"),
        (7, 40, {"target_error": 1e-9}, "with render.target_error no pass ends at 7 samples"),
        (100, 200, {"target_error": 1e-9}, "with render.target_error no pass ends at 100 samples"),
    ],
)
def test_more_samples_that_would_be_others_are_refused(
    few: int, many: int, wishes: dict[str, Any], says: str, box: torchpt.Scene, tmp_path: Path
) -> None:
    file = tmp_path / "a.ckpt"
    shot(box, checkpoint=str(file), **{**wishes, "spp": few})
    before = file.read_bytes()
    with pytest.raises(AssetError) as caught:
        shot(box, checkpoint=str(file), resume=True, **{**wishes, "spp": many})
    assert f"render.spp: {few} there, {many} here; {says})" in str(caught.value) and "\n" not in str(caught.value)
    assert file.read_bytes() == before


@pytest.mark.parametrize("spp", [1, 2, 3, 16, 18, 20, 24, 48, 63, 64, 96, 112])
def test_passes_of_a_render_that_ends_by_its_error(spp: int, box: torchpt.Scene) -> None:
    """Where a pass ends follows from the samples alone, and it is known without taking them."""
    run = Run(box, settings(box.description, {"render": {"target_error": 1.0, "spp": 10**6}}), None, torch.float32)
    ends, end = set(), 0
    while end < 128:
        ends.add(end := end + run.stop_rules.next_pass_spp(end))
    assert ends_a_pass(run, spp) == (spp in ends)


# -- where none can be written


def test_a_render_whose_checkpoint_cannot_be_written_goes_on(
    box: torchpt.Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    file, full = tmp_path / "a.ckpt", []

    def no_space(*given: Any, **more: Any) -> None:
        full.append(1)
        if len(full) != 2:  # room for one of them
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        savez(*given, **more)

    savez = np.savez
    monkeypatch.setattr(np, "savez", no_space)
    assert equal(shot(box, checkpoint=str(file)), shot(box))
    said = capfd.readouterr().err.splitlines()
    assert said == [f"torchpt: {file}: cannot be written (No space left on device); the render goes on without it"]
    assert len(full) > 3 and os.listdir(tmp_path) == ["a.ckpt"]
    assert equal(shot(box, checkpoint=str(file), resume=True), shot(box)), "the one that was written is whole"


def test_a_picture_is_saved_though_the_folder_of_its_checkpoint_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    take = Run.take_alone

    def gone(run: Run, spans: Any) -> bool:
        shutil.rmtree("there", ignore_errors=True)
        return take(run, spans)

    monkeypatch.setattr(Run, "take_alone", gone)
    words = ["film.width=8", "film.height=8", "render.spp=4", "render.checkpoint=there/a.ckpt", "out=a.exr"]
    assert main(["render", "scene=cornell_box", *words]) == 0
    said = [line for line in capfd.readouterr().err.splitlines() if "checkpoint" in line or "a.ckpt" in line]
    assert len(said) == 1 and said[0].startswith("torchpt: there/a.ckpt: cannot be written: there is no folder")
    assert os.listdir(tmp_path) == ["a.exr"]


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
from torchpt.rendering import checkpoint
import torchpt.rendering.run
checkpoint.EVERY = torchpt.rendering.run.EVERY = 0.1
checkpoint.PATIENCE = 1.0
from torchpt.cli.main import run
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


@pytest.mark.parametrize("kills", [2, 200])
@pytest.mark.slow
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
