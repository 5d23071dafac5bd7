"""Settings: built-in default < scene file < override, and whose fault an error is."""

from __future__ import annotations

from typing import Any

import pytest

from torchpt.core.errors import SceneError
from torchpt.paths.integrators import KINDS
from torchpt.scene.formats.description import read_description, settings
from torchpt.scene.settings import Settings

PATH, DIRECT = KINDS["path"], KINDS["direct"]


def merged(overrides: dict[str, Any] | None = None, **blocks: Any) -> Settings:
    camera = {"origin": [0, 0, 1], "target": [0, 0, 0]}
    return settings(read_description({"camera": camera, **blocks}), overrides)


def test_built_in_defaults() -> None:
    found = merged()
    assert (found.film.width, found.film.height, found.film.gamma, found.film.tonemap) == (512, 512, "srgb", "none")
    assert (found.film.filter.name, found.film.filter.values) == ("gaussian", {"stddev": 0.5, "radius": 2.0})
    assert found.integrator == PATH(max_depth=16, rr_depth=5)
    assert found.sampler.name == "sobol"
    assert (found.render.spp, found.render.seed, found.render.threads) == (64, 0, "auto")


def test_precedence() -> None:
    found = merged({"render": {"spp": 4, "seed": None}}, render={"spp": 16, "seed": 7}, film={"width": 8})
    assert (found.render.spp, found.render.seed, found.film.width, found.film.height) == (4, 7, 8, 512)


def test_null_is_unset_everywhere() -> None:
    assert merged({"integrator": {"rr_prob": None}, "film": None}, integrator={"rr_prob": 0.8}).integrator == (
        PATH(rr_prob=0.8)
    )


def test_keys_of_another_type_do_not_follow() -> None:
    found = merged({"integrator": {"type": "direct"}}, integrator={"max_depth": 8, "strategy": "light"})
    assert found.integrator == DIRECT(strategy="light")
    with pytest.raises(SceneError) as caught:
        merged({"integrator": {"type": "direct", "max_depth": 8}})
    assert caught.value.key == "integrator.max_depth"


@pytest.mark.parametrize(
    ("scene", "override", "name", "values"),
    [
        ("box", None, "box", {}),
        ({"type": "gaussian", "stddev": 0.25}, None, "gaussian", {"stddev": 0.25, "radius": 1.0}),
        ({"stddev": 0.25}, {"radius": 3}, "gaussian", {"stddev": 0.25, "radius": 3.0}),
        ({"stddev": 0.25}, "box", "box", {}),
        ("box", {"type": "gaussian"}, "gaussian", {"stddev": 0.5, "radius": 2.0}),
        ({"stddev": 0.25, "radius": 3}, "tent", "tent", {"radius": 3.0}),
        ("tent", None, "tent", {"radius": 1.0}),
        ({"radius": 3}, {"type": "mitchell", "B": 0}, "mitchell", {"B": 0.0, "C": 1 / 3}),
    ],
)
def test_filter_merges(scene: Any, override: Any, name: str, values: dict[str, float]) -> None:
    filter = merged({"film": {"filter": override}}, film={"filter": scene}).film.filter
    assert (filter.name, filter.values) == (name, values)


def test_words_and_sizes() -> None:
    found = merged(render={"compile": True, "max_memory": "1.5GiB", "threads": 2, "device": "cuda:1"})
    assert (found.render.compile, found.render.max_memory) == ("on", 3 * 2**29)
    assert merged({"render": {"compile": False, "max_memory": "4GB"}}).render.max_memory == 4 * 10**9
    assert merged({"film": {"gamma": 0.6, "aovs": "depth"}}).film.aovs == ("depth",)
    assert merged({"integrator": "direct", "sampler": "independent"}).sampler.name == "independent"


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        ({"rendr": {}}, "rendr"),
        ({"render": {"ssp": 3}}, "render.ssp"),
        ({"render": {"spp": 2.5}}, "render.spp"),
        ({"render": {"spp": "4"}}, "render.spp"),
        ({"render": {"seed": -1}}, "render.seed"),
        ({"render": {"seed": 2**63}}, "render.seed"),
        ({"render": {"threads": 0}}, "render.threads"),
        ({"film": {"filter": {"type": "mitchell", "radius": 2}}}, "film.filter.radius"),
        ({"film": {"filter": {"type": "mitchell", "C": 1.5}}}, "film.filter.C"),
        ({"film": {"filter": {"type": "tent", "radius": 0}}}, "film.filter.radius"),
        ({"film": {"filter": {"type": "tent", "stddev": 1}}}, "film.filter.stddev"),
        ({"sampler": {"type": "halton"}}, "sampler.type"),
        ({"render": {"compile": "maybe"}}, "render.compile"),
        ({"film": {"width": 0}}, "film.width"),
        ({"film": {"width": 60000, "height": 60000}}, "film.width"),
        ({"film": {"gamma": 0}}, "film.gamma"),
        ({"film": {"tonemap": "agx"}}, "film.tonemap"),
        ({"film": {"filter": {"stddev": -1}}}, "film.filter.stddev"),
        ({"integrator": {"rr_prob": 0}}, "integrator.rr_prob"),
        ({"integrator": {"max_depth": -2}}, "integrator.max_depth"),
        ({"integrator": {"clamp": 0}}, "integrator.clamp"),
        ({"integrator": {"type": "pth"}}, "integrator.type"),
        ({"integrator": {"type": "aov", "clamp": 1}}, "integrator.clamp"),
        ({"sampler": {"type": "sobol", "spp": 1}}, "sampler.spp"),
    ],
)
def test_bad_overrides(overrides: dict[str, Any], key: str) -> None:
    with pytest.raises(SceneError) as caught:
        merged(overrides)
    assert caught.value.key == key
    assert caught.value.file is None and "\n" not in str(caught.value)


def test_largest_seed() -> None:
    assert merged({"render": {"seed": 2**63 - 1}}).render.seed == 2**63 - 1
