"""What every kind of camera must do, of each in the table and each row of ``optics.CAMERAS``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import pytest
import torch
from optics import CAMERAS, POSE, numbers
from outside import numbers_outside, values_outside
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.physics.cameras import KINDS, Camera
from torchpt.scene import Scene
from torchpt.scene.formats.cameras import read_camera
from torchpt.scene.formats.description import settings
from torchpt.spec import Moves, parameters_of

SIZE = {"width": 8, "height": 6}
PLACES = ("origin", "target", "up", "to_world", "R", "t")


def loaded(name: str) -> Scene:
    return torchpt.load({"camera": {**POSE, **CAMERAS[name]}, "film": SIZE}, "cpu")


def exact(scene: Scene) -> dict[str, Tensor]:
    """Its parameters in float64, as written."""
    return {name: torch.as_tensor(value) for name, value in scene.built.parameters.items()}


def camera_of(scene: Scene, params: dict[str, Tensor]) -> Camera:
    return scene.camera(settings(scene.description).film, params, torch.float64)


def rays(camera: Camera, x: Tensor, y: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    o, d = camera.rays(x, y, u if camera.lens else None)
    return o.expand_as(d), d


def rows_of(kind: str) -> list[str]:
    return [name for name, keys in CAMERAS.items() if keys["type"] == kind]


def test_every_kind_and_every_tensor_of_it_has_a_row():
    for kind in KINDS:
        differentiable = {key for key, spec in parameters_of(KINDS[kind]).items() if spec.differentiable} - {"to_world"}
        assert differentiable <= {key for name in rows_of(kind) for key in CAMERAS[name]}
        assert differentiable <= {field.name for field in fields(KINDS[kind])}
        assert set(KINDS[kind].reaches) <= differentiable


@pytest.mark.parametrize("kind", list(KINDS))
def test_what_is_declared(kind):
    for key, spec in parameters_of(KINDS[kind]).items():
        assert spec.doc, key
        if spec.differentiable:
            assert spec.moves is Moves.SURFACES, key  # whatever it is, rays go elsewhere


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_are_unit_wherever_they_start(name):
    scene = loaded(name)
    camera = camera_of(scene, exact(scene))
    place = numbers(2, 4096) * camera.film[:, None]
    corners = torch.tensor([[0.0, 8, 0, 8], [0, 0, 6, 6]], dtype=torch.float64)
    x, y = torch.cat((place, corners), 1)
    o, d = rays(camera, x, y, numbers(2, len(x), 1))
    assert o.shape == d.shape == (3, len(x))
    assert torch.isfinite(o).all()
    assert torch.allclose(d.norm(dim=0), torch.ones_like(x), atol=1e-14)
    single = camera_of(scene, {key: value.float() for key, value in exact(scene).items()})
    again = type(camera).on(single.to_world.float(), camera.resolution, {
        field.name: value.float() if isinstance(value := getattr(camera, field.name), Tensor) else value
        for field in fields(camera)
    })  # fmt: skip
    o32, d32 = rays(again, x.float(), y.float(), numbers(2, len(x), 1).float())
    assert o32.dtype == d32.dtype == torch.float32
    assert torch.allclose(d32.double(), d, atol=1e-5) and torch.allclose(o32.double(), o, atol=1e-5)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_pixels_footprint_is_that_of_its_rays(name):
    scene = loaded(name)
    camera = camera_of(scene, exact(scene))
    *e, w, spread = camera.pixel().tolist()
    toward = torch.tensor(e, dtype=torch.float64)
    matrix = camera.intrinsics()
    axis = 0.5 * camera.film if matrix is None else matrix[:2, 2]  # the ray that goes where the camera looks
    step, middle = 1e-4, torch.full((2, 5), 0.5, dtype=torch.float64)
    x = axis[0] + step * torch.tensor([0.0, 1, -1, 0, 0], dtype=torch.float64)
    y = axis[1] + step * torch.tensor([0.0, 0, 0, 1, -1], dtype=torch.float64)
    o, d = rays(camera, x, y, middle)
    for distance in (0.7, 2.3):
        p = o + distance * d
        across = torch.linalg.cross(p[:, 1] - p[:, 2], p[:, 3] - p[:, 4]) / (2 * step) ** 2
        way = toward - w * p[:, 0]
        assert torch.allclose(way / way.norm(), -d[:, 0], atol=1e-12)
        assert float((across @ d[:, 0]).abs().sqrt()) == pytest.approx(spread * float(way.norm()), rel=1e-6)


@pytest.mark.parametrize("name", CAMERAS)
def test_gradients_of_rays_and_footprints_are_finite_differences(name):
    scene = loaded(name)
    params = exact(scene)
    names = [key for key in params if key.startswith("camera.")]
    x, y = numbers(2, 7, 5) * torch.tensor([[8.0], [6.0]], dtype=torch.float64)
    u = numbers(2, 7, 6)

    def seen(*values: Tensor) -> tuple[Tensor, ...]:
        camera = camera_of(scene, dict(zip(names, values, strict=True)))
        return *rays(camera, x, y, u), camera.pixel()

    leaves = [params[key].clone().requires_grad_() for key in names]
    assert torch.autograd.gradcheck(seen, leaves, eps=1e-6, atol=1e-7, rtol=1e-5)
    made = seen(*leaves)
    weights = [
        numbers(value.shape[0], value.shape[1], 9) if value.dim() == 2 else torch.ones_like(value) for value in made
    ]
    total = torch.stack([(weight * value).sum() for weight, value in zip(weights, made, strict=True)]).sum()
    for key, gradient in zip(names, torch.autograd.grad(total, leaves), strict=True):
        assert float(gradient.abs().max()) > 1e-4, key  # none is left out


def cases() -> list[Any]:
    return [
        pytest.param(name, key, id=f"{name}-{key}")
        for name in ("shifted", *(rows_of(kind)[-1] for kind in KINDS if kind != "perspective"))
        for key in parameters_of(KINDS[CAMERAS[name]["type"]])
    ]


@pytest.mark.parametrize(("name", "key"), cases())
def test_no_parameter_may_be_out_of_range(name, key):
    spec, keys = parameters_of(KINDS[CAMERAS[name]["type"]])[key], {**POSE, **CAMERAS[name]}
    for value in values_outside(spec):
        with pytest.raises(SceneError) as caught:
            read_camera({**keys, key: value}, {}, None)
        assert caught.value.key.startswith(f"camera.{key}"), value
        assert "\n" not in str(caught.value)
    if spec.differentiable and key not in PLACES:
        scene = loaded(name)
        for value in numbers_outside(spec):
            with pytest.raises(SceneError) as caught:
                torchpt.render(scene, params={f"camera.{key}": torch.tensor(value)}, spp=1)
            assert caught.value.key == f"params.camera.{key}"


@pytest.mark.parametrize("kind", list(KINDS))
def test_poses_out_of_range(kind):
    scene = loaded(rows_of(kind)[0])
    for matrix in (torch.zeros(4, 4), torch.full((4, 4), float("nan")), torch.eye(3)):
        with pytest.raises(SceneError, match=r"params\.camera\.to_world"):
            torchpt.render(scene, params={"camera.to_world": matrix}, spp=1)


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
@pytest.mark.parametrize("kind", list(KINDS))
def test_poses_are_held_to_what_files_are(kind):
    scene = loaded(rows_of(kind)[0])
    pose = scene.params["camera.to_world"]
    sheared, larger = pose.clone(), pose.clone()
    sheared[:3, 0] += 0.1 * pose[:3, 1]
    larger[:3, :3] *= 1.01
    for matrix in (sheared, larger):
        ways: list[Callable[[], Any]] = [
            lambda given=matrix: torchpt.render(scene, params={"camera.to_world": given}, spp=1),
            lambda given=matrix: torchpt.render(
                scene, params={"camera.to_world": given.clone().requires_grad_()}, spp=1
            ),
            lambda given=matrix: torchpt.render_batch(scene, [given], spp=1),
            lambda given=matrix: scene.pinhole({"camera.to_world": given}),
            lambda given=matrix: scene.seen_by({**CAMERAS[rows_of(kind)[0]], "to_world": given}),
        ]
        for way in ways:
            with pytest.raises(SceneError, match="expected a pose without scale or shear") as caught:
                way()
            assert "\n" not in str(caught.value)
        with pytest.raises(SceneError, match="without scale or shear"):
            other = loaded(rows_of(kind)[0])
            other.params["camera.to_world"].copy_(matrix)
            torchpt.render(other, spp=1)
    mirrored = pose @ torch.diag(torch.tensor([-1.0, 1, 1, 1]))
    near = pose + 1e-4 * torch.eye(4)[:, [1, 2, 0, 3]] * torch.tensor([1.0, 1, 1, 0])
    for matrix in (mirrored, near):  # as load does
        torchpt.render(scene, params={"camera.to_world": matrix}, spp=1)
