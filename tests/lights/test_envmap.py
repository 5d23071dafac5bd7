"""Environment maps: the look-up and its place in the world, draws against their density, and what breaks tables."""

from __future__ import annotations

import math
from itertools import product

import pytest
import torch
from few import few
from torch import Tensor
from trials import SIGNIFICANCE, chi_square_p, z_limit

from torchpt.math.sampling import Distribution2D, cosine_hemisphere, invert_linear, power_heuristic, uniform_sphere
from torchpt.physics.lights.kinds import envmap

N = 1 << 16
EYE = torch.eye(3)
ONE = torch.tensor(1.0)
#: A rotation about a skew axis, and its mirror image.
SKEW64 = torch.linalg.qr(torch.tensor([[0.3, 0.8, -0.5], [0.9, -0.2, 0.1], [0.2, 0.4, 0.7]], dtype=torch.float64)).Q
SKEW = SKEW64.float()
MIRROR = SKEW * torch.tensor([1.0, -1.0, 1.0])


def generator(seed: int = 1) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def squares(n: int = N, seed: int = 1) -> Tensor:
    """Numbers ``(2, n)`` as samplers give them: 24 bits, below 1."""
    return torch.randint(0, 1 << 24, (2, n), generator=generator(seed)) / 2.0**24


def noise(height: int, width: int, seed: int = 3) -> Tensor:
    return torch.rand(height, width, 3, generator=generator(seed)) ** 4


def sun(height: int = 16, width: int = 32) -> Tensor:
    """A sky of 0.2 with one texel of 1e5."""
    sky = torch.full((height, width, 3), 0.2)
    sky[5, 9] = 1e5
    return sky


def stripes() -> Tensor:
    """Zero rows at the top, in the middle and at the bottom, and a few bright texels."""
    rows = torch.zeros(12, 7, 3)
    rows[3:5] = noise(2, 7)
    rows[8, 2] = 4.0
    return rows


def poles() -> Tensor:
    """Light in the two polar rows alone."""
    texels = torch.zeros(8, 6, 3)
    texels[0], texels[-1] = 5.0, noise(1, 6)[0]
    return texels


MAPS = {
    "noise": noise(9, 14),
    "sun": sun(),
    "stripes": stripes(),
    "poles": poles(),
    "row": noise(1, 8),
    "column": noise(6, 1),
    "pixel": torch.ones(1, 1, 3),
    "black": torch.zeros(5, 8, 3),
    "below zero": noise(9, 14) - 0.3,
}


def direct(texels: Tensor, d: Tensor) -> Tensor:
    """The bilinear look-up as the format defines it, in float64: texels ``(H, W, 3)``, directions ``(3, N)``."""
    texels, d = texels.double(), d.double()
    if len(texels) == 1:
        texels = texels.expand(2, -1, -1)
    height, width, _ = texels.shape
    x = torch.atan2(d[0], -d[2]) / (2 * math.pi) % 1.0 * width - 0.5
    y = torch.atan2((d[0] ** 2 + d[2] ** 2).sqrt(), d[1]) / math.pi * (height - 1)
    j, i = x.floor(), y.floor().clamp(0, height - 2)
    x, y, i, j = x - j, y - i, i.long(), j.long()
    out = torch.zeros_like(d)
    for k, wide in ((j, 1 - x), (j + 1, x)):
        for r, tall in ((i, 1 - y), (i + 1, y)):
            out += wide * tall * texels[r, k % width].T
    return out


def everywhere(n: int = N, seed: int = 5) -> Tensor:
    return uniform_sphere(squares(n, seed).double()).float()


@pytest.mark.parametrize("name", few(MAPS, 3))
@pytest.mark.parametrize("turn", [EYE, SKEW, MIRROR], ids=["upright", "turned", "mirrored"])
def test_radiance_is_the_bilinear_look_up(name, turn):
    d = everywhere(4096)
    axes = torch.cat((EYE, -EYE), 1)[:, [0, 2, 3, 5]]  # at a pole any column will do
    d = torch.cat((d, turn.T @ axes), 1)
    map = envmap.build(MAPS[name], turn, torch.tensor(1.5))
    exact = 1.5 * direct(MAPS[name], turn.double() @ d.double())
    # In float32 a place is known to some 1e-6 of the way round.
    largest = float(MAPS[name].abs().max())
    torch.testing.assert_close(envmap.radiance(map, d).double(), exact, atol=1e-4 * largest + 1e-9, rtol=1e-4)
    both, density = envmap.environment(map, d, True)
    torch.testing.assert_close(both, envmap.radiance(map, d), rtol=0, atol=0)
    torch.testing.assert_close(density, envmap.pdf(map, d, True), rtol=0, atol=0)


def cells_of(d: Tensor, bands: int, width: int, turn: Tensor) -> Tensor:
    """Cells of equal solid angle in the map's own space."""
    local = turn @ d
    phi = torch.atan2(local[0], -local[2]) / (2 * math.pi) % 1.0
    column = (phi * width).long().clamp_max(width - 1)
    return ((0.5 - 0.5 * local[1]) * bands).long().clamp(0, bands - 1) * width + column


def shares(map: envmap.EnvironmentMap, mis: bool, turn: Tensor, bands: int, width: int, fine: int) -> Tensor:
    """Return what the density says each of the cells gets: a midpoint rule."""
    z = 1.0 - (torch.arange(bands * fine, dtype=torch.float64) + 0.5) * (2.0 / (bands * fine))
    phi = (torch.arange(width * fine, dtype=torch.float64) + 0.5) * (2 * math.pi / (width * fine))
    z, phi = (a.reshape(-1) for a in torch.meshgrid(z, phi, indexing="ij"))
    r = (1 - z * z).sqrt()
    d = turn.T @ torch.stack((r * torch.sin(phi), z, -r * torch.cos(phi)))
    value = envmap.pdf(map, d.to(map.texels.dtype), mis).double() * (4 * math.pi / len(z))
    return value.view(bands, fine, width, fine).sum((1, 3)).reshape(-1)


@pytest.mark.parametrize(("name", "mis"), few(product(MAPS, [False, True]), 3))
def test_draws_follow_the_density(name, mis):
    """Chi-square over cells of equal solid angle, and the density of a draw is that of its direction."""
    turn = SKEW64 * torch.tensor([1.0, -1.0, 1.0])
    map = envmap.build(MAPS[name].double(), turn, ONE.double(), compensation=True)
    wi, density, light = envmap.sample(map, squares().double(), mis)
    assert torch.isfinite(wi).all() and torch.isfinite(density).all() and (density >= 0).all()
    torch.testing.assert_close(wi.square().sum(0), torch.ones(N).double())
    torch.testing.assert_close(light, envmap.radiance(map, wi), rtol=1e-6, atol=1e-6 * float(MAPS[name].abs().max()))
    torch.testing.assert_close(density, envmap.pdf(map, wi, mis), rtol=1e-6, atol=1e-6 * float(density.max()))
    bands, width = 12, 16
    expected = shares(map, mis, turn, bands, width, 96 if name == "sun" else 32)
    assert float(expected.sum()) == pytest.approx(1.0, abs=4e-3)
    observed = torch.bincount(cells_of(wi, bands, width, turn), minlength=bands * width).double()
    expected = expected * N / expected.sum()
    assert float(observed[expected < 1e-9].sum()) == 0
    few = expected < 20
    observed = torch.cat((observed[~few], observed[few].sum()[None]))
    expected = torch.cat((expected[~few], expected[few].sum()[None]))
    # The midpoint rule errs on kinks and on the edges of a sun.
    variance = expected.clamp_min(1e-9) + (4e-3 * expected) ** 2
    p = chi_square_p(float(((observed - expected) ** 2 / variance).sum()), len(expected) - 1)
    assert p > SIGNIFICANCE / (2 * len(MAPS))


@pytest.mark.parametrize("name", few(MAPS, 3))
def test_float32_agrees_with_float64(name):
    """The same numbers draw the same directions: the choice of a cell is float64 either way."""
    u = squares(1 << 14, 9)
    exact = envmap.build(MAPS[name].double(), SKEW64, ONE.double())
    single = envmap.build(MAPS[name], SKEW, ONE)
    (wi, density, _), (w32, d32, _) = (envmap.sample(m, a, True) for m, a in ((exact, u.double()), (single, u)))
    same = (wi - w32).abs().amax(0) < 1e-4
    assert same.float().mean() > 0.999  # the sums may differ in the last digit of a texel
    apart = (density - d32).abs()[same]
    assert float((apart / density.clamp_min(1e-3 * float(density.max()))[same]).max()) < 2e-3


@pytest.mark.parametrize("name", few(["noise", "sun", "stripes", "poles"], 2))
def test_all_the_light_is_found(name):
    """Sampled alone, the mean of radiance over density is the integral over the sphere, at no more than a small variance.

    The density is the look-up's own but for the course of cos(theta) within a row, so little is left to vary.
    """
    texels = MAPS[name]
    grey = texels.mean(2, keepdim=True).expand_as(texels).contiguous()
    map = envmap.build(grey, SKEW, ONE)
    _, density, light = envmap.sample(map, squares(), False)
    assert (density > 0).float().mean() > 0.9999
    value = torch.where(density > 0, light[0] / torch.where(density > 0, density, 1.0), 0.0).double()
    side = 384
    z = 1 - (torch.arange(side).double() + 0.5) * (2 / side)
    phi = (torch.arange(side).double() + 0.5) * (2 * math.pi / side)
    z, phi = (a.reshape(-1) for a in torch.meshgrid(z, phi, indexing="ij"))
    r = (1 - z * z).sqrt()
    exact = 4 * math.pi * float(direct(grey, torch.stack((r * torch.sin(phi), z, -r * torch.cos(phi))))[0].mean())
    assert float(value.mean()) == pytest.approx(exact, rel=1e-3 + 4 * float(value.std() / value.mean()) / math.sqrt(N))
    if name != "poles":  # there the look-up is linear in the angle, the density in its cosine
        assert float(value.std() / value.mean()) < 0.08


def test_a_black_map_is_drawn_evenly():
    map = envmap.build(torch.zeros(6, 8, 3), SKEW, ONE)
    assert map.compensated is None and float(map.mean) == 0
    wi, density, light = envmap.sample(map, squares(), True)
    torch.testing.assert_close(density, torch.full_like(density, 1 / (4 * math.pi)))
    assert (light == 0).all()
    assert wi.mean(1).abs().max() < 5 / math.sqrt(3 * N)


def test_zero_rows_are_never_drawn():
    map = envmap.build(stripes(), EYE, ONE)
    wi, density, light = envmap.sample(map, squares(), False)
    assert (light.amax(0) > 0)[density > 0].all()
    row = torch.acos(wi[1].clamp(-1, 1)) / math.pi * 11
    assert (((row > 1.99) & (row < 5.01)) | ((row > 6.99) & (row < 9.01))).all()


def test_poles_are_finite():
    d = torch.tensor([[0.0, 1, 0], [0, -1, 0], [1e-20, 1, 0], [0, -1, -1e-20], [1e-4, 1, 1e-4], [0, 1, -1e-7]]).T
    for name, texels in MAPS.items():
        map = envmap.build(texels, EYE, ONE)
        light, density = envmap.environment(map, d, True)
        assert torch.isfinite(light).all() and torch.isfinite(density).all(), name
    # A bright pole is drawn, with a density that does not grow toward it.
    map = envmap.build(poles(), EYE, ONE)
    assert float(envmap.pdf(map, d[:, :1], False)) > 1
    assert float(envmap.sample(map, squares(), False)[1].max()) <= float(envmap.pdf(map, d[:, :1], False)) * 1.0001


def test_large_maps_keep_their_sums():
    """Two million texels: a float32 sum of them would stop growing. Draws are even to the last row."""
    texels = torch.ones(1024, 2048, 3)
    map = envmap.build(texels, EYE, ONE, compensation=True)
    assert map.compensated is None  # nothing of it lies above its mean
    wi, density, _ = envmap.sample(map, squares(), True)
    torch.testing.assert_close(density, torch.full_like(density, 0.25 / math.pi), rtol=1e-4, atol=0)
    counts = torch.bincount(cells_of(wi, 32, 64, EYE), minlength=2048).double()
    expected = N / 2048
    assert chi_square_p(float(((counts - expected) ** 2 / expected).sum()), 2047) > SIGNIFICANCE


def test_stratified_numbers_stay_so():
    """Of a grid of numbers with one in each of its squares, every row of the map gets its share to within one."""
    side = 256
    a = (torch.arange(side) + 0.5) / side
    u = torch.stack([g.reshape(-1) for g in torch.meshgrid(a, a, indexing="ij")])
    texels = noise(9, 14)
    map = envmap.build(texels, EYE, ONE)
    grid = map.grid(True)
    row, column, rest = grid.cells.sample(u)
    counts = torch.bincount(row, minlength=8).double() / side
    assert ((counts - grid.cells.rows.diff() * side).abs() <= 1.0).all()
    shares = grid.cells.ends.view(8, -1)[:, :14].double().diff(prepend=torch.zeros(8, 1, dtype=torch.float64)) / 2**31
    inside = shares * grid.cells.rows.diff()[:, None] * side * side
    found = torch.bincount(row * 14 + column, minlength=8 * 14).view(8, 14).double()
    assert ((found - inside).abs() <= 1 + 2 * side * (inside > 0) * 0.5).all()
    assert (rest >= 0).all() and (rest <= 1).all()


def test_the_sun_is_found_and_weighs_little():
    """Irradiance under the sun of 1e5 by MIS with the cosine: no bias, and hardly any variance."""
    map = envmap.build(sun(64, 128), EYE, ONE)
    assert map.compensated is not None
    n = 1 << 16
    wi, density, light = envmap.sample(map, squares(n), True)
    cosine = wi[1].clamp_min(0) / math.pi
    by_map = light[0] * cosine / density * power_heuristic(density, cosine)
    local = cosine_hemisphere(squares(n, 2))
    d = torch.stack((local[0], local[2], -local[1]))
    found, theirs = envmap.environment(map, d, True)
    by_cosine = found[0] * power_heuristic(d[1] / math.pi, theirs)
    value = (by_map + by_cosine).double()
    side = 4096
    z = (torch.arange(side).double() + 0.5) / side
    phi = (torch.arange(side).double() + 0.5) * (2 * math.pi / side)
    # Rows of the sun alone; the sky's share is known.
    near = (z > math.cos(math.pi * 6.5 / 63)) & (z < math.cos(math.pi * 3.5 / 63))
    z, phi = (
        a.reshape(-1) for a in torch.meshgrid(z[near], phi[(phi / 2 / math.pi * 128 - 9.5).abs() < 1.5], indexing="ij")
    )
    r = (1 - z * z).sqrt()
    bright = direct(sun(64, 128) - 0.2, torch.stack((r * torch.sin(phi), z, -r * torch.cos(phi))))[0]
    exact = 0.2 + float((bright * z).sum()) * 2 / side / side
    error = float(value.std()) / math.sqrt(n)
    assert abs(float(value.mean()) - exact) < z_limit(1) * error + 1e-3 * exact
    assert float(value.std() / value.mean()) < 0.15


def test_compensation():
    """What lies above the mean is drawn, the rest never; with BSDF sampling nothing is lost, and an even map keeps its own."""
    side = torch.full((32, 64, 3), 0.5)
    side[8:12, 20:30] = 3.0
    map = envmap.build(side, EYE, ONE)
    assert map.compensated is not None
    d = everywhere(1 << 14)
    density = envmap.pdf(map, d, True)
    # Linear in the cosine down a cell, not in the angle: the same to a hundredth.
    above = direct((side - map.mean).clamp_min(0), d)[0] * map.compensated.factor
    torch.testing.assert_close(density.double(), above, rtol=0, atol=0.015 * float(density.max()))
    assert (envmap.pdf(map, d, False) > 0).all() and (density == 0).float().mean() > 0.9
    wobble = 1 + 0.1 * torch.rand(32, 64, 3, generator=generator())
    assert envmap.build(wobble, EYE, ONE).compensated is None
    assert envmap.build(wobble, EYE, ONE, compensation=True).compensated is not None
    assert envmap.build(side, EYE, ONE, compensation=False).compensated is None
    # A faint lamp before an even sky is no noise.
    side = torch.ones(32, 64, 3)
    side[8:12, 20:30] = 2.0
    assert envmap.build(side, EYE, ONE).compensated is not None


def test_derivatives():
    """Radiance is linear in texels and scale, and follows a turned map."""
    texels = noise(3, 5).double().requires_grad_()
    scale = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
    turn = SKEW64.clone().requires_grad_()
    d = everywhere(5).double()

    def look(texels: Tensor, scale: Tensor, turn: Tensor) -> Tensor:
        return envmap.radiance(envmap.build(texels, turn, scale), d)

    assert torch.autograd.gradcheck(look, (texels, scale, turn), fast_mode=True)
    u = squares(64).double()
    _, density, light = envmap.sample(envmap.build(texels, turn, scale), u, True)
    assert not density.requires_grad
    light.sum().backward()
    assert scale.grad is not None and float(scale.grad) == pytest.approx(float(light.detach().sum()) / 1.3)
    dark = torch.zeros(4, 4, 3, requires_grad=True)
    poles = torch.tensor([[0.0, 1, 0], [0, -1, 0]]).T.requires_grad_()
    envmap.radiance(envmap.build(dark, EYE, ONE), poles).sum().backward()
    assert dark.grad is not None and torch.isfinite(dark.grad).all() and float(dark.grad.sum()) == pytest.approx(6)
    assert poles.grad is not None and torch.isfinite(poles.grad).all()


def test_every_lane_rounds_alike():
    """A lane's bits do not depend on its place or its neighbours."""
    map = envmap.build(noise(9, 14), SKEW, ONE)
    u, d = squares(131), everywhere(131)
    whole = (*envmap.sample(map, u, True), *envmap.environment(map, d, True))
    for cut in (1, 17, 64):
        parts = [(*envmap.sample(map, a, True), *envmap.environment(map, b, True))
                 for a, b in zip(u.split(cut, 1), d.split(cut, 1), strict=True)]  # fmt: skip
        for one, many in zip(whole, zip(*parts, strict=True), strict=True):
            assert torch.equal(one, torch.cat(many, -1))


def test_cells_and_their_ends():
    weights = torch.tensor([[0.0, 0, 0], [0, 2, 0], [0, 0, 0], [1, 0, 1], [0, 0, 0]])
    cells = Distribution2D.of([weights.double()], 5, 3, weights.device)
    u = torch.tensor(
        [[0.0, 0.0], [1 - 2.0**-24, 0.0], [0.0, 1 - 2.0**-24], [1 - 2.0**-24, 1 - 2.0**-24]]
    ).T.contiguous()
    row, column, rest = cells.sample(u)
    assert row.tolist() == [1, 1, 3, 3] and column.tolist() == [1, 1, 0, 2]
    assert (rest >= 0).all() and (rest <= 1).all()
    # 1 - 2^-53 is the largest double below 1.
    row, column, _ = cells.sample(torch.full((2, 1), 1 - 2.0**-53, dtype=torch.float64))
    assert row.tolist() == [3] and column.tolist() == [2]


@pytest.mark.parametrize("shape", [(5, 7), (3, 64), (4, 65), (1, 128), (2, 2048), (200, 1), (1, 200)])
def test_cells_are_drawn_by_their_weight(shape):
    """Rows shorter and longer than a block and as long as one, with cells and a row that have no weight."""
    rng = torch.Generator().manual_seed(sum(shape))
    weights = torch.rand(shape, generator=rng, dtype=torch.float64) ** 4
    weights[torch.rand(shape, generator=rng) < 0.3] = 0.0
    if shape[0] > 2:
        weights[1] = 0.0
    chance = (weights / weights.sum()).flatten()
    u = torch.rand(2, N, generator=rng)
    row, column, rest = Distribution2D.of(weights.split(2), shape[0], shape[1], weights.device).sample(u)
    assert int(column.min()) >= 0 and int(column.max()) < shape[1] and float(rest.min()) >= 0 and float(rest.max()) <= 1
    counts = torch.bincount(row * shape[1] + column, minlength=len(chance)).double()
    assert (counts[chance == 0] == 0).all()
    often = chance * N > 20
    expected, counts = ([*x[often], x[~often].sum()] for x in (chance * N, counts))
    statistic = sum((c - e) ** 2 / e for c, e in zip(counts, expected, strict=True) if e > 0)
    assert chi_square_p(float(statistic), len(expected) - 1) > SIGNIFICANCE
    # What is left of a number lies evenly in its cell.
    assert (rest.double().mean(1) - 0.5).abs().max() < 5.0 / math.sqrt(12.0 * N)


@pytest.mark.parametrize(("a", "b"), [(1.0, 1.0), (0.0, 3.0), (2.0, 0.0), (1e-30, 1e30), (1e30, 1e-3), (1.0, 1.0001)])
def test_linear_densities_are_inverted(a, b):
    u = (torch.arange(1000) + 0.5) / 1000
    x = invert_linear(u, torch.full_like(u, a), torch.full_like(u, b)).double()
    back = (a * x + 0.5 * (b - a) * x * x) / (0.5 * (a + b))
    torch.testing.assert_close(back, u.double(), atol=1e-5, rtol=1e-4)
    assert float(invert_linear(torch.zeros(1), torch.zeros(1), torch.zeros(1))) == 0


def test_against_mitsuba():
    """Radiance per ray, the density per ray, and where its draws and ours fall, under a rotation."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    import numpy as np

    height, width = 48, 96
    smooth = torch.nn.functional.interpolate(
        noise(6, 12).permute(2, 0, 1)[None], (height, width), mode="bilinear", align_corners=True
    )[0].permute(1, 2, 0)
    texels = (smooth + 0.2).contiguous()
    axis = np.array([1.0, 2.0, 3.0]) / math.sqrt(14.0)
    to_world = mi.ScalarTransform4f().rotate(list(axis), 40)
    emitter = mi.load_dict(
        {
            "type": "scene",
            "map": {
                "type": "envmap",
                "bitmap": mi.Bitmap(texels.numpy()),
                "scale": 2.0,
                "to_world": to_world,
            },
            "ball": {"type": "sphere"},
        }
    ).environment()
    turn = torch.from_numpy(np.array(to_world.matrix)[:3, :3].T.copy()).float()
    map = envmap.build(texels, turn, torch.tensor(2.0))
    d = everywhere(400)
    light, density = envmap.environment(map, d, False)
    theirs, chances = [], []
    for k in range(d.shape[1]):
        si, at = mi.SurfaceInteraction3f(), mi.DirectionSample3f()
        si.wi, at.d = -mi.Vector3f(d[:, k].tolist()), mi.Vector3f(d[:, k].tolist())
        theirs.append(np.array(emitter.eval(si)))
        chances.append(emitter.pdf_direction(mi.Interaction3f(), at))
    torch.testing.assert_close(light, torch.from_numpy(np.stack(theirs, 1)).float(), rtol=1e-4, atol=1e-4)
    # Its density interpolates luminance times sin(theta): the same up to the curvature within a row, and near the poles.
    off = (turn @ d)[1].abs() < 0.98
    torch.testing.assert_close(density[off], torch.tensor(chances)[off], rtol=0.02, atol=1e-3)
    u = squares(2000, 4)
    drawn = [emitter.sample_direction(mi.Interaction3f(), u[:, k].tolist())[0] for k in range(u.shape[1])]
    d = torch.tensor([[s.d.x, s.d.y, s.d.z] for s in drawn]).T
    off = (turn @ d)[1].abs() < 0.98
    chances = torch.tensor([s.pdf for s in drawn])
    torch.testing.assert_close(envmap.pdf(map, d, False)[off], chances[off], rtol=0.02, atol=1e-3)
