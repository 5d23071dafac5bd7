"""Pilots: one pixel of each block, by the seed and the film alone."""

from __future__ import annotations

import pytest
import torch

from torchpt.physics.film import Pilots, pilots_of


def at(pilots: Pilots, width: int) -> set[tuple[int, int]]:
    return {(int(p) % width, int(p) // width) for p in pilots.pixels}


@pytest.mark.parametrize("film", [(16, 8), (13, 7), (3, 2), (1, 1), (4, 1)])
def test_one_a_block(film):
    width, height = film
    pilots = pilots_of(7, film, (0, 0, width, height))
    blocks = {(x // 4, y // 4) for x, y in at(pilots, width)}
    assert len(blocks) == len(pilots) == -(-width // 4) * -(-height // 4)
    assert float(pilots.pixels_of_block.sum()) == width * height
    for place, row, column in zip(pilots.pixels.tolist(), *pilots.block.tolist(), strict=True):
        assert (place // width // 4, place % width // 4) == (row, column)


def test_every_pixel_is_as_likely():
    counts = torch.zeros(7 * 9)
    for seed in range(800):
        counts[pilots_of(seed, (7, 9), (0, 0, 7, 9)).pixels] += 1
    sizes = torch.tensor([[(4 if x < 4 else 3) * (4 if y < 8 else 1) for x in range(7)] for y in range(9)]).reshape(-1)
    expected = 800 / sizes
    z = (counts - expected) / (expected * (1 - 1 / sizes)).sqrt()
    assert float(z.abs().max()) < 4.5 and float(z.square().mean()) == pytest.approx(1.0, abs=0.6)


def test_a_crop_has_those_of_the_film():
    whole = at(pilots_of(3, (30, 21), (0, 0, 30, 21)), 30)
    x, y, width, height = 5, 3, 14, 10
    part = at(pilots_of(3, (30, 21), (x, y, width, height)), width)
    assert part == {(a - x, b - y) for a, b in whole if x <= a < x + width and y <= b < y + height}
    assert len(part) > 5


def test_seeds_differ():
    one, other, large = (pilots_of(seed, (64, 64), (0, 0, 64, 64)).pixels for seed in (1, 2, 1 + 2**32))
    assert not torch.equal(one, other) and not torch.equal(one, large)
    assert float((one == other).double().mean()) == pytest.approx(1 / 16, abs=0.06)
