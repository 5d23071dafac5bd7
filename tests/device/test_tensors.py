"""The engine of tensor operations on a simulated CUDA device: pictures have the CPU's bits, and the host seldom waits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from accel_reference import rays, soup
from simulated_cuda import Log, simulated_cuda, without_compiled_functions

import torchpt
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search import build, lbvh

SCENES = sorted(path.stem for path in (Path(__file__).parents[2] / "configs" / "scene").glob("*.yaml"))
#: Scenes that are rendered in `make test`.
FEW = (
    "cornell_box", "cornell_bunny", "cornell_specular", "cornell_spheres", "cornell_transmissive", "duck", "games101",
    "games101_spheres", "ibl_row", "veach_mis",
)  # fmt: skip
#: Those of them with paths that go on behind the first surface.
DEEPER = ("cornell_box", "cornell_transmissive")


@pytest.fixture
def log() -> Iterator[Log]:
    """What is done on the simulated device."""
    with simulated_cuda() as log:
        yield log


# ---- Pictures


def check_picture(scene: str, **options: Any) -> None:
    """Render by tensors on both devices, and compare the bits."""
    with without_compiled_functions():
        expected = torchpt.render(torchpt.load(scene, device="cpu"), compile="off", accel="torch", **options)
    found = torchpt.render(torchpt.load(scene, device="cuda"), compile="off", **options)
    assert found.device == torch.device("cuda:0")
    assert found.cpu().equal(expected)


@pytest.mark.parametrize("name", FEW)
def test_picture(log: Log, name: str):
    depth = 2 if name in DEEPER else 1
    check_picture(name, spp=1, film={"width": 4, "height": 3}, integrator={"max_depth": depth})


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_picture_of_whole_paths(log: Log, name: str):
    check_picture(name, spp=2, film={"width": 8, "height": 6})


# ---- How often the host waits


def on_device(geometry: Geometry) -> Geometry:
    corners = {name: getattr(geometry, name).to("cuda") for name in ("p0", "p1", "p2")}
    return replace(geometry, **corners)


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The steps of traversals, as they are taken."""
    taken: list[str] = []
    for name in ("_descend", "_test"):
        step = getattr(lbvh._Chunk, name)
        monkeypatch.setattr(
            lbvh._Chunk, name, lambda self, *args, step=step, name=name: (taken.append(name), step(self, *args))[1]
        )
    return taken


def test_traversal_asks_once_in_8_steps(log: Log, steps: list[str]):
    geometry = soup(0)
    here, there = build(on_device(geometry)), build(geometry, "torch")
    o, d, t_max = rays(2, 100)
    moved = [x.to("cuda") for x in (o, d, t_max)]
    found = []
    for search in (here.intersect, here.occluded):
        log.clear()
        steps.clear()
        found.append(search(*moved))
        asked = sum(log.waits.values())
        assert len(steps) == 8 * asked >= 16 and set(steps) == {"_descend", "_test"} and not log.transfers
    hits, blocked = found
    assert all(a.cpu().equal(b) for a, b in zip(hits, there.intersect(o, d, t_max), strict=True))
    assert blocked.cpu().equal(there.occluded(o, d, t_max))


def test_waits_and_transfers_of_a_wave(log: Log):
    depth, found = 1, []
    scene = torchpt.load("cornell_spheres", device="cuda")
    for width in (12, 3, 12):  # the first one builds the search, and salts of random numbers
        log.clear()
        torchpt.render(scene, spp=1, film={"width": width, "height": 3}, integrator={"max_depth": depth}, compile="off")
        found.append((sum(log.waits.values()) - log.waits_in("search/lbvh.py"), sum(log.transfers.values()), log.bytes))
    assert found[1] == found[2]  # whatever the number of lanes
    waits, transfers, size = found[1]
    # To the host: at each vertex the number of lanes by model; for a picture whether all samples are finite, and counts of
    # samples. To the device: three tensors of the camera, and the sampler's seeds.
    assert transfers == depth + 3 and waits == transfers + 4 and size <= 256
