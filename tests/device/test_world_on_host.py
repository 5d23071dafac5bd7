"""What stages read on a device is computed on the host: torch's operators round differently on a GPU."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from simulated_cuda import Log, simulated_cuda

import torchpt
from torchpt.core.tree import leaves
from torchpt.scene.formats.description import settings


@pytest.fixture
def log() -> Iterator[Log]:
    """What is done on the simulated device."""
    with simulated_cuda() as log:
        yield log


@pytest.mark.parametrize("name", ["cornell_box", "ibl_row", "veach_mis"])
def test_no_operator_runs_on_the_device_to_make_a_world(log: Log, name: str):
    scene = torchpt.load(name, device="cuda")
    log.clear()
    world, geometry = scene.world(torch.float32)
    assert set(log.operators) <= {"detach"}
    moved = {key: value + 0.0 for key, value in scene.params.items() if key.endswith("to_world")}
    log.clear()
    world, geometry = scene.world(torch.float32, {key: value for key, value in moved.items() if "camera" not in key})
    camera = scene.camera(settings(scene.description).film, scene.merged(moved), torch.float32)
    assert set(log.operators) <= {"detach"}
    assert all(leaf.device.type == "cuda" for leaf in leaves((world, geometry, camera)))
    assert all(leaf.device.type == "cuda" for leaf in leaves((world, geometry)))
