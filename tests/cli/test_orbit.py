"""`torchpt orbit`: what the camera does, which files there are when, and that a frame is what a render gives."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from few import few
from PIL import Image, ImageSequence
from textured_quad import repeated, textured_quad

import torchpt
from torchpt.cli.main import main
from torchpt.cli.orbit import Turn, poses
from torchpt.images.movie import write_movie

from .conftest import SCENE, Renderer

TINY = ["render.spp=1", "render.compile=off", "frames=4"]


def files(folder: Path) -> set[str]:
    return set(os.listdir(folder)) - {"s.yaml"}


def summary(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def scene_of(camera: dict[str, Any]) -> Any:
    shapes = {"ball": {"type": "sphere", "center": [1, 2, 3]}, "other": {"type": "sphere", "center": [3, 2, 3]}}
    return torchpt.load({"camera": camera, "shapes": shapes}, "cpu")


# --- the camera


def test_a_camera_goes_round_its_target_about_its_up_axis() -> None:
    scene = scene_of({"origin": [4, 3, 0], "target": [0, 3, 0], "up": [0, 0, 2]})
    turned = list(poses(scene, Turn(frames=4)))
    assert np.array_equal(turned[0], scene.built.parameters["camera.to_world"])
    assert np.allclose([pose[:3, 3] for pose in turned], [[4, 3, 0], [0, 7, 0], [-4, 3, 0], [0, -1, 0]])
    for pose in turned:
        assert np.allclose(pose[:3, 2], ([0, 3, 0] - pose[:3, 3]) / 4) and np.allclose(pose[:3, 1], [0, 0, 1])


def test_a_placed_camera_goes_round_the_scene_about_the_nearest_axis() -> None:
    pitched = torchpt.math.transforms.look_at((2, 6, -7), (2, 3, 3), (0, -1, 0))
    turned = list(poses(scene_of({"to_world": pitched.tolist()}), Turn(frames=2)))
    middle = np.array([2.0, 2.0, 3.0])  # of both balls
    assert np.array_equal(turned[0], pitched)
    assert np.allclose(turned[1][:3, 3] - middle, [0, 4, 10])
    assert np.allclose(turned[1][:3, :3], np.diag([-1, 1, -1]) @ pitched[:3, :3])


@pytest.mark.parametrize(("degrees", "last"), [(90.0, 67.5), (-90.0, -67.5), (720.0, 540.0)])
def test_degrees(degrees: float, last: float) -> None:
    scene = scene_of({"origin": [0, 0, 4], "target": [0, 0, 0]})
    place = list(poses(scene, Turn(frames=4, degrees=degrees)))[-1][:3, 3]
    assert np.allclose(place, [4 * np.sin(np.radians(last)), 0, 4 * np.cos(np.radians(last))])


# --- the command


def test_a_frame_is_what_a_render_of_its_camera_gives(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    described = yaml.safe_load(SCENE)
    described["shapes"]["small"] = {"type": "sphere", "center": [0.8, 0.9, -1], "radius": 0.4, "emission": 3}
    (folder / "s.yaml").write_text(yaml.safe_dump(described))
    words = ["scene=s.yaml", "render.spp=2", "render.seed=7"]
    assert main(["orbit", *words, "frames=3", "fps=12.5", "out=t.gif", "keep=true"]) == 0
    facts = summary(capsys)
    assert facts["out"] == "t.gif" and facts["frames"] == facts["rendered"] == 3 and facts["rays"] > 0
    for number, pose in list(enumerate(poses(torchpt.load("s.yaml", "cpu"), Turn(frames=3))))[1:]:
        (folder / "k.yaml").write_text(yaml.safe_dump({**described, "camera": {"to_world": pose.tolist()}}))
        assert main(["render", "scene=k.yaml", "render.spp=2", f"render.seed={7 + number}", "out=k.png"]) == 0
        assert (folder / f"t.gif.frames/{number:06d}.png").read_bytes() == (folder / "k.png").read_bytes()
    with Image.open("t.gif") as movie:
        shown = [(frame.info["duration"], frame.convert("RGB")) for frame in ImageSequence.Iterator(movie)]
        assert [duration for duration, _ in shown] == [80, 80, 80] and movie.info["loop"] == 0
    pictures = [np.asarray(frame, np.int64) for _, frame in shown]
    with Image.open("t.gif.frames/000002.png") as last:
        assert np.abs(pictures[2] - np.asarray(last)).max() <= 8  # 48 pixels, 256 colours
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_stopped_run_goes_on(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    def stop(done: int) -> None:
        if len(renderer.settings) == 3 and done == 2:
            os.kill(os.getpid(), signal.SIGINT)

    renderer.after_pass = stop
    words = ["orbit", "scene=s.yaml", "frames=5", "render.seed=100"]
    assert main(words) == 130
    captured = capsys.readouterr()
    assert captured.err == "torchpt: stopped by a signal; 2 of 5 frames are in s.gif.frames\n"
    assert json.loads(captured.out)["complete"] is False
    assert files(folder) == {"s.gif.frames"}
    assert set(os.listdir("s.gif.frames")) == {"orbit.json", "000000.png", "000001.png"}
    renderer.settings.clear()
    renderer.after_pass = lambda done: None
    assert main([*words, "render.threads=1", "fps=10"]) == 0  # what frames do not depend on may change
    assert [settings.render.seed for settings in renderer.settings] == [102, 103, 104]
    facts = summary(capsys)
    assert facts["rendered"] == 3 and "complete" not in facts
    assert files(folder) == {"s.gif"}  # the frames are gone


def test_other_settings_are_refused(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["orbit", "scene=s.yaml", *TINY, "keep=true"]) == 0
    for word, said in (
        ("render.spp=2", "render.spp 1, now 2"),
        ("degrees=90", "degrees 360.0, now 90.0"),
        ("frames=5", "frames 4, now 5"),
        ("sampler=independent", "sampler.type sobol, now independent"),
    ):
        kept = [one for one in TINY if one.partition("=")[0] != word.partition("=")[0]]
        assert main(["orbit", "scene=s.yaml", *kept, word]) == 2
        assert said in capsys.readouterr().err and len(renderer.settings) == 4


def test_another_scene_is_refused(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["orbit", "scene=s.yaml", *TINY, "keep=true"]) == 0
    (folder / "s.yaml").write_text(SCENE.replace("radius: 1", "radius: 2"))
    assert main(["orbit", "scene=s.yaml", *TINY]) == 2
    line = capsys.readouterr().err
    assert line.startswith("torchpt: s.gif.frames: holds frames of other settings (the scene was another)")


def test_what_a_mesh_file_says_of_its_texture_is_part_of_the_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renderer: Renderer, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    textured_quad(tmp_path)
    words = ["orbit", "scene=quad.yaml", *TINY]
    assert main([*words, "keep=true"]) == 0
    repeated(tmp_path, 3)
    assert main(words) == 2
    assert "the scene was another" in capsys.readouterr().err and len(renderer.settings) == 4


@pytest.mark.parametrize(
    ("words", "said"),
    few(
        [
            (["frames=0"], "frames: expected a whole number 1.."),
            (["frames=2.5"], "frames: expected a whole number 1.."),
            (["degrees=much"], "degrees: expected an angle in degrees, got 'much'"),
            (["fps=0"], "fps: expected a number above 0"),
            (["fps=60"], "s.gif: .gif shows at most 50 frames a second, fps=60"),
            (["keep=maybe"], "keep: expected true or false"),
            (["frames=2"], "frames: given twice"),
            (["out=a.png"], "a.png: cannot write the kind '.png'; accepted: .gif .mp4"),
            (["out=no/a.gif"], "there is no folder"),
            (["film.aovs=[albedo]"], "film.aovs: expected nothing"),
            (["render.preview=p.png"], "render.preview: expected nothing"),
            (["turn=3"], "turn: unknown key"),
        ],
        4,
    ),
)
def test_bad_input_is_one_line(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    base = ["frames=2"] if words == ["frames=2"] else []
    assert main(["orbit", "scene=s.yaml", *base, *words]) == 2
    captured = capsys.readouterr()
    assert said in captured.err and len(captured.err.splitlines()) == 1 and captured.out == ""
    assert files(folder) == set()


@pytest.mark.parametrize("inside", [{"orbit.json": "{"}, {"mine.txt": "keep me"}])
def test_a_folder_in_the_way(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], inside: Any) -> None:
    (folder / "s.gif.frames").mkdir()
    for name, text in inside.items():
        (folder / "s.gif.frames" / name).write_text(text)
    assert main(["orbit", "scene=s.yaml", *TINY]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert set(os.listdir("s.gif.frames")) == set(inside)


def test_the_keys_are_orbits_alone(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "scene=s.yaml", "frames=2"]) == 2
    assert "frames: unknown key" in capsys.readouterr().err


def test_multirun(folder: Path, renderer: Renderer) -> None:
    assert main(["orbit", "-m", "scene=s.yaml", "render.spp=1", "frames=1", "out=a b.gif"]) == 0  # of one job
    assert files(folder) == {"a b_0.gif"}


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["orbit", "--help"]) == 0
    text = capsys.readouterr().out
    assert (
        "frames=" in text and "film.width" not in text.splitlines()[0] and "{keys" not in text and "{scenes" not in text
    )


# --- moving pictures


def frames_of(size: tuple[int, int], count: int) -> list[Any]:
    rows = np.linspace(0, 255, size[0] * size[1]).reshape(*size, 1)
    return [np.uint8(np.broadcast_to((rows + 40 * k) % 256, (*size, 3))).copy() for k in range(count)]


def test_a_gifs_times_add_up(tmp_path: Path) -> None:
    for name, frames, many in (
        ("a", frames_of((5, 7), 12), 12),
        ("b", 6 * frames_of((5, 7), 1) + 6 * frames_of((5, 7), 2)[1:], 2),
        ("c", 12 * frames_of((5, 7), 1), 1),
    ):
        write_movie(tmp_path / f"{name}.gif", frames, fps=24)
        with Image.open(tmp_path / f"{name}.gif") as movie:
            times = [frame.info["duration"] for frame in ImageSequence.Iterator(movie)]
        assert len(times) == many and sum(times) == 500  # equal frames are one that is shown for longer


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio's reader leaves pipes open
def test_mp4(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="imageio-ffmpeg is not installed (extra `video`)")
    import imageio.v2 as iio

    frames = [
        np.full((33, 47, 3), level, np.uint8) for level in ((200, 40, 40), (40, 200, 40), (40, 40, 200), (9, 9, 9))
    ]
    write_movie(tmp_path / "a.mp4", frames, fps=10)
    movie: Any = iio.get_reader(tmp_path / "a.mp4", "FFMPEG")
    with movie:
        facts = movie.get_meta_data()
        shown = [np.asarray(frame) for frame in movie]
    assert len(shown) == 4 and shown[0].shape == (34, 48, 3)
    assert facts["fps"] == 10 and facts["codec"] == "h264" and facts["duration"] == pytest.approx(0.4)
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_mp4_without_ffmpeg(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchpt.images.movie.find_spec", lambda name: None)
    assert main(["orbit", "scene=s.yaml", *TINY, "out=a.mp4"]) == 2
    line = capsys.readouterr().err
    assert (
        "needs the package imageio-ffmpeg: pip install '.[video]' in the checkout of torchpt" in line
        and files(folder) == set()
    )


def test_an_encoder_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a.gif").write_text("old")
    with pytest.raises(torchpt.OutputError, match=r"a\.gif: cannot be written"):
        write_movie(tmp_path / "a.gif", iter([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), "O")]), fps=10)
    assert (tmp_path / "a.gif").read_text() == "old" and os.listdir(tmp_path) == ["a.gif"]
