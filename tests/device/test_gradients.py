"""Gradients by the engine of a device, on a simulated one: the bits of the CPU's, in any order of lanes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from gradient_rooms import room, several, sums_of
from mirrored import Mirrored, lights
from simulated_driver import PtxDriver, SimulatedCuda, simulated_target
from torch import Tensor

import torchpt
from torchpt.compiler.graph import Unsupported
from torchpt.compiler.ptx import ptx_target
from torchpt.engines.kernels import engine
from torchpt.engines.kernels.backward import VjpKernels
from torchpt.engines.kernels.device_backward import SegmentSums
from torchpt.gradients import replay
from torchpt.math import sum_kernels, sums

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

#: Parameters of four kinds. A camera that moves alone has its gradient without path replay.
NAMES = [
    ("camera.to_world", "camera.fov", "materials.grey.reflectance", "shapes.plate.to_world"),
    ("shapes.lamp.vertices", "shapes.plate.to_world"),
    ("lights.sky.radiance", "shapes.lamp.emission"),
    ("materials.grey.reflectance",),
]


# -- sums of terms


def terms(entries: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Entries, numbers and slots of terms in random order; some are of no entry."""
    random = np.random.default_rng(entries)
    slots = random.permutation(1500)[:1200]
    size = np.exp(8 * random.standard_normal((width, 1200))) * random.standard_normal((width, 1200))
    index = random.integers(-1, entries + 1, 1200)
    return torch.from_numpy(index), torch.from_numpy(size.astype(np.float32)), torch.from_numpy(slots)


@pytest.mark.parametrize("ptx", [False, True])
@pytest.mark.parametrize(("entries", "width", "dtype"), [(1, 3, "f8"), (40, 2, "f8"), (900, 1, "f4")])
def test_terms_are_added_in_the_order_of_slots(entries, width, dtype, ptx):
    index, values, slots = terms(entries, width)
    order = np.argsort(slots.numpy())
    given = [index.numpy()[order].astype(np.int32), values.numpy()[:, order], slots.numpy()[order].astype(np.int32)]
    start = np.random.default_rng(1).standard_normal((entries, width)).astype(dtype)
    cuda, target = (SimulatedCuda(PtxDriver()), ptx_target()) if ptx else (SimulatedCuda(), simulated_target(1024))
    segments = SegmentSums(cuda, target)
    expected, found = start.copy(), torch.from_numpy(start.copy())
    sum_kernels.add_at(expected, *given[:2])
    segments.add(found, index, values, slots)
    assert np.array_equal(found.numpy(), expected)
    if dtype == "f8":
        sum_kernels.add_by_columns(expected, *given)
        segments.add_by_columns(found, index, values, slots)
        assert np.array_equal(found.numpy(), expected)


def test_terms_of_no_entry_change_nothing():
    segments = SegmentSums(SimulatedCuda(), simulated_target(1024))
    total = torch.arange(6.0, dtype=torch.float64).view(3, 2)
    for add in (segments.add, segments.add_by_columns):
        add(total, torch.tensor([-1, 3]), torch.ones(2, 2), torch.tensor([1, 0]))
        assert torch.equal(total, torch.arange(6.0, dtype=torch.float64).view(3, 2))


# -- gradients


@pytest.fixture(params=few(["few", "dense", "stream"], 1))
def table(request, monkeypatch) -> None:
    """How the tables of a scene are summed, which have few numbers."""
    monkeypatch.setattr(sums, "MAX_BY_COLUMNS", sums.MAX_BY_COLUMNS if request.param == "few" else 0)
    monkeypatch.setattr(sums, "MAX_DENSE", 0 if request.param == "stream" else sums.MAX_DENSE)


def assert_same(device: Any, scene: torchpt.Scene, *names: str, ptx: bool = False, **wish: Any) -> SimulatedCuda:
    """The sums of gradients have the CPU's bits, with lanes in a random order."""
    of_cpu = sums_of(scene, *names, **wish)
    cuda = device(1024, None if ptx else 0, ptx=ptx)
    found = sums_of(scene, *names, **wish)
    assert cuda.fallback == "" and torch.equal(found, of_cpu)
    return cuda


@pytest.mark.parametrize("names", few([pytest.param(names, id=names[0]) for names in NAMES], 1))
@pytest.mark.usefixtures("table")
def test_gradients_have_the_bits_of_the_cpu(monkeypatch, names, device):
    monkeypatch.setattr(replay, "LANES_OF_KERNELS", engine.LANES // 16)  # so that there are some chunks
    assert_same(device, several(), *names)


@pytest.mark.slow
def test_texels_have_the_bits_of_the_cpu(device, tmp_path: Path):
    file = tmp_path / "texels.ppm"
    file.write_text("P3\n128 128\n255\n" + " ".join(str((37 * k) % 256) for k in range(128 * 128 * 3)))
    described = room({"type": "diffuse", "reflectance": {"type": "image", "path": str(file)}})
    scene = torchpt.load(described, "cpu")
    (name,) = (name for name in scene.params if scene.params[name].numel() > sums.MAX_DENSE)
    assert_same(device, scene, name)


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [1.0, 0.5])
@pytest.mark.parametrize("names", NAMES, ids=lambda names: names[0])
def test_gradients_through_opacity_have_the_bits_of_the_cpu(names, opacity, device):
    assert_same(device, several(opacity), *names, integrator={"type": "path", "max_depth": 6})


@pytest.mark.slow
def test_paths_without_a_depth_limit(device):
    """Long walks are replayed from marks."""
    cuda = assert_same(
        device,
        several(),
        *NAMES[0],
        integrator={"type": "path", "max_depth": -1, "rr_depth": 12, "rr_prob": 0.8},
        spp=4,
    )
    assert cuda.driver.launches.total() > 100


@pytest.mark.slow
def test_splats_have_the_bits_of_the_cpu(device):
    assert_same(device, several(), *NAMES[0], integrator=Mirrored(**lights()))


@pytest.mark.slow
@pytest.mark.parametrize("names", NAMES, ids=lambda names: names[0])
def test_ptx_gives_the_bits_of_the_cpu(names, device):
    film = {"width": 8, "height": 6, "filter": "box"}
    assert_same(device, several(), *names, ptx=True, film=film, spp=4, integrator={"type": "path", "max_depth": 3})


@pytest.mark.slow
def test_a_stage_that_cannot_be_compiled_leaves_the_gradient_to_tensor_operations(monkeypatch, device, capsys):
    made = VjpKernels._get

    def get(self: Any, listed: bool, build: Any, *arguments: Any) -> Any:
        if build.__name__ == "escape_vjp":
            raise Unsupported("an operator of the test's own")
        return made(self, listed, build, *arguments)

    monkeypatch.setattr(VjpKernels, "_get", get)
    scene = several()
    by_tensors = sums_of(scene, *NAMES[0], compile="off")
    cuda = device(1024)
    assert torch.allclose(sums_of(scene, *NAMES[0]), by_tensors, rtol=1e-3)
    assert cuda.fallback == "no kernel can be made of an operator of the test's own"
    assert "are taken by tensor operations, as no kernel can be made of" in capsys.readouterr().err
