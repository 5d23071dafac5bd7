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
from torchpt.engines.kernels.device_backward import DeviceBackward, DeviceVjpKernels
from torchpt.engines.kernels.device_sums import Places, SegmentSums, WaveSums
from torchpt.gradients import replay
from torchpt.math import sums
from torchpt.math.sums import ChunkGradientSums, GradientSums

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
    """Entries, numbers and samples of terms in random order; some are of no entry."""
    random = np.random.default_rng(entries)
    samples = random.permutation(1500)[:1200]
    size = np.exp(8 * random.standard_normal((width, 1200))) * random.standard_normal((width, 1200))
    index = random.integers(-1, entries + 1, 1200)
    return torch.from_numpy(index), torch.from_numpy(size.astype(np.float32)), torch.from_numpy(samples)


def wave_sums(table: Tensor, whole: GradientSums, ptx: bool = False) -> tuple[WaveSums, Places]:
    """Sums of a wave of 250 pixels of 6 samples, in chunks of 500 samples but for the last one: 83, 83, 83 and 1 pixels."""
    cuda, target = (SimulatedCuda(PtxDriver()), ptx_target()) if ptx else (SimulatedCuda(), simulated_target(1024))
    made = WaveSums([table], whole, SegmentSums(cuda, target), 500)
    return made, made.begin(250, 6, torch.device("cpu"))


@pytest.mark.parametrize(("entries", "width", "dense", "ptx"), [
    (1, 3, None, False), (40, 2, None, False), (400, 3, None, False), (400, 3, 0, False), (1, 3, None, True), (40, 2, 0, True),
])  # fmt: skip
def test_terms_are_added_in_the_order_of_chunks_and_slots(entries, width, dense, ptx, monkeypatch):
    monkeypatch.setattr(sums, "MAX_DENSE", sums.MAX_DENSE if dense is None else dense)
    index, values, samples = terms(entries, width)
    table = torch.zeros(width, entries)
    expected, found = (GradientSums([table]) for _ in range(2))
    wave, places = wave_sums(table, found, ptx)
    exists = torch.rand(1200, generator=torch.Generator().manual_seed(3)) < 0.9
    for _ in range(2):  # two look-ups
        wave.add_terms(0, None, index.int(), values, places.terms(samples, exists))
    if dense is None:
        whole = values[:1].expand(table.numel(), -1).contiguous()
        wave.add_all(0, whole, places.terms(samples, exists))
    wave.merge_into_whole()
    first = 0
    for pixels in (83, 83, 83, 1):
        chunk = ChunkGradientSums([table])
        # sample s of pixel p is number 250 s + p of the wave, and slot pixels s + p - first of the chunk
        slot = samples // 250 * pixels + samples % 250 - first
        mine = (exists & (samples % 250 >= first) & (samples % 250 < first + pixels)).nonzero()[:, 0]
        mine = mine[slot[mine].argsort()]
        of_chunk = values[:, mine].numpy(), slot[mine].int().numpy()
        for _ in range(2):
            chunk.add_rows(0, index[mine].int().numpy(), *of_chunk)
        if dense is None:
            chunk.add_all(0, np.repeat(of_chunk[0][:1], table.numel(), 0), of_chunk[1])
        expected.merge(chunk)
        first += pixels
    assert found.total(0).any() and torch.equal(found.total(0), expected.total(0))


def test_terms_of_no_entry_change_nothing():
    table = torch.zeros(2, 3)
    whole = GradientSums([table])
    wave, places = wave_sums(table, whole)
    found = places.terms(torch.tensor([1, 0]), torch.tensor([True, True]))
    wave.add_terms(0, None, torch.tensor([-1, 3], dtype=torch.int32), torch.ones(2, 2), found)
    wave.merge_into_whole()
    assert not whole.total(0).any()


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


@pytest.mark.parametrize("short", ["fails", "known"])
def test_waves_of_fewer_lanes_where_memory_is_short(monkeypatch, device, short):
    """An allocation that fails, and memory that is known to be short: the same gradient from smaller waves."""
    monkeypatch.setattr(replay, "LANES_OF_KERNELS", engine.LANES // 16)
    lanes: list[int] = []
    made, merge, fewest = DeviceVjpKernels.engine, WaveSums.merge_into_whole, engine.LANES // 16

    def noted(self: DeviceVjpKernels) -> DeviceBackward:
        lanes.append(self.lanes)
        return made(self)

    def merged(self: WaveSums) -> None:
        """Merge the sums; then there is no memory for the next wave of many lanes."""
        merge(self)
        if short == "fails" and lanes[-1] > fewest:
            raise MemoryError

    monkeypatch.setattr(DeviceVjpKernels, "engine", noted)
    monkeypatch.setattr(WaveSums, "merge_into_whole", merged)
    if short == "known":
        monkeypatch.setattr(replay, "free_memory", lambda device: 0)
    assert_same(device, several(), *NAMES[3])
    assert lanes[-1] == fewest and (len(lanes) > 1) == (short == "fails")


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
    assert_same(device, several(), *NAMES[2], integrator=Mirrored(**lights()))


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
