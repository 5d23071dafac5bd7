"""When renders end: by samples, by seconds, by error; and what that does to the picture."""

from __future__ import annotations

import time
from typing import Any

import pytest
import torch
from few import few
from few_lanes import few_lanes
from trials import film_of

import torchpt
from torchpt.core.errors import SceneError
from torchpt.native import kernels
from torchpt.physics.film import ErrorEstimate, pilots_of
from torchpt.rendering.api import Rendering, render_scene
from torchpt.rendering.stopping import StopRules
from torchpt.scene.formats.description import settings
from torchpt.scene.settings import Render
from torchpt.spec.schema import read_params


@pytest.fixture(scope="module")
def box() -> torchpt.Scene:
    return torchpt.load("cornell_box", device="cpu")


def shot(scene: torchpt.Scene, film: Any = None, sampler: Any = "sobol", **render: Any) -> Rendering:
    wishes = {"film": {"filter": "box", **(film or film_of(32))}, "sampler": sampler, "render": render}
    return render_scene(scene, settings(scene.description, wishes))


def rule(**wishes: Any) -> StopRules:
    return StopRules(Render(**read_params(Render, wishes, "render", None).values))


# -- the rules


def steps(stop: StopRules, pace: float, error: Any = None) -> list[int]:
    """Passes until the end, with every sample of the picture taking ``pace`` seconds."""
    taken, out = 0, []
    while size := stop.next_pass_spp(taken):
        out.append(size)
        taken += size
        stop.update(taken, pace * taken, None if error is None else error(taken))
    return out


def test_passes_double_where_only_samples_end_a_render():
    assert steps(rule(spp=300), 1.0) == [1, 1, 2, 4, 8, 16, 32, 64, 64, 64, 44]


def test_blocks_of_sixteen_under_a_time_limit():
    found = steps(rule(spp=10_000, time_limit=10.0), 0.05)
    assert found[:6] == [1, 1, 2, 4, 8, 16] and set(found[5:-4]) == {16}
    assert 0.97 * 10.0 <= sum(found) * 0.05 <= 1.03 * 10.0
    starts = [sum(found[:k]) for k in range(len(found))]
    assert all(start % size == 0 for start, size in zip(starts[1:], found[1:], strict=True))


@pytest.mark.parametrize("pace", [0.002, 0.02, 0.05, 0.3])
@pytest.mark.parametrize("seed", range(8))
def test_a_time_limit_holds_on_a_machine_that_others_slow(pace, seed):
    """By a clock that runs twice as fast now and then, and at the end above all."""
    g = torch.Generator().manual_seed(seed)
    stop, taken, seconds = rule(spp=100_000, time_limit=10.0), 0, 0.0
    while size := stop.next_pass_spp(taken):
        slow = float(torch.rand((), generator=g)) < (0.3 if seconds < 8.0 else 0.7)
        taken, seconds = taken + size, seconds + pace * size * (2.0 if slow else 1.0)
        stop.update(taken, seconds, None)
    one = 2.0 * pace - 1.25 * pace  # a single sample that takes longer than its rule foresaw
    assert stop.reason == "time_limit" and 9.6 - 2.5 * pace <= seconds <= 10.3 + one


def test_time_for_a_second_look_is_kept():
    stop = rule(spp=100_000, time_limit=10.0)
    stop.resampling_share = 0.1
    taken = sum(steps(stop, 0.01))
    assert stop.reason == "time_limit" and 9.6 <= 0.01 * 1.1 * taken <= 10.3


@pytest.mark.parametrize(("pace", "samples"), [(0.4, 25), (3.0, 3), (60.0, 1)])
def test_slow_scenes_end_by_whole_samples(pace, samples):
    stop = rule(spp=1000, time_limit=10.0)
    assert sum(steps(stop, pace)) == samples and stop.reason == "time_limit"


def test_an_error_ends_it_soon_after_it_is_reached():
    for target in (0.03, 0.004, 0.0007):
        stop = rule(spp=100_000, target_error=target)
        taken = sum(steps(stop, 0.01, lambda n, stop=stop: 1.0 / n if stop.checks_error(n) else None))
        assert stop.reason == "target_error" and 1.0 / target <= taken <= 1.25 / target + 1


def test_an_error_is_asked_for_seldom_and_not_before_it_means_something():
    stop, asked = rule(spp=200, target_error=1e-9), []
    steps(stop, 0.01, lambda n: asked.append(n) if stop.checks_error(n) else None)
    assert asked == [16, 20, 24, 28, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192]
    assert not rule(spp=64).checks_error(32) and stop.checks_error(33.7, adaptive=True) and not stop.checks_error(33.7)


def test_the_first_rule_ends_it():
    stop = rule(spp=20, time_limit=10.0, target_error=1e-9)
    assert sum(steps(stop, 0.01, lambda n: 1.0 / n)) == 20 and stop.reason == "spp"


# -- pictures


@pytest.mark.parametrize("compile", few(["on", "off"], 1))
def test_a_stopped_picture_is_that_of_its_samples(box, compile):
    film = film_of(16) if compile == "off" else None
    stopped = shot(box, film, spp=4096, target_error=0.02, compile=compile)
    assert stopped.stopped_by == "target_error" and stopped.complete and 16 <= stopped.spp < 200
    assert stopped.relmse_interval is not None and stopped.relmse_interval[1] <= 0.02 and not stopped.heavy_tailed
    again = shot(box, film, spp=stopped.spp, pilots=True, compile=compile)
    assert torch.equal(again.image, stopped.image) and again.relmse == stopped.relmse


@pytest.mark.parametrize("doubt", ["heavy", "null", "wide"])
def test_no_error_in_doubt_ends_a_render(box, monkeypatch, doubt):
    """Pilots alone are certain of it; the picture, once suspects were looked at again, is not."""
    told = {
        "heavy": (ErrorEstimate(0.01, (0.009, 0.011), True), ""),
        "null": (ErrorEstimate(0.01, (0.009, 0.011), False), "a reason"),
        "wide": (ErrorEstimate(0.01, (0.002, 0.05), False), ""),
    }
    monkeypatch.setattr("torchpt.rendering.run.error_estimate_of", lambda *_: told[doubt])
    found = shot(box, spp=40, target_error=0.02)
    assert (found.spp, found.stopped_by) == (40, "spp") and found.summary()["stopped_by"] == "spp"
    monkeypatch.undo()
    plain = shot(box, spp=40, pilots=True)
    assert torch.equal(plain.image, found.image) and plain.relmse == found.relmse
    assert (plain.rays, plain.paths) == (found.rays, found.paths)  # a look that led to nothing leaves no trace


def test_kernels_take_none_of_the_time(monkeypatch):
    """Those of the search are made at their first call, when sampling has begun."""
    scene = torchpt.load("cornell_box", device="cpu")
    shot(scene, spp=2, accel="numba")
    original, made = kernels._load, []

    def slow(module: str) -> Any:
        made.append(module)
        time.sleep(0.25)
        return original(module)

    monkeypatch.setattr(kernels, "_load", slow)
    monkeypatch.delitem(kernels._modules, "tree_nearest")
    start = time.perf_counter()
    found = shot(scene, spp=10**6, accel="numba", time_limit=0.15, threads=1)
    wall = time.perf_counter() - start
    assert made and found.stopped_by == "time_limit" and found.spp > 1
    assert found.compile_seconds >= 0.25 and 0.05 < found.render_seconds < wall - 0.2
    assert 0.0 <= wall + found.load_seconds - found.seconds < 0.15


def test_a_time_limit(box):
    shot(box, spp=16)  # what is compiled is there
    stopped = shot(box, spp=1_000_000, time_limit=0.2)
    assert stopped.stopped_by == "time_limit" and stopped.complete
    assert 0.1 < stopped.render_seconds < 1.5  # longer on a busy machine: the long form is stricter
    assert torch.equal(shot(box, spp=stopped.spp).image, stopped.image)


def test_no_time_at_all_still_gives_a_picture(box):
    stopped = shot(box, spp=1000, time_limit=1e-9)
    assert stopped.spp == 1 and torch.equal(stopped.image, shot(box, spp=1).image)


def test_pilots_are_the_mean_of_two_values(box):
    with_pilots, without = shot(box, spp=8, pilots=True), shot(box, spp=8)
    other = (with_pilots.image != without.image).any(2)
    assert 0 < int(other.sum()) <= 64 and without.relmse is None and with_pilots.relmse is not None
    assert with_pilots.paths > without.paths * 17 / 16 - 1


def test_what_cannot_be_is_refused(box):
    for key, wishes in {
        "render.pilots": {"render": {"pilots": False, "target_error": 0.1}},
        "film.aovs": {"film": {"aovs": ["variance"]}, "render": {"target_error": 0.1}},
        "sampler.adaptive": {"sampler": {"type": "stratified", "adaptive": True}},
        "render.target_error": {"integrator": "aov", "render": {"target_error": 0.1}},
        "render.time_limit": {"render": {"time_limit": 0}},
    }.items():
        with pytest.raises(SceneError) as error:
            settings(box.description, wishes)
        assert error.value.key == key


# -- adaptive


def test_adaptive_is_the_same_on_any_number_of_threads(box):
    wish = {"type": "sobol", "adaptive": True}
    one, two = (shot(box, sampler=wish, spp=64, threads=n) for n in (1, 2))
    assert torch.equal(one.image, two.image) and one.relmse == two.relmse
    assert one.spp == 64 and one.complete and one.summary()["stopped_by"] == "spp"
    with few_lanes(312):
        few = shot(box, sampler=wish, spp=64)
    assert torch.equal(few.image, one.image)


@pytest.mark.parametrize(("size", "spp"), [((32, 32), 64), ((40, 24), 100), ((9, 5), 20), ((33, 17), 37)])
def test_adaptive_takes_the_samples_that_it_was_given(box, size, spp):
    film = {**film_of(*size), "aovs": ["samples"]}
    found = shot(box, film, {"type": "sobol", "adaptive": True}, spp=spp)
    missing = spp - float(found.layers["samples"].double().mean())
    assert found.spp == spp and 0.0 <= missing < 16.0 / (size[0] * size[1]) + 1e-6


def test_adaptive_with_layers_and_a_crop(box):
    wish = {"type": "independent", "adaptive": True}
    found = shot(box, {**film_of(40, 24), "crop": [3, 2, 21, 17], "aovs": ["depth", "albedo"]}, wish, spp=48)
    assert found.image.shape == (17, 21, 3) and torch.isfinite(found.image).all()
    plain = shot(box, {**film_of(40, 24), "crop": [3, 2, 21, 17], "aovs": ["depth", "albedo"]}, "independent", spp=48)
    assert torch.allclose(found.layers["depth"], plain.layers["depth"], rtol=0.2)


@pytest.mark.parametrize("size", [(1, 1), (4, 4), (9, 5)])
@pytest.mark.parametrize("spp", [8, 20, 40, 100])
def test_adaptive_pictures_of_a_few_blocks_are_complete(box, size, spp):
    """Samples of a block can only be doubled: what is left over is not an interrupted render."""
    found = shot(box, film_of(*size), {"type": "sobol", "adaptive": True}, spp=spp)
    assert found.complete and found.stopped_by == "spp" and min(16, spp) <= found.spp <= spp


@pytest.mark.parametrize("compile", few(["on", "off"], 1))
@pytest.mark.parametrize("sampler", ["sobol", {"type": "sobol", "adaptive": True}])
def test_a_crop_without_pilots(box, sampler, compile):
    """One pixel of sixteen is a pilot: most crops of one pixel have none, and know nothing."""
    film = film_of(8) | {"crop": [0, 0, 1, 1]}
    found = [shot(box, film, sampler, spp=100, seed=seed, pilots=True, compile=compile) for seed in range(4)]
    assert all(one.complete and one.spp >= 16 for one in found) and None in [one.relmse for one in found]


def pilots_at(seed: int, side: int) -> torch.Tensor:
    mask = torch.zeros(side * side, dtype=torch.bool)
    mask[pilots_of(seed, (side, side), (0, 0, side, side)).pixels] = True
    return mask


@pytest.mark.parametrize("seeds", [150, pytest.param(2000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("way", ["target_error", "adaptive"])
@pytest.mark.slow
def test_no_bias(box, way, seeds):
    """Means over renders that end by their error, or share samples by it: those of renders that do neither.

    Decisions read pilots alone. Where they end a render, a pilot's mean over ``k`` samples is taken where it says to stop; that
    is off by no more than the sum over ``k`` of ``sqrt(P(k))`` times its standard deviation (Cauchy and Schwarz). Of adaptive
    renders pilots' own values are not asked either.
    """
    side = 8 if way == "adaptive" else 12  # of fewer than eight pilots no error is told
    sampler = {"type": "sobol", "adaptive": way == "adaptive"}
    wishes: dict[str, Any] = {"spp": 64} if way == "adaptive" else {"spp": 64, "target_error": 0.01}
    sums, squares, counts = (torch.zeros(2, side * side, 3, dtype=torch.float64) for _ in range(3))
    ended: dict[int, int] = {}
    for seed in range(seeds):
        one = shot(box, film_of(side), sampler, seed=seed, threads=1, **wishes)
        values, kind = one.image.double().view(-1, 3), pilots_at(seed, side).long()
        every = torch.arange(side * side)
        sums[kind, every] += values
        squares[kind, every] += values.square()
        counts[kind, every] += 1
        ended[one.spp] = ended.get(one.spp, 0) + 1
    plain = torch.stack(
        [shot(box, film_of(side), spp=1024, seed=10**6 + k, threads=1).image.double().view(-1, 3) for k in range(16)]
    )
    mean, noise = plain.mean(0), plain.var(0) / 16
    found = sums / counts.clamp_min(1)
    variance = (squares / counts.clamp_min(1) - found.square()) / (counts - 1).clamp_min(1) + noise
    z = (found - mean) / variance.sqrt()
    others = z[0]
    assert float(others.abs().max()) < 5.0 and float(others.square().mean()) < 1.5
    if way == "adaptive":
        enough = counts[1] > 5  # of few values the spread is little known
        assert float(z[1][enough].square().mean()) < (1.6 if seeds > 1000 else 3.0)
    else:
        assert len(ended) >= 4 and min(ended) >= 16 and max(ended) <= 64
        deviation = torch.sqrt(((squares / counts.clamp_min(1)) - found.square()).clamp_min(0.0))[0].mean()
        bound = float(deviation) * sum((number / seeds) ** 0.5 for number in ended.values())
        assert abs(float((found[1] - mean)[counts[1] > 5].mean())) < bound
