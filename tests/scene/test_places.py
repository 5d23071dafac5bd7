"""Places and sizes that float32 cannot hold: one line that names the key, whatever brings them in."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few import few

import torchpt
from torchpt.core.errors import AssetError, SceneError
from torchpt.math.transforms import is_usable

CAMERA = {"origin": [0, 0, 5], "target": [0, 0, 0]}
TRIANGLE = {"type": "mesh", "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]]}
CUBE = {"type": "cube", "transform": [{"scale": 1e-20}]}
FAR = [[1.0, 0.0, 0.0, 1e39], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
LIT = {"emission": [1, 1, 1]}
SMALL = {"width": 2, "height": 2}

OPERATIONS: dict[str, list[dict[str, Any]]] = {
    "moved out": [{"translate": [1e39, 0, 0]}],
    "moved out in two steps": [{"translate": [2e38, 0, 0]}, {"translate": [2e38, 0, 0]}],
    "huge": [{"scale": 1e300}],
    "huge in two steps": [{"scale": 1e20}, {"scale": 1e20}],
    "tiny": [{"scale": 1e-300}],
    "tiny in two steps": [{"scale": 1e-20}, {"scale": 1e-20}],
    "a tiny matrix": [{"matrix": np.diag([1e-39, 1e-39, 1e-39, 1]).tolist()}],
    "a matrix far off": [{"matrix": FAR}],
    "an inverse far off": [{"scale": 1e-10}, {"translate": [1e30, 0, 0]}],
    "looked at from afar": [{"look_at": {"origin": [1e39, 0, 0], "target": [1e39, 0, 1e30]}}],
}
SHAPES: dict[str, dict[str, Any]] = {
    "sphere": {"type": "sphere"},
    "shining sphere": {"type": "sphere", **LIT},
    "cylinder": {"type": "cylinder"},
    "cone": {"type": "cone"},
    "disk": {"type": "disk"},
    "shining rectangle": {"type": "rectangle", **LIT},
    "cube": {"type": "cube"},
    "mesh": TRIANGLE,
    "instance": {"type": "instance", "of": "first"},
}


def load(**blocks: Any) -> torchpt.Scene:
    return torchpt.load({"camera": CAMERA, **blocks}, device="cpu")


@pytest.mark.parametrize("what", SHAPES)
def test_a_transform_that_float32_cannot_hold_is_refused(what: str) -> None:
    for how, operations in OPERATIONS.items():
        with pytest.raises(SceneError) as caught:
            load(shapes={"first": {"type": "cube"}, "s": {**SHAPES[what], "transform": operations}})
        said = str(caught.value)
        assert re.search(r"product can be inverted, it and its inverse finite in float32.*got \[\{", said), (how, said)
        assert caught.value.key == "shapes.s.transform", how
        assert "\n" not in said, how


def test_the_error_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "far.yaml"
    file.write_text(
        "camera: {origin: [0, 0, 5], target: [0, 0, 0]}\n"
        "shapes:\n  s: {type: sphere, transform: [{scale: 1e20}, {scale: 1e20}]}\n"
    )
    with pytest.raises(SceneError, match=r"far\.yaml: shapes\.s\.transform: expected .*float32.*'scale': 1e\+20"):
        torchpt.load(file, device="cpu")


@pytest.mark.parametrize(
    ("operation", "size", "place"),
    [({"scale": 6e37}, 6e37, 0), ({"scale": 1e-38}, 1e-38, 0), ({"translate": [3e38, 0, 0]}, 1, 3e38)],
)
@pytest.mark.parametrize("what", few(["shining sphere", "shining rectangle", "shining cube", "shining cone"], 2))
def test_the_limits_of_float32_show_the_same_picture(
    what: str, operation: dict[str, Any], size: float, place: float
) -> None:
    shape = {"type": what.split()[1], **LIT}

    def picture(camera: dict[str, Any], **keys: Any) -> torch.Tensor:
        scene = torchpt.load({"camera": camera, "shapes": {"s": {**shape, **keys}}}, device="cpu")
        return torchpt.render(scene, spp=4, film={"width": 8, "height": 8}, compile="off")

    pose = [[-1, 0, 0, place], [0, 1, 0, 0], [0, 0, -1, 5 * size], [0, 0, 0, 1]]
    there, here = picture({"to_world": pose}, transform=[operation]), picture(CAMERA)
    assert here.mean() > 0.1
    assert ((there - here).abs() < 1e-4).float().mean() > 0.95


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "sphere", "radius": 1e30, "transform": [{"scale": 1e30}]},
        {"type": "sphere", "radius": 1e-44},
        {"type": "sphere", "center": [1e30, 0, 0], "radius": 1e-10},
        {"type": "cylinder", "radius": 1e38, "height": 1e38, "transform": [{"scale": 10}]},
        {"type": "cone", "height": 1e30, "slope": 1e30},
    ],
    ids=["huge", "tiny", "far", "cylinder", "cone"],
)
def test_sizes_count_too(shape: dict[str, Any]) -> None:
    with pytest.raises(SceneError, match=r"float32") as caught:
        load(shapes={"s": shape})
    assert caught.value.key == "shapes.s"


def test_a_size_below_float32() -> None:
    with pytest.raises(SceneError, match=r"> 0, got 1e-200") as caught:
        load(shapes={"s": {"type": "sphere", "radius": 1e-200, **LIT}})
    assert caught.value.key == "shapes.s.radius"


def test_a_copy_too_far_from_its_mesh() -> None:
    copy = {"type": "instance", "of": "first", "transform": [{"scale": 1e20}]}
    with pytest.raises(SceneError, match=r"where first lies.*float32") as caught:
        load(shapes={"first": CUBE, "s": copy})
    assert caught.value.key == "shapes.s.transform"


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_camera_too_far(kind: str) -> None:
    with pytest.raises(SceneError, match=r"float32") as caught:
        torchpt.load({"camera": {"type": kind, "to_world": FAR}}, device="cpu")
    assert caught.value.key == "camera.to_world"


def test_a_map_turned_out_of_range(tmp_path: Path) -> None:
    torchpt.write_image(tmp_path / "sky.exr", torch.ones(4, 8, 3))
    sky = {"type": "envmap", "path": str(tmp_path / "sky.exr"), "transform": [{"scale": 1e300}]}
    with pytest.raises(SceneError, match=r"float32") as caught:
        load(lights={"sky": sky})
    assert caught.value.key == "lights.sky.transform"


def test_a_light_of_a_mesh_file_too_far() -> None:
    from torchpt.physics.parts import Parameters
    from torchpt.scene.meshes import FileLight
    from torchpt.scene.sources import build_file_lights

    light = FileLight("bulb", "point", np.array([1e30, 0, 0]), np.array([0, 0, 1.0]), {})
    with pytest.raises(AssetError, match=r"light 'bulb' has no finite place"):
        build_file_lights([light], "shapes.s", np.diag([1e10, 1e10, 1e10, 1]), "a.glb", Parameters())


def pose(scale: float = 1.0, move: float = 0.0) -> torch.Tensor:
    matrix = torch.diag(torch.tensor([scale, scale, scale, 1.0], dtype=torch.float64))
    matrix[0, 3] = move
    return matrix


@pytest.mark.parametrize("name", ["shapes.ball", "shapes.lamp", "shapes.mesh", "shapes.copy", "camera"])
@pytest.mark.parametrize("value", few([pose(1e39), pose(1e-39), pose(1e-200), pose(move=1e39), pose(1e-10, 1e30)], 3))
def test_poses_as_parameters(name: str, value: torch.Tensor) -> None:
    shapes = {
        "ball": {"type": "sphere"},
        "lamp": {"type": "rectangle", **LIT},
        "mesh": TRIANGLE,
        "copy": {"type": "instance", "of": "mesh"},
    }
    scene, key = load(shapes=shapes), f"{name}.to_world"
    with pytest.raises(SceneError, match=r"float32") as caught:
        torchpt.render(scene, spp=1, params={key: value}, film=SMALL)
    assert caught.value.key == f"params.{key}"
    # The same, put in place.
    torchpt.render(scene, spp=1, film=SMALL, compile="off")
    scene.params[key] = value
    with pytest.raises(SceneError, match=r"float32") as caught:
        torchpt.render(scene, spp=1, film=SMALL, compile="off")
    assert caught.value.key == f"params.{key}"


def test_vertices_as_parameters() -> None:
    vertices = torch.tensor(TRIANGLE["vertices"], dtype=torch.float64) * 1e39
    with pytest.raises(SceneError, match=r"finite in float32"):
        torchpt.render(load(shapes={"mesh": TRIANGLE}), spp=1, params={"shapes.mesh.vertices": vertices})


def test_a_usable_matrix() -> None:
    assert is_usable(np.eye(4)) and is_usable(np.diag([1e38, 1e38, 1e38, 1])) and is_usable(np.diag([1e-38] * 3 + [1]))
    for size in (1e39, 1e-39, 1e-160, 1e-320):
        assert not is_usable(np.diag([size] * 3 + [1]))


@pytest.mark.parametrize("camera", [{}, {"type": "orthographic"}])
def test_a_camera_far_from_the_origin_sees_what_lies_there(camera: dict[str, Any]) -> None:
    """Target and origin were compared once float32 had made them one."""
    pictures = []
    for far in (0.0, 1e12):
        places = {"origin": [far, 0, far + 4], "target": [far, 0, far]}
        scene = torchpt.load(
            {
                "camera": {**camera, **places},
                "film": {"width": 8, "height": 8},
                "lights": {"sky": {"type": "constant", "radiance": 0.5}},
                "shapes": {"ball": {"type": "sphere", "center": places["target"]}},
            },
            device="cpu",
        )
        pictures.append(torchpt.render(scene, spp=4, compile="off"))
    assert torch.allclose(pictures[0], pictures[1], atol=1e-3) and pictures[0].std() > 0.05


def test_a_camera_that_looks_nowhere_is_refused() -> None:
    for target in (10**17 + 1, 1e17):
        with pytest.raises(
            SceneError, match=r"^camera.target: expected a point other than the origin \(to the 16 digits"
        ):
            load(camera={"origin": [10**17, 0, 0], "target": [target, 0, 0]})
