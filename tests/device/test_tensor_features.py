"""All that a render can be asked for, by tensors on a simulated CUDA device: the CPU's bits, or an error of one line."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from scene_makers import room
from simulated_cuda import simulated_cuda, without_compiled_functions
from torch import Tensor
from torch.utils.data import DataLoader

import torchpt
from torchpt.rendering.one_path import one_path
from torchpt.scene.formats.description import settings

FILM = {"width": 6, "height": 5, "filter": "box"}
#: Large enough for blocks of pilots.
LARGE = {"width": 16, "height": 12}
WALL = "materials.wall.reflectance"
#: Light on all surfaces, without which the error of a picture is not known.
SKY = {"sky": {"type": "constant", "radiance": 0.3}}

#: Called with a device and an empty folder.
Feature = Callable[[str, Path], list[Tensor]]


def options(device: str, **changes: Any) -> dict[str, Any]:
    """Return options of a render by tensors, the search among them."""
    return {"spp": 2, "film": FILM, "compile": "off", "accel": "torch", **changes}


def picture(**changes: Any) -> Feature:
    """Return a feature: the picture with these options, its layers, and the estimate of its error."""

    def call(device: str, folder: Path) -> list[Tensor]:
        scene = torchpt.load({**room(1), "lights": SKY}, device)
        found = torchpt.render(scene, full=True, **options(device, **changes))
        assert found.relmse_unknown == ""
        error = [] if found.relmse is None else [torch.tensor(found.relmse)]
        return [found.image, *found.layers.values(), *error]

    return call


def gradient(name: str, **changes: Any) -> Feature:
    """Return a feature: the picture, and its gradient by a parameter."""

    def call(device: str, folder: Path) -> list[Tensor]:
        scene = torchpt.load(room(1), device)
        value = scene.params[name].clone().requires_grad_()
        image = torchpt.render(scene, params={name: value}, **options(device, **changes))
        weight = torch.linspace(0, 1, image.numel(), device=device).reshape(image.shape)
        return [image.detach(), *torch.autograd.grad((image * weight).sum(), value)]

    return call


def rays(device: str) -> tuple[Tensor, Tensor]:
    """Return the origin and directions of twelve rays into the room."""
    aside = torch.linspace(-0.3, 0.3, 24).reshape(12, 2)
    return torch.tensor([0.0, 0.0, 4.0], device=device), torch.cat((aside, -torch.ones(12, 1)), 1).to(device)


def traced(device: str, folder: Path) -> list[Tensor]:
    o, d = (x.requires_grad_() for x in rays(device))
    light = torchpt.trace(torchpt.load(room(1), device), o, d, spp=2, compile="off", accel="torch")
    return [light.detach(), *torch.autograd.grad(light.sum(), (o, d))]


def first_path(device: str, folder: Path) -> list[Tensor]:
    scene = torchpt.load(room(1), device)
    wish = {"film": FILM, "render": {"spp": 2, "compile": "off", "accel": "torch"}}
    return [torch.tensor(one_path(scene, settings(scene.description, wish), (2, 2), 0).radiance)]


def batch_of_cameras(device: str, folder: Path) -> list[Tensor]:
    scene = torchpt.load(room(1), device)
    poses = scene.params["camera.to_world"].repeat(2, 1, 1)
    poses[1, 0, 3] += 0.1
    found = torchpt.render_batch(scene, poses, full=True, **options(device, film={**FILM, "aovs": ["depth"]}))
    return [x for k in range(2) for x in (found[0, k].image, found[0, k].layers["depth"])]


def batch_of_scenes(device: str, folder: Path) -> list[Tensor]:
    scene = torchpt.load(room(1), device)
    colours = torch.stack((scene.params[WALL], 0.5 * scene.params[WALL])).requires_grad_()
    images = torchpt.render_batch(scene, params={WALL: colours}, **options(device))
    return [images.detach(), *torch.autograd.grad(images.sum(), colours)]


def data_set(device: str, folder: Path) -> list[Tensor]:
    given = {**options(device, spp=1), "layers": ["depth"], "device": device}
    indexed = next(iter(DataLoader(torchpt.data.RenderDataset(room, 2, **given), batch_size=2)))
    assert indexed["image"].device.type == device
    stream = itertools.islice(torchpt.data.RenderStream(room, **given), 2)
    return [*indexed.values(), *(x for item in stream for x in item.values())]


def trained(device: str, folder: Path) -> list[Tensor]:
    names = [WALL, "shapes.ball.to_world", "shapes.lamp.emission"]
    module = torchpt.nn.Renderer(torchpt.load(room(1), device), names, edges=False, **options(device))
    optimizer, images = torch.optim.Adam(module.parameters(), lr=0.01), []
    for _ in range(2):
        optimizer.zero_grad()
        images.append(module())
        images[-1].mean().backward()
        optimizer.step()
    module.write()
    return [x.detach() for x in (*images, *(module.scene.params[name] for name in names))]


def module_moved(device: str, folder: Path) -> list[Tensor]:
    module = torchpt.nn.Renderer(torchpt.load(room(1), "cpu"), WALL, **options(device)).to(device)
    image = module()
    assert module.scene.device.type == image.device.type == device
    return [image.detach(), *torch.autograd.grad(image.mean(), list(module.parameters()))]


def resumed(**changes: Any) -> Feature:
    """Return a feature: a picture that goes on from its checkpoint."""

    def call(device: str, folder: Path) -> list[Tensor]:
        wish = {"checkpoint": str(folder / f"{device}.npz"), **changes}
        scene = torchpt.load({**room(1), "lights": SKY}, device)
        torchpt.render(scene, **options(device, spp=4, **wish))
        return [torchpt.render(scene, resume=True, **options(device, spp=8, **wish))]

    return call


def files(device: str, folder: Path) -> list[Tensor]:
    found = torchpt.render(
        torchpt.load(room(1), device), full=True, **options(device, film={**FILM, "aovs": ["depth"]})
    )
    torchpt.write_image(folder / f"{device}.exr", found.image, layers=found.layers)
    torchpt.write_image(folder / f"{device}.png", found.image)
    return [torchpt.read_image(folder / f"{device}.exr"), torchpt.read_image(folder / f"{device}.png")]


def moved(device: str, folder: Path) -> list[Tensor]:
    scene = torchpt.load(room(1), "cpu").to(device)
    camera = {"type": "perspective", "origin": [1, 0, 4], "target": [0, 0, 0], "fov": 40}
    return [torchpt.render(scene.seen_by(camera), **options(device))]


def tensor_in_a_dict(device: str, folder: Path) -> list[Tensor]:
    described = room(1)
    colour = torch.tensor([0.2, 0.3, 0.4], device=device, requires_grad=True)
    described["materials"]["wall"]["reflectance"] = colour
    image = torchpt.render(torchpt.load(described, device), **options(device))
    return [image.detach(), *torch.autograd.grad(image.mean(), colour)]


def transformed(device: str, folder: Path) -> list[Tensor]:
    scene = torchpt.load(room(1), device)

    def render(colour: Tensor) -> Tensor:
        return torchpt.render(scene, params={WALL: colour}, **options(device))

    colour = scene.params[WALL]
    images = torch.func.vmap(render)(torch.stack((colour, 0.5 * colour)))
    return [images, torch.func.grad(lambda x: render(x).mean())(colour)]


AOVS = ["albedo", "normal", "depth", "position", "uv", "object_id", "alpha", "variance", "samples"]
FEATURES: dict[str, Feature] = {
    "layers": picture(film={**FILM, "aovs": AOVS}),
    "integrator aov": picture(film={**FILM, "aovs": AOVS[:3]}, integrator="aov"),
    "integrator direct": picture(integrator="direct"),
    "clamp": picture(integrator={"clamp": 0.5}),
    "float64": picture(dtype=torch.float64),
    **{f"sampler {name}": picture(sampler=name) for name in ("independent", "stratified", "hammersley", "zsobol")},
    **{f"filter {name}": picture(film={**FILM, "filter": name}) for name in ("gaussian", "tent", "mitchell")},
    "denoiser": picture(film={**FILM, "denoise": True}),
    "pilots": picture(film=LARGE, spp=4, pilots=True),
    "adaptive sampling": picture(
        film={**LARGE, "aovs": ["samples"]}, spp=8, sampler={"type": "sobol", "adaptive": True}
    ),
    "target error": picture(film=LARGE, spp=32, target_error=0.1),
    "time limit": picture(spp=4, time_limit=1000.0),
    "checkpoint": resumed(),
    "checkpoint of adaptive sampling": resumed(film=LARGE, sampler={"type": "sobol", "adaptive": True}),
    "files": files,
    "scene.to": moved,
    "trace": traced,
    "one path": first_path,
    "render_batch of cameras": batch_of_cameras,
    "render_batch of scenes": batch_of_scenes,
    "data sets": data_set,
    "nn.Renderer": trained,
    "nn.Renderer.to": module_moved,
    "tensors in dicts": tensor_in_a_dict,
    "torch.func": transformed,
    **{
        f"gradient of {name}": gradient(name)
        for name in (WALL, "shapes.lamp.emission", "camera.fov", "camera.to_world")
    },
    **{f"gradient of {name}": gradient(name) for name in ("shapes.back.to_world", "shapes.ball.to_world")},
    "gradient without edges": gradient("shapes.ball.to_world", edges=False),
    "gradient in float64": gradient(WALL, dtype=torch.float64),
}
#: Features that are tried in `make test`.
QUICK = ("integrator aov", "trace", "render_batch of cameras")


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in FEATURES]
)
def test_feature(name: str, tmp_path: Path):
    with without_compiled_functions():
        expected = FEATURES[name]("cpu", tmp_path)
    with simulated_cuda():
        found = [x.cpu() for x in FEATURES[name]("cuda", tmp_path)]
    assert len(found) == len(expected) > 0
    assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(found, expected, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["ibl_row", "noise"])
def test_split_sum(scene: str):
    wish: dict[str, Any] = {"spp": 1, "film": FILM, "integrator": "ibl", "compile": "off"}
    with without_compiled_functions():
        expected = torchpt.render(torchpt.load(scene, "cpu"), accel="torch", **wish)
    with simulated_cuda():
        assert torchpt.render(torchpt.load(scene, "cuda"), **wish).cpu().equal(expected)


# ---- What is refused, in one line


def test_a_checkpoint_of_the_cpu_is_refused(tmp_path: Path):
    file = str(tmp_path / "state.npz")
    torchpt.render(torchpt.load(room(1), "cpu"), checkpoint=file, **options("cpu"))
    with simulated_cuda(), pytest.raises(torchpt.AssetError, match=r'\(device: "cpu" there, "cuda" here\)'):
        torchpt.render(torchpt.load(room(1), "cuda"), checkpoint=file, resume=True, **options("cuda"))


@pytest.mark.parametrize("accel", ["numba", "brute"])
def test_searches_of_the_cpu_are_refused(accel: str):
    with simulated_cuda(), pytest.raises(torchpt.SceneError, match="expected torch \\(this scene is on cuda\\), got"):
        torchpt.render(torchpt.load(room(1), "cuda"), **options("cuda", accel=accel))


def test_tensors_of_the_cpu_are_refused():
    with simulated_cuda():
        scene = torchpt.load(room(1), "cuda")
        with pytest.raises(torchpt.SceneError, match="o: expected a tensor on the scene's device cuda:0, got 'cpu'"):
            torchpt.trace(scene, *rays("cpu"))


def test_a_forked_process_is_refused(monkeypatch: pytest.MonkeyPatch):
    with simulated_cuda():
        monkeypatch.setattr(torch.cuda, "_is_in_bad_fork", lambda: True)
        with pytest.raises(torchpt.RenderError) as caught:
            torchpt.load(room(1), "cuda")
    assert str(caught.value) == (
        "render.device: cuda is not available, as this process was forked from one that uses CUDA "
        "(multiprocessing_context='spawn' starts workers that may use it); cpu and auto are"
    )
