"""What every kind of sampler must do, of each in the table."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch
from outside import values_outside
from torch import Tensor
from trials import SIGNIFICANCE, grid_cells, uniform_p, z_limit

from torchpt.core.errors import SceneError
from torchpt.physics.samplers import ADAPTIVE, KINDS, Dimension, Draws, Sampler, points_of, salts
from torchpt.spec import parameters_of
from torchpt.spec.schema import read_typed

CPU = torch.device("cpu")
PIXELS, COUNT, WIDTH = 1 << 12, 16, 64
#: Deal one sequence out over the film, so that the numbers of neighbours are apart on purpose.
TOGETHER = ("zsobol",)
SETS = [(0, Dimension.PIXEL), (1, Dimension.BSDF), (1, Dimension.LIGHT), (2, Dimension.BSDF)]
LINES = [(1, Dimension.ROULETTE), (1, Dimension.LOBE), (2, Dimension.ROULETTE)]
KIND = pytest.mark.parametrize("kind", list(KINDS))


def keys(kind: str, seed: int = 3, randomizations: int = 1) -> Tensor:
    """Of all samples of each pixel, pixel by pixel."""
    pixel = torch.arange(PIXELS).repeat_interleave(COUNT)
    return Sampler(kind, seed, randomizations, COUNT, WIDTH).key(pixel, torch.arange(COUNT).repeat(PIXELS))


def drawn(kind: str, key: Tensor) -> Tensor:
    """``(rows, N)``: of some sets of one and of two dimensions, through what stages call."""
    two = [Draws(kind, key, salts(depth, CPU)).two(name) for depth, name in SETS]
    return torch.cat((*two, *(Draws(kind, key, salts(depth, CPU)).one(name)[None] for depth, name in LINES)))


@KIND
def test_what_is_declared(kind):
    parameters = parameters_of(KINDS[kind])
    assert set(parameters) - set(ADAPTIVE) == {field.name for field in fields(KINDS[kind])}
    assert (set(ADAPTIVE) <= set(parameters)) != KINDS[kind].needs_count
    for key, spec in parameters.items():
        assert spec.doc, key
        for value in values_outside(spec):
            with pytest.raises(SceneError, match=rf"sampler\.{key}"):
                read_typed("sampler", KINDS, {"type": kind, key: value}, "sampler", None)
    values = read_typed("sampler", KINDS, {"type": kind}, "sampler", None).values
    assert points_of(kind) == KINDS[kind](**{key: value for key, value in values.items() if key not in ADAPTIVE})
    if KINDS[kind].needs_count:
        with pytest.raises(ValueError, match="must know their number"):
            Sampler(kind, 0, 2, 1)


@KIND
def test_numbers_are_multiples_of_one_step_below_one(kind):
    key = keys(kind)
    assert key.shape == (KINDS[kind].rows, PIXELS * COUNT) and key.dtype == torch.int32
    u = drawn(kind, key)
    assert u.shape == (2 * len(SETS) + len(LINES), PIXELS * COUNT) and u.dtype == torch.float32
    assert float(u.min()) >= 0 and float(u.max()) <= 1 - 2**-24
    assert torch.equal((u * 2**24).round(), u * 2**24)


@KIND
def test_uniform_in_each_set_of_dimensions(kind):
    # One point a pixel, each of another index: as even as chance at least.
    place = torch.arange(PIXELS) * COUNT + torch.arange(PIXELS) % COUNT
    u = drawn(kind, keys(kind))[:, place]
    several = 3 * (len(SETS) + len(LINES)) * len(KINDS)
    for row in range(len(SETS)):
        assert uniform_p(grid_cells(u[2 * row : 2 * row + 2], 16), 256) > SIGNIFICANCE / several, SETS[row]
    for row in u:
        assert uniform_p(grid_cells(row[None], 64), 64) > SIGNIFICANCE / several
    # And all points of all pixels, where each pixel's own are evened out.
    every = drawn(kind, keys(kind))
    for row in every.double():
        assert abs(float(row.mean()) - 0.5) < z_limit(several) / (12 * row.numel()) ** 0.5


@KIND
def test_a_number_does_not_depend_on_the_others(kind):
    key = keys(kind)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = drawn(kind, key)
        order = torch.randperm(key.shape[1], generator=torch.Generator().manual_seed(1))[:20_000]
        assert torch.equal(drawn(kind, key[:, order]), whole[:, order])
        parts = (5, 1), (1023, 2), (31_111, 20_001)
        for threads, those in ((1, parts), (2, ((0, PIXELS * COUNT), *parts))):
            torch.set_num_threads(threads)
            for first, size in those:
                assert torch.equal(drawn(kind, key[:, first : first + size]), whole[:, first : first + size])
    finally:
        torch.set_num_threads(before)
    # Nor a key on those that are made with it.
    some = torch.tensor([7, 5 * COUNT + 3, PIXELS * COUNT - 1])
    alone = Sampler(kind, 3, 1, COUNT, WIDTH).key(some // COUNT, some % COUNT)
    assert torch.equal(alone, key[:, some])


@KIND
def test_sets_of_dimensions_are_uncorrelated(kind):
    centred = drawn(kind, keys(kind)).double() - 0.5
    correlation = centred @ centred.T * 12 / centred.shape[1] ** 0.5
    correlation.fill_diagonal_(0)
    for row in range(0, 2 * len(SETS), 2):  # of one set the two axes may be a net together
        correlation[row, row + 1] = correlation[row + 1, row] = 0
    assert float(correlation.abs().max()) < 1.05 * z_limit(55 * len(KINDS))


@KIND
def test_pixels_seeds_and_randomizations_are_uncorrelated(kind):
    rows = []
    for seed in (0, 1, 2**40):
        u = Draws(kind, keys(kind, seed, 2), salts(1, CPU)).two(Dimension.BSDF)[1].double().view(PIXELS, COUNT) - 0.5
        rows += [u[:, ::2].reshape(-1), u[:, 1::2].reshape(-1)]
        if kind not in TOGETHER:
            rows += [u.roll(1, 0)[:, ::2].reshape(-1), u.roll(WIDTH, 0)[:, ::2].reshape(-1)]
    centred = torch.stack(rows)
    correlation = centred @ centred.T * 12 / centred.shape[1] ** 0.5
    correlation.fill_diagonal_(0)
    assert float(correlation.abs().max()) < 1.05 * z_limit(66 * len(KINDS))
