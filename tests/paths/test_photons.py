"""The photon map: the photons within the radius, one of which is chosen by its flux."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchpt.paths.photons import FIRST_ROW, PHOTON_ROWS, LightOfSample, PhotonMap, SentLight, SentPhotons
from torchpt.physics.film.splats import Splats

VALUE = slice(FIRST_ROW["value"], FIRST_ROW["value"] + 3)


def photons(count: int, side: float, seed: int = 1) -> SentPhotons:
    rng = np.random.default_rng(seed)
    p, data = (rng.random((rows, count), np.float32) for rows in (3, PHOTON_ROWS))
    # Found by merges alone.
    data[FIRST_ROW["dvcm"]], data[FIRST_ROW["dvc"]] = np.arange(count, dtype=np.float32) * 1e-12, 0.0
    data[FIRST_ROW["depth"]] = rng.integers(1, 5, count)
    p = (p - 0.5) * np.float32(side)
    return SentPhotons(np.arange(count), np.ascontiguousarray(np.concatenate((p, data)).T))


def sent(
    rows: np.ndarray, first_pixel: int = 0, lost: tuple[int, ...] = (), splats: tuple[Splats, ...] = ()
) -> SentLight:
    lanes = np.arange(len(rows))
    found = [(lanes, rows.T[:3], rows.T[3:])]
    return SentLight.of(first_pixel, len(lanes), found, splats, np.array(lost, np.int64))


@pytest.mark.parametrize(
    "count, side, radius", [(2000, 1.0, 0.1), (2000, 100.0, 1.0), (500, 1e-3, 1e-2), (3, 1.0, 0.3)]
)
def test_the_sum_of_photons_within_the_radius(count, side, radius):
    """The value of the chosen photon, times the sum of fluxes over its own, beside all pairs."""
    light = photons(count, side)
    found = PhotonMap.of([light], radius, paths=10.0)
    rng = np.random.default_rng(2)
    p = ((rng.random((3, 500)) - 0.5) * side).astype(np.float32)
    near = found.near(p, rng.integers(-(2**31), 2**31, (2, 500)).astype(np.int32), depth=3)
    distance = ((p[:, :, None].astype(np.float64) - light.rows.T[:3, None, :]) ** 2).sum(0)
    flux = light.rows.T[3:][VALUE].max(0)
    total = ((distance < radius**2) * flux).sum(1)
    sure = abs(distance / radius**2 - 1.0).min(1) > 1e-4
    np.testing.assert_allclose(near[VALUE].max(0)[sure] * math.pi * radius**2 * 10.0, total[sure], rtol=1e-5, atol=0.0)
    assert (total > 0).any() and ((near[FIRST_ROW["depth"]] > 0) == (total > 0))[sure].all()


def test_photons_are_chosen_by_their_flux():
    light = photons(4, 0.0)
    found = PhotonMap.of([light], 1.0, paths=1.0)
    keys = np.random.default_rng(3).integers(-(2**31), 2**31, (1, 40000)).astype(np.int32)
    near = found.near(np.zeros((3, 40000), np.float32), keys, depth=1)
    flux = light.rows.T[3:][VALUE].max(0)
    chosen = (near[FIRST_ROW["dvcm"]][:, None] == light.rows[:, 3 + FIRST_ROW["dvcm"]]).mean(0)
    assert chosen.sum() == pytest.approx(1.0)
    expected = flux / flux.sum()
    assert (abs(chosen - expected) < 5.0 * np.sqrt(expected * (1.0 - expected) / 40000)).all()


def test_the_order_of_parts_changes_nothing():
    light = photons(1000, 1.0)
    halves = [SentPhotons(light.pixel[part], light.rows[part]) for part in (slice(0, 400), slice(400, 1000))]
    whole, a, b = (PhotonMap.of(parts, 0.1, 1.0) for parts in ([light], halves, halves[::-1]))
    for name in ("points", "data", "starts"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
        assert np.array_equal(getattr(a, name), getattr(whole, name)), name


def test_a_map_without_photons():
    near = PhotonMap.of([], 0.1, 1.0).near(np.zeros((3, 5), np.float32), np.zeros((1, 5), np.int32), depth=1)
    assert not near.any()


def test_many_photons_at_one_place():
    """More than are kept while one is chosen."""
    light = photons(2000, 0.0)
    found = PhotonMap.of([light], 1.0, paths=1.0)
    keys = np.random.default_rng(3).integers(-(2**31), 2**31, (1, 4000)).astype(np.int32)
    near = found.near(np.zeros((3, 4000), np.float32), keys, depth=1)
    np.testing.assert_allclose(near[VALUE].max(0) * math.pi, light.rows.T[3:][VALUE].max(0).sum(), rtol=1e-5)
    mean, flux = near[FIRST_ROW["dvcm"]].mean() * 1e12, light.rows.T[3:][VALUE].max(0).astype(np.float64)
    expected = (flux * np.arange(2000)).sum() / flux.sum()
    assert abs(mean - expected) < 5.0 * 577.0 / math.sqrt(4000)


@pytest.mark.parametrize("field", ["p", "value", "dvcm"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_photons_that_are_not_finite_make_their_pixels_lost(field, bad):
    rows = photons(10, 1.0).rows
    rows[3, 0 if field == "p" else 3 + FIRST_ROW[field]] = bad
    splats = Splats(torch.tensor([2, 7]), torch.tensor([0, 1]), torch.ones(3, 2))
    part = sent(rows, first_pixel=100, lost=(7,), splats=(splats,))
    assert part.lost.tolist() == [103, 107] and part.photons is not None
    assert part.photons.pixel.tolist() == [100 + k for k in range(10) if k != 3]
    found = LightOfSample.of([part, sent(rows[:2])], 0.1, 10.0)
    (of_others,), lost = found.of_pixels(104, 3)
    assert not len(of_others.lane) and not len(lost) and not found.of_pixels(50, 50)[0]
    (of_pixels,), lost = found.of_pixels(102, 6)
    assert lost.tolist() == [1, 5] and of_pixels.lane.tolist() == [0, 5] and of_pixels.pixel.tolist() == [0, 1]
    (of_all,), lost = found.of_pixels(99, 20)
    assert lost.tolist() == [4, 8] and of_all.lane.tolist() == [3, 8]
