"""The CPU kernels give the bits of the tensor form, wherever a lane stands and however many threads there are."""

from __future__ import annotations

import pytest
import torch
from few import few

from torchpt.samplers import KINDS, Dimension, Draws, Sampler, points_of, salts
from torchpt.samplers.kernels import draw

CPU = torch.device("cpu")
KERNELS = [name for name in KINDS if points_of(name).kernels() is not None]
NAMES = [0, 1, -1, 2**31 - 1, -(2**31), *salts(3, CPU).tolist()]


def keys(n: int, kind: str) -> torch.Tensor:
    """Any words at all; of points that are counted, the largest numbers among them."""
    g = torch.Generator().manual_seed(n)
    words = torch.randint(-(2**31), 2**31, (2, n), generator=g)
    if KINDS[kind].rows == 3:
        count = torch.randint(1, 2**30, (n,), generator=g) >> torch.randint(0, 30, (n,), generator=g)
        count = count.clamp_min(1)
        words = torch.stack((words[0], words[1].abs() % count, count))
    return words.to(torch.int32)


@pytest.mark.parametrize("kind", KERNELS)
@pytest.mark.parametrize("n", few([0, 1, 3, 1023, 1025, 70_003], 3))
def test_bits_are_those_of_the_tensor_form(kind, n):
    key, points = keys(n, kind), points_of(kind)
    for name in NAMES if n < 2000 else NAMES[:: len(NAMES) // 3]:
        salt = torch.tensor(name, dtype=torch.int32)
        assert torch.equal(draw(points, 1, key, name), points.draw_1d(key, salt)[None])
        assert torch.equal(draw(points, 2, key, name), points.draw_2d(key, salt))
        if points.joint:
            assert torch.equal(draw(points, 2, key, name, further=True), points.draw_further(key, salt))


@pytest.mark.parametrize("kind", KERNELS)
@pytest.mark.slow
def test_place_and_threads_do_not_matter(kind):
    key, points = keys(70_003, kind), points_of(kind)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = draw(points, 2, key, NAMES[6])
        for threads in (1, 2):
            torch.set_num_threads(threads)
            for first, size in ((0, 70_003), (0, 1), (1, 3), (5, 1024), (11, 32_769), (70_000, 3)):
                part = draw(points, 2, key[:, first : first + size], NAMES[6])
                assert torch.equal(part, whole[:, first : first + size])
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("kind", list(KINDS))
def test_draws_are_the_kinds(kind):
    key = Sampler(kind, 3, 4, 28).key(torch.arange(999), torch.arange(999) % 7)
    draws, names = Draws(kind, key, salts(2, CPU)), salts(2, CPU)
    roulette, bsdf = int(Dimension.ROULETTE), int(Dimension.BSDF)
    assert torch.equal(draws.one(Dimension.ROULETTE), points_of(kind).draw_1d(key, names[roulette]))
    assert torch.equal(draws.two(Dimension.BSDF), points_of(kind).draw_2d(key, names[bsdf]))
    light = points_of(kind).draw_2d(key, names[int(Dimension.LIGHT)])
    if points_of(kind).joint:  # the direction that led from the first vertex to the second
        light = points_of(kind).draw_further(key, salts(1, CPU)[bsdf])
    assert torch.equal(draws.two(Dimension.LIGHT), light)
