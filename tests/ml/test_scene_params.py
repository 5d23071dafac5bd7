"""Numbers of a scene that no file could hold are refused, however they came there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import torchpt
from torchpt.core.errors import SceneError
from torchpt.nn.parametrizations import AxisAnglePose

ALBEDO, BALL, FOV = "materials.paint.reflectance", "shapes.ball.to_world", "camera.fov"


def scene(colour: Any = 0.5) -> torchpt.Scene:
    return torchpt.load(
        {
            "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40.0},
            "film": {"width": 6, "height": 6},
            "materials": {"paint": {"type": "diffuse", "reflectance": colour}},
            "shapes": {"ball": {"type": "sphere", "material": "paint"}},
            "lights": {"sky": {"type": "constant"}},
        },
        "cpu",
    )


def put(name: str, value: Any) -> Callable[[torchpt.Scene], None]:
    return lambda own: own.params.__setitem__(name, value)


@pytest.mark.parametrize("rendered", [False, True])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda own: own.params[FOV].fill_(-3.0), "params.camera.fov: expected"),
        (lambda own: own.params[ALBEDO].fill_(torch.nan), "params.materials.paint.reflectance: expected"),
        (
            lambda own: own.params[BALL][:3, :3].zero_(),
            "params.shapes.ball.to_world: expected a matrix that can be inverted",
        ),
        (lambda own: own.params["camera.to_world"][3].fill_(2.0), "last row is 0 0 0 1"),
        (put(ALBEDO, torch.tensor([-3.0, 2.0, 2.0])), "params.materials.paint.reflectance: expected"),
        (put(ALBEDO, torch.rand(2)), r"expected a floating tensor of shape \(3,\)"),
        (put(ALBEDO, 0.5), r"expected a floating tensor of shape \(3,\), got 0.5"),
        (
            put(ALBEDO, torch.rand(3).to_sparse()),
            r"expected a dense floating tensor of shape \(3,\).*sparse_coo tensor",
        ),
        (put(ALBEDO, None), r"expected a floating tensor of shape \(3,\)"),
        (put("foo", torch.rand(3)), "params.foo: expected the names that the scene was loaded with"),
        (lambda own: own.params.pop(ALBEDO), "params.materials.paint.reflectance: .* got 'nothing'"),
    ],
)
def test_refused(change: Callable[[torchpt.Scene], Any], says: str, rendered: bool) -> None:
    own = scene()
    if rendered:
        torchpt.render(own, spp=1)
    change(own)
    for grad in (torch.enable_grad(), torch.no_grad()):
        with grad, pytest.raises(SceneError, match=says):
            torchpt.render(own, spp=1)
    with pytest.raises(SceneError, match=says):
        torchpt.render_batch(own, spp=1)


def test_a_leaf_that_left_its_range_is_refused_without_gradients_too() -> None:
    leaf = torch.full((3,), 0.5, requires_grad=True)
    own = scene(leaf)
    with torch.no_grad():
        torchpt.render(own, spp=1)
        leaf.fill_(1.5)
        with pytest.raises(SceneError, match="reflectance"):
            torchpt.render(own, spp=1)


def test_a_renderer_under_autocast_has_the_same_poses() -> None:
    renderer = torchpt.nn.Renderer(scene(), BALL, spp=2)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(0.03)
    plain = renderer(seed=1)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(renderer(seed=1), plain)


def test_many_turns_are_a_rotation() -> None:
    found = AxisAnglePose(torch.eye(4), 8.0)
    x = torch.cat((3000.0 * torch.randn(3, generator=torch.Generator().manual_seed(1)), torch.tensor([1.0, 0.0, -0.5])))
    pose = found(x)
    assert torch.allclose(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3), atol=1e-5)
    assert pose[:3, 3].tolist() == [8.0, 0.0, -4.0]


def rendered(**wishes: Any) -> torch.Tensor:
    return torchpt.render(scene(), spp=2, **wishes)


@pytest.mark.parametrize(
    ("name", "written", "tensor"),
    [
        (ALBEDO, 0.25, torch.full((3,), 0.25)),
        (ALBEDO, torch.tensor(0.25), torch.full((3,), 0.25)),
        (ALBEDO, [0, 0.5, 1], torch.tensor([0.0, 0.5, 1.0])),
        (ALBEDO, (torch.tensor(0.25), 0.5, 1), torch.tensor([0.25, 0.5, 1.0])),
        (ALBEDO, np.array([0.25, 0.5, 1.0]), torch.tensor([0.25, 0.5, 1.0])),
        (ALBEDO, np.float64(0.25), torch.full((3,), 0.25)),
        (FOV, 30, torch.tensor(30.0)),
        (
            BALL,
            [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            torch.eye(4).index_put((torch.tensor(0), torch.tensor(3)), torch.tensor(0.5)),
        ),
        ("lights.sky.radiance", 2, torch.full((3,), 2.0)),
    ],
)
def test_params_are_written_as_in_scene_files(name: str, written: Any, tensor: torch.Tensor) -> None:
    expected = rendered(params={name: tensor})
    assert torch.equal(rendered(params={name: written}), expected) and not torch.equal(rendered(), expected)
    assert torch.equal(torchpt.render_batch(scene(), params=[{name: written}], spp=2)[0, 0], expected)
    assert torch.equal(torchpt.nn.Renderer(scene(), spp=2)({name: written}, seed=0), expected)


def test_texels_may_be_an_array() -> None:
    texels = np.linspace(0.1, 0.9, 4 * 4 * 3).reshape(4, 4, 3)
    tensor = torch.from_numpy(texels).float()
    assert torch.equal(rendered(params={ALBEDO: texels}), rendered(params={ALBEDO: tensor}))


def test_a_medium_stands_for_its_index() -> None:
    own = torchpt.load("material_row", "cpu")
    name = next(name for name in own.params if name.endswith(".int_ior"))
    pictures = [torchpt.render(own, spp=1, film=(12, 8), params={name: value}) for value in ("water", 1.333)]
    assert torch.equal(*pictures)


def test_gradients_of_a_broadcast_colour_are_the_sum_of_its_channels() -> None:
    own, grey, rgb = scene(), torch.tensor(0.5, requires_grad=True), torch.full((3,), 0.5, requires_grad=True)
    for value in (grey, rgb):
        torchpt.render(own, spp=4, params={ALBEDO: value}).square().mean().backward()
    assert grey.grad is not None and rgb.grad is not None and float(grey.grad) > 0
    torch.testing.assert_close(grey.grad, rgb.grad.sum())
    mixed = torch.tensor(0.5, requires_grad=True)  # in a list
    torchpt.render(own, spp=4, params={ALBEDO: [mixed, 0.5, 0.5]}).square().mean().backward()
    torch.testing.assert_close(mixed.grad, rgb.grad[0])
    found = torch.func.grad(lambda x: torchpt.render(own, spp=4, params={ALBEDO: x}).square().mean())(grey.detach())
    torch.testing.assert_close(found, grey.grad)


def test_broadcast_in_a_batch_and_along_rays() -> None:
    own = scene()
    greys = torch.tensor([0.2, 0.7], requires_grad=True)
    batch = torchpt.render_batch([own, own], params={ALBEDO: greys}, spp=2)
    for k, grey in enumerate((0.2, 0.7)):
        assert torch.equal(batch[k, 0], rendered(params={ALBEDO: grey}))
    batch.sum().backward()
    assert greys.grad is not None and bool((greys.grad > 0).all())
    fovs = torchpt.render_batch(own, params={FOV: [20, 30]}, spp=2)
    assert torch.equal(fovs[1, 0], rendered(params={FOV: 30.0}))
    o, d = torch.tensor([0.0, 0.0, 4.0]), torch.tensor([0.1, 0.0, -1.0])
    seen = [torchpt.trace(own, o, d, params={ALBEDO: value}) for value in (0.25, torch.full((3,), 0.25))]
    assert torch.equal(*seen)


def test_a_renderer_is_assigned_numbers() -> None:
    renderer = torchpt.nn.Renderer(scene(), [ALBEDO, FOV], spp=1)
    renderer.assign({ALBEDO: 0.25, FOV: 30})
    torch.testing.assert_close(renderer.values()[ALBEDO], torch.full((3,), 0.25))
    torch.testing.assert_close(renderer.values()[FOV], torch.tensor(30.0))


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        (ALBEDO, [0.1, 0.2], r"params.materials.paint.reflectance: expected a floating tensor of shape \(3,\)"),
        (ALBEDO, True, r"reflectance: expected a floating tensor of shape \(3,\).*got True"),
        (ALBEDO, "red", r"reflectance: expected a floating tensor of shape \(3,\).*got 'red'"),
        (ALBEDO, [0.1, "x", 0.2], "reflectance: expected a floating tensor"),
        (ALBEDO, torch.tensor(1), "reflectance: expected a floating tensor"),
        (
            ALBEDO,
            1.5,
            r"reflectance: expected \[r, g, b\] or one number, each finite and in 0..1 \(clamp before rendering\)",
        ),
        (FOV, [30.0], r"params.camera.fov: expected a floating tensor of shape \(\)"),
        (FOV, -3, "params.camera.fov: expected an angle"),
        (BALL, 1.0, r"to_world: expected a floating tensor of shape \(4, 4\)"),
    ],
)
def test_numbers_and_lists_that_are_refused(name: str, value: Any, says: str) -> None:
    with pytest.raises(SceneError, match=says) as error:
        rendered(params={name: value})
    assert "\n" not in str(error.value)
