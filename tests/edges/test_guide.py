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
from torchpt.gradients.edges.gradients import boundary_of, samples_for
from torchpt.math import guiding
from torchpt.math.guiding import EdgeGuide, Guide, Memory, Observations, Round, guide_of, rounds
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


def lesson(name: str, seed: int = 1, guide: Guide | None = None, count: int = COUNT) -> Observations:
    """What numbers bring that are drawn evenly, or by a guide."""
    u = numbers(seed, count=count)
    u, inverse = (u, torch.ones_like(u[0])) if guide is None else guide.draw(u)
    return Observations(u, inverse, BROUGHT[name](u))


def taught(name: str) -> Guide:
    found = guide_of(lesson(name))
    assert found is not None
    return found


def taught_again(name: str) -> Guide:
    """A guide that learns of samples that another one drew."""
    memory = Memory()
    for seed in range(20, 24):
        memory.add(lesson(name, seed, memory.guide, count=2000))
    assert memory.guide is not None
    return memory.guide


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


@pytest.mark.parametrize("teach", [taught, taught_again])
@pytest.mark.parametrize("name", BROUGHT)
def test_guided_means_are_right_and_vary_less(name: str, teach: Callable[[str], Guide]):
    guide = teach(name)
    even = BROUGHT[name](numbers(3, count=400_000))
    drawn, inverse = guide.draw(numbers(4, count=400_000))
    guided = BROUGHT[name](drawn) * inverse
    error = float(((even.var() + guided.var()) / 400_000).sqrt())
    assert abs(float(even.mean() - guided.mean())) < 4 * error
    assert guided.var() < 0.5 * even.var()


def test_nothing_is_learned_of_nothing():
    nothing = Observations(numbers(5), torch.ones(COUNT, dtype=torch.float64), torch.zeros(COUNT))
    assert guide_of(nothing) is None
    memory = Memory()
    memory.add(nothing)
    assert memory.guide is None
    memory.add(lesson("corner"))
    known = memory.guide
    memory.add(nothing)
    assert memory.guide is known is not None


def test_a_memory_forgets_and_does_not_mind_how_much_a_lesson_brings(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(guiding, "_KEPT", 3 * COUNT)
    memory, other = Memory(), Memory()
    for seed in range(4):
        own = lesson("corner", seed) if seed else lesson("peak", seed)
        memory.add(own)
        other.add(replace(own, contribution=own.contribution * 10.0**-seed))
        assert memory.guide is not None and other.guide is not None
        torch.testing.assert_close(memory.guide.choice.pmf, other.guide.choice.pmf)
    assert memory._kept is not None and memory._kept.u.shape == (3, 3 * COUNT)
    assert torch.equal(memory._kept.u, torch.cat([lesson("corner", seed).u for seed in (1, 2, 3)], 1))


def even(turns: list[Round], u: Tensor) -> float:
    return sum(float(turn.draw(u)[1].mean()) * turn.count for turn in turns)


def test_rounds_share_the_samples_and_the_estimate():
    assert [(turn.count, turn.memory) for turn in rounds(4000)] == [(4000, None)]
    first, then = rounds(80_000)
    assert first.memory is not None and then.memory is None
    assert then.first == first.count and then.count == 80_000 - first.count
    assert first.share + then.share == pytest.approx(1) and then.guide is None
    assert even([first, replace(then, guide=taught("corner"))], numbers(6)) == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("total", [100, 1000, 80_000])
def test_a_memory_learns_of_every_call(total: int):
    memory, found = Memory(), list[Round]()
    for turn in rounds(total, memory):
        found.append(turn)
        u, weight = turn.draw(numbers(8, count=turn.count))
        if turn.memory is not None:
            turn.record(u, weight, BROUGHT["corner"](u) * weight)
    assert found[0].guide is None and all(turn.guide is not None for turn in found[1:])
    known = memory.guide
    later = list(rounds(total, memory))
    assert [turn.guide for turn in later] == [known] * len(later) and known is not None
    assert [turn.count for turn in later] == [turn.count for turn in found]
    assert sum(turn.count for turn in later) == total and later[0].memory is memory
    assert all(turn.share == pytest.approx(turn.count / total) for turn in later)


def moved(case: str, seeds: int, spp: float, guide: EdgeGuide | None = None) -> Tensor:
    """What moving edges of shadows and in reflected light add to a known gradient, one seed after the other."""
    pair = known.PAIRS[case]
    scene, parameter = known.loaded(pair), pair.parameter
    given, pose = settings(scene.description, {}), scene.params[parameter]
    cotangent = known.weights().float().permute(2, 0, 1)
    found = []
    for seed in range(seeds):
        own = replace(given, render=given.render.but(seed=seed))
        edges = boundary_of(scene, own, {parameter: pose}, [parameter], torch.float32, cotangent, guide=guide)
        assert edges is not None
        (value,) = edges.gradients(edges.shadows(spp), [parameter])
        assert value is not None
        found.append((value * pair.along(pose)).sum().double())
    return torch.stack(found)


def assert_less_varied(guided: Tensor, even: Tensor) -> None:
    error = float((even.var() / len(even) + guided.var() / len(guided)).sqrt())
    assert abs(float(even.mean() - guided.mean())) < 4 * error
    assert guided.var() < even.var()


@pytest.mark.parametrize("case", [pytest.param("ball_on_floor_radius", marks=pytest.mark.slow), "block_in_corner"])
def test_gradients_of_edges_keep_their_mean_and_vary_less(case: str, monkeypatch: pytest.MonkeyPatch):
    guided = moved(case, 12, 24)
    monkeypatch.setattr(guiding, "_LEAST_FIRST", 1 << 30)
    even = moved(case, 12, 24)
    assert_less_varied(guided, even)
    assert not torch.equal(guided, even)


@pytest.mark.parametrize("case", ["block_in_corner", pytest.param("lamp_pose_room_indirect", marks=pytest.mark.slow)])
def test_what_is_kept_from_call_to_call_changes_no_mean_and_varies_less(case: str):
    guide = EdgeGuide()
    alone, kept = moved(case, 12, 2), moved(case, 14, 2, guide)[2:]
    assert_less_varied(kept, alone)
    assert "Segments" in repr(guide)


def test_a_run_with_a_new_guide_repeats():
    pair = known.PAIRS["block_in_corner"]
    scene, parameter = known.loaded(pair), pair.parameter

    def run(guide: torchpt.EdgeGuide | None) -> list[Tensor]:
        found = []
        for seed in range(3):
            leaf = scene.params[parameter].clone().requires_grad_()
            torchpt.render(scene, params={parameter: leaf}, spp=4, seed=seed, edge_guide=guide).mean().backward()
            assert leaf.grad is not None
            found.append(leaf.grad)
        return found

    first = run(torchpt.EdgeGuide())
    assert all(map(torch.equal, first, run(torchpt.EdgeGuide())))
    assert not torch.equal(first[2], run(None)[2])


def test_calls_of_one_seed_draw_samples_that_the_guide_was_not_learned_from():
    """A guide would draw again more of what contributed much by chance, with less weight."""
    true, found = numbers(9, count=400_000), list[float]()
    small = (true - 0.5).square().sum(0).sqrt() < 0.12
    for run in range(20):
        guide = EdgeGuide()
        memory = guide.memory("it", torch.device("cpu"))
        for _ in range(6):
            (turn,) = rounds(512, memory)
            u, weight = turn.draw(numbers(guide.next_seed(run) % (1 << 40), count=512))
            contribution = ((u - 0.5).square().sum(0).sqrt() < 0.12).double() * weight
            turn.record(u, weight, contribution)
            found.append(float(contribution.sum()))
    values = torch.tensor(found).view(20, 6)[:, 2:].mean(1)
    assert abs(float(values.mean()) - float(small.double().mean())) < 3 * float(values.std()) / 20**0.5
    guide = EdgeGuide()
    assert len({guide.next_seed(3) for _ in range(9)}) == 9


def test_an_edge_guide_is_one():
    scene = known.loaded(known.PAIRS["block_in_corner"])
    with pytest.raises(torchpt.SceneError, match=r"edge_guide: expected a torchpt.EdgeGuide, got 3"):
        torchpt.render(scene, edge_guide=3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(torchpt.SceneError, match=r"edge_guide: expected None where edges is False"):
        torchpt.render(scene, edge_guide=EdgeGuide(), edges=False)
    with pytest.raises(torchpt.SceneError, match=r"edge_guide: expected none: pictures of a data set"):
        torchpt.data.RenderDataset(lambda index: scene, 1, edge_guide=EdgeGuide())
    with pytest.raises(torchpt.SceneError, match=r"edge_guide: expected none: pictures of a data set"):
        torchpt.data.RenderDataset(lambda index: (scene, {"edge_guide": EdgeGuide()}), 1)[0]
    with pytest.raises(torchpt.SceneError, match=r"edge_guide: expected None for a batch"):
        torchpt.render_batch([scene], edge_guide=EdgeGuide())  # pyright: ignore[reportCallIssue]


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
