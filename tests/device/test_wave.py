"""Whole pictures by the engine of a device, on a simulated one: the bits of the CPU's, in any order of lanes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from mirrored import Mirrored
from scene_makers import lit_floor, turned
from torch import Tensor

import torchpt
from torchpt.core.errors import RenderError
from torchpt.engines.kernels import device_forward as forward_module
from torchpt.engines.kernels.device import DeviceCalls, DeviceMemory
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs import Parameters
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.rendering.api import Progress, Rendering, render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

SCENES = (
    "cornell_box",
    "veach_mis",
    "shapes_and_maps",
    "many_lights",
    "cornell_spheres",
    "ibl_row",
    "thin_lens",
    "cornell_specular",
    "cornell_bunny",
    "instances",
    "env_teapot",
    "terrace",
    "cornell_transmissive",
)
FILM = {"width": 32, "height": 24, "filter": "mitchell", "aovs": ["albedo", "normal", "depth", "variance"]}


def rendered(scene: Scene, on_progress: Any = None, **keys: Any) -> Rendering:
    wish: dict[str, Any] = {"film": FILM, **keys, "render": {"spp": 5, "seed": 3, **keys.get("render", {})}}
    return render_scene(scene, settings(scene.description, wish), on_progress)


def assert_same(a: Rendering, b: Rendering) -> None:
    def facts(x: Rendering) -> tuple[Any, ...]:
        return x.rays, x.paths, x.spp, x.truncated_paths, x.nonfinite_samples, x.nonfinite_first, x.clamped, x.relmse

    assert facts(a) == facts(b)
    assert torch.equal(a.image, b.image) and a.layers.keys() == b.layers.keys()
    assert all(torch.equal(a.layers[name], b.layers[name]) for name in a.layers)


def box(**more: Any) -> dict[str, Any]:
    """A floor, a ball and a lamp."""
    return lit_floor(ball={"type": "sphere", "material": "grey", "center": [0, 0.4, 0], "radius": 0.4}, **more)


PANE = {"pane": turned("film", 0.0, 0.7, [0, 0.6, 1])}


@pytest.mark.parametrize("name", few(SCENES, 1))
def test_pictures_have_the_bits_of_the_cpu(name, device):
    scene = torchpt.load(name, device="cpu")
    of_cpu = rendered(scene)
    for lanes, order in ((4096, None), (2048, 0), (1024, 1)):
        cuda = device(lanes, order)
        assert_same(rendered(scene), of_cpu)
        assert cuda.driver.launches.total() > 10


@pytest.mark.parametrize("threads", few([32, 64, 256], 1))
def test_ptx_gives_the_bits_of_the_cpu(threads, device):
    scene = torchpt.load(box(), device="cpu")
    keys = {"film": {"width": 8, "height": 6}, "integrator": {"type": "path", "max_depth": 2}, "render": {"spp": 2}}
    of_cpu = rendered(scene, **keys)
    device(1024, ptx=True).threads = threads
    assert_same(rendered(scene, **keys), of_cpu)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_box", "veach_mis", "env_teapot", "terrace"])
def test_ptx_of_scenes_gives_the_bits_of_the_cpu(name, device):
    scene = torchpt.load(name, device="cpu")
    keys = {"film": {"width": 12, "height": 8}, "render": {"spp": 1}}
    of_cpu = rendered(scene, **keys)
    device(1024, ptx=True)
    assert_same(rendered(scene, **keys), of_cpu)


@pytest.mark.parametrize(
    "keys",
    few(
        [
            {"integrator": {"type": "path", "max_depth": -1, "rr_depth": 2, "rr_prob": 0.7}},
            {"integrator": {"type": "path", "clamp": 0.5}},
            {"integrator": {"type": "direct"}},
            {"integrator": {"type": "aov"}, "film": {**FILM, "aovs": ["albedo", "uv"]}},
            {"integrator": {"type": "path", "max_depth": 0}},
            {"render": {"pilots": False}},
            {"sampler": "stratified"},
            {"integrator": {"type": "bdpt"}},
            {"integrator": {"type": "bdpt", "connections": "one"}},
        ],
        3,
    ),
    ids=str,
)
def test_settings_have_the_bits_of_the_cpu(keys, device):
    scene = torchpt.load(box(), device="cpu")
    of_cpu = rendered(scene, **keys)
    device(2048, 0)
    assert_same(rendered(scene, **keys), of_cpu)


@pytest.mark.parametrize("accel", few(["torch", "numba", "auto"], 1))
def test_opacity_has_the_bits_of_the_cpu(accel, device):
    scene = torchpt.load(box(**PANE), device="cpu")
    of_cpu = rendered(scene, render={"accel": accel})
    device(2048, 0, by_kernels=False)
    assert_same(rendered(scene, render={"accel": accel}), of_cpu)


def test_packets_search_what_a_tree_of_tensors_holds(device):
    scene = torchpt.load(box(), device="cpu")
    of_cpu = rendered(scene)
    device(2048, 0)
    assert_same(rendered(scene, render={"accel": "torch"}), of_cpu)


def test_splats_have_the_bits_of_the_cpu(device):
    scene = torchpt.load(box(), device="cpu")
    of_cpu = rendered(scene, integrator=Mirrored())
    device(2048, 0)
    assert_same(rendered(scene, integrator=Mirrored()), of_cpu)


class Own(torchpt.Bsdf):
    """Diffuse, by an operator that no kernel has."""

    name = "own"
    parameters = {"level": 0.5}  # noqa: RUF012

    def eval(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        order = torch.sort(wi, 0).values.sum(0) - wi.sum(0)
        return parameters["level"] * self.pdf(parameters, wo, wi).expand(3, -1) + 0.0 * order

    def pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        return wi[2].clamp_min(0.0) / math.pi

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        pdf = self.pdf(parameters, wo, wi)
        return BsdfSample(wi, pdf, self.eval(parameters, wo, wi) / torch.where(pdf > 0, pdf, 1.0))

    def albedo(self, parameters: Parameters) -> Tensor:
        return parameters["level"].expand(3, -1)


def test_models_that_cannot_be_compiled_run_between_kernels(device):
    described = box()
    described["materials"]["grey"] = {"type": "own", "level": 0.4}
    scene = torchpt.load(described, device="cpu", bsdfs={"own": Own()})
    keys = {"film": {"width": 12, "height": 8}, "render": {"spp": 2}}
    of_cpu = rendered(scene, **keys)
    assert of_cpu.eager
    device(2048)
    found = rendered(scene, **keys)
    assert found.eager
    assert_same(found, of_cpu)


def test_a_wave_does_not_ask_for_the_number_of_lanes(device, monkeypatch):
    def known(self: DeviceCalls, count: Any) -> int:
        raise AssertionError("a wait for the device")

    cuda = device(2048)
    copies = []
    monkeypatch.setattr(DeviceCalls, "known", known)
    monkeypatch.setattr(cuda, "to_host", lambda values, plain=cuda.to_host: copies.append(0) or plain(values))
    film = {"width": 32, "height": 32}
    found = rendered(torchpt.load(box(), device="cpu"), film=film, integrator={"type": "path", "max_depth": 8})
    assert found.complete
    # Of each of three waves of two samples a pixel: its counters, the samples that are not finite, and two looks.
    assert len(copies) <= 3 * 4


def test_samples_that_are_not_finite_are_counted(device):
    near = {"type": "point", "position": [0, 0.81, 0], "intensity": 3e38}
    scene = torchpt.load({**box(), "lights": {"near": near}}, device="cpu")
    of_cpu = rendered(scene)
    assert of_cpu.nonfinite_samples
    device(2048, 0)
    assert_same(rendered(scene), of_cpu)


def test_waves_shrink_where_memory_runs_out(device, monkeypatch):
    scene = torchpt.load(box(), device="cpu")
    of_cpu = rendered(scene)
    plain = DeviceMemory.__init__

    def bounded(self: DeviceMemory, rows: int, row: int, where: torch.device) -> None:
        if row > 1024:
            raise MemoryError("out of memory")
        plain(self, rows, row, where)

    monkeypatch.setattr(DeviceMemory, "__init__", bounded)
    device(2048)
    assert_same(rendered(scene), of_cpu)
    monkeypatch.setattr(forward_module, "MIN_LANES", 2048)
    with pytest.raises(RenderError, match="not enough memory for a wave of the fewest lanes"):
        rendered(scene)


def test_a_render_ends_between_waves(device):
    scene = torchpt.load(box(), device="cpu")
    device(1024)
    seen: list[int] = []

    def end(progress: Progress) -> bool:
        seen.append(progress.done)
        return True

    found = rendered(scene, end, render={"spp": 64})
    assert seen[0] <= 2048 and not found.complete and found.paths <= 2048 and found.stopped_by == ""


def test_checkpoints_go_on_with_the_same_bits(device, tmp_path: Path):
    scene = torchpt.load(box(), device="cpu")
    of_cpu = rendered(scene, render={"spp": 8})
    device(1024, 1)
    file = str(tmp_path / "state.ckpt")
    first = rendered(scene, lambda progress: progress.done >= 2048, render={"spp": 8, "checkpoint": file})
    assert not first.complete
    found = rendered(scene, render={"spp": 8, "checkpoint": file, "resume": True})
    assert torch.equal(found.image, of_cpu.image) and found.rays == of_cpu.rays
