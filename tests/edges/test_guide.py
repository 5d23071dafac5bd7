"""Guiding changes where samples of edges are drawn, and no mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import known_gradients as known
import pytest
import torch
from torch import Tensor

from torchpt.gradients.edges import guide as guiding
from torchpt.gradients.edges.gradients import boundary_of
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
    assert first_round(8000) is None
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
