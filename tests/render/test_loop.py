"""The compiled loop shows what eager stages show: each kernel lane by lane, and whole pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from lanewise import ALLOWED, arena, compare, loaded, prepared, run_bounce, waves
from showcase import MATERIALS, showcase
from significance import t_limit
from trials import coarse, film_of

import torchpt
from torchpt.engines.kernels.engine import Chunk, KernelsEngine
from torchpt.engines.kernels.layout import HIT
from torchpt.engines.kernels.threads import KernelsForward
from torchpt.math.vectors import rows
from torchpt.paths.layers import LAYERS
from torchpt.paths.vertex import STRATEGIES
from torchpt.physics.bsdfs import KINDS
from torchpt.physics.film import Film
from torchpt.physics.samplers import KINDS as SAMPLERS
from torchpt.physics.shapes.geometry import Hit
from torchpt.rendering import kernels_of
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene.formats.description import settings

SCENES = sorted(path.stem for path in Path("configs/scene").glob("*.yaml")) or ["cornell_box"]
#: Layers of first surfaces.
SEEN = [name for name in LAYERS if not LAYERS[name].light]
DIFFUSE = ("cornell_box", "cornell_bunny", "cornell_statue_bunny_diffuse", "games101")


def scene_of(name: str) -> torchpt.Scene:
    try:
        return loaded(name)
    except torchpt.SceneError as error:
        if "TORCHPT_ASSETS" in str(error) or "asset" in str(error):
            pytest.skip(str(error))
        raise


# -- stages, lane by lane


def agreeing(name: str | Mapping[str, Any], side: int, samples: int, **wishes: Any) -> set[str]:
    """The kernels that were compared, after all of them were found to agree with the eager stages."""
    scene = loaded(name) if isinstance(name, Mapping) else scene_of(name)
    wish = {"film": film_of(side), "render": {"spp": samples, "seed": 7}, **wishes}
    if settings(scene.description, wish).integrator.name == "bdpt":  # whose stages weigh in light paths
        wish["integrator"] = "path"
    found = compare(scene, wish, side * side, samples)
    assert sum(found.values.values()) > 20 / ALLOWED  # so that the lane of one decision may differ
    assert found.share() <= ALLOWED, found.worst()
    for kernel in found.kernels():  # a kernel that is wrong in one lane of a hundred does not hide behind the others
        assert found.share(kernel) <= 0.01, (kernel, found.worst())
    return set(found.kernels())


@pytest.mark.parametrize(
    "name",
    ["cornell_box", *(pytest.param(name, marks=pytest.mark.slow) for name in ("games101_spheres", "env_teapot"))],
)
def test_kernels_beside_stages(name):
    kernels = agreeing(name, 24, 8)
    assert "generate" in kernels and "nearest" in kernels
    assert any(kernel.endswith("with roulette") for kernel in kernels)


@pytest.mark.slow
def test_kernels_of_surfaces_that_let_rays_through():
    kernels = agreeing(showcase("lace", "lattice", "glass", "tiles"), 32, 8)
    assert {"apart bounce dielectric", "apart escape", "apart emit", "light", "nearest"} <= kernels


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_kernels_of_shipped_scenes(name):
    agreeing(name, 32, 8)


@pytest.mark.slow
@pytest.mark.parametrize("names", [list(MATERIALS)[k : k + 6] for k in range(0, len(MATERIALS), 6)], ids=" ".join)
def test_kernels_of_every_material(names):
    agreeing(showcase(*names), 32, 8)


def test_every_model_is_among_the_materials():
    assert {MATERIALS[name]["type"] for name in MATERIALS} >= KINDS.keys() - {"blend"}


@pytest.mark.slow
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_kernels_of_strategies(strategy):
    chosen = showcase("satin", "glass", "gold", "tiles")
    agreeing(chosen, 32, 8, integrator={"type": "path", "strategy": strategy, "max_depth": 5, "rr_prob": 0.7})


def test_what_goes_where_after_a_hit():
    """``sort_lanes`` makes no arithmetic: lists, ends and light of shadow rays are exact."""
    described = showcase("lace", "glass", "diffuse")
    described["shapes"]["lamp"]["radius"] = 0.9  # so that some lanes meet it
    scene = loaded(described)
    wave, _ = prepared(scene, {"film": film_of(32), "render": {"spp": 4}})
    with torch.no_grad():
        kernels = kernels_of(scene, wave)
        worker, recorder = KernelsEngine(kernels), waves(wave, 1024, 4)
        assert not kernels.fused and kernels.has_environment and kernels.has_emitters and kernels.models == 2
        _, state, hit, _, _ = next(found for found in recorder.bounces if found[4] == 2)
        n = len(state.lane)
        dead = torch.arange(n) % 10 == 0
        state = replace(state, t_max=state.t_max.masked_fill(dead, 0.0))
        hit = replace(hit, prim=hit.prim.masked_fill(dead, -1))
        light, transmittance = torch.rand(3, n), torch.rand(n)
        here = arena(
            kernels, **{name: getattr(state, name) for name in ("lane", "t_max", "radiance", "key")},
            **{name: getattr(hit, name) for name in HIT}, shadow_radiance=light, transmittance=transmittance,
        )  # fmt: skip
        worker.calls.clear()
        lists = worker.room(1).lists
        worker.calls.run(kernels.sort_lanes(True), n, here, here, lists=lists)
        _, places = worker.calls.counted()
        wanted = torch.addcmul(state.radiance, light, transmittance)
        held = kernels.state.take(here, np.arange(n), ("radiance",))["radiance"]
        assert torch.allclose(held, wanted, rtol=1e-6, atol=0)
        key = wave.context.world.materials.key[wave.context.world.geometry.slot(hit.prim) + 1].long()
        alive = state.t_max > 0
        expected = [(key == m) | (key == 2 + m) for m in range(2)]
        expected += [(key < 2) & (hit.prim >= 0), (hit.prim < 0) & alive]
        for number, mask in enumerate(expected):
            named = lists[number].words[0, : places[number]]
            assert np.array_equal(np.sort(named), mask.nonzero().squeeze(1).numpy()), number
            assert len(named)
        ended = (hit.prim < 0) & ~alive
        slots = torch.from_numpy(worker.slots.floats[:, state.lane[ended].numpy()].copy())
        assert int(ended.sum()) and torch.equal(slots, held[:, ended])


@pytest.mark.parametrize("clamp", [None, 0.75])
def test_samples_enter_the_film_as_eagerly(clamp):
    """``accumulate`` is exact: sums in float64, samples that are not finite black and counted."""
    scene = loaded("cornell_box")
    wave, _ = prepared(scene, {"film": film_of(20, 10), "render": {"spp": 6}})
    kernels = kernels_of(scene, wave)
    generator = torch.Generator().manual_seed(5)
    values = torch.randn(3, 6, 200, generator=generator).exp()
    for place, bad in (((0, 2, 7), math.nan), ((1, 5, 199), math.inf), ((2, 0, 0), -math.inf), ((0, 0, 0), math.nan)):
        values[place] = bad
    films = [Film(20, 10, 2, torch.device("cpu")) for _ in range(2)]
    loop = KernelsForward(kernels, 1, clamp, False)
    worker = KernelsEngine(kernels)
    finite = torch.isfinite(values).all(0)
    eager = torch.where(finite, values, 0.0)
    if clamp is not None:
        eager = eager * (clamp / eager.abs().amax(0).clamp_min(clamp)).clamp_max(1.0)
    for first in (0, 3):  # two chunks of pixels 37..87 and two of the others, of three samples each
        for start, count in ((0, 37), (37, 50), (87, 113)):
            part = values[:, first : first + 3, start : start + count].reshape(3, -1)
            worker.slots.floats[:, : part.shape[1]] = part.numpy()
            chunk = Chunk(start, count, first, 3)
            bad = loop._accumulate(worker.slots.floats, chunk, films[0], clamp)
            there = slice(start, start + count)
            assert bad == int((~finite[first : first + 3, there]).sum())
            films[1].add(eager[:, first : first + 3, there], start, first)
    assert torch.equal(films[0]._counts, films[1]._counts)
    if clamp is None:
        assert torch.equal(films[0].sums, films[1].sums)
    else:  # a quotient may round otherwise
        torch.testing.assert_close(films[0].sums, films[1].sums, rtol=1e-6, atol=0)


# -- pictures


def rendered(scene: torchpt.Scene, mode: str, seed: int, spp: int, wishes: Mapping[str, Any]) -> Rendering:
    wish = {**wishes, "render": {"spp": spp, "seed": seed, "compile": mode, **wishes.get("render", {})}}
    return render_scene(scene, settings(scene.description, wish))


def layers_of(result: Rendering) -> dict[str, torch.Tensor]:
    return {"image": result.image, **{name: value for name, value in result.layers.items() if name != "variance"}}


def test_the_limit_of_a_t_test():
    assert t_limit(1, 1) == pytest.approx(math.tan(math.pi * (0.5 - 0.5e-3)), rel=1e-2)
    assert t_limit(1, 7, 0.05) == pytest.approx(2.365, rel=1e-3)
    assert t_limit(50, 7, 0.05) == pytest.approx(5.408, rel=1e-3)


#: Sums of a few thousand numbers that round to 6e-8 each, differently in both.
ROUNDING = 1e-5


def paired(
    scene: torchpt.Scene, wishes: Mapping[str, Any], side: int, spp: int, seeds: int = 8, block: int = 8
) -> float:
    """Largest t of the blocks' differences, as a share of the limit for all of them together.

    The same seeds, so a block differs by those paths alone that rounding sends elsewhere. Where that is no bias its mean over
    seeds is within the limit of Student's t for ``seeds - 1`` degrees; many paths far away from each other that differ by
    chance make the test milder, never sharper.
    """
    wish = {**wishes, "film": {**film_of(side), **wishes.get("film", {})}}
    differences: dict[str, list[torch.Tensor]] = {}
    sizes: dict[str, torch.Tensor] = {}
    for seed in range(seeds):
        on, off = (rendered(scene, mode, seed, spp, wish) for mode in ("on", "off"))
        assert on.eager == () and on.nonfinite_samples == off.nonfinite_samples
        assert on.spp == off.spp and on.paths == off.paths
        assert abs(on.rays - off.rays) <= max(0.01 * off.rays, 3)  # a path that goes elsewhere may be longer
        for name, value in layers_of(off).items():
            a, b = (
                coarse(layers_of(on)[name].nan_to_num(posinf=0.0), block),
                coarse(value.nan_to_num(posinf=0.0), block),
            )
            differences.setdefault(name, []).append(a - b)
            sizes[name] = sizes.get(name, torch.zeros(())) + b.abs() / seeds
    worst, comparisons = 0.0, sum(found[0].numel() for found in differences.values())
    for name, found in differences.items():
        stack = torch.stack(found)
        floor = ROUNDING * (sizes[name] + sizes[name].mean())
        noise = (stack.var(0) / seeds + floor.square()).sqrt()
        worst = max(worst, float((stack.mean(0).abs() / noise.clamp_min(1e-30)).max()))
    return worst / t_limit(comparisons, seeds - 1)


@pytest.mark.parametrize("name", few(["cornell_transmissive", "env_teapot", "ibl_row"], 1))
def test_pictures(name):
    assert paired(scene_of(name), {}, 16, 4) <= 1.0


def test_the_means_of_diffuse_scenes():
    for name in DIFFUSE[:1] + DIFFUSE[3:]:
        scene = scene_of(name)
        a, b = (
            float(rendered(scene, mode, 3, 32, {"film": film_of(32)}).image.double().mean()) for mode in ("on", "off")
        )
        assert a == pytest.approx(b, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_pictures_of_shipped_scenes(name):
    scene = scene_of(name)
    assert paired(scene, {}, 32, 16) <= 1.0
    if name in DIFFUSE:
        a, b = (rendered(scene, mode, 3, 64, {"film": film_of(64)}).image.double().mean() for mode in ("on", "off"))
        assert float(a) == pytest.approx(float(b), rel=1e-4)


def test_a_picture_that_differs_is_found(monkeypatch):
    """A hundredth more light in one block of sixteen is seen."""
    scene, kept = loaded("cornell_box"), KernelsEngine.trace

    def brighter(self: KernelsEngine, chunk: Chunk, traced: Any) -> Any:
        tally = kept(self, chunk, traced)
        places = np.arange(chunk.pixels * chunk.samples) % chunk.pixels + chunk.first_pixel
        self.slots.floats[:, : len(places)][:, (places % 32 < 8) & (places < 8 * 32)] *= 1.01
        return tally

    monkeypatch.setattr(KernelsEngine, "trace", brighter)
    assert paired(scene, {}, 32, 4) > 1.0


def quick(some: tuple[Any, ...], all: Iterable[Any]) -> list[Any]:
    """All of them, those but ``some`` only in the slow form: each has kernels of its own to be compiled."""
    return [one if one in some else pytest.param(one, marks=pytest.mark.slow) for one in all]


@pytest.mark.parametrize("sampler", quick(("sobol",), SAMPLERS))
def test_samplers(sampler):
    assert paired(loaded("cornell_box"), {"sampler": {"type": sampler}}, 16, 4) <= 1.0


_WIDE = {"type": "gaussian", "radius": 1.3, "stddev": 0.3}


@pytest.mark.parametrize("filter", quick(("mitchell",), ["box", "tent", "gaussian", "mitchell", _WIDE]), ids=str)
def test_filters(filter):
    assert paired(loaded("cornell_box"), {"film": {"filter": filter, "aovs": ["albedo", "depth"]}}, 16, 4) <= 1.0


@pytest.mark.parametrize("kind", quick(("direct",), ["direct", "path"]))
@pytest.mark.parametrize("strategy", quick(("light",), STRATEGIES))
def test_strategies(kind, strategy):
    wish = {"integrator": {"type": kind, "strategy": strategy}}
    assert paired(loaded("cornell_box"), wish, 16, 4) <= 1.0


@pytest.mark.parametrize(
    "limits", few([{"max_depth": -1, "rr_depth": 2}, {"rr_prob": 0.5, "rr_depth": 1}, {"max_depth": 1}], 2), ids=str
)
def test_depths_and_roulette(limits):
    assert paired(loaded("cornell_box"), {"integrator": {"type": "path", **limits}}, 16, 4) <= 1.0


@pytest.mark.parametrize("integrator", quick(("path",), ["path", "aov"]))
@pytest.mark.parametrize("name", quick(("cornell_box",), ["cornell_box", "showcase"]))
def test_layers(name, integrator):
    scene = loaded(showcase("lattice", "glass", "tiles", "patches") if name == "showcase" else name)
    wish = {"integrator": {"type": integrator}, "film": {"aovs": SEEN, "filter": "mitchell"}}
    assert paired(scene, wish, 16, 4) <= 1.0


def test_first_surfaces_agree_pixel_by_pixel():
    """No path to go astray: but for edges that rays graze, layers are equal to rounding."""
    scene = loaded(showcase("lattice", "glass", "tiles", "patches"))
    wish = {"integrator": {"type": "aov"}, "film": {**film_of(40, 30), "aovs": SEEN}}
    on, off = (layers_of(rendered(scene, mode, 1, 2, wish)) for mode in ("on", "off"))
    for name in on:
        near = torch.isclose(
            on[name], off[name], rtol=1e-3, atol=1e-4 * float(off[name].nan_to_num(posinf=0).abs().max())
        )
        assert near.all(-1).float().mean() > 0.995, name


def test_a_crop_shows_the_very_pixels():
    scene = loaded("cornell_box")
    whole = rendered(scene, "on", 5, 6, {"film": film_of(40, 30)})
    part = rendered(scene, "on", 5, 6, {"film": {**film_of(40, 30), "crop": [7, 11, 21, 13]}})
    assert torch.equal(part.image, whole.image[11:24, 7:28])
    assert paired(scene, {"film": {"crop": [3, 5, 16, 8]}}, 24, 4) <= 1.0


@pytest.mark.slow  # of the contract of integrators is a quicker one
def test_a_clamp_takes_the_same_light():
    scene = loaded("cornell_box")
    wish = {"integrator": {"type": "path", "clamp": 0.5}}
    assert paired(scene, wish, 16, 4) <= 1.0
    on, off = (rendered(scene, mode, 2, 16, {**wish, "film": film_of(32)}) for mode in ("on", "off"))
    assert off.clamped is not None and 0.01 < off.clamped < 0.9
    assert on.clamped == pytest.approx(off.clamped, rel=1e-3)


# -- a lane's place


@pytest.mark.parametrize("name", few(["cornell_box", "showcase"], 1))
def test_the_same_rays_in_another_order(name):
    """Bit for bit: nothing of a lane hangs on its neighbours in a vector, a packet or a list."""
    scene = loaded(showcase("lattice", "glass", "gold", "patches") if name == "showcase" else name)
    wave, _ = prepared(scene, {"film": film_of(32), "render": {"spp": 4}})
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        kernels = kernels_of(scene, wave)
        worker, compared = KernelsEngine(kernels), 0
        for model, state, hit, index, depth in waves(wave, 1024, 4).bounces:
            order = torch.randperm(len(index), generator=generator)
            there = torch.randperm(len(state.lane), generator=generator)
            back = torch.empty_like(there)
            back[there] = torch.arange(len(there))
            plain = run_bounce(worker, model, True, state, hit, index, depth)
            # The arena in another order, and the list (or the arena's own lanes) too.
            mixed = run_bounce(worker, model, True, rows(state, there), rows(hit, there), back[index][order], depth)
            for key, value in plain[0].items():
                if value is not None:
                    assert _same(value[..., order], mixed[0][key]), key
                    compared += value.numel()
            assert torch.equal(plain[1][order], mixed[1])
            if kernels.fused:
                gone = ~plain[1]
                assert _same(plain[2][:, gone], mixed[2][:, order.argsort()][:, gone])
        assert compared > 100_000


def _same(a: torch.Tensor, b: torch.Tensor) -> bool:
    a, b = a.contiguous(), b.contiguous()
    return torch.equal(a.view(torch.int32), b.view(torch.int32)) if a.is_floating_point() else torch.equal(a, b)


@pytest.mark.parametrize("name", few(["cornell_box", "showcase", "env_teapot"], 2))
def test_searches_do_not_depend_on_the_packet(name):
    scene = loaded(showcase("lattice", "glass", "gold")) if name == "showcase" else scene_of(name)
    wave, _ = prepared(scene, {"film": film_of(32), "render": {"spp": 4}})
    with torch.no_grad():
        kernels = kernels_of(scene, wave)
        kernels = type(kernels)(wave, kernels.by_kernels, False)
        worker, states = KernelsEngine(kernels), waves(wave, 1024, 4).states
        state = states[1]
        n = len(state.lane)

        def found(state: Any) -> Hit:
            nothing = torch.zeros(n)
            here = arena(kernels, o=state.o, d=state.d, t_max=state.t_max, key=state.key, t=nothing)
            worker.search.nearest(here, n)
            return Hit(*kernels.state.take(here, np.arange(n), tuple(HIT)).values())

        order = torch.randperm(n, generator=torch.Generator().manual_seed(4))
        plain, mixed = found(state), found(rows(state, order))
        assert int((plain.prim >= 0).sum()) > n // 4
        for key in HIT:
            assert _same(getattr(plain, key)[order], getattr(mixed, key)), key
