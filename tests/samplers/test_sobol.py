"""The Sobol' sampler: nets, stratification, padded dimensions, scrambling, and the error that it saves."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
import torch
from trials import SIGNIFICANCE, film_of, grid_cells, shoot, uniform_p

import torchpt
from torchpt.physics.samplers import Dimension, Draws, Sampler, points_of, salts
from torchpt.physics.samplers import bits as scrambling

CPU = torch.device("cpu")
sobol = points_of("sobol")


def points(number: int, seed: int = 0, pixel: int = 0, depth: int = 1, dimension: Dimension = Dimension.BSDF):
    """``(2, number)`` points of one pixel."""
    key = Sampler("sobol", seed).key(torch.full((number,), pixel), torch.arange(number))
    return Draws("sobol", key, salts(depth, CPU)).two(dimension)


@pytest.mark.parametrize("seed", [0, 1, 77])
@pytest.mark.parametrize("dimension", [Dimension.BSDF, Dimension.LIGHT])
def test_it_is_a_net_in_all_elementary_intervals(seed, dimension):
    """A (0, m, 2)-net: each interval of area 2^-m with sides of powers of two holds exactly one of 2^m points."""
    for power in range(13):
        u = points(1 << power, seed, pixel=seed * 31 + 5, dimension=dimension).double()
        for k in range(power + 1):
            column = (u[0] * (1 << k)).long()
            row = (u[1] * (1 << (power - k))).long()
            cells = column * (1 << (power - k)) + row
            assert torch.equal(cells.sort().values, torch.arange(1 << power)), (power, k)


@pytest.mark.parametrize("digits", range(7))
@pytest.mark.parametrize("depth", [1, 2, 5])
def test_light_is_stratified_with_what_led_there(digits, depth):
    """A (0, m, 4)-net in base 4, of the light's numbers and those of the pixel or of the direction before."""
    n, first = 1 << 2 * digits, (1 << 2 * digits) * 3  # any aligned part of the sequence
    led = Dimension.PIXEL, 0
    if depth > 1:
        led = Dimension.BSDF, depth - 1
    before = points(first + n, 5, 12, led[1], led[0])
    u = torch.cat((before, points(first + n, 5, 12, depth, Dimension.LIGHT)))[:, first:].double()
    for sides in itertools.product(range(digits + 1), repeat=4):
        if sum(sides) == digits:
            cell = torch.zeros(n, dtype=torch.int64)
            for axis, side in zip(u, sides, strict=True):
                cell = cell * 4**side + (axis * 4**side).long()
            assert torch.equal(cell.sort().values, torch.arange(n)), sides


def test_third_and_fourth_coordinates_are_niederreiters():
    """Over the field of four elements: row i, column j of the generator of ``a`` is ``C(j, i) a^(j - i)``."""
    product = [[0, 0, 0, 0], [0, 1, 2, 3], [0, 2, 3, 1], [0, 3, 1, 2]]  # 2 is w, 3 is w + 1 = w²

    def coordinate(index: int, a: int) -> int:
        digits, found = [index >> 2 * j & 3 for j in range(16)], 0
        for i in range(16):
            total = 0
            for j in range(i, 16):
                power = 1
                for _ in range(j - i):
                    power = product[power][a]
                total ^= product[digits[j]][power] if math.comb(j, i) % 2 else 0
            found |= total << 2 * i
        return found

    # W of the code turns (low, high) into (high, low + high): the digit is low + high w, and so is its multiplication.
    index = [*range(300), 12_345_678, 2**31 - 1]
    lanes = torch.tensor(index, dtype=torch.int64).to(torch.int32)
    third, fourth = (f(lanes).tolist() for f in (scrambling.third_dimension, scrambling.fourth_dimension))
    assert [x & 0xFFFFFFFF for x in third] == [coordinate(i, 2) for i in index]
    bits = [coordinate(i, 3) for i in index]
    assert [x & 0xFFFFFFFF for x in fourth] == [x ^ (x >> 1 & 0x55555555) for x in bits]


@pytest.mark.parametrize("power", [1, 4, 7, 10])
def test_every_aligned_block_of_the_sequence_is_a_net(power):
    u = points(1 << 12, 3).double()
    for first in range(0, 1 << 12, 1 << power):
        block = u[:, first : first + (1 << power)]
        for axis in block:
            assert torch.equal((axis * (1 << power)).long().sort().values, torch.arange(1 << power))


@pytest.mark.parametrize("power", [3, 8, 14])
def test_one_dimension_is_stratified(power):
    n = 1 << power
    key = Sampler("sobol", 4).key(torch.full((n,), 9), torch.arange(n))
    u = sobol.draw_1d(key, salts(2, CPU)[int(Dimension.ROULETTE)]).double()
    assert torch.equal((u * n).long().sort().values, torch.arange(n))


def test_the_second_coordinate_is_sobols():
    """Against the direction numbers v_j = v_(j-1) ^ (v_(j-1) >> 1) of the polynomial x + 1 (Joe and Kuo, 2008)."""
    direction = [1 << 31]
    for _ in range(31):
        direction.append(direction[-1] ^ (direction[-1] >> 1))
    index = torch.cat((torch.arange(2000), torch.tensor([2**20 + 12_345, 2**31 - 1])))
    expected = []
    for i in index.tolist():
        y = 0
        for bit in range(32):
            y ^= direction[bit] if i >> bit & 1 else 0
        expected.append(y)
    found = scrambling.reverse_bits(scrambling.second_dimension(index.to(torch.int32)))
    assert [x & 0xFFFFFFFF for x in found.tolist()] == expected


def test_reversing_bits_twice_is_the_identity():
    x = torch.randint(-(2**31), 2**31, (10_000,), generator=torch.Generator().manual_seed(0)).to(torch.int32)
    assert torch.equal(scrambling.reverse_bits(scrambling.reverse_bits(x)), x)
    assert scrambling.reverse_bits(torch.tensor([1, 2, 6], dtype=torch.int32)).tolist() == [-(2**31), 2**30, 0x60000000]


def test_scrambling_is_a_bijection_that_keeps_prefixes():
    seed = torch.tensor(12345, dtype=torch.int32)
    x = torch.arange(1 << 16, dtype=torch.int32)
    y = scrambling.scramble(x, seed)
    for bits in (1, 5, 11, 16):  # on bit-reversed numbers: a value's low bits depend on the low bits alone
        mask = (1 << bits) - 1
        assert len(torch.unique(((x & mask).long() << 16) | (y & mask))) == 1 << bits


def test_each_bit_of_the_scramble_is_flipped_half_the_time():
    n = 1 << 14
    seeds = Sampler("independent", 1).key(torch.arange(n), torch.zeros(n, dtype=torch.int64))[0]
    flips = scrambling.scramble(torch.zeros(n, dtype=torch.int32), seeds)
    share = torch.stack([((flips >> bit) & 1).double().mean() for bit in range(32)])
    # 32 binomial shares; bits below are the value's leading ones. 4.2 sigma bounds all at 1e-3.
    assert (share - 0.5).abs().max() < 4.2 * 0.5 / n**0.5


@pytest.mark.parametrize("power", [4, 8])
def test_padded_dimensions_are_decorrelated(power):
    """Points of two dimensions of the same pixels, paired: uniform over the square, and free of serial correlation."""
    n, pixels = 1 << power, 4096 >> (power - 4)
    pixel = torch.arange(pixels).repeat_interleave(n)
    key = Sampler("sobol", 21).key(pixel, torch.arange(n).repeat(pixels))
    drawn = [
        Draws("sobol", key, salts(depth, CPU)).two(d)[axis]
        for depth, d, axis in (
            (1, Dimension.BSDF, 0),
            (1, Dimension.LIGHT, 0),
            (1, Dimension.LIGHT, 1),
            (2, Dimension.BSDF, 0),
            (2, Dimension.LIGHT, 1),
            (5, Dimension.BSDF, 1),
        )
    ]
    for depth, d in ((1, Dimension.ROULETTE), (2, Dimension.ROULETTE), (1, Dimension.LIGHT_DIGITS)):
        drawn.append(sobol.draw_1d(key, salts(depth, CPU)[int(d)]))
    pairs = [(a, b) for a in range(len(drawn)) for b in range(a)]
    pairs.remove((2, 1))  # the two axes of one dimension are a net by design
    for a, b in pairs:
        together = torch.stack((drawn[a], drawn[b])).double() - 0.5
        # Each margin is stratified within a pixel, so only the correlation is a fair sum; its deviate is normal.
        r = float((together[0] * together[1]).mean() * 12 * (n * pixels) ** 0.5)
        assert abs(r) < 4.5, (
            a,
            b,
        )  # 34 comparisons, 2 sizes: 1e-3 in all is 4.3, and estimated variances are a little off
        # One point a pixel: pixels are independent, so cells are counted as chi-square has it.
        cells = grid_cells(together[:, :: n + 1 if n < pixels else n] + 0.5, 8)
        assert uniform_p(cells, 64) > SIGNIFICANCE / len(pairs), (a, b)


def test_pixels_have_sequences_of_their_own():
    pixels = 1 << 14
    key = Sampler("sobol", 2).key(torch.arange(pixels), torch.full((pixels,), 3))
    u = sobol.draw_2d(key, salts(0, CPU)[0])
    assert uniform_p(grid_cells(u, 16), 256) > SIGNIFICANCE / 3
    for axis in u.double() - 0.5:  # neighbours
        assert abs(float((axis[1:] * axis[:-1]).mean() * 12 * pixels**0.5)) < 3.6


def test_first_samples_of_seeds_and_randomizations_are_independent():
    u = []
    for seed in range(64):
        key = Sampler("sobol", seed, 4).key(torch.arange(64).repeat(4), torch.arange(4).repeat_interleave(64))
        u.append(sobol.draw_2d(key, salts(1, CPU)[5]).view(2, 4, 64))
    drawn = torch.stack(u, 1).double()  # (2, seeds, randomizations, pixels)
    assert uniform_p(grid_cells(drawn.reshape(2, -1).float(), 16), 256) > SIGNIFICANCE / 3
    centred = drawn - 0.5
    for a, b in ((0, 1), (0, 3), (2, 3)):
        r = (centred[:, :, a] * centred[:, :, b]).mean((1, 2)) * 12 * 4096**0.5
        assert r.abs().max() < 4.2
    r = (centred[:, 1:] * centred[:, :-1]).mean((1, 2, 3)) * 12 * (63 * 256) ** 0.5
    assert r.abs().max() < 4.2


def test_golden_values():
    """A change of these is a change of every picture."""
    key = Sampler("sobol", 7, 4).key(torch.tensor([0, 1, 4095]), torch.tensor([0, 5, 1023]))
    assert key.tolist() == GOLDEN_KEY
    salt = salts(2, CPU)
    assert sobol.draw_1d(key, salt[6]).tolist() == GOLDEN_1D
    assert sobol.draw_2d(key, salt[5]).tolist() == GOLDEN_2D
    assert sobol.draw_further(key, salt[5]).tolist() == GOLDEN_FURTHER


GOLDEN_KEY = [[-243300574, -802353018, -1162944142], [0, 1, 255]]
GOLDEN_1D = [0.4664114713668823, 0.6570622324943542, 0.32438111305236816]
GOLDEN_2D = [
    [0.10253113508224487, 0.9393109083175659, 0.5581554174423218],
    [0.4157901406288147, 0.2794380784034729, 0.1803293228149414],
]
GOLDEN_FURTHER = [
    [0.8844265937805176, 0.5105987191200256, 0.6316094398498535],
    [0.4383094906806946, 0.6402947902679443, 0.4410426616668701],
]


@pytest.mark.slow
def test_sobol_saves_error_on_the_cornell_box():
    """relMSE at 64 spp, box filter, 8 seeds, against Mitsuba's reference whose own variance is taken off: <= 0.60x."""
    layers = torchpt.read_layers(Path(__file__).parent.parent / "references" / "cornell_box.exr")
    truth, noise = layers["image"].double(), layers["variance"].double()
    scene = torchpt.load("cornell_box", device="cpu")

    def error(sampler: str) -> float:
        total = 0.0
        for seed in range(8):
            image = shoot(scene, 64, seed, sampler, {"max_depth": 8}, film_of(64)).image.double()
            total += float((((image - truth) ** 2 - noise) / (truth**2 + 1e-2)).mean())
        return total / 8

    assert error("sobol") <= 0.60 * error("independent")
