"""Light to other pixels from samples of several processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from forks import in_ranks
from mirrored import KEYS, Mirrored, lights, room

import torchpt


def test_ranks_come_to_the_bits_of_one_process(tmp_path: Path) -> None:
    scene = torchpt.load(room(), "cpu")

    def work(group: Any) -> np.ndarray:
        return torchpt.render(scene, integrator=Mirrored(**lights()), ranks=group, **KEYS).numpy()

    parts = in_ranks(3, work, tmp_path)
    whole = torchpt.render(scene, integrator=Mirrored(**lights()), **KEYS).numpy()
    assert all(np.array_equal(whole, part) for part in parts)
