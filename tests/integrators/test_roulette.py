"""Russian roulette: who survives, and that paths which hardly lose anything have the means that they should."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from trials import estimate, film_of, shoot, z_limit

from torchpt.paths import roulette
from torchpt.paths.integrators import base
from torchpt.paths.integrators.base import Limits
from torchpt.physics.samplers import Draws


class _Drawn(Draws):
    """The same number for every lane."""

    def __init__(self, number: float) -> None:
        self.number = number

    def one(self, dimension: Any) -> torch.Tensor:
        return torch.tensor([self.number])


def survival(throughput: float, eta: float | None = None, cap: float = 1.0, chance: float | None = None) -> float:
    """The chance that a path survives with, from the weight that makes up for it; 0 where it never does."""
    carried = torch.tensor([[throughput], [0.25 * throughput], [0.0]])
    index = None if eta is None else torch.tensor([eta])
    least = roulette.survival_probability(chance, cap, carried.amax(0), index)
    on, after = roulette.russian_roulette(least, _Drawn(0.0), torch.ones(1, dtype=torch.bool), carried)
    return float(carried[0] / after[0]) if bool(on) else 0.0


@pytest.mark.parametrize("carried", [1e-30, 0.01, 0.3, 0.95, 0.999, 1.0, 1.5, 1e30])
def test_a_path_survives_with_what_it_can_still_bring(carried):
    assert survival(carried) == pytest.approx(min(1.0, carried))
    # Radiance was divided by the square of the index on the way in, and will be multiplied by it on the way out.
    assert survival(carried, 1.5) == pytest.approx(min(1.0, 2.25 * carried))
    assert survival(carried, 1 / 1.5) == pytest.approx(min(1.0, carried / 2.25))
    assert survival(carried, cap=0.9) == pytest.approx(min(0.9, carried))
    assert survival(carried, chance=0.7) == pytest.approx(0.7)


def test_the_largest_number_ends_no_path_that_loses_nothing():
    one = torch.ones(3, 1)
    chance = roulette.survival_probability(None, 1.0, one[0], None)
    on, after = roulette.russian_roulette(chance, _Drawn(1.0 - 2.0**-24), torch.ones(1, dtype=torch.bool), one)
    assert bool(on) and torch.equal(after, one)


def test_only_deep_paths_without_an_end_are_capped():
    endless, ended = Limits(-1, 5), Limits(10**6, 5)
    assert [endless.roulette(depth) for depth in (1, 4, 5, 1000, 1001)] == [0, 0, 1, 1, roulette.DEEP_CAP]
    assert [ended.roulette(depth) for depth in (4, 5, 1001)] == [0, 1, 1]
    # That no path which loses nothing comes to the end: one of a million million would be many.
    assert roulette.DEEP_CAP ** (base.ENDLESS - roulette.DEEP) < 1e-12


def room(albedo: float) -> dict[str, Any]:
    """A closed room whose walls shine: its radiance is 1 / (1 - albedo)."""
    material = {"type": "diffuse", "reflectance": albedo}
    walls = {"type": "cube", "flip_normals": True, "emission": [1, 1, 1], "material": material}
    camera = {"origin": [0.1, -0.2, 0.3], "target": [0.7, 0.4, -0.3], "fov": 60}
    return {"camera": camera, "shapes": {"room": walls}}


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("albedo", "strategy", "compile"),
    [
        (0.99, "mis", "on"),
        pytest.param(0.99, "bsdf", "off", marks=SLOW),
        pytest.param(0.999, "mis", "on", marks=SLOW),
        pytest.param(0.999, "bsdf", "on", marks=SLOW),
        pytest.param(0.99, "mis", "off", marks=SLOW),
        pytest.param(0.999, "mis", "off", marks=SLOW),
        pytest.param(0.999, "bsdf", "off", marks=SLOW),
    ],
)
def test_a_closed_room_of_high_albedo(albedo, strategy, compile):
    # A path is as long as it survives, so the deviation of one sample is the mean: 0.8 % after 16,384 of them.
    keys = {"max_depth": -1, "strategy": strategy}
    shot = shoot(room(albedo), 64, integrator=keys, film=film_of(16), compile=compile)
    mean, error = estimate(shot.image)
    expected = 1 / (1 - albedo)
    assert error.max() < 0.011 * expected
    assert (mean - expected).abs().max() <= z_limit(8) * error.max()
    assert shot.truncated_paths == 0


@pytest.mark.parametrize(
    ("index", "compile"),
    # Without reflection nothing is left to chance: the easier one.
    [(1.5, "on"), *(pytest.param(*one, marks=SLOW) for one in ((1.5, "off"), (1.0, "on"), (1.0, "off")))],
)
def test_two_hundred_clear_panes(index, compile):
    count = 200
    glass = {"type": "thindielectric", "int_ior": index, "ext_ior": 1.0}
    shapes: dict[str, Any] = {
        f"pane{k}": {
            "type": "rectangle",
            "transform": [{"scale": 50}, {"translate": [0, 0, -0.1 * k]}],
            "material": glass,
        }
        for k in range(count)
    }
    behind = [{"scale": 50}, {"translate": [0, 0, -0.1 * count - 0.1]}]
    black = {"type": "diffuse", "reflectance": 0}
    shapes["lamp"] = {"type": "rectangle", "transform": behind, "emission": [1, 1, 1], "material": black}
    camera = {"origin": [0, 0, 1], "target": [0, 0, 0], "fov": 0.01}
    shot = shoot(
        {"camera": camera, "shapes": shapes}, 16, integrator={"max_depth": -1}, film=film_of(32), compile=compile
    )
    # A pane reflects r = 2 R / (1 + R), and n of them that lose nothing let (1 - r) / (1 + (n - 1) r) through.
    once = ((index - 1) / (index + 1)) ** 2
    r = 2 * once / (1 + once)
    expected = (1 - r) / (1 + (count - 1) * r)
    mean = float(shot.image[..., 0].double().mean())
    error = math.sqrt(expected * (1 - expected) / shot.paths)  # a path sees the lamp or the dark
    assert error < 0.04 * expected
    assert abs(mean - expected) <= z_limit(4) * error + 1e-5
    assert shot.truncated_paths == 0


def test_light_that_is_never_lost_ends_too():
    # The radiance of such a room has no bound; a picture of it is finite, and no path was cut.
    shot = shoot(room(1.0), 4, integrator={"max_depth": -1, "strategy": "bsdf"}, film=film_of(8), compile="on")
    assert torch.isfinite(shot.image).all()
    assert 1000 < float(shot.image.mean())
    assert shot.truncated_paths == 0


@pytest.mark.parametrize("compile", ["on", "off"])
def test_paths_that_roulette_may_not_end_are_cut_and_counted(monkeypatch, compile):
    monkeypatch.setattr(base, "ENDLESS", 50)
    never = {"max_depth": -1, "rr_depth": 2**31 - 1, "strategy": "bsdf"}
    shot = shoot(room(0.9), 3, integrator=never, film=film_of(4, 2), compile=compile)
    assert shot.truncated_paths == 3 * 8
    assert shot.summary()["truncated_paths"] == 3 * 8
    # What was cut is missing from the picture: the series of 50 terms.
    expected = (1 - 0.9**50) / 0.1
    torch.testing.assert_close(shot.image, torch.full_like(shot.image, expected), rtol=1e-4, atol=0)


def test_the_variance_of_a_dim_path_is_that_of_its_light():
    # Throughput that falls to a half at each vertex: all survivors carry the same.
    shot = shoot(room(0.5), 256, integrator={"max_depth": -1, "rr_depth": 1, "strategy": "bsdf"}, film=film_of(16))
    mean, error = estimate(shot.image)
    assert abs(float(mean[0]) - 2) <= z_limit(1) * float(error[0])
    # Vertices are counted by a geometric distribution of mean 2 and variance 2.
    assert float(error[0]) * math.sqrt(shot.paths) == pytest.approx(math.sqrt(2), rel=0.2)
