"""A scene's fingerprint: whatever changes a picture changes it, and where files lie does not."""

from __future__ import annotations

import base64
import copy
import io
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from few import few
from PIL import Image
from torch import Tensor
from trials import film_of, shoot

import torchpt
from torchpt.core import tree
from torchpt.core.errors import SceneError
from torchpt.scene.fingerprint import fingerprint, fingerprints

#: A quad of 2 x 2 whose texture coordinates go from 0 to 2.
CORNERS, COORDINATES = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 0], [2, 0], [2, 2], [0, 2]]
OBJ = "mtllib o.mtl\nusemtl a\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 2 0\nvt 2 2\nvt 0 2\nf 1/1 2/2 3/3 4/4\n"
MTL = "newmtl a\nKs 0.2 0.2 0.2\nNs 20\nmap_Kd -s 1 1 1 i.png\nmap_Bump -bm 1 h.png\n"
SCENE: dict[str, Any] = {
    "camera": {"type": "thinlens", "origin": [0, 1, 4], "target": [0, 0, 0], "aperture_radius": 0.2, "focus_distance": 4},
    "textures": {"t": {"type": "image", "path": "i.png", "uv_transform": {"scale": 2}}},
    "materials": {"red": {"type": "roughplastic", "diffuse_reflectance": {"texture": "t"}, "alpha": 0.2}},
    "shapes": {
        "file": {"type": "mesh", "path": "o.obj"},
        "ball": {"type": "sphere", "center": [1, 0, 1], "radius": 0.4, "material": "red"},
        "lamp": {"type": "rectangle", "transform": [{"scale": 0.3}, {"translate": [0, 1, 1]}], "emission": 5},
    },
    "lights": {
        "sky": {"type": "envmap", "path": "i.png", "scale": 1.5},
        "bulb": {"type": "spot", "position": [0, 0, 3], "target": [0, 0, 0], "intensity": 5, "cutoff_angle": 40},
    },
}  # fmt: skip


def png(mode: str, seed: int) -> bytes:
    channels = {"L": (), "RGBA": (4,)}[mode]
    picture = Image.fromarray(np.random.default_rng(seed).integers(0, 256, (8, 8, *channels), np.uint8), mode)
    picture.save(held := io.BytesIO(), "png")
    return held.getvalue()


def uri(content: bytes) -> str:
    return "data:application/octet-stream;base64," + base64.b64encode(content).decode()


def gltf() -> dict[str, Any]:
    points, numbers = np.array(CORNERS, "<f4").tobytes(), np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    body = points + np.array(COORDINATES, "<f4").tobytes() + numbers
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    metallic = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 0.6}
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": metallic, "alphaMode": "MASK", "alphaCutoff": 0.5, "doubleSided": True}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{}],
        "images": [{"uri": uri(png("RGBA", 3))}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
            {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": 4},
            {"bufferView": 2, "componentType": 5123, "type": "SCALAR", "count": 6},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 32},
            {"buffer": 0, "byteOffset": 80, "byteLength": 12},
        ],
        "buffers": [{"byteLength": len(body), "uri": uri(body)}],
    }


def described(folder: Path, mesh: str = "o.obj") -> Path:
    """The scene's files in a folder."""
    folder.mkdir(exist_ok=True)
    (folder / "i.png").write_bytes(png("RGBA", 1))
    (folder / "h.png").write_bytes(png("L", 2))
    (folder / "o.obj").write_text(OBJ)
    (folder / "o.mtl").write_text(MTL)
    (folder / "o.gltf").write_text(json.dumps(gltf()))
    told = {**SCENE, "shapes": {**SCENE["shapes"], "file": {"type": "mesh", "path": mesh}}}
    (folder / "s.yaml").write_text(yaml.safe_dump(told))
    return folder / "s.yaml"


def picture(file: Path) -> tuple[str, Tensor]:
    scene = torchpt.load(str(file), device="cpu")
    return fingerprint(scene), shoot(scene, 2, film=film_of(20), integrator={"max_depth": 3}).image


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, Tensor]]:
    """Fingerprint and picture of the scene with either mesh."""
    return {mesh: picture(described(tmp_path_factory.mktemp("a"), mesh)) for mesh in ("o.obj", "o.gltf")}


def texts(file: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))

    return change


def nested(file: str, *keys: Any) -> Callable[[Path], None]:
    """The value of the last key but one becomes the last."""

    def change(folder: Path) -> None:
        *path, last, value = keys
        read, write = (json.loads, json.dumps) if file.endswith(".gltf") else (yaml.safe_load, yaml.safe_dump)
        whole = inner = read((folder / file).read_text())
        for key in path:
            inner = inner[key] if isinstance(inner, list) else inner.setdefault(key, {})
        inner[last] = value
        (folder / file).write_text(write(whole))

    return change


def image(file: str, mode: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / file).write_bytes(png(mode, 9))

    return change


TEXTURE = ("materials", 0, "pbrMetallicRoughness", "baseColorTexture", "extensions", "KHR_texture_transform")
CHANGES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "mtl -s": ("o.obj", texts("o.mtl", "-s 1 1 1", "-s 3 3 1")),
    "mtl -o": ("o.obj", texts("o.mtl", "-s 1 1 1", "-o 0.3 0 0")),
    "mtl -clamp": ("o.obj", texts("o.mtl", "-s 1 1 1", "-clamp on")),
    "mtl -bm": ("o.obj", texts("o.mtl", "-bm 1", "-bm 5")),
    "mtl Ns": ("o.obj", texts("o.mtl", "Ns 20", "Ns 90")),
    "mtl map": ("o.obj", texts("o.mtl", "1 1 1 i.png", "1 1 1 h.png")),
    "mtl d": ("o.obj", texts("o.mtl", "Ns 20", "Ns 20\nd 0.5")),
    "obj v": ("o.obj", texts("o.obj", "v 1 1 0", "v 1 1 0.1")),
    "obj vt": ("o.obj", texts("o.obj", "vt 2 2", "vt 2 1")),
    "obj f": ("o.obj", texts("o.obj", "f 1/1 2/2 3/3 4/4", "f 1/1 2/2 3/3")),
    "obj vn": ("o.obj", texts("o.obj", "f 1/1 2/2 3/3", "vn 0.3 0 1\nf 1/1/1 2/2/1 3/3/1")),
    "its image": ("o.obj", image("i.png", "RGBA")),
    "its heights": ("o.obj", image("h.png", "L")),
    "gltf alphaCutoff": ("o.gltf", nested("o.gltf", "materials", 0, "alphaCutoff", 0.8)),
    "gltf alphaMode": ("o.gltf", nested("o.gltf", "materials", 0, "alphaMode", "OPAQUE")),
    "gltf wrapS": ("o.gltf", nested("o.gltf", "samplers", 0, "wrapS", 33071)),
    "gltf magFilter": ("o.gltf", nested("o.gltf", "samplers", 0, "magFilter", 9728)),
    "gltf offset": ("o.gltf", nested("o.gltf", *TEXTURE, "offset", [0.2, 0])),
    "gltf rotation": ("o.gltf", nested("o.gltf", *TEXTURE, "rotation", 0.4)),
    "gltf scale": ("o.gltf", nested("o.gltf", *TEXTURE, "scale", [3, 3])),
    "gltf image": ("o.gltf", nested("o.gltf", "images", 0, "uri", uri(png("RGBA", 8)))),
    "gltf roughness": ("o.gltf", nested("o.gltf", "materials", 0, "pbrMetallicRoughness", "roughnessFactor", 0.2)),
    "gltf pose": ("o.gltf", nested("o.gltf", "nodes", 0, "translation", [0, 0.2, 0])),
    "camera": ("o.obj", nested("s.yaml", "camera", "blades", 5)),
    "focus": ("o.obj", nested("s.yaml", "camera", "focus_distance", 3)),
    "texture wrap": ("o.obj", nested("s.yaml", "textures", "t", "wrap", "mirror")),
    "texture filter": ("o.obj", nested("s.yaml", "textures", "t", "filter", "nearest")),
    "texture colorspace": ("o.obj", nested("s.yaml", "textures", "t", "colorspace", "linear")),
    "texture scale": ("o.obj", nested("s.yaml", "textures", "t", "scale", 0.5)),
    "texture transform": ("o.obj", nested("s.yaml", "textures", "t", "uv_transform", "rotate", 30)),
    "material": ("o.obj", nested("s.yaml", "materials", "red", "nonlinear", True)),
    "opacity": ("o.obj", nested("s.yaml", "materials", "red", "opacity", 0.5)),
    "inside out": ("o.obj", nested("s.yaml", "shapes", "lamp", "flip_normals", True)),
    "light": ("o.obj", nested("s.yaml", "lights", "bulb", "beam_width", 5)),
    "sky": ("o.obj", nested("s.yaml", "lights", "sky", "transform", [{"rotate": {"axis": [0, 1, 0], "angle": 40}}])),
}


@pytest.mark.parametrize("name", few(CHANGES, 8))
def test_what_changes_a_picture_changes_the_fingerprint(
    name: str, before: dict[str, tuple[str, Tensor]], tmp_path: Path
) -> None:
    mesh, change = CHANGES[name]
    file = described(tmp_path, mesh)
    change(tmp_path)
    found, image = picture(file)
    assert not torch.equal(image, before[mesh][1]), "a change that is none proves nothing"
    assert found != before[mesh][0]


def test_names_and_places_of_files_comments_and_defaults_change_nothing(tmp_path: Path) -> None:
    found = set()
    for folder in ("a", "b"):
        file = described(tmp_path / folder)
        if folder == "b":
            described(tmp_path / folder)
            nested("s.yaml", "camera", "fov_axis", "x")(tmp_path / folder)
            texts("o.mtl", "Ns", "# shiny\nNs")(tmp_path / folder)
            file = file.rename(file.with_name("other.yaml"))
            file.write_text(f"# a comment\n{file.read_text()}")
        found.add(fingerprint(torchpt.load(str(file), device="cpu")))
    assert len(found) == 1


def test_tensors_count_as_they_are_now(tmp_path: Path) -> None:
    scene = torchpt.load(str(described(tmp_path)), device="cpu")
    first = fingerprints(scene)
    name = "lights.bulb.intensity"
    given = fingerprints(scene, {name: scene.params[name] + 1})
    scene.params[name] += 1.0
    changed = fingerprints(scene)
    assert changed == given and {key for key in first if first[key] != changed[key]} == {"lights"}
    scene.params[name] -= 1.0
    assert fingerprints(scene) == first
    assert fingerprint(scene.seen_by({"origin": [0, 0, 5], "target": [0, 0, 0]})) != fingerprint(scene)


# -- everything

EVERYTHING: dict[str, Any] = {
    "camera": SCENE["camera"],
    "materials": {
        "glass": {"type": "roughdielectric", "alpha": 0.2, "opacity": {"type": "image", "data": [[0.2, 0.9]], "wrap": "clamp"}},
        "leaf": {"type": "diffuse", "opacity": {"type": "checkerboard"}, "alpha_cutoff": 0.3, "two_sided": False},
        "metal": {"type": "roughconductor", "eta": [1, 2, 3], "k": 3, "alpha_u": 0.2, "alpha_v": 0.3,
                  "normal_map": {"type": "image", "data": [[[0.5, 0.6, 1.0]]], "filter": "nearest"}, "normal_strength": 0.5},
        "mix": {"type": "blend", "a": {"type": "phong"}, "b": {"type": "principled", "metallic": 0.3}, "weight": 0.4},
        "glow": {"type": "diffuse", "emission": {"type": "image", "data": [[0.2, 0.9]]}, "emission_strength": 2.0},
        "rough": {"type": "plastic", "nonlinear": True, "bump_map": {"type": "image", "data": [[0.2, 0.9]], "scale": 0.1}},
    },
    "shapes": {
        "ball": {"type": "sphere", "material": "glass"},
        "tube": {"type": "cylinder", "center": [3, 0, 0], "radius": 1, "height": 1, "material": "rough"},
        "hat": {"type": "cone", "apex": [3, 4, 0], "height": 1, "slope": 0.5},
        "plate": {"type": "disk", "transform": [{"translate": [0, 0, 4]}], "material": "leaf"},
        "box": {"type": "cube", "transform": [{"translate": [-4, 0, 0]}], "material": "rough"},
        "mesh": {"type": "mesh", "vertices": CORNERS, "faces": [[0, 1, 2], [0, 2, 3]], "uvs": COORDINATES,
                 "normals": [[0, 0.1, 1]] * 4, "material": "rough"},
        "again": {"type": "instance", "of": "mesh", "material": "leaf", "transform": [{"translate": [0, 3, 0]}]},
        "lamp": {"type": "rectangle", "transform": [{"translate": [0, 8, 0]}], "material": "glow"},
        "bulb": {"type": "sphere", "center": [9, 9, 9], "emission": 3},
        "grey": {"type": "rectangle", "transform": [{"translate": [0, -8, 0]}], "material": "metal"},
        "wall": {"type": "rectangle", "transform": [{"translate": [0, 0, -8]}], "material": "mix"},
    },
    "lights": {
        "sky": {"type": "envmap", "data": np.random.default_rng(0).random((4, 8, 3)), "scale": 2},
        "point": {"type": "point", "position": [0, 5, 0], "intensity": 1},
        "spot": SCENE["lights"]["bulb"],
        "sun": {"type": "directional", "direction": [0, -1, 0.2], "irradiance": 1},
    },
}  # fmt: skip


def other(value: Any) -> Any:
    """Another value of the same kind, as near to it as can be."""
    if isinstance(value, Tensor):
        return other(value.detach().numpy()) if value.numel() else None
    if isinstance(value, np.ndarray):
        content = bytearray(np.ascontiguousarray(value).tobytes())
        if not content:
            return None
        content[-value.itemsize] ^= 1  # the last bit of the last number
        return np.frombuffer(content, value.dtype).reshape(value.shape)
    if isinstance(value, bool):
        return not value
    if isinstance(value, float):
        return float(np.nextafter(value, 9e9))
    if isinstance(value, int):
        return value + 1
    if isinstance(value, str):
        return f"{value}1"
    return object if value is None or isinstance(value, type) else None


def variants(value: Any, key: str, seen: set[str]) -> Iterator[tuple[str, bool, Any]]:
    """Return what is like a record but for one number or word: the place, whether it counts, the record; one for each place."""
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            inner = f"{key}.{type(value).__name__}.{field.name}"
            for place, counts, changed in variants(getattr(value, field.name), inner, seen):
                yield place, counts and field.metadata.get("fingerprint", True), _with(value, field.name, changed)
    elif isinstance(value, dict):
        for name, item in value.items():
            for place, counts, changed in variants(item, f"{key}.{name}", seen):
                yield place, counts, {**value, name: changed}
    elif isinstance(value, tuple | list):
        for number, item in enumerate(value):
            for place, counts, changed in variants(item, f"{key}.#", seen):
                yield place, counts, type(value)((*value[:number], changed, *value[number + 1 :]))
    elif key not in seen and (changed := other(value)) is not None:
        seen.add(key)
        yield key, True, torch.from_numpy(changed) if isinstance(value, Tensor) else changed


def _with(value: Any, name: str, changed: Any) -> Any:
    made = object.__new__(type(value))
    made.__dict__.update({**value.__dict__, name: changed})
    return made


@pytest.fixture(scope="module")
def everything() -> torchpt.Scene:
    return torchpt.load(EVERYTHING, device="cpu")


def test_every_number_and_word_of_a_world_counts(everything: torchpt.Scene) -> None:
    world, _ = everything.world(torch.float32, uv=True)
    known, places = {tree.fingerprint(world)}, []
    for place, counts, changed in variants(world, "", set()):
        known.add(tree.fingerprint(changed))
        places.append(place)
        assert counts and len(known) == len(places) + 1, place
    assert len(places) > 150
    for part in (
        "Atlas.wraps",
        "Atlas.transforms",
        "Atlas.layouts",
        "OpacityMaps",
        "Instances.x",
        "Quadrics.e3",
        "two_sided",
    ):
        assert any(part in place for place in places), part


def test_every_number_and_word_of_what_was_built_counts(everything: torchpt.Scene) -> None:
    everything, left = copy.copy(everything), set()
    built, description = everything.built, everything.description
    known, count = {fingerprint(everything)}, 1
    for place, counts, changed in variants((built, description.camera), "", set()):
        if ".parameters." in place:
            continue  # as they were loaded
        everything.replace_build(changed[0])
        everything.description = replace(description, camera=changed[1])
        found = fingerprint(everything)
        if counts:
            known.add(found)
            count += 1
            assert len(known) == count, place
        else:
            left.add(place.rpartition(".")[2])
            assert found in known, place
    assert count > 150 and left == {"source"}
    for name, value in everything.params.items():
        changed = other(value)
        assert changed is not None
        known.add(str(fingerprints(everything, {name: torch.from_numpy(changed)})))
        count += 1
        assert len(known) == count, name


# -- models of one's own

MODEL = """
from torchpt import Bsdf
class Own(Bsdf):
    strength = 1.0
    def albedo(self, parameters): return 2.0 * parameters["color"]
    def eval(self, parameters, wo, wi): return parameters["color"] * self.strength
    def pdf(self, parameters, wo, wi): return wi[2]
"""


def test_models_of_ones_own_count_by_code_and_state() -> None:
    def scene(text: str = MODEL, **state: Any) -> torchpt.Scene:
        space: dict[str, Any] = {"__name__": "someone"}
        exec(text, space)
        model = space["Own"]()
        for name, value in state.items():
            setattr(model, name, value)
        told = {"camera": SCENE["camera"], "shapes": {"a": {"type": "sphere", "material": {"type": "own"}}}}
        return torchpt.load(told, device="cpu", bsdfs={"own": model})

    first = fingerprint(scene())
    assert first == fingerprint(scene()) == fingerprint(scene(f"# words\n{MODEL}"))
    texts = [MODEL.replace("2.0", "2.5"), MODEL.replace("1.0", "1.5"), MODEL.replace("wi[2]", "wo[2]")]
    found = {first, *(fingerprint(scene(text)) for text in texts), fingerprint(scene(table=torch.ones(3)))}
    assert len(found) == 5
    changing = scene(table=torch.ones(3))
    before = fingerprint(changing)
    vars(changing.own_models[0])["table"][1] = 2.0
    assert fingerprint(changing) != before
    with pytest.raises(SceneError, match="models whose contents can be compared"):
        fingerprint(scene(lock=threading.Lock()))


CODE = (
    "import torchpt; from torchpt.scene.fingerprint import fingerprint; print(fingerprint(torchpt.load('{}', 'cpu')))"
)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_box", "noise"])
def test_two_processes_agree(name: str) -> None:
    found = set()
    for number in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": number}  # the order of sets follows from it
        words = [sys.executable, "-c", CODE.format(name)]
        found.add(subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout)
    assert len(found) == 1
