"""The samplers that know their number of points: strata, nets, padding, blue noise."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from trials import SIGNIFICANCE, film_of, grid_cells, shoot, uniform_p, z_limit

import torchpt
from torchpt.core.errors import NotBuiltError, SceneError
from torchpt.physics.samplers import KINDS, Dimension, Sampler, points_of, salts
from torchpt.physics.samplers.bits import shuffle
from torchpt.physics.samplers.kinds import zsobol
from torchpt.scene.formats.description import read_description, settings

CPU = torch.device("cpu")
COUNTED = [name for name, kind in KINDS.items() if kind.needs_count]
SETS = [(1, Dimension.BSDF), (1, Dimension.LIGHT), (2, Dimension.BSDF), (7, Dimension.LIGHT)]
LINES = [(1, Dimension.ROULETTE), (1, Dimension.LOBE), (5, Dimension.ROULETTE)]


def keys(kind: str, pixels: int, count: int, seed: int = 0, randomizations: int = 1, width: int = 64) -> Tensor:
    """Of all samples of each pixel, pixel by pixel."""
    pixel = torch.arange(pixels).repeat_interleave(count)
    return Sampler(kind, seed, randomizations, count, width).key(pixel, torch.arange(count).repeat(pixels))


def one(kind: str, key: Tensor, name: tuple[int, Dimension]) -> Tensor:
    return points_of(kind).draw_1d(key, salts(name[0], CPU)[int(name[1])])


def two(kind: str, key: Tensor, name: tuple[int, Dimension]) -> Tensor:
    return points_of(kind).draw_2d(key, salts(name[0], CPU)[int(name[1])])


# --- Strata


def one_in_each(u: Tensor, count: int) -> bool:
    """Return True where each of ``count`` equal intervals holds one of as many numbers, which are cut to 24 bits."""
    level, k = (u.double() * 2**24).long().sort(-1).values, torch.arange(count)
    return bool(((level >= (k << 24) // count) & (level * count < (k + 1) << 24)).all())


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 31, 32, 97, 100, 1000, 1024])
@pytest.mark.parametrize("kind", ["stratified", "hammersley"])
def test_each_of_n_intervals_holds_one_point(kind, count):
    key = keys(kind, 16, count)
    lines = [one(kind, key, name) for name in LINES]
    if kind == "hammersley":
        lines += [two(kind, key, name)[0] for name in SETS]
    for u in lines:
        assert one_in_each(u.view(16, count), count)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 31, 32, 97, 100, 1000, 1024])
def test_each_of_n_equal_cells_holds_one_point(count):
    columns = int(count**0.5 + 0.5)
    first = [c * count // columns for c in range(columns + 1)]
    assert all(0.4 <= (first[c + 1] - first[c]) / columns <= 2.0 for c in range(columns))  # nearly square
    key = keys("stratified", 8, count)
    for name in SETS:
        x, y = two("stratified", key, name).view(2, 8, count)
        order = x.argsort(1)
        x, y = x.gather(1, order).double(), y.gather(1, order)
        for c in range(columns):  # sorted by x, each column's points come in a run
            a, b = first[c], first[c + 1]
            assert bool((x[:, a] >= (a << 24) // count / 2**24).all() and (x[:, b - 1] < b / count).all())
            assert one_in_each(y[:, a:b], b - a)


@pytest.mark.parametrize("power", [0, 1, 4, 7, 10])
def test_hammersley_points_are_a_net(power):
    """Each interval of area 2^-m with sides of powers of two holds exactly one of 2^m points."""
    for u in two("hammersley", keys("hammersley", 4, 1 << power, 5), SETS[0]).double().view(2, 4, -1).unbind(1):
        for k in range(power + 1):
            cells = (u[0] * (1 << k)).long() * (1 << (power - k)) + (u[1] * (1 << (power - k))).long()
            assert torch.equal(cells.sort().values, torch.arange(1 << power)), k


@pytest.mark.parametrize(("count", "side"), [(1, 16), (2, 8), (4, 8), (5, 8), (8, 4)])
def test_zsobol_spreads_each_square_of_pixels_over_the_square(count, side):
    """Aligned 2^k x 2^k pixels hold as many points of a (0, 2)-sequence: a net, so each elementary interval has one."""
    kind, rounded = "zsobol", 1 << (count - 1).bit_length()
    width = 64
    x, y = torch.arange(side).repeat(side), torch.arange(side).repeat_interleave(side)
    for x0, y0 in ((0, 0), (side, 0), (2 * side, 3 * side)):
        pixel = ((y + y0) * width + x + x0).repeat_interleave(rounded)
        sample = torch.arange(rounded).repeat(side * side)
        key = Sampler(kind, 3, 1, count, width).key(pixel, sample)
        total = side * side * rounded
        power = total.bit_length() - 1
        for name in SETS[:2]:
            u = two(kind, key, name).double()
            for k in range(power + 1):
                cells = (u[0] * (1 << k)).long() * (1 << (power - k)) + (u[1] * (1 << (power - k))).long()
                assert torch.equal(cells.sort().values, torch.arange(total)), k
        u = one(kind, key, LINES[0]).double()
        assert torch.equal((u * total).long().sort().values, torch.arange(total))


def test_places_on_the_curve_are_permuted_within_their_digits():
    """A bijection that keeps squares together; each of the 24 orders of the lowest four comes up as often as the others."""
    for odd in (0, 1):
        n = 1 << (12 + odd)
        words = torch.arange(n)
        place = ((words << (1 - odd)) - (odd << 31)).to(torch.int32)
        index = zsobol._index(place, torch.full((n,), 12345, dtype=torch.int32)).long()
        assert torch.equal((index % n).sort().values, words) and len((index // n).unique()) == 1
        for shift in (3, 7) if odd else (2, 6):  # those that share high digits do so afterwards
            low, high = (index >> shift).view(-1, 1 << shift).aminmax(dim=1)
            assert torch.equal(low, high)
    states = Sampler("independent", 1).key(torch.arange(1 << 14), torch.zeros(1 << 14, dtype=torch.int64))[0]
    # The hash of all digits above differs from state to state.
    orders = torch.stack([zsobol._index(torch.full_like(states, 2 * k), states) & 3 for k in range(4)])
    code = orders[0] * 64 + orders[1] * 16 + orders[2] * 4 + orders[3]
    kinds, counts = code.unique(return_counts=True)
    assert len(kinds) == 24
    assert uniform_p(torch.arange(24).repeat_interleave(counts), 24) > SIGNIFICANCE


# --- Shuffles


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 17, 64, 1000, 65_537])
def test_a_shuffle_is_a_bijection(count):
    for seed in (0, 1, -7):
        place = shuffle(*(torch.full((count,), x, dtype=torch.int32).clone() for x in (0, count, seed)))
        assert len(place.unique()) == 1
        place = shuffle(
            torch.arange(count, dtype=torch.int32),
            torch.full((count,), count, dtype=torch.int32),
            torch.full((count,), seed, dtype=torch.int32),
        )
        assert torch.equal(place.sort().values, torch.arange(count, dtype=torch.int32))


def test_shuffles_place_any_one_and_any_two_evenly():
    n = 1 << 16
    seed = Sampler("independent", 3).key(torch.arange(n), torch.zeros(n, dtype=torch.int64))[0]
    for count in (4, 9):
        number = torch.full((n,), count, dtype=torch.int32)
        a, b = (shuffle(torch.full_like(number, i), number, seed).long() for i in (0, 1))
        assert uniform_p(a, count) > SIGNIFICANCE / 4
        # The pair: the last rounds leave some 2^-ROUNDS of the order, which this many cannot tell from chance.
        pairs = a * (count - 1) + b - (b > a).long()
        assert uniform_p(pairs[: n // 4], count * (count - 1)) > SIGNIFICANCE / 4


# --- Independence


@pytest.mark.parametrize("kind", COUNTED)
@pytest.mark.parametrize(("pixels", "count"), [(1 << 12, 16), (1 << 15, 2), (1 << 6, 1 << 10)])
def test_uniform_in_one_and_two_dimensions(kind, pixels, count):
    # One point a pixel, so that points are independent (of zsobol they are not: more even than chance, never less).
    key = keys(kind, pixels, count, 9, width=1 << 8)
    place = torch.arange(pixels) * count + torch.arange(pixels) % count
    u, v = two(kind, key, SETS[0]), one(kind, key, LINES[0])
    if kind == "zsobol":
        for cells, number in ((grid_cells(u, 16), 256), (grid_cells(v[None], 256), 256)):
            counts = torch.bincount(cells, minlength=number).double()
            assert float((counts - counts.mean()).abs().max()) <= 1  # a net
        return
    if pixels >= 1 << 12:
        assert uniform_p(grid_cells(u[:, place], 16), 256) > SIGNIFICANCE / 8
        assert uniform_p(grid_cells(v[None, place], 256), 256) > SIGNIFICANCE / 8
    assert float(u.min()) >= 0 and float(u.max()) < 1


@pytest.mark.parametrize("kind", COUNTED)
@pytest.mark.parametrize(("pixels", "count"), [(1 << 10, 16), (1 << 8, 100)])
def test_padded_dimensions_are_uncorrelated(kind, pixels, count):
    key = keys(kind, pixels, count, 21)
    drawn = [two(kind, key, name)[axis] for name in SETS for axis in (0, 1)]
    drawn += [one(kind, key, name) for name in LINES]
    centred = torch.stack(drawn).double() - 0.5
    # Margins are stratified, so the products' sum has no more than the variance of independent ones.
    correlation = centred @ centred.T * 12 / (pixels * count) ** 0.5
    for a in range(0, 2 * len(SETS), 2):
        correlation[a, a + 1] = correlation[a + 1, a] = 0  # the two axes of a set are a net by design
    correlation.fill_diagonal_(0)
    assert float(correlation.abs().max()) < 1.05 * z_limit(6 * 51)


@pytest.mark.parametrize("kind", ["stratified", "hammersley"])
def test_pixels_seeds_and_randomizations_are_uncorrelated(kind):
    pixels, count = 1 << 12, 8
    drawn = []
    for seed in (0, 1, 2**40):
        u = two(kind, keys(kind, pixels, count, seed, 2), SETS[0])[1].double().view(pixels, count) - 0.5
        drawn += [u[:, ::2].reshape(-1), u[:, 1::2].reshape(-1), u.roll(1, 0)[:, ::2].reshape(-1)]
    centred = torch.stack(drawn)
    correlation = centred @ centred.T * 12 / centred.shape[1] ** 0.5
    correlation.fill_diagonal_(0)
    assert float(correlation.abs().max()) < 1.05 * z_limit(2 * 36)


# --- Pictures

SOFT = {
    "camera": {"origin": [0, 2.5, 4], "target": [0, 0.4, 0], "fov": 45},
    "film": {"filter": "box"},
    "integrator": {"type": "direct"},
    "materials": {"grey": {"type": "diffuse", "reflectance": 0.6}},
    "shapes": {
        "floor": {"type": "rectangle", "material": "grey", "transform": [
            {"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 8}]},
        "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7, "material": "grey"},
        "lamp": {"type": "rectangle", "emission": 6, "transform": [
            {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [1, 4, 0]}]},
    },
}  # fmt: skip


@pytest.mark.slow
def test_errors_of_zsobol_are_blue():
    """Blurred over neighbours, its error is far below that of pixels with sequences of their own; alike pixel by pixel."""
    scene, film = torchpt.load(SOFT, device="cpu"), film_of(48)
    truth = shoot(scene, 256, 99, "sobol", {"type": "direct"}, film).image.double()

    def energies(kind: str, spp: int) -> tuple[float, float]:
        plain = blurred = 0.0
        for seed in range(12):
            error = (shoot(scene, spp, seed, kind, {"type": "direct"}, film).image.double() - truth)[..., 0]
            plain += float(error.square().mean())
            blurred += float(torch.nn.functional.avg_pool2d(error[None, None], 4, 1).square().mean())
        return plain, blurred

    for spp, most in ((1, 0.65), (2, 0.75), (4, 0.9)):
        (plain, blurred), (white, white_blurred) = energies("zsobol", spp), energies("sobol", spp)
        assert blurred < most * white_blurred
        assert 0.7 < plain / white < 1.4


@pytest.mark.parametrize("kind", COUNTED)
@pytest.mark.slow
def test_a_picture_is_that_of_independent_numbers(kind):
    scene = torchpt.load(SOFT, device="cpu")
    keys = {"max_depth": 3, "rr_depth": 2}
    ours = [shoot(scene, spp, 3, kind, keys, film_of(24)).image.double().mean() for spp in (5, 64)]
    many = torch.stack([shoot(scene, 64, k, "independent", keys, film_of(24)).image.double().mean() for k in range(6)])
    for found, times in zip(ours, (64 / 5, 1), strict=True):
        # Each errs by no more than independent numbers would; t of five degrees at 1e-3 is 6.9.
        assert abs(float(found - many.mean())) < 6.9 * float(many.std()) * (times + 1 / 6) ** 0.5


# --- What the count is needed for


@pytest.mark.parametrize("kind", COUNTED)
@pytest.mark.parametrize("key", ["time_limit", "target_error"])
def test_only_spp_may_end_such_a_render(kind, key):
    scene = read_description(SOFT)
    with pytest.raises(SceneError, match="points depend on how many there are") as caught:
        settings(scene, {"sampler": kind, "render": {key: 5}})
    assert caught.value.key == f"render.{key}" and "\n" not in str(caught.value)
    assert not isinstance(caught.value, NotBuiltError)
    assert settings(scene, {"sampler": kind, "render": {key: None}}).sampler.kind.needs_count
    with pytest.raises(ValueError, match="must know their number"):
        Sampler(kind, 0, 2, 1)


GOLDEN = {
    "stratified": [
        0.4654706120491028,
        0.6393583416938782,
        0.4654582142829895,
        0.4964485764503479,
        0.029054999351501465,
        0.5575405955314636,
        0.39571112394332886,
        0.06352585554122925,
        0.051444292068481445,
    ],
    "hammersley": [
        0.4654706120491028,
        0.6393583416938782,
        0.4654582142829895,
        0.46548283100128174,
        0.009684979915618896,
        0.3858468532562256,
        0.16339194774627686,
        0.2524353861808777,
        0.5156506896018982,
    ],
    "zsobol": [
        0.8418814539909363,
        0.4697136878967285,
        0.041590332984924316,
        0.1863335371017456,
        0.23440468311309814,
        0.7575868964195251,
        0.11858177185058594,
        0.31022363901138306,
        0.7176151275634766,
    ],
}


@pytest.mark.parametrize("kind", COUNTED)
def test_golden_values(kind):
    """A change of these is a change of every picture."""
    key = Sampler(kind, 7, 4, 37, 100).key(torch.tensor([0, 1, 4095]), torch.tensor([0, 5, 36]))
    found = [*one(kind, key, (2, Dimension.ROULETTE)).tolist(), *two(kind, key, (2, Dimension.BSDF)).flatten().tolist()]
    assert found == GOLDEN[kind]
