"""Splats and connections: the kernels of a CPU beside tensor operations, as devices take them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from torchpt.engines.kernels.joins import HostJoins, TensorJoins
from torchpt.engines.kernels.layout import CONNECTION, SHADOW, SPLAT, Memory, Rows
from torchpt.physics.film.splats import SplatSums

LANES = 200


def joins(kind: type, partly: bool, words: np.ndarray) -> tuple[Any, Any, Rows]:
    """Return joins over an arena with ``words``, whose search blocks rays by a number in them."""
    result = {"transmittance": ((), "f")} if partly else {"blocked": ((), "i")}
    fields: Any = {"lane": ((), "l"), "radiance": ((3,), "f"), **SPLAT, **CONNECTION, **SHADOW, **result}
    rows, arena = Rows(fields), Memory(Rows(fields).count)
    arena.words[:, :LANES] = words[: rows.count]
    arena.floats[rows.first("splat_radiance"), 5], arena.floats[rows.first("splat_o"), 5] = np.inf, 1.0
    arena.floats[rows.first("connection_t"), :LANES:3] = 0.0
    arena.words[rows.first("splat_pixel"), :LANES] = np.arange(LANES) % 7 - 3
    arena.words[rows.first("lane"), :LANES] = np.arange(LANES)[::-1]
    memory: Any = arena
    if kind is TensorJoins:
        words_of = torch.from_numpy(arena.words)
        memory = SimpleNamespace(words=words_of, floats=words_of.view(torch.float32))

    def light(_: Any, count: int) -> None:
        o = arena.floats[rows.first("shadow_o"), :count]
        if partly:
            arena.floats[rows.first("transmittance"), :count] = np.maximum(o - 0.4, 0.0)
        else:
            arena.words[rows.first("blocked"), :count] = o < 0.4

    calls = SimpleNamespace(known=int, lanes=int)
    search: Any = SimpleNamespace(kernels=SimpleNamespace(state=rows), calls=calls, light=light)
    return kind(search), memory, rows


@pytest.mark.parametrize("partly", [False, True], ids=["opaque", "partly"])
@pytest.mark.parametrize("count", [LANES, 37, 3, 0])
def test_kernels_and_tensors_agree(count, partly):
    words = np.random.default_rng(1).random((80, LANES), np.float32).view(np.int32)
    (a, host, rows), (b, device, _) = joins(HostJoins, partly, words), joins(TensorJoins, partly, words)
    found, expected = a.splats(host, count), b.splats(device, count)
    assert (found is None) == (expected is None) == (count in (0, 3))
    if found is not None:
        for name in ("lane", "pixel", "value"):
            assert torch.equal(getattr(found[0], name), getattr(expected[0], name)), name
        assert found[1].tolist() == expected[1].tolist() == [LANES - 6]
    assert np.array_equal(host.words, device.words.numpy())
    before = host.floats[rows.first("radiance"), :LANES].copy()
    a.connect(host, count)
    b.connect(device, count)
    assert np.array_equal(host.words, device.words.numpy())
    assert (before != host.floats[rows.first("radiance"), :LANES]).any() == (count > 1)


@pytest.mark.parametrize("pixel", [-1, 12, 10**9])
def test_splats_outside_of_the_picture_are_refused(pixel):
    """An integrator of one's own may get it wrong; nothing is written."""
    sums = SplatSums(12, 2, torch.device("cpu"))
    one = torch.ones(3, 2)
    with pytest.raises(IndexError, match="of a picture of 12 pixels"):
        sums.add(torch.tensor([0, 1]), torch.tensor([3, pixel]), one)
    assert not sums.state().any()
    sums.add(torch.tensor([0, 1]), torch.tensor([3, 11]), one)
    assert sums.values(1)[:, 11].tolist() == [1.0] * 3 and float(sums.values(0).sum()) == 3.0
