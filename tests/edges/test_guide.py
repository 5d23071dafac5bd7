"""Guiding changes where samples of edges are drawn, and no mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import known_gradients as known
import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.gradients.edges import gradients as gradients_module
from torchpt.gradients.edges import guide as guiding
from torchpt.gradients.edges.gradients import boundary_of, samples_for
from torchpt.gradients.edges.guide import Guide, first_round, guide_of
from torchpt.scene.formats.description import settings

COUNT = 20_000


def numbers(seed: int, dimensions: int = 3, count: int = COUNT) -> Tensor:
    return torch.rand(dimensions, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


#: What numbers bring: in a corner, along a thin plate, in rare and large amounts.
BROUGHT: dict[str, Callable[[Tensor], Tensor]] = {
    "corner": lambda u: (u < 0.3).all(0).double(),
    "plate": lambda u: (0.5 - 40 * (u[1] - u[0]).abs()).clamp_min(0.0),
    "peak": lambda u: torch.exp(-100 * (u - 0.8).square().sum(0)),
}


def taught(name: str) -> Guide:
    u = numbers(1)
    found = guide_of(u, BROUGHT[name](u))
    assert found is not None
    return found


@pytest.mark.parametrize("name", BROUGHT)
def test_boxes_fill_the_cube_and_densities_are_those_of_the_draw(name: str):
    guide = taught(name)
    assert float(guide.choice.pmf.sum()) == pytest.approx(1, abs=1e-12)
    assert float(guide.size.prod(0).sum()) == pytest.approx(1, abs=1e-12)
    u = numbers(2)
    drawn, inverse = guide.draw(u)
    within = ((drawn[:, :, None] >= guide.low[:, None]) & (drawn[:, :, None] < (guide.low + guide.size)[:, None])).all(
        0
    )
    assert (within.sum(1) == 1).all()
    box = within.long().argmax(1)
    torch.testing.assert_close(inverse, guide.size.prod(0)[box] / guide.choice.pmf[box])
    # Half of the draws are even, so no weight is more than 2.
    assert inverse.max() <= 2 + 1e-12
    share = torch.bincount(box, minlength=len(guide.choice.pmf)) / COUNT
    assert (share - guide.choice.pmf).abs().max() < 5 * (0.25 / COUNT) ** 0.5


@pytest.mark.parametrize("name", BROUGHT)
def test_guided_means_are_right_and_vary_less(name: str):
    guide = taught(name)
    even = BROUGHT[name](numbers(3, count=400_000))
    drawn, inverse = guide.draw(numbers(4, count=400_000))
    guided = BROUGHT[name](drawn) * inverse
    error = float(((even.var() + guided.var()) / 400_000).sqrt())
    assert abs(float(even.mean() - guided.mean())) < 4 * error
    assert guided.var() < 0.5 * even.var()


def test_nothing_is_learned_of_nothing():
    assert guide_of(numbers(5), torch.zeros(COUNT)) is None


def test_rounds_share_the_samples_and_the_estimate():
    assert first_round(4000) is None
    first = first_round(80_000)
    assert first is not None and first.lesson == []
    then = first.then(80_000)
    assert then.first == first.count and then.count == 80_000 - first.count
    assert first.share + then.share == pytest.approx(1) and then.guide is None
    u = numbers(6)
    total = sum(float(turn.draw(u)[1].mean()) * turn.count for turn in (first, replace(then, guide=taught("corner"))))
    assert total == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("case", ["ball_on_floor_radius", "block_in_corner"])
def test_gradients_of_edges_keep_their_mean_and_vary_less(case: str, monkeypatch: pytest.MonkeyPatch):
    pair = known.PAIRS[case]
    scene, parameter = known.loaded(pair), pair.parameter
    given = settings(scene.description, {})
    cotangent = known.weights().float().permute(2, 0, 1)
    seeds, spp = 12, 24

    def gradients() -> Tensor:
        found = []
        for seed in range(seeds):
            own = replace(given, render=given.render.but(seed=seed))
            pose = scene.params[parameter]
            edges = boundary_of(scene, own, {parameter: pose}, [parameter], torch.float32, cotangent)
            assert edges is not None
            (value,) = edges.gradients(edges.shadows(spp), [parameter])
            assert value is not None
            found.append((value * pair.along(pose)).sum().double())
        return torch.stack(found)

    guided = gradients()
    monkeypatch.setattr(guiding, "_LEAST_FIRST", 1 << 30)
    even = gradients()
    error = float(((even.var() + guided.var()) / seeds).sqrt())
    assert abs(float(even.mean() - guided.mean())) < 4 * error
    assert guided.var() < even.var()
    assert not torch.equal(guided, even)


class Rank:
    """One of two processes, which adds up nothing."""

    def __init__(self, rank: int) -> None:
        self.rank, self.size = rank, 2

    def sum(self, total: Tensor) -> Tensor:
        return total


def test_ranks_learn_the_same_and_count_the_first_samples_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(gradients_module, "SAMPLES", 2048)
    pair = known.PAIRS["block_in_corner"]
    scene, parameter = known.loaded(pair), pair.parameter
    cotangent = known.weights().float().permute(2, 0, 1)

    def gradient(ranks: Any) -> Tensor:
        poses, given = {parameter: scene.params[parameter]}, settings(scene.description, {})
        edges = boundary_of(scene, given, poses, [parameter], torch.float32, cotangent, ranks)
        assert edges is not None
        (value,) = edges.gradients(edges.shadows(16), [parameter])
        assert value is not None
        return value

    alone, parts = gradient(None), [gradient(Rank(k)) for k in range(2)]
    assert all(part.abs().max() > 0 for part in parts)
    torch.testing.assert_close(parts[0] + parts[1], alone, rtol=1e-4, atol=1e-6)


def test_samples_by_what_is_differentiated():
    shapes = {"ball": {"type": "sphere"}, "fine": mesh(100), "coarse": mesh(10)}
    scene = torchpt.load({"camera": {"origin": [0, 0, 4], "target": [0, 0, 0]}, "shapes": shapes}, "cpu")
    ball, fine, coarse = "shapes.ball.to_world", "shapes.fine.vertices", "shapes.coarse.vertices"
    assert samples_for(scene, [ball], 64, 1000) == 8
    assert samples_for(scene, [ball, "shapes.ball.material.reflectance"], 20, 1000) == 2.5
    assert samples_for(scene, [ball], 16, 256 * 256) == 1
    assert samples_for(scene, [coarse], 64, 1000) == samples_for(scene, [coarse, fine], 64, 1000) == 16
    assert samples_for(scene, [fine, ball], 64, 1000) == 16
    assert samples_for(scene, [fine], 16, 256 * 256) == 0.5


def mesh(count: int) -> dict[str, Any]:
    points = numbers(7, count=count).T.tolist()
    return {"type": "mesh", "vertices": points, "faces": [[k, k + 1, k + 2] for k in range(count - 2)]}
