"""The same picture on CUDA as on the CPU. Run with ``pytest -m gpu`` where there is a device."""

from __future__ import annotations

import pytest
import torch

import torchpt

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
FILM = {"width": 96, "height": 96, "filter": "box"}


@pytest.fixture(scope="module")
def pictures() -> dict[str, torch.Tensor]:
    wish = {"spp": 16, "seed": 3, "film": FILM, "compile": "off"}
    return {device: torchpt.render(torchpt.load("cornell_box", device), **wish).cpu() for device in ("cpu", "cuda")}


def test_only_rounding_differs_between_devices(pictures):
    # The same random numbers: but for paths that rounding sends elsewhere, the pictures are equal.
    close = torch.isclose(pictures["cpu"], pictures["cuda"], rtol=1e-3, atol=1e-4).all(-1)
    assert close.float().mean() > 0.9
    assert abs(float(pictures["cpu"].mean() / pictures["cuda"].mean()) - 1) < 2e-3


def test_gradients_agree_with_the_cpu():
    grads = []
    for device in ("cpu", "cuda"):
        scene = torchpt.load("cornell_box", device)
        rgb = scene.params["materials.red.reflectance"].clone().requires_grad_()
        image = torchpt.render(scene, params={"materials.red.reflectance": rgb}, spp=16, film=FILM, compile="off")
        image.mean().backward()
        assert rgb.grad is not None
        grads.append(rgb.grad.cpu())
    assert torch.allclose(*grads, rtol=2e-2)


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
@pytest.mark.parametrize("name", ["materials.red.reflectance", "shapes.floor.vertices"])
def test_gradients_have_the_same_bits_in_each_run(name):
    scene, grads = torchpt.load("cornell_box", "cuda"), []
    for _ in range(3):
        leaf = scene.params[name].clone().requires_grad_()
        torchpt.render(scene, params={name: leaf}, spp=16, film=FILM, edges=False).mean().backward()
        assert leaf.grad is not None
        grads.append(leaf.grad.cpu())
    assert torch.equal(grads[0], grads[1]) and torch.equal(grads[0], grads[2])


def test_mesh_with_smooth_normals():
    wish = {"spp": 8, "film": FILM, "compile": "off"}
    cpu, cuda = (torchpt.render(torchpt.load("cornell_bunny", device), **wish).cpu() for device in ("cpu", "cuda"))
    assert torch.isclose(cpu, cuda, rtol=1e-2, atol=1e-3).all(-1).float().mean() > 0.9
    assert abs(float(cpu.mean() / cuda.mean()) - 1) < 5e-3


def test_many_lights_by_the_tree():
    wish = {"spp": 8, "film": FILM, "compile": "off"}
    cpu, cuda = (torchpt.render(torchpt.load("many_lights", device), **wish).cpu() for device in ("cpu", "cuda"))
    assert torch.isclose(cpu, cuda, rtol=1e-2, atol=1e-3).all(-1).float().mean() > 0.8
    assert abs(float(cpu.mean() / cuda.mean()) - 1) < 5e-3


@pytest.mark.parametrize("integrator", [{"type": "path"}, {"type": "path", "clamp": 0.5}], ids=str)
def test_cameras_of_a_batch(integrator):
    """To the bit what each is alone: no sum of a forward render is without an order."""
    scene = torchpt.load("cornell_box", "cuda")
    poses = scene.params["camera.to_world"].repeat(4, 1, 1)
    poses[:, 0, 3] += 0.05 * torch.arange(4, device="cuda")
    wish = {"spp": 4, "film": {**FILM, "aovs": ["depth"]}, "compile": "off", "integrator": integrator, "full": True}
    batch = torchpt.render_batch(scene, poses, **wish)
    for c, pose in enumerate(poses):
        alone = torchpt.render(scene, params={"camera.to_world": pose}, **wish)
        own = batch[0, c]
        assert torch.equal(own.image, alone.image) and torch.equal(own.layers["depth"], alone.layers["depth"])
        assert (own.rays, own.spp, own.complete) == (alone.rays, alone.spp, True)


@pytest.mark.parametrize("name", ["cornell_spheres", "instances", "many_lights", "shapes_and_maps"])
def test_scenes_of_a_batch(name):
    """Likewise where shapes move."""
    scene = torchpt.load(name, "cuda")
    key = next(key for key in scene.params if key.endswith(".to_world") and key.startswith("shapes."))
    poses = scene.params[key].repeat(3, 1, 1)
    poses[:, 1, 3] += 0.01 * torch.arange(3, device="cuda")
    wish = {"spp": 4, "film": {**FILM, "aovs": ["depth"]}, "compile": "off", "full": True}
    batch = torchpt.render_batch(scene, params={key: poses}, **wish)
    for s, pose in enumerate(poses):
        alone, own = torchpt.render(scene, params={key: pose}, **wish), batch[s, 0]
        assert torch.equal(own.image, alone.image) and torch.equal(own.layers["depth"], alone.layers["depth"])
        assert own.rays == alone.rays
