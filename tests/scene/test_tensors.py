"""Tensors in a scene's dict: the same numbers, the same picture, and gradients through all that a parameter is made of."""

from __future__ import annotations

import copy
import pickle
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
QUAD = [[-1.0, -1.0, 0.2], [1.0, -1.0, 0.0], [1.0, 1.0, 0.1], [-1.0, 1.0, 0.0]]
SCENE: dict[str, Any] = {
    "camera": {"type": "thinlens", "origin": [0.1, 0.4, 4.0], "target": [0.0, 0.1, 0.0], "up": [0.1, 1.0, 0.0], "fov": 40.0,
               "aperture_radius": 0.1, "focus_distance": 3.5},
    "film": {"width": 16, "height": 16},
    "integrator": {"type": "path", "max_depth": 3},
    "render": {"spp": 4, "threads": 1},
    "textures": {"squares": {"type": "checkerboard", "color0": [0.1, 0.2, 0.3], "color1": 0.8},
                 "paint": {"type": "image", "data": [[[0.2, 0.3, 0.4], [0.5, 0.6, 0.7]], [[0.8, 0.2, 0.1], [0.3, 0.3, 0.3]]]}},
    "materials": {
        "red": {"type": "principled", "base_color": [0.7, 0.1, 0.1], "roughness": 0.4},
        "tiles": {"type": "diffuse", "reflectance": {"texture": "squares"}},
        "mix": {"type": "blend", "a": "red", "b": {"type": "diffuse", "reflectance": [0.2, 0.3, 0.4]}, "weight": 0.3},
        "wall": {"type": "diffuse", "reflectance": {"texture": "paint"}},
    },
    "shapes": {
        "ball": {"type": "sphere", "center": [0.0, 0.1, 0.0], "radius": 0.7, "material": "mix",
                 "transform": [{"scale": [1.0, 1.2, 0.9]}, {"rotate": {"axis": [0.0, 1.0, 0.3], "angle": 20.0}},
                               {"translate": [0.1, 0.0, 0.0]}]},
        "pipe": {"type": "cylinder", "center": [-1.0, 0.0, 0.0], "radius": 0.2, "height": 1.0, "material": "tiles"},
        "hat": {"type": "cone", "apex": [1.0, 0.8, 0.0], "height": -0.7, "slope": 0.5, "emission": [0.2, 0.1, 0.3]},
        "quad": {"type": "mesh", "vertices": QUAD, "faces": [[0, 1, 2], [0, 2, 3]],
                 "normals": [[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.1, 0.1, 1.0], [0.0, 0.1, 1.0]],
                 "uvs": [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
                 "material": {"type": "diffuse", "reflectance": {"type": "image", "data": [[0.2, 0.4], [0.6, 0.8]]}},
                 "transform": [{"look_at": {"origin": [0.0, 0.0, -2.0], "target": [0.1, 0.0, 0.0]}}]},
        "floor": {"type": "rectangle", "material": "wall",
                  "transform": [[2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, -1.0], [0.0, -2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]},
    },
    "lights": {
        "spot": {"type": "spot", "position": [2.0, 3.0, 2.0], "target": [0.0, 0.0, 0.0], "intensity": 20.0,
                 "cutoff_angle": 30.0},
        "sky": {"type": "envmap", "data": [[[0.4, 0.5, 0.6]] * 3, [[0.2, 0.1, 0.3]] * 3], "scale": 0.8,
                "transform": [{"rotate": {"axis": [0.0, 1.0, 0.0], "angle": 15.0}}]},
    },
}  # fmt: skip

SIMPLE: dict[str, Any] = {
    **{key: SCENE[key] for key in ("film", "render")},
    "camera": {"origin": [0.1, 0.4, 4.0], "target": [0.0, 0.1, 0.0], "fov": 40.0},
    "integrator": {"type": "path", "max_depth": 3},
    "materials": {"red": {"type": "diffuse", "reflectance": [0.7, 0.1, 0.1]}},
    "shapes": {"ball": {"type": "sphere", "radius": 0.7, "material": "red"}},
    "lights": {"sky": {"type": "constant", "radiance": 0.5}},
}

#: Where a tensor may stand, and the parameter that it goes into.
PLACES = {
    "camera.origin": "camera.to_world",
    "camera.target": "camera.to_world",
    "camera.up": "camera.to_world",
    "camera.fov": "camera.fov",
    "camera.aperture_radius": "camera.aperture_radius",
    "camera.focus_distance": "camera.focus_distance",
    "textures.squares.color0": "textures.squares.color0",
    "textures.squares.color1": "textures.squares.color1",
    "textures.paint.data": "textures.paint",
    "materials.red.base_color": "materials.red.base_color",
    "materials.red.roughness": "materials.red.roughness",
    "materials.mix.b.reflectance": "materials.mix.b.reflectance",
    "materials.mix.weight": "materials.mix.weight",
    "shapes.ball.center": "shapes.ball.to_world",
    "shapes.ball.radius": "shapes.ball.to_world",
    "shapes.ball.transform.0.scale": "shapes.ball.to_world",
    "shapes.ball.transform.1.rotate.axis": "shapes.ball.to_world",
    "shapes.ball.transform.1.rotate.angle": "shapes.ball.to_world",
    "shapes.ball.transform.2.translate": "shapes.ball.to_world",
    "shapes.pipe.center": "shapes.pipe.to_world",
    "shapes.pipe.radius": "shapes.pipe.to_world",
    "shapes.pipe.height": "shapes.pipe.to_world",
    "shapes.hat.apex": "shapes.hat.to_world",
    "shapes.hat.height": "shapes.hat.to_world",
    "shapes.hat.slope": "shapes.hat.to_world",
    "shapes.hat.emission": "shapes.hat.emission",
    "shapes.quad.vertices": "shapes.quad.vertices",
    "shapes.quad.vertices.2": "shapes.quad.vertices",
    "shapes.quad.normals": "shapes.quad.normals",
    "shapes.quad.uvs": "shapes.quad.uvs",
    "shapes.quad.material.reflectance.data": "shapes.quad.material.reflectance",
    "shapes.quad.transform.0.look_at.origin": "shapes.quad.to_world",
    "shapes.quad.transform.0.look_at.target": "shapes.quad.to_world",
    "shapes.floor.transform": "shapes.floor.to_world",
    "lights.spot.position": "lights.spot.position",
    "lights.spot.target": "lights.spot.target",
    "lights.spot.intensity": "lights.spot.intensity",
    "lights.spot.cutoff_angle": "lights.spot.cutoff_angle",
    "lights.sky.data": "lights.sky.texels",
    "lights.sky.scale": "lights.sky.scale",
    "lights.sky.transform.0.rotate.angle": "lights.sky.to_world",
}


def put(key: str, change: Callable[[Any], Any], scene: dict[str, Any]) -> dict[str, Any]:
    """The scene, in which what stands at a dotted key is changed; its tensors stay what they are."""
    *path, last = [int(part) if part.isdecimal() else part for part in key.split(".")]
    owner: Any = scene
    for part in path:
        owner = owner[part]
    owner[last] = change(owner.get(last) if isinstance(owner, dict) else owner[last])  # pyright: ignore
    return scene


def placed(key: str, change: Callable[[Any], Any], scene: dict[str, Any] = SCENE) -> dict[str, Any]:
    """A copy of the scene with what stands at a dotted key changed."""
    return put(key, change, copy.deepcopy(scene))


def wanted(value: Any, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(value, dtype=dtype, requires_grad=True)


@pytest.fixture(scope="module")
def plain() -> torchpt.Scene:
    return torchpt.load(SCENE, "cpu")


@pytest.mark.parametrize("key", PLACES)
def test_parameters_follow_the_tensors_they_are_made_of(key: str, plain: torchpt.Scene) -> None:
    """Values to the bit, and derivatives as differences of scenes that are loaded anew."""
    tensors: list[Tensor] = []

    def tensor(value: Any) -> Tensor:
        tensors.append(wanted(value))
        return tensors[-1]

    scene, name = torchpt.load(placed(key, tensor), "cpu"), PLACES[key]
    assert all(scene.params[other].equal(value) for other, value in plain.params.items())
    traced = {other for other, value in scene.params.items() if value.requires_grad}
    assert traced == {name} | ({"lights.spot.beam_width"} if key == "lights.spot.cutoff_angle" else set())
    value = scene.params[name]
    weight = torch.linspace(0.5, 1.5, value.numel(), dtype=torch.float64).reshape(value.shape)
    (gradient,) = torch.autograd.grad((value * weight).sum(), tensors)
    way = torch.linspace(1.0, 0.3, gradient.numel(), dtype=torch.float64).reshape(gradient.shape)
    if key == "shapes.floor.transform":
        way[3] = 0.0  # no number of the scene
    step = 1e-3

    def moved(sign: float) -> Tensor:
        other = torchpt.load(placed(key, lambda x: np.asarray(x) + sign * step * way.numpy()), "cpu")
        if name.endswith((".normals", ".uvs")):  # parameters only where they are asked for
            return torch.from_numpy(np.asarray(other.description.shapes["quad"][name.rpartition(".")[2]]))
        return torch.from_numpy(np.asarray(other.built.parameters[name], np.float64))

    expected = ((moved(1.0) - moved(-1.0)) * weight).sum() / (2.0 * step)
    assert torch.isclose((gradient * way).sum(), expected, rtol=2e-4, atol=2e-6), (gradient, expected)


@pytest.mark.slow
def test_a_picture_is_differentiated_as_by_params() -> None:
    keys = (
        "camera.target", "textures.paint.data", "materials.red.reflectance", "shapes.ball.transform.1.rotate.angle",
        "shapes.ball.radius", "shapes.quad.vertices", "lights.spot.cutoff_angle", "lights.sky.data",
    )  # fmt: skip
    tensors: dict[str, Tensor] = {}

    def tensor(value: Any) -> Tensor:
        tensors[key] = wanted(value, torch.float32 if key.startswith(("materials", "textures")) else torch.float64)
        return tensors[key]

    plain = {**SCENE, **{key: SIMPLE[key] for key in ("camera", "integrator")}}
    plain["materials"] = {**SIMPLE["materials"], "wall": SCENE["materials"]["wall"]}
    plain["shapes"] = {name: {**SCENE["shapes"][name], "material": "wall"} for name in ("quad", "floor")}
    plain["shapes"]["ball"] = {**SCENE["shapes"]["ball"], "material": "red"}
    scene = copy.deepcopy(plain)
    for key in keys:
        scene = put(key, tensor, scene)
    loaded, still = torchpt.load(scene, "cpu"), torchpt.load(plain, "cpu")
    picture = torchpt.render(loaded, seed_grad=3, edges=False)
    names = [name for name, value in loaded.params.items() if value.requires_grad]
    leaves = {name: still.params[name].clone().requires_grad_() for name in names}
    by_params = torchpt.render(still, params=leaves, seed_grad=3, edges=False)
    assert picture.equal(by_params) and picture.equal(torchpt.render(still))
    by_params.square().sum().backward()
    made = [loaded.params[name] for name in names]
    expected = torch.autograd.grad(made, list(tensors.values()), [leaves[n].grad for n in names], retain_graph=True)
    picture.square().sum().backward()
    for (key, value), gradient in zip(tensors.items(), expected, strict=True):
        assert value.grad is not None and value.grad.any(), key
        assert torch.allclose(value.grad, gradient, rtol=1e-5, atol=1e-6 * float(gradient.abs().max())), key


def test_normals_and_texture_coordinates_have_the_pictures_gradients() -> None:
    """Against differences; a pixel's change is smooth, as texels are as wide as several of them."""
    paint = torch.linspace(0.1, 0.9, 12).reshape(2, 2, 3).flip(0)
    plain: dict[str, Any] = {
        **{key: SIMPLE[key] for key in ("film", "render", "camera")},
        "integrator": {"type": "direct"},
        "shapes": {"quad": {"type": "mesh", "vertices": QUAD, "faces": [[0, 1, 2], [0, 2, 3]],
                            "normals": [[0.0, 0.1, 1.0], [0.1, 0.0, 1.0], [-0.1, 0.0, 1.0], [0.0, -0.1, 1.0]],
                            "uvs": [[0.3, 0.3], [0.7, 0.3], [0.7, 0.7], [0.3, 0.7]],
                            "material": {"type": "diffuse", "reflectance": paint}}},
        "lights": {"lamp": {"type": "point", "position": [1.0, 1.0, 3.0], "intensity": 10.0}},
    }  # fmt: skip
    weight = torch.linspace(0.2, 1.4, 16 * 16 * 3).reshape(16, 16, 3)
    for key in ("shapes.quad.normals", "shapes.quad.uvs"):
        tensor = wanted(_at(key, plain))
        way = torch.linspace(1.0, -0.6, tensor.numel(), dtype=torch.float64).reshape(tensor.shape)
        scene = torchpt.load(placed(key, lambda _, t=tensor: t, plain), "cpu")
        (torchpt.render(scene, seed_grad=0, dtype=torch.float64, edges=False) * weight).sum().backward()
        found = []
        for step in (1e-3, -1e-3):
            other = tensor.detach() + step * way
            moved = placed(key, lambda _, x=other: x, plain)
            found.append((torchpt.render(torchpt.load(moved, "cpu"), dtype=torch.float64) * weight).sum())
        assert tensor.grad is not None
        assert torch.isclose((tensor.grad * way).sum(), (found[0] - found[1]) / 2e-3, rtol=2e-3), key


def _at(key: str, scene: dict[str, Any]) -> Any:
    found: Any = scene
    for part in key.split("."):
        found = found[part]
    return found


def test_a_tensor_that_fits_is_the_parameter_itself() -> None:
    color = wanted([0.7, 0.1, 0.1], torch.float32)
    scene = torchpt.load(placed("materials.red.base_color", lambda _: color), "cpu")
    assert scene.params["materials.red.base_color"] is color
    before = torchpt.render(scene).detach()
    with torch.no_grad():
        color.mul_(0.5)  # as an optimizer's step does
    assert not torchpt.render(scene).detach().equal(before)
    kept = torchpt.load(placed("materials.red.base_color", lambda _: color.detach()), "cpu")
    with torch.no_grad():
        color.zero_()
    assert kept.params["materials.red.base_color"].any() and not kept.params["materials.red.base_color"].requires_grad


@pytest.mark.slow
def test_one_tensor_in_two_places_gets_both_gradients() -> None:
    shared = wanted([0.3, 0.2, 0.1], torch.float32)
    material = {"type": "diffuse", "reflectance": shared}
    scene = copy.deepcopy(SCENE)
    scene["materials"] |= {"one": material, "two": material}
    scene["shapes"]["pipe"]["material"], scene["shapes"]["floor"]["material"] = "one", "two"
    loaded = torchpt.load(scene, "cpu")
    assert loaded.params["materials.one.reflectance"] is shared is loaded.params["materials.two.reflectance"]
    torchpt.render(loaded).sum().backward()
    assert shared.grad is not None and (shared.grad > 0).all()


def test_a_tape_is_for_one_backward_pass() -> None:
    shade = wanted(0.4)
    scene = torchpt.load({**SIMPLE, "materials": {"red": {"type": "diffuse", "reflectance": 0.5 * shade}}}, "cpu")
    first, second = (torchpt.render(scene, seed_grad=seed).sum() for seed in (1, 2))
    (first + second).backward()
    assert shade.grad is not None
    with pytest.raises(RuntimeError, match="second time"):
        torchpt.render(scene).sum().backward()


def test_a_size_that_is_a_tensor_beside_an_empty_transform() -> None:
    radius = wanted(0.5)
    shapes = {"ball": {"type": "sphere", "radius": radius, "transform": []}}
    scene = torchpt.load(
        {"camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0]}, "shapes": shapes}, "cpu"
    )
    (gradient,) = torch.autograd.grad(scene.params["shapes.ball.to_world"].sum(), radius)
    assert float(gradient) == pytest.approx(3.0)


COPIES = {"pickle": lambda scene: pickle.loads(pickle.dumps(scene)), "deepcopy": copy.deepcopy}


@pytest.mark.parametrize("how", COPIES)
def test_copies_apart_have_tensors_of_their_own(how: str) -> None:
    angle = wanted(20.0)
    scene = torchpt.load(placed("shapes.ball.transform.1.rotate.angle", lambda _: angle), "cpu")
    made, beside = COPIES[how](scene), copy.copy(scene)
    pose = made.params["shapes.ball.to_world"]
    assert pose.is_leaf and pose.requires_grad and pose.equal(scene.params["shapes.ball.to_world"])
    assert made is not scene and torchpt.render(made).equal(torchpt.render(scene))
    pose.sum().backward()
    assert pose.grad is not None and angle.grad is None
    assert beside.params["shapes.ball.to_world"] is scene.params["shapes.ball.to_world"]
    beside.params["shapes.ball.to_world"].sum().backward()
    assert angle.grad is not None and "tensor(" not in repr(made.description)


#: A key, what is put there, and what the error says.
WRONG = {
    "materials.red.base_color": (torch.tensor([0.5, 0.5, 1.5]), r"base_color: expected .*0\.\.1"),
    "materials.red.roughness": (torch.tensor(float("nan")), "roughness: expected a finite number"),
    "camera.fov": (torch.tensor([40.0, 50.0]), "camera.fov: expected an angle"),
    "camera.up": (torch.zeros(3, requires_grad=True), "camera.up: expected a direction"),
    "shapes.quad.faces": (torch.tensor([[0, 1, 9]]), r"faces.0: expected vertex indices in 0\.\.3"),
    "shapes.quad.vertices": (torch.rand(3, 4), "vertices: expected a list of"),
    "shapes.ball.transform.0.scale": (torch.zeros(3), "transform.0.scale: expected a non-zero"),
    "textures.paint.data": (torch.rand(3, 8, 8), r"paint.data: expected texels \(H, W, C\)"),
    "textures.paint": ({"type": "image", "data": torch.full((2, 2, 3), 2.0)}, r"reflectance: expected numbers in 0\.\.1"),
    "lights.sky.data": (torch.full((2, 2, 3), -1.0), "sky.data: expected numbers >= 0"),
    "lights.spot.intensity": (torch.tensor([True, False, True]), "intensity: expected"),
    "film.width": (torch.tensor(16.0, requires_grad=True), "film.width: expected numbers without gradients"),
    "lights.spot": ({"type": "constant", "radiance": [torch.rand((), requires_grad=True), 2, "a"]}, "radiance: expected"),
    "textures.squares.scale": (torch.tensor(4.0, requires_grad=True), "squares.scale: expected numbers without gradients"),
    "camera.size": (torch.tensor([8, 8]), "camera.size: expected a size only beside K"),
    "materials.mix.weight": (torch.rand(2, 2).to_sparse(), "weight: expected a dense tensor"),
    "shapes.hat.emission": (torch.rand(2, 2, 3), "emission: expected"),
}  # fmt: skip


@pytest.mark.parametrize("key", WRONG)
def test_what_is_wrong_with_a_tensor_is_one_line(key: str) -> None:
    value, words = WRONG[key]
    with pytest.raises(SceneError) as error:
        torchpt.load(placed(key, lambda _: value), "cpu")
    assert re.search(words, str(error.value)) and "\n" not in str(error.value)


def test_gradients_of_a_feature_that_is_left_out_are_refused() -> None:
    none = torch.tensor(0.0, requires_grad=True)
    with pytest.raises(SceneError, match=r"red.metallic: expected numbers without gradients"):
        torchpt.load(put("materials.red.metallic", lambda _: none, _with("materials.red", metallic=0.0)), "cpu")


def _with(key: str, **more: Any) -> dict[str, Any]:
    return placed(key, lambda block: {**block, **more})


@pytest.mark.slow
def test_texels_where_a_number_or_a_colour_stands() -> None:
    texels, rough = wanted(torch.rand(3, 2, 3).tolist(), torch.float32), wanted([[0.3, 0.6]], torch.float32)
    scene = put("materials.red.roughness", lambda _: rough, _with("materials.red", base_color=None))
    scene["materials"]["red"]["base_color"] = texels
    loaded = torchpt.load(scene, "cpu")
    assert loaded.params["materials.red.base_color"] is texels
    assert loaded.params["materials.red.roughness"].shape == (1, 2, 1)
    torchpt.render(loaded, edges=False).sum().backward()
    assert texels.grad is not None and rough.grad is not None and rough.grad.any() and texels.grad.any()
    del scene["shapes"]["quad"]["uvs"]
    scene["shapes"]["quad"]["material"] = "red"
    with pytest.raises(SceneError, match=r"red.base_color: expected uvs .* for shapes.quad"):
        torchpt.load(scene, "cpu")


def test_eight_bit_texels_are_those_of_a_file(tmp_path: Any) -> None:
    values = (torch.rand(4, 5, 3) * 255).to(torch.uint8)
    torchpt.write_image(str(tmp_path / "paint.exr"), values.float() / 255)
    image = torchpt.load(placed("textures.paint.data", lambda _: values), "cpu")
    linear = torchpt.load(
        placed("textures.paint", lambda _: {"type": "image", "path": str(tmp_path / "paint.exr")}), "cpu"
    ).params["textures.paint"]
    decoded = torch.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    assert torch.allclose(image.params["textures.paint"], decoded, atol=1e-6)
    stored = placed("textures.paint", lambda _: {"type": "image", "data": values, "colorspace": "linear"})
    assert torch.allclose(torchpt.load(stored, "cpu").params["textures.paint"], linear)


def test_opencv_matrices_keep_their_gradients() -> None:
    """A principal point in the middle can be moved from there."""
    matrix = wanted([[30.0, 0, 8], [0, 30, 8], [0, 0, 1]])
    turn, move = wanted(np.diag([1.0, -1, -1]).tolist()), wanted([0.1, 0.2, 4.0])
    scene = {**SCENE, "camera": {"K": matrix, "R": turn, "t": move}}
    loaded = torchpt.load(scene, "cpu")
    found = loaded.pinhole(dtype=torch.float64)
    for ours, theirs in zip(found, (matrix, turn, move), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-5)
    gradients = torch.autograd.grad(found.K[:2].sum() + found.t.sum(), (matrix, move))
    assert torch.allclose(gradients[0][[0, 0, 1, 1], [0, 2, 1, 2]], torch.ones(4, dtype=torch.float64), atol=1e-5)
    assert torch.allclose(gradients[1], torch.ones(3, dtype=torch.float64), atol=1e-5)


@pytest.mark.gpu
@pytest.mark.parametrize(("at", "scene_on"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_tensors_may_lie_on_another_device(at: str, scene_on: str) -> None:
    """Gradients go back to where they came from."""
    given = [torch.tensor(value, device=at, requires_grad=True) for value in ([0.7, 0.1, 0.1], 0.7)]
    scene = put("materials.red.reflectance", lambda _: given[0], copy.deepcopy(SIMPLE))
    loaded = torchpt.load(put("shapes.ball.radius", lambda _: given[1], scene), scene_on)
    assert all(value.device.type == scene_on for value in loaded.params.values())
    torchpt.render(loaded).sum().backward()
    assert all(value.grad is not None and value.grad.device.type == at and value.grad.any() for value in given)
