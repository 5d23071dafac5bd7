"""Independent numbers by hashing: uniform, uncorrelated over samples, pixels, dimensions, seeds; and below one."""

from __future__ import annotations

import pytest
import torch
from trials import SIGNIFICANCE, grid_cells, uniform_p

from torchpt.math.hashing import logical_shift, mix, mix_int, to_unit
from torchpt.physics.samplers import KINDS, Dimension, Sampler, points_of, salts

CPU = torch.device("cpu")
independent = points_of("independent")
TESTS = 24  # comparisons in this file, each at SIGNIFICANCE / TESTS


def lanes(pixels: int, samples: int, seed: int = 0, randomizations: int = 1) -> torch.Tensor:
    pixel = torch.arange(pixels).repeat_interleave(samples)
    return Sampler("independent", seed, randomizations).key(pixel, torch.arange(samples).repeat(pixels))


@pytest.mark.parametrize(("pixels", "samples"), [(1, 1 << 18), (1 << 18, 1), (1 << 9, 1 << 9)])
def test_uniform_in_one_and_two_dimensions(pixels, samples):
    key, salt = lanes(pixels, samples), salts(1, CPU)
    one = independent.draw_1d(key, salt[int(Dimension.ROULETTE)])
    two = independent.draw_2d(key, salt[int(Dimension.BSDF)])
    assert uniform_p(grid_cells(one[None], 1024), 1024) > SIGNIFICANCE / TESTS
    assert uniform_p(grid_cells(two, 32), 1024) > SIGNIFICANCE / TESTS


def test_successive_numbers_are_uncorrelated():
    u = independent.draw_1d(lanes(512, 512), salts(1, CPU)[6]).view(512, 512).double()
    pairs = {
        "samples": (u[:, :-1], u[:, 1:]),
        "samples two apart": (u[:, :-2], u[:, 2:]),
        "pixels": (u[:-1], u[1:]),
        "pixels a power of two apart": (u[:-256], u[256:]),
        "diagonal": (u[:-1, :-1], u[1:, 1:]),
    }
    for name, (a, b) in pairs.items():
        cells = grid_cells(torch.stack((a.reshape(-1), b.reshape(-1)))[:, ::2], 16)
        assert uniform_p(cells, 256) > SIGNIFICANCE / TESTS, name
        deviate = float(((a - 0.5) * (b - 0.5)).mean()) * 12 * a.numel() ** 0.5
        assert abs(deviate) < 4.2, name


def test_dimensions_depths_seeds_and_randomizations_are_uncorrelated():
    n = 1 << 16
    key = lanes(n, 1)
    drawn = [independent.draw_1d(key, salts(depth, CPU)[d]) for depth, d in ((0, 0), (1, 2), (1, 4), (1, 6), (2, 6))]
    drawn += [independent.draw_1d(lanes(n, 1, seed), salts(0, CPU)[0]) for seed in (1, 2**31, 2**32, 2**63 - 1)]
    drawn.append(independent.draw_2d(key, salts(1, CPU)[3])[1])
    drawn.append(independent.draw_1d(lanes(n >> 1, 2, 0, 2), salts(0, CPU)[0]))
    centred = torch.stack(drawn).double() - 0.5
    correlation = centred @ centred.T * 12 / n**0.5
    correlation.fill_diagonal_(0)
    assert correlation.abs().max() < 4.6  # 55 pairs: 4.4 at 1e-3


def test_every_stream_has_a_name_of_its_own():
    names = torch.stack([salts(depth, CPU) for depth in range(5000)])
    led = names[:, int(Dimension.PREVIOUS_DIRECTION)].tolist()
    assert led[1] == names[0, int(Dimension.PIXEL)] and led[2:] == names[1:-1, int(Dimension.BSDF)].tolist()
    own = names[:, [int(d) for d in Dimension if d is not Dimension.PREVIOUS_DIRECTION]]
    assert len(torch.unique(own)) == own.numel()


@pytest.mark.parametrize("kind", list(KINDS))
def test_numbers_lie_in_zero_to_below_one(kind):
    pixel = torch.arange(1 << 8).repeat_interleave(1 << 8)
    key = Sampler(kind, 0, 1, 1 << 8, 16).key(pixel, torch.arange(1 << 8).repeat(1 << 8))
    one = points_of(kind).draw_1d(key, salts(3, CPU)[6])
    two = points_of(kind).draw_2d(key, salts(3, CPU)[5])
    for u in (one, two):
        assert u.dtype == torch.float32
        assert u.min() >= 0
        assert u.max() <= 1 - 2**-24
        for n in (3, 7, 1000, 2**16):  # an index into n things stays below n
            assert int((u * n).long().max()) < n


def test_the_largest_number_is_below_one():
    words = torch.tensor([-1, 0, 255, 256, 2**31 - 1, -(2**31)], dtype=torch.int32)
    assert to_unit(words).tolist() == [1 - 2**-24, 0.0, 0.0, 2**-24, 0.5 - 2**-24, 0.5]


def test_the_hash_of_integers_is_that_of_lanes():
    x = torch.cat((torch.arange(-5000, 5000), torch.tensor([2**31 - 1, -(2**31)]))).to(torch.int32)
    assert mix(x).tolist() == [mix_int(i) for i in x.tolist()]
    assert len(torch.unique(mix(torch.arange(1 << 20, dtype=torch.int32)))) == 1 << 20
    assert logical_shift(torch.tensor([-1], dtype=torch.int32), 31).tolist() == [1]


def test_the_hash_avalanches():
    """Flipping any input bit flips each output bit half the time (to 2 %, Wellons' measured bias is 0.2 %)."""
    x = mix(torch.arange(1 << 14, dtype=torch.int32))
    for bit in range(32):
        flipped = mix(x) ^ mix(x ^ (1 << bit if bit < 31 else -(2**31)))
        share = torch.stack([((flipped >> k) & 1).double().mean() for k in range(32)])
        assert (share - 0.5).abs().max() < 0.025


def test_keys_of_pixels_never_collide():
    """Of so many at random 32 pairs would."""
    for seed in (0, 12345):
        keys = Sampler("sobol", seed).key(torch.arange(1 << 19), torch.zeros(1 << 19, dtype=torch.int64))
        assert len(torch.unique(keys[0])) == 1 << 19


def test_golden_values():
    key = Sampler("independent", 7, 4).key(torch.tensor([0, 1, 4095]), torch.tensor([0, 5, 1023]))
    salt = salts(2, CPU)
    assert independent.draw_1d(key, salt[6]).tolist() == [0.25919538736343384, 0.06587833166122437, 0.7398347854614258]
    assert independent.draw_2d(key, salt[5]).tolist() == [
        [0.9896961450576782, 0.4407835602760315, 0.849068284034729],
        [0.8941990733146667, 0.5070334672927856, 0.6855378746986389],
    ]
