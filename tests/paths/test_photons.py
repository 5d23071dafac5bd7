"""The photon map: the photons within the radius, one of which is chosen by its flux."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from torchpt.paths.photons import PHOTON, PhotonMap


def photons(count: int, side: float, seed: int = 1) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    rng = np.random.default_rng(seed)
    values: dict[str, Any] = {name: rng.random((rows, count), np.float32) for name, rows in PHOTON.items()}
    values["p"] = (values["p"] - 0.5) * side
    values["dvcm"], values["dvc"] = (
        np.arange(count, dtype=np.float32)[None] * 1e-12,
        0 * values["dvc"],
    )  # found by merges alone
    values["depth"] = rng.integers(1, 5, (1, count)).astype(np.int64)
    return np.arange(count), {name: value if len(value) > 1 else value[0] for name, value in values.items()}


@pytest.mark.parametrize(
    "count, side, radius", [(2000, 1.0, 0.1), (2000, 100.0, 1.0), (500, 1e-3, 1e-2), (3, 1.0, 0.3)]
)
def test_the_sum_of_photons_within_the_radius(count, side, radius):
    """The value of the chosen photon, times the sum of fluxes over its own, beside all pairs."""
    pixel, values = photons(count, side)
    found = PhotonMap.of([(pixel, values)], radius, paths=10.0)
    rng = np.random.default_rng(2)
    p = ((rng.random((3, 500)) - 0.5) * side).astype(np.float32)
    near = found.near(p, rng.integers(-(2**31), 2**31, (2, 500)).astype(np.int32), depth=3)
    distance = ((p[:, :, None].astype(np.float64) - values["p"][:, None, :]) ** 2).sum(0)
    flux = values["value"].max(0)
    total = ((distance < radius**2) * flux).sum(1)
    sure = abs(distance / radius**2 - 1.0).min(1) > 1e-4
    np.testing.assert_allclose(
        near["value"].max(0)[sure] * math.pi * radius**2 * 10.0, total[sure], rtol=1e-5, atol=0.0
    )
    assert (total > 0).any() and ((near["depth"] > 0) == (total > 0))[sure].all()


def test_photons_are_chosen_by_their_flux():
    pixel, values = photons(4, 0.0)
    found = PhotonMap.of([(pixel, values)], 1.0, paths=1.0)
    keys = np.random.default_rng(3).integers(-(2**31), 2**31, (1, 40000)).astype(np.int32)
    near = found.near(np.zeros((3, 40000), np.float32), keys, depth=1)
    flux = values["value"].max(0)
    chosen = (near["dvcm"][:, None] == values["dvcm"]).mean(0)
    assert chosen.sum() == pytest.approx(1.0)
    expected = flux / flux.sum()
    assert (abs(chosen - expected) < 5.0 * np.sqrt(expected * (1.0 - expected) / 40000)).all()


def test_the_order_of_parts_changes_nothing():
    pixel, values = photons(1000, 1.0)
    halves = [
        (pixel[part], {name: value[..., part] for name, value in values.items()})
        for part in (slice(0, 400), slice(400, None))
    ]
    a, b = PhotonMap.of(halves, 0.1, 1.0), PhotonMap.of(halves[::-1], 0.1, 1.0)
    for name in ("points", "data", "starts"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


def test_a_map_without_photons():
    near = PhotonMap.of([], 0.1, 1.0).near(np.zeros((3, 5), np.float32), np.zeros((1, 5), np.int32), depth=1)
    assert not near["value"].any() and not near["depth"].any()
