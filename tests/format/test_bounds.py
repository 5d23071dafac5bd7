"""What an untrusted scene may ask for: every bound is an error of one line that names the key, and nothing is waited for."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from small_files import DAE, MTL, OBJ, glb, gltf_document

import torchpt
from torchpt.core.errors import AssetError, SceneError, TorchptError
from torchpt.core.files import UnreadableFile, check_regular, read_regular
from torchpt.images import has_alpha, read_header, read_image, read_layers, read_texels
from torchpt.scene.formats import description, yaml
from torchpt.scene.formats.description import read_description
from torchpt.scene.formats.yaml import parse_yaml, plain
from torchpt.scene.meshes import FORMATS, PARSERS, load_mesh, mesh

CAMERA = {"origin": [0, 1, 4], "target": [0, 0, 0]}
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="devices and pipes are others there")


@pytest.fixture(autouse=True)
def no_waiting() -> Iterator[None]:
    """Whoever waits for a pipe is told, rather than the tests never ending."""

    def ring(*_: object) -> None:
        raise AssertionError("it waits")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(params=["device", "pipe"])
def endless(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    """Makes a file that has no end, or that nobody writes to, by name."""

    def make(name: str) -> Path:
        path = tmp_path / name
        if request.param == "device":
            path.symlink_to("/dev/zero")
        else:
            os.mkfifo(path)
        return path

    return make


def refused(act: Any, kind: type[TorchptError] = AssetError) -> str:
    with pytest.raises(kind) as caught:
        act()
    assert str(caught.value).isprintable()
    return str(caught.value)


WHAT = "is a device, a pipe or a socket"


def test_scene_files_are_regular_files(endless: Any) -> None:
    file = endless("a.yaml")
    assert WHAT in refused(lambda: torchpt.load(str(file)), SceneError)


@pytest.mark.parametrize("ending", FORMATS)
def test_meshes_are_regular_files(endless: Any, ending: str) -> None:
    file = endless(f"a{ending}")
    assert WHAT in refused(lambda: load_mesh(file))
    scene = {"camera": CAMERA, "shapes": {"s": {"type": "mesh", "path": str(file)}}}
    assert refused(lambda: torchpt.load(scene)) == f"{file}: {WHAT}, named by shapes.s.path"


@pytest.mark.parametrize("ending", ["png", "exr", "hdr", "jpg", "tga", "bmp", "ppm", "pgm"])
def test_pictures_are_regular_files(endless: Any, ending: str) -> None:
    file = endless(f"a.{ending}")
    for read in (read_image, read_texels, read_layers, read_header):
        refused(lambda read=read: read(file))
    assert has_alpha(file) is False
    image = {"type": "image", "path": str(file)}
    scene = {
        "camera": CAMERA,
        "shapes": {"s": {"type": "sphere", "material": {"type": "diffuse", "reflectance": image}}},
    }
    assert WHAT in refused(lambda: torchpt.load(scene))
    assert WHAT in refused(
        lambda: torchpt.load({"camera": CAMERA, "lights": {"e": {"type": "envmap", "path": str(file)}}})
    )


def test_what_mesh_files_name_is_regular(endless: Any, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ)
    endless("a.mtl")
    assert "mtllib a.mtl (no such file)" in load_mesh(tmp_path / "a.obj")[0].ignored
    (tmp_path / "a.mtl").unlink()
    (tmp_path / "a.mtl").write_text(MTL)
    endless("a.png")
    assert "'a.png' is missing" in refused(lambda: load_mesh(tmp_path / "a.obj"))
    document, body = gltf_document()
    endless("a.bin")
    for key, where in (("buffers", "buffers 0"), ("images", "images 0")):
        changed = {**document, key: [{**document[key][0], "uri": "a.bin"}]}
        changed[key][0].pop("bufferView", None)
        (tmp_path / "a.glb").write_bytes(glb(changed, body))
        assert f"{where}: the file 'a.bin' is missing" in refused(lambda: load_mesh(tmp_path / "a.glb"))


def test_what_other_formats_name_is_regular(endless: Any, tmp_path: Path) -> None:
    for name in PARSERS[".dae"]:
        pytest.importorskip(name)
    endless("wood.png")
    (tmp_path / "a.dae").write_text(DAE)
    assert "wood.png" in refused(lambda: load_mesh(tmp_path / "a.dae"))


def test_checkpoints_are_regular_files(endless: Any) -> None:
    scene = torchpt.load({"camera": CAMERA, "film": {"width": 4, "height": 4}, "shapes": {"s": {"type": "sphere"}}})
    file = endless("a.ckpt")
    refused(lambda: torchpt.render(scene, spp=1, checkpoint=str(file), resume=True), TorchptError)


def test_large_files_are_not_read(tmp_path: Path) -> None:
    file = tmp_path / "a.obj"
    file.touch()
    os.truncate(file, 5 * 2**30)  # no byte of it is on the disk
    assert "has 5368709120 bytes; at most 4294967296 are read" in refused(lambda: load_mesh(file))
    scene = tmp_path / "a.yaml"
    scene.touch()
    os.truncate(scene, 300 * 2**20)
    assert "at most 256 MiB" in refused(lambda: torchpt.load(str(scene)), SceneError)
    with pytest.raises(UnreadableFile):
        read_regular(scene, 10)
    assert check_regular(scene) == 300 * 2**20
    with pytest.raises(UnreadableFile, match="no file can have"):
        check_regular("a\0b")


@pytest.mark.parametrize(
    ("change", "key", "part"),
    [
        ({"film": {"width": 65537}}, "film.width", "1..65536"),
        ({"film": {"width": 65536, "height": 65536}}, "film.width", "at most 268435456 pixels"),
        ({"film": {"width": 10**400}}, "film.width", "1..65536"),
        ({"render": {"spp": 2**31}}, "render.spp", "1..2147483647"),
        ({"render": {"threads": 10**6}}, "render.threads", "1..1024"),
        ({"render": {"preview": "/home/you/picture.png"}}, "render.preview", "never by a scene"),
        ({"render": {"checkpoint": "a.ckpt"}}, "render.checkpoint", "never by a scene"),
        ({"render": {"resume": True}}, "render.resume", "never by a scene"),
        (
            {"lights": {"l": {"type": "point", "position": [0, 0, float("inf")], "intensity": 1}}},
            "lights.l.position",
            "finite",
        ),
        (
            {"lights": {"l": {"type": "point", "position": [0, 0, 10**400], "intensity": 1}}},
            "lights.l.position",
            "finite",
        ),
        ({"materials": {"m": {"_target_": "os.system"}}}, "materials.m._target_", "never names Python objects"),
        ({"materials": {"m" * 300: {}}}, "materials", "at most 256 characters"),
        (
            {"textures": {"t": {"type": "image", "path": "a.png", "max_pixels": 2**31}}},
            "textures.t.max_pixels",
            "1..1073741824",
        ),
        ({"textures": {"t": {"type": "noise", "octaves": 17}}}, "textures.t.octaves", "1..16"),
        ({"shapes": {"s": {"type": "sphere", "radius": 10**5000}}}, "shapes.s.radius", "that cannot be shown"),
    ],
)
def test_what_a_scene_declares_is_bounded(change: dict[str, Any], key: str, part: str) -> None:
    with pytest.raises(SceneError) as caught:
        torchpt.load({"camera": CAMERA, **change})
    assert caught.value.key == key and part in str(caught.value) and str(caught.value).isprintable()


@pytest.mark.parametrize("block", ["textures", "materials", "shapes", "lights"])
def test_entries_are_bounded(monkeypatch: pytest.MonkeyPatch, block: str) -> None:
    monkeypatch.setattr(description, "MAX_ENTRIES", 3)
    entries = {f"e{number}": {} for number in range(4)}
    with pytest.raises(SceneError, match=f"^{block}: expected at most 3 of them .*, got 4"):
        read_description({"camera": CAMERA, block: entries})


@pytest.mark.parametrize(
    "text", ["[" + "1, " * 60 + "]", "- 1\n" * 60, "a: [[1, 1], [1, 1], [1, 1], [1, 1], [1, 1], [1, 1]]"]
)
def test_values_are_bounded_while_they_are_read(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr(yaml, "MAX_VALUES", 15)
    with pytest.raises(SceneError, match="at most 15 values, got 16"):
        parse_yaml(text)


def test_parts_are_bounded_and_quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "a.obj"
    file.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "".join(f"usemtl m{number}\nf 1 2 3\n" for number in range(5000)))
    parts = load_mesh(file)
    assert [part.name for part in parts] == [f"m{number}" for number in range(5000)]
    monkeypatch.setattr("torchpt.scene.meshes.obj.MOST_PARTS", 4999)
    assert f"more than {mesh.MOST_PARTS} parts" in refused(lambda: load_mesh(file))
    document, body = gltf_document()
    document["nodes"] = [{"children": list(range(1, 5))}, *({"mesh": 0} for _ in range(4))]
    file = tmp_path / "a.glb"
    file.write_bytes(glb(document, body))
    assert len(load_mesh(file)) == 4
    monkeypatch.setattr("torchpt.scene.meshes.gltf.MOST_PARTS", 3)
    assert "parts; at most so many are read" in refused(lambda: load_mesh(file))


def test_lines_stay_lines(tmp_path: Path) -> None:
    folder = tmp_path / "a\nb\x1b[31m"
    folder.mkdir()
    (folder / "a.yaml").write_text("camera: 3\n")
    refused(lambda: torchpt.load(str(folder / "a.yaml")), SceneError)
    (folder / "a.obj").write_text("f 1 2\n")
    refused(lambda: load_mesh(folder / "a.obj"))

    class Liar:
        def __repr__(self) -> str:
            raise RuntimeError

    assert "type Liar that cannot be shown" in refused(lambda: torchpt.load({"camera": Liar()}), SceneError)
    names: Any = {f"material number {number}": {"type": "diffuse"} for number in range(2000)}
    scene = {"camera": CAMERA, "materials": names, "shapes": {"s": {"type": "sphere", "material": "x"}}}
    assert len(refused(lambda: torchpt.load(scene), SceneError)) < 1200
    with pytest.raises(SceneError, match="256 characters"):
        plain({"a" * 257: 1})


@pytest.mark.parametrize(
    "text",
    [
        DAE.replace("<?xml", '<!DOCTYPE x [<!ENTITY a "b">]><?xml').encode(),
        DAE.replace('<?xml version="1.0"?>', '<?xml version="1.0"?><!DOCTYPE x SYSTEM "file:///etc/passwd">').encode(
            "utf-16"
        ),
        ('<?xml version="1.0" encoding="IBM037"?>' + DAE[21:]).encode("cp037"),
        ('<?xml version="1.0" encoding="UTF-7"?>' + DAE[21:]).encode("utf-7"),
    ],
    ids=["entity", "utf-16", "ebcdic", "utf-7"],
)
def test_xml_entities_are_refused_in_any_encoding(tmp_path: Path, text: bytes) -> None:
    for name in PARSERS[".dae"]:
        pytest.importorskip(name)
    (tmp_path / "a.dae").write_bytes(text)
    said = refused(lambda: load_mesh(tmp_path / "a.dae"))
    assert "document type" in said or "is no XML in UTF-8" in said


def test_a_film_that_memory_cannot_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """It ended the process: a film of 2^28 pixels takes tens of GiB."""
    scene = torchpt.load({"camera": CAMERA, "film": {"width": 16384, "height": 16384}}, "cpu")
    monkeypatch.setattr("torchpt.scene.memory_estimate.free_memory", lambda _: 2**30)
    with pytest.raises(
        SceneError, match=r"^film.width: expected a film that fits into memory: .* 1.0 GiB are free, got \[16384"
    ):
        torchpt.render(scene, spp=1)
    assert torchpt.render(scene, spp=1, film={"crop": [0, 0, 4, 4]}, compile="off").shape == (4, 4, 3)


def test_free_memory_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from torchpt.core import memory

    told = memory.free_memory(torch.device("cpu"))
    assert told is None or 2**20 < told < 2**50
    (tmp_path / "memory.max").write_text("1000\n")
    (tmp_path / "memory.current").write_text("900\n")
    (tmp_path / "memory.stat").write_text("anon 3\ninactive_file 50\n")
    monkeypatch.setattr(memory, "_CONTROL_GROUP", tmp_path)
    assert memory.free_memory(torch.device("cpu")) == 150
    monkeypatch.setattr(memory, "_CONTROL_GROUP", tmp_path / "none")
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "none")
    assert memory.free_memory(torch.device("cpu")) is None
