"""Random numbers of edges: by the sampler of renders, a function of the seed, the sample, its use and the dimension."""

from __future__ import annotations

import torch
from torch import Tensor

import torchpt
from torchpt.gradients.edges.traced import Traced, Use, traced_of
from torchpt.physics.samplers import Dimension
from torchpt.scene.formats.description import settings

TOTAL = 4096


def traced(seed: int, accel: str = "auto") -> Traced:
    described = {"camera": {"origin": [0, 0, 4], "target": [0, 0, 0]}, "shapes": {"it": {"type": "sphere"}}}
    scene = torchpt.load(described, "cpu")
    wish = settings(scene.description, {"render": {"seed": seed, "accel": accel}})
    return traced_of(scene, wish, {}, torch.float32)


def numbers(seed: int, use: Use, number: Tensor) -> Tensor:
    along = traced(seed)
    key = along.key(number, use)
    place, other = along.edge(number, key, TOTAL)
    return torch.stack((place * TOTAL - number, other, along.draws(key, 2).one(Dimension.ROULETTE).double()))


def test_samples_have_numbers_of_their_own_whatever_else_is_drawn() -> None:
    every = torch.arange(TOTAL)
    whole = numbers(7, Use.LIGHTS, every)
    assert torch.equal(numbers(7, Use.LIGHTS, every[1000:1003]), whole[:, 1000:1003])
    sets = [whole, *(numbers(7, use, every) for use in Use if use is not Use.LIGHTS), numbers(8, Use.LIGHTS, every)]
    lanes = torch.cat(sets)
    assert bool((lanes >= 0).all()) and bool((lanes < 1).all())
    # Of independent uniform numbers: correlations are normal with a deviation of 1 / sqrt(N); 105 pairs.
    found = torch.corrcoef(lanes) - torch.eye(len(lanes), dtype=torch.float64)
    assert float(found.abs().max()) < 5 / TOTAL**0.5
    assert float((lanes.mean(1) - 0.5).abs().max()) < 5 / (12 * TOTAL) ** 0.5


def test_places_are_stratified_over_all_edges() -> None:
    number, along = torch.arange(TOTAL), traced(3)
    place, _ = along.edge(number, along.key(number, Use.PRIMARY), TOTAL)
    assert torch.equal((place * TOTAL).long(), number)


def test_rays_of_edges_are_searched_by_the_tree() -> None:
    assert [traced(0, accel).wave.accel.name for accel in ("auto", "brute", "numba", "torch")] == [
        *("numba", "numba", "numba"),
        "torch",
    ]
