"""Calls that are made ahead of their use: each once, by whichever thread comes first."""

from __future__ import annotations

import threading
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import torchpt
from torchpt.core.errors import AssetError
from torchpt.core.threads import ReadAhead
from torchpt.images import decode
from torchpt.scene import Scene, prepare


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_each_call_is_made_once_and_errors_come_with_the_result(threads: int) -> None:
    made: list[int] = []

    def square(k: int) -> int:
        made.append(k)
        if k == 7:
            raise ValueError("seven")
        return k * k

    with ReadAhead(threads) as ahead:
        results = [ahead.add(lambda k=k: square(k)) for k in range(20)]
        for k in (19, 3, 3, *range(7), *range(8, 20)):
            assert results[k]() == k * k
        for _ in range(2):
            with pytest.raises(ValueError, match="seven"):
                results[7]()
    assert sorted(made) == list(range(20))


def test_one_thread_makes_calls_where_results_are_asked_for() -> None:
    made: list[str] = []
    with ReadAhead(1) as ahead:
        ahead.add(lambda: made.append("never"))
        late = ahead.add(lambda: made.append("late"))
        assert made == []
        late()
    assert made == ["late"]


def test_a_second_thread_works_beside_and_the_end_waits_for_it() -> None:
    begun, go, ended = threading.Event(), threading.Event(), threading.Event()

    def slow() -> None:
        begun.set()
        go.wait(10)
        ended.set()

    with ReadAhead(2) as ahead:
        ahead.add(slow)
        dropped = ahead.add(lambda: pytest.fail("was begun though nobody asks"))
        assert begun.wait(10)
        threading.Timer(0.05, go.set).start()
    assert ended.is_set() and dropped is not None


@pytest.fixture
def scene(tmp_path: Path) -> dict[str, object]:
    rng = np.random.default_rng(1)
    for name, bands in (("grey", 1), ("colour", 3), ("alpha", 4)):
        pixels = rng.integers(0, 256, (40, 50, bands), np.uint8)
        Image.fromarray(pixels[..., 0] if bands == 1 else pixels).save(tmp_path / f"{name}.png")
    torchpt.write_image(tmp_path / "sky.exr", torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(1)))

    def image(name: str) -> dict[str, object]:
        return {"type": "image", "path": str(tmp_path / f"{name}.png")}

    return {
        "camera": {"origin": [0, 0, 5], "target": [0, 0, 0]},
        "textures": {"shared": image("colour")},
        "materials": {
            "a": {"type": "diffuse", "reflectance": {"texture": "shared"}, "opacity": {**image("alpha"), "channel": "a"}},
            "b": {"type": "principled", "base_color": image("alpha"), "roughness": image("colour"), "metallic": image("grey")},
        },
        "shapes": {
            "one": {"type": "rectangle", "material": "a"},
            "two": {"type": "rectangle", "material": "b", "transform": [{"translate": [0, 0, 1]}]},
            "three": {"type": "sphere", "material": {"type": "diffuse", "reflectance": image("grey")}},
        },
        "lights": {"sky": {"type": "envmap", "path": str(tmp_path / "sky.exr")}},
    }  # fmt: skip


@pytest.fixture(autouse=True)
def _threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_a_scene_read_by_several_threads_is_the_same(scene: dict[str, object]) -> None:
    torch.set_num_threads(1)
    one = torchpt.load(scene).params
    torch.set_num_threads(3)
    for _ in range(3):
        several = torchpt.load(scene).params
        assert list(one) == list(several)
        assert all(torch.equal(one[name], several[name]) for name in one)


def test_texels_are_kept_once(scene: dict[str, object]) -> None:
    loaded = torchpt.load(scene)
    names = [name for name, value in loaded.built.parameters.items() if value.dtype == np.float32]
    assert len(names) >= 4
    for name in names:
        assert loaded.built.parameters[name].ctypes.data == loaded.params[name].data_ptr()
    assert len({loaded.params[name].data_ptr() for name in names}) == len(names)  # each parameter is its own


@pytest.mark.parametrize("most", [0, 1 << 25])
def test_tables_are_built_by_one_thread_of_torch(
    scene: dict[str, object], most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prepare, "QUICK_NUMBERS", most)
    threads: list[int] = []
    build = Scene.world
    monkeypatch.setattr(Scene, "world", lambda *a, **k: threads.append(torch.get_num_threads()) or build(*a, **k))
    torch.set_num_threads(2)
    torchpt.render(torchpt.load(scene), spp=1, film=(256, 256), threads=2)
    assert threads and set(threads) == {1 if most else 2} and torch.get_num_threads() == 2


@pytest.mark.parametrize("broken", ["grey.png", "sky.exr", "missing"])
def test_so_are_its_errors(scene: dict[str, object], tmp_path: Path, broken: str) -> None:
    if broken == "missing":
        (tmp_path / "colour.png").unlink()
    else:
        (tmp_path / broken).write_bytes((tmp_path / broken).read_bytes()[:60])
    messages = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        with pytest.raises(AssetError) as error:
            torchpt.load(scene)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def test_warnings_of_pillow_are_ignored_and_filters_stay_as_they_were() -> None:
    before = list(warnings.filters)
    inside, leave = threading.Event(), threading.Event()

    def hold() -> None:
        with decode._quiet_pillow():
            inside.set()
            leave.wait(10)

    holder = threading.Thread(target=hold)
    holder.start()
    assert inside.wait(10)
    with decode._quiet_pillow():
        warnings.warn_explicit("odd metadata", UserWarning, "TiffImagePlugin.py", 1, "PIL.TiffImagePlugin")
        with pytest.warns(UserWarning, match="ours"):
            warnings.warn_explicit("ours", UserWarning, "scene.py", 1, "torchpt.scene")
    warnings.warn_explicit("odd metadata", UserWarning, "TiffImagePlugin.py", 1, "PIL.TiffImagePlugin")
    leave.set()
    holder.join()
    assert list(warnings.filters) == before
    with pytest.raises(UserWarning):
        warnings.warn_explicit("odd metadata", UserWarning, "TiffImagePlugin.py", 2, "PIL.TiffImagePlugin")
