"""How adaptive sampling shares samples out."""

from __future__ import annotations

import pytest
import torch

from torchpt.physics.film.error import allocate_samples, expected_errors

PIXELS = torch.full((100,), 16)


def counts(n: int) -> torch.Tensor:
    return torch.full((100,), n)


def test_even_errors_share_evenly():
    assert (allocate_samples(torch.ones(100).double(), counts(16), PIXELS, 64.0) == 64).all()
    assert (allocate_samples(torch.zeros(100).double(), counts(16), PIXELS, 32.0) == 32).all()


def test_samples_go_with_the_root_of_the_variance():
    error = torch.ones(100).double()
    error[:50] = 4.0
    aims = allocate_samples(error, counts(64), PIXELS, 192.0)
    assert (aims[:50] == 256).all() and (aims[50:] == 128).all()


def test_numbers_are_doubled_within_what_there_is():
    g = torch.Generator().manual_seed(1)
    error, have = (
        (3 * torch.randn(100, generator=g, dtype=torch.float64)).exp(),
        16 << torch.randint(0, 4, (100,), generator=g),
    )
    mean = 2.0 * float(have.double().mean())
    aims = allocate_samples(error, have, PIXELS, mean)
    assert set((aims / have).tolist()) == {1.0, 2.0, 4.0}
    assert 0.9 * mean <= float(aims.double().mean()) <= mean
    ratio = (error * have).sqrt()
    assert float(ratio[aims == 4 * have].mean()) > float(ratio[aims == have].mean())


def test_the_last_round_leaves_nothing_over():
    g = torch.Generator().manual_seed(3)
    pixels = torch.full((100,), 16)
    pixels[7::10], pixels[9] = 12, 3  # at the film's edge
    for spp in (20.0, 33.0, 61.5, 64.0):
        error = (3 * torch.randn(100, generator=g, dtype=torch.float64)).exp()
        have = 16 << torch.randint(0, 2, (100,), generator=g)
        if float((have * pixels).sum()) > spp * float(pixels.sum()):
            continue
        aims = allocate_samples(error, have, pixels, min(spp, 2.0 * float(have.double().mean())), last=True)
        total = min(spp, 2.0 * float(have.double().mean())) * float(pixels.sum())
        assert (aims >= have).all() and 0.0 <= total - float((aims * pixels).sum()) < 16.0


def test_bad_estimates_do_no_harm():
    error = torch.full((100,), -1.0).double()
    assert (allocate_samples(error, counts(32), PIXELS, 64.0) == 64).all()


def test_a_constant_is_kept_and_the_known_alone_are_asked():
    values, known = torch.full((9, 7), 3.0).double(), torch.ones(9, 7, dtype=torch.bool)
    values[4, 4], known[4, 4] = 1e9, False
    torch.testing.assert_close(expected_errors(values, known), torch.full((9, 7), 3.0).double())
    lonely = torch.zeros(9, 7, dtype=torch.bool)
    lonely[0, 0] = True
    assert (expected_errors(values, lonely) == 3.0).all()  # the mean where nothing near is known
    assert (expected_errors(values, torch.zeros_like(lonely)) == 0.0).all()


def test_errors_that_gather_are_followed_and_those_that_do_not_are_shared():
    g = torch.Generator().manual_seed(2)
    known = torch.ones(60, 60, dtype=torch.bool)
    noise = torch.rand(60, 60, generator=g).double()
    edge = noise.clone()
    edge[28:30] *= 100.0
    found = expected_errors(edge, known)
    assert float(found[28:30].mean()) > 20 * float(found[:20].mean())
    assert float(found.mean()) == pytest.approx(float(edge.mean()), rel=0.1)
    rare = noise.clone()
    rare[torch.rand(60, 60, generator=g) < 0.01] = 100.0
    found = expected_errors(rare, known)
    assert float(found.mean()) == pytest.approx(float(rare.mean()), rel=0.1)
    assert float(found.max()) < 3 * float(found.min())
    half = noise.clone()  # ordinary noise of which one side has more
    half[:, :30] *= 4.0
    found = expected_errors(half, known)
    assert float(found[:, :28].mean()) == pytest.approx(4 * float(found[:, 32:].mean()), rel=0.2)
