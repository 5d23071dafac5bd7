"""Lights and cameras of glTF files: where they come to stand, what they are called, what is said of errors."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

import torchpt
from torchpt.core.errors import AssetError, EdgeWarning, SceneError
from torchpt.scene.formats.cameras import read_camera
from torchpt.scene.formats.description import settings
from torchpt.scene.meshes import FileLight, load_mesh

HALF = math.sqrt(0.5)
BULB = {"name": "bulb", "type": "point", "color": [1, 0.5, 0.25], "intensity": 8, "range": 50}
CONE = {"innerConeAngle": math.radians(20), "outerConeAngle": math.radians(30)}
SPOT = {"name": "lamp.1", "type": "spot", "color": [0.5, 1, 1], "intensity": 20, "spot": CONE}
SUN = {"type": "directional", "intensity": 3}


def lit(number: int, **node: Any) -> dict[str, Any]:
    return {"extensions": {"KHR_lights_punctual": {"light": number}}, **node}


#: Turned by 90 degrees from z to x, twice as large, moved; its lights: one moved, one looking down, one by a matrix.
NODES = [
    {"children": [1, 2, 3, 4, 5], "rotation": [0, HALF, 0, HALF], "scale": [2, 2, 2], "translation": [1, 0, 0]},
    {"mesh": 0},
    lit(0, translation=[1, 1, 0]),
    lit(1, translation=[0, 1.5, 0], rotation=[-HALF, 0, 0, HALF]),
    lit(2, name="sun", matrix=[1, 0, 0, 0, 0, 0, 1, 0, -1, 2, -0.5, 0, 0, 0, 0, 1]),
    {"camera": 0, "translation": [0, 1, 2]},
]
#: What they come to under TRANSFORM, in numbers of a scene file.
TRANSFORM = [{"scale": [1, 1, 2]}, {"translate": [0, 0, 3]}]
PLACED: dict[str, dict[str, Any]] = {
    "bulb": {"type": "point", "position": [1, 2, -1], "intensity": [8, 4, 2]},
    "lamp_1": {
        "type": "spot", "position": [1, 3, 3], "target": [1, 0, 3], "intensity": [10, 20, 20],
        "cutoff_angle": 30, "beam_width": 20,
    },
    "sun": {"type": "directional", "direction": [0.5, -2, -2], "irradiance": 3},
}  # fmt: skip


def write(folder: Path, lights: list[Any] | None, nodes: list[Any] = NODES, name: str = "a", **changes: Any) -> Path:
    """A floor of two triangles, lights at nodes of their own."""
    points = np.array([[-4, 0, -4], [-4, 0, 4], [4, 0, 4], [4, 0, -4]], "<f4").tobytes()
    body = points + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes if lights is not None else nodes[:1] + nodes[1:2] + [{}] * (len(nodes) - 2),
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "buffers": [{"byteLength": len(body), "uri": uri}],
        "cameras": [{"name": "Main", "type": "perspective", "perspective": {"yfov": math.radians(40), "znear": 0.1}}],
        **changes,
    }
    if lights is not None:
        document |= {"extensions": {"KHR_lights_punctual": {"lights": lights}}}
        document |= {"extensionsUsed": ["KHR_lights_punctual"], "extensionsRequired": ["KHR_lights_punctual"]}
    (folder / f"{name}.gltf").write_text(json.dumps(document))
    return folder / f"{name}.gltf"


def scene(path: Path, lights: dict[str, Any] | None = None, **shape: Any) -> dict[str, Any]:
    return {
        "camera": {"origin": [1, 9, 3], "target": [1, 0, 3], "up": [0, 0, 1], "fov": 60},
        "shapes": {"m": {"type": "mesh", "path": str(path), "transform": TRANSFORM, **shape}},
        "lights": lights or {},
        "film": {"width": 24, "height": 24, "filter": "box"},
        "integrator": {"type": "path", "max_depth": 3},
    }


def loaded(path: Path, lights: dict[str, Any] | None = None, **shape: Any) -> torchpt.Scene:
    return torchpt.load(scene(path, lights, **shape), device="cpu")


def one_light(folder: Path, light: Any, **node: Any) -> FileLight:
    (part,) = load_mesh(write(folder, [light], [{"children": [1, 2]}, {"mesh": 0}, lit(0, **node)]))
    (found,) = part.lights
    return found


def test_lights_stand_where_a_scene_file_would_put_them(tmp_path: Path) -> None:
    brought = loaded(write(tmp_path, [BULB, SPOT, SUN]))
    told = loaded(write(tmp_path, None, name="b"), PLACED)
    for name, value in told.params.items():
        if name.startswith("lights."):
            own = brought.params[f"shapes.m.{name}"]
            if name.endswith((".target", ".direction")):  # only where they point matters
                origin = told.params.get("lights.lamp_1.position", 0.0) if name.endswith(".target") else 0.0
                own, value = (x.double() - origin for x in (own, value))
                own, value = own / own.norm(), value / value.norm()
            torch.testing.assert_close(own.double(), value.double(), rtol=1e-6, atol=1e-6, msg=name)
    assert sum(name.startswith("shapes.m.lights.") for name in brought.params) == 2 + 5 + 2
    a, b = (made.world(torch.float32)[0].lights for made in (brought, told))
    assert a is not None and b is not None and a.kinds == b.kinds == ("point", "spot", "directional")
    for column in ("p0", "e1", "normal", "radiance"):
        torch.testing.assert_close(getattr(a, column), getattr(b, column), rtol=1e-6, atol=1e-6)
    images = [torchpt.render(made, spp=8, compile="off") for made in (brought, told)]
    assert images[0].mean() > 0.3
    torch.testing.assert_close(*images, rtol=1e-4, atol=1e-5)


def test_defaults_and_units(tmp_path: Path) -> None:
    point = one_light(tmp_path, {"type": "point"}, translation=[3, 4, 5], scale=[7, 7, 7])
    assert (point.name, point.kind, point.numbers) == (
        "light0",
        "point",
        {"intensity": (1, 1, 1)},
    )  # size is no strength
    assert point.position.tolist() == [3, 4, 5]
    spot = one_light(tmp_path, {"type": "spot", "intensity": 2}, name="n")
    assert (spot.name, spot.direction.tolist()) == ("n", [0, 0, -1])
    assert spot.numbers == {"intensity": (2, 2, 2), "cutoff_angle": pytest.approx(45), "beam_width": 1e-3}
    narrow = one_light(tmp_path, {"type": "spot", "spot": {"outerConeAngle": 1e-7}}).numbers
    assert 0 < float(np.max(narrow["beam_width"])) <= float(np.max(narrow["cutoff_angle"]))
    half = one_light(tmp_path, {"type": "spot", "spot": {"outerConeAngle": float(np.float32(math.pi / 2))}}).numbers
    assert half["cutoff_angle"] == pytest.approx(90)
    mirrored = one_light(tmp_path, {"type": "directional"}, scale=[1, 1, -3]).direction
    assert mirrored.tolist() == [0, 0, 1]


def test_lights_of_one_name_and_of_a_far_scene(tmp_path: Path) -> None:
    nodes = [{"children": [1, 2, 3]}, {"mesh": 0}, lit(0), lit(0, translation=[0, 1, 0])]
    made = loaded(write(tmp_path, [BULB], nodes), transform=[{"translate": [1e6, 0, 0]}])
    names = [name for name in made.params if ".lights." in name]
    assert names == [
        f"shapes.m.lights.{label}.{key}" for label in ("bulb", "bulb_1") for key in ("position", "intensity")
    ]
    assert made.params["shapes.m.lights.bulb_1.position"].dtype == torch.float64  # moved to the origin before float32
    assert made.params["shapes.m.lights.bulb_1.position"].tolist() == [1e6, 1, 0]


def test_they_are_parameters(tmp_path: Path) -> None:
    """A picture is linear in all amounts of light, so that its derivative along them is the picture."""
    made = loaded(write(tmp_path, [BULB, SPOT, SUN]))
    amounts = {
        name: value.clone().requires_grad_()
        for name, value in made.params.items()
        if name.endswith((".intensity", ".irradiance"))
    }
    assert len(amounts) == 3
    image = torchpt.render(made, params=amounts, spp=4, seed_grad=0, compile="off")
    image.sum().backward()
    along = sum(float((value.grad * value.detach()).sum()) for value in amounts.values() if value.grad is not None)
    assert along == pytest.approx(float(image.detach().sum()), rel=1e-3)
    name = "shapes.m.lights.bulb.position"
    place = made.params[name].clone().requires_grad_()
    with pytest.warns(EdgeWarning):
        torchpt.render(made, params={name: place}, spp=4, compile="off", edges=False).sum().backward()
    assert place.grad is not None and float(place.grad[1]) != 0


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("bulb.intensity", [-1.0, 0, 0], r">= 0 \(clamp"),
        ("bulb.position", [float("nan"), 0, 0], "finite"),
        ("sun.direction", [0.0, 0, 0], "a direction other than"),
        ("lamp_1.cutoff_angle", 0.0, "an angle in degrees"),
    ],
)
def test_parameters_are_checked(tmp_path: Path, key: str, value: Any, expected: str) -> None:
    made = loaded(write(tmp_path, [BULB, SPOT, SUN]))
    with pytest.raises(SceneError, match=expected):
        made.check({f"shapes.m.lights.{key}": torch.tensor(value)})


def test_a_light_may_be_called_material(tmp_path: Path) -> None:
    made = loaded(write(tmp_path, [{**BULB, "name": "material"}], [{"children": [1, 2]}, {"mesh": 0}, lit(0)]))
    made.check({"shapes.m.lights.material.position": torch.tensor([-1.0, -2, -3])})


def test_a_material_leaves_lights_and_an_instance_brings_none(tmp_path: Path) -> None:
    told = scene(write(tmp_path, [BULB, SPOT, SUN]), material={"type": "diffuse", "reflectance": 0.2})
    told["shapes"]["again"] = {"type": "instance", "of": "m", "transform": [{"translate": [0, -1, 0]}]}
    lights = torchpt.load(told, device="cpu").world(torch.float32)[0].lights
    assert lights is not None and lights.p0.shape[1] == 3


def test_info_names_lights_and_offers_cameras(tmp_path: Path) -> None:
    made = loaded(write(tmp_path, [BULB, SPOT, SUN]))
    row = made.info(settings(made.description))["shapes"]["m"]
    assert row["lights"] == {"bulb": "point", "lamp_1": "spot", "sun": "directional"}
    *rest, camera = row["ignored_in_file"]
    assert rest == ["KHR_lights_punctual.range"]
    block = yaml.safe_load(camera.removeprefix("camera Main: "))
    assert (block["fov"], block["fov_axis"]) == (40, "y")
    # At (0, 1, 2) looking along -z, turned to look along -x by the root; then the shape's transform.
    straight = {"origin": [5, 2, 3], "target": [4, 2, 3], "up": [0, 1, 0], "fov": 40, "fov_axis": "y"}
    found, expected = (read_camera(x, {}, None)["to_world"] for x in (block, straight))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_cameras_of_other_kinds(tmp_path: Path) -> None:
    flat = {"type": "orthographic", "orthographic": {"xmag": 1.5, "ymag": 1}}
    (part,) = load_mesh(write(tmp_path, [BULB, SPOT, SUN], cameras=[flat]))
    assert [(camera.kind, camera.name, camera.film_text) for camera in part.cameras] == [
        ("orthographic", "camera0", "width: 3")
    ]
    for odd in ({"type": "perspective"}, {"type": "perspective", "perspective": {"yfov": 4}}, {"type": "fisheye"}, 3):
        (part,) = load_mesh(write(tmp_path, [BULB, SPOT, SUN], cameras=[odd]))
        assert part.cameras == () and "cameras" in part.ignored


ERRORS: dict[str, tuple[Any, str]] = {
    "negative": ({**BULB, "intensity": -1}, "intensity '-1' is no number"),
    "not a number": ({**BULB, "intensity": float("nan")}, "intensity 'nan' is no number"),
    "a word": ({**BULB, "intensity": "bright"}, "intensity 'bright' is no number"),
    "too bright": ({**BULB, "intensity": 1e29, "color": [1, 1, 1e5]}, "color times intensity is above 1e\\+30"),
    "two colours": ({**BULB, "color": [1, 1]}, r"color '\[1, 1\]' is not 3 numbers"),
    "negative colour": ({**BULB, "color": [1, 1, -0.5]}, "color '-0.5' is no number"),
    "wide": ({**SPOT, "spot": {"outerConeAngle": 1.6}}, "outerConeAngle 1.6 is not above 0 and at most pi / 2"),
    "closed": ({**SPOT, "spot": {"outerConeAngle": 0}}, "outerConeAngle 0 is not above 0"),
    "inside out": (
        {**SPOT, "spot": {"innerConeAngle": 0.5, "outerConeAngle": 0.5}},
        "innerConeAngle 0.5 is not below outerConeAngle 0.5",
    ),
    "unknown": ({**BULB, "type": "area"}, "type 'area', expected point, spot or directional"),
    "no object": (3, r"extensions.KHR_lights_punctual.lights\[0\]: expected an object, got 3"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors_are_one_line(tmp_path: Path, name: str) -> None:
    light, problem = ERRORS[name]
    with pytest.raises(AssetError, match=problem) as caught:
        one_light(tmp_path, light)
    assert str(caught.value).startswith(str(tmp_path / "a.gltf")) and str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("node", "problem"),
    [
        (lit(7), "light 7 does not exist \\(1 are declared\\)"),
        (lit(-1), "light -1 does not exist"),
        (lit(0, scale=[1, 1, 0]), "light 0: its node leaves it no direction"),
    ],
)
def test_nodes_that_place_no_light(tmp_path: Path, node: dict[str, Any], problem: str) -> None:
    with pytest.raises(AssetError, match=problem):
        load_mesh(write(tmp_path, [BULB], [{"children": [1, 2]}, {"mesh": 0}, node]))


def test_a_file_of_lights_alone_is_no_mesh(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="the mesh is empty"):
        load_mesh(write(tmp_path, [BULB], [lit(0)]))


def test_lights_follow_a_transform_of_tensors(tmp_path: Path) -> None:
    """What moves the mesh moves its lights, and so do gradients; directions only turn."""
    path = write(tmp_path, [BULB, SPOT, SUN])
    move = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    angle = torch.zeros((), dtype=torch.float64, requires_grad=True)
    turn = {"rotate": {"axis": [0, 0, 1], "angle": angle}}
    made = torchpt.load(scene(path, transform=[*TRANSFORM, turn, {"translate": move}]), "cpu")
    still = torchpt.load(scene(path), "cpu")
    assert all(value.allclose(still.params[name], atol=1e-6) for name, value in made.params.items())
    names = [name for name, value in made.params.items() if value.requires_grad and ".lights." in name]
    assert {name.rpartition(".")[2] for name in names} == {"position", "target", "direction"}
    for name in names:
        own = still.params[name].double()
        gradients = torch.autograd.grad(made.params[name].sum(), (move, angle), retain_graph=True, allow_unused=True)
        expected = 0.0 if name.endswith(".direction") else 1.0
        assert gradients[0] is None or gradients[0].allclose(torch.full_like(move, expected)), name
        assert gradients[1] is not None
        assert torch.isclose(gradients[1], (own[0] - own[1]) * math.pi / 180.0, rtol=1e-4, atol=1e-6), name
