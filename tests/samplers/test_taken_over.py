"""What the lane compiler makes of samplers gives the bits of the tensor form, wherever a lane stands and on any threads."""

from __future__ import annotations

import pytest
import torch
from few import few

import torchpt.engines  # noqa: F401  (registers)
from torchpt.compiler.function import Lanewise
from torchpt.physics import samplers
from torchpt.physics.samplers import KINDS, Dimension, Draws, Sampler, points_of, salts

CPU = torch.device("cpu")
DRAWS = {"draw_1d": samplers.draw_1d, "draw_2d": samplers.draw_2d, "draw_further": samplers.draw_further}
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


def drawn(name: str, kind: str, key: torch.Tensor, salt: torch.Tensor) -> torch.Tensor:
    """By the kernel, which takes any number of lanes but none."""
    (kernel,) = (other for other in DRAWS[name].implementations if isinstance(other, Lanewise))
    found = kernel(points_of(kind), key, salt)
    assert not kernel.refused
    assert (found is NotImplemented) == (key.shape[1] == 0)
    return DRAWS[name](points_of(kind), key, salt) if found is NotImplemented else found


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("n", few([0, 1, 3, 1023, 1025, 70_003], 3))
def test_bits_are_those_of_the_tensor_form(kind, n):
    key, points = keys(n, kind), points_of(kind)
    for name in NAMES if n < 2000 else NAMES[:: len(NAMES) // 3]:
        salt = torch.tensor(name, dtype=torch.int32)
        assert torch.equal(drawn("draw_1d", kind, key, salt), points.draw_1d(key, salt))
        assert torch.equal(drawn("draw_2d", kind, key, salt), points.draw_2d(key, salt))
        if points.joint:
            assert torch.equal(drawn("draw_further", kind, key, salt), points.draw_further(key, salt))


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.slow
def test_place_and_threads_do_not_matter(kind):
    key, salt = keys(200_003, kind), torch.tensor(NAMES[6], dtype=torch.int32)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = drawn("draw_2d", kind, key, salt)
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            for first, size in ((0, 200_003), (0, 1), (1, 3), (5, 1024), (11, 132_769), (200_000, 3)):
                part = drawn("draw_2d", kind, key[:, first : first + size], salt)
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
