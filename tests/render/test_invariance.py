"""What must not change a bit of a picture: rows are scenes with a feature, columns what does not matter.

A new feature is one row.

Columns: chunks of pixels, threads, tasks, passes over samples, an earlier render, the crop that the film shows. Both ways to
render hold to them, the compiled loop and tensor operations; how near the two are to each other is tests/render/test_loop.py's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from few_lanes import few_lanes
from showcase import showcase
from trials import film_of

import torchpt
from torchpt.engines.kernels import threads
from torchpt.physics.film import FILTERS
from torchpt.physics.samplers import KINDS as SAMPLERS
from torchpt.rendering.api import Rendering, render_scene
from torchpt.rendering.stopping import StopRules
from torchpt.scene.formats.description import settings

#: Nothing here is a whole number of vectors, and five samples are passes of 2, 2 and 1.
WIDTH, HEIGHT, SPP = 19, 15, 5
DOWN = {"rotate": {"axis": [1, 0, 0], "angle": -90}}


@dataclass(frozen=True)
class Row:
    """A scene (of a folder with its files), and what is asked of the render."""

    scene: Callable[[Path], Any]
    wish: dict[str, Any] = field(default_factory=dict)
    modes: tuple[str, ...] = ("eager", "compiled")


def room(**more: Any) -> dict[str, Any]:
    """A ball and a block on a floor, under a lamp and a dim sky."""
    shapes = {
        "floor": {"type": "rectangle", "transform": [{"scale": 3}, DOWN]},
        "ball": {"type": "sphere", "center": [0.3, 0.6, 0], "radius": 0.6, "material": "gloss"},
        "block": {"type": "cube", "transform": [{"scale": 0.3}, {"translate": [-0.8, 0.3, 0.5]}]},
        "lamp": {"type": "sphere", "center": [1, 3, 1], "radius": 0.4, "emission": 12},
        **more.pop("shapes", {}),
    }
    return {
        "camera": {"origin": [0, 1.5, 4], "target": [0, 0.5, 0], "fov": 45},
        "materials": {"gloss": {"type": "roughplastic", "alpha": 0.2}, **more.pop("materials", {})},
        "lights": {"sky": {"type": "constant", "radiance": [0.3, 0.35, 0.4]}},
        "shapes": shapes,
        **more,
    }


def primitives(_: Path) -> dict[str, Any]:
    """Every kind of primitive, lamps among them."""
    pyramid = {
        "type": "mesh",
        "vertices": [[-1, 0.1, 0], [0, 0.1, 0], [-0.5, 1, 0.3], [-0.5, 0.1, 0.8]],
        "faces": [[0, 1, 2], [1, 3, 2], [3, 0, 2]],
        "emission": [0.3, 0.2, 0.1],
    }
    disk = {"type": "disk", "transform": [{"scale": 0.3}, {"translate": [0.9, 1.5, -1]}], "emission": [1, 2, 3]}
    needle = {"type": "cylinder", "center": [1.1, 0.5, 1], "radius": 0.1, "height": 1}
    copy = {"type": "instance", "of": "block", "transform": [{"rotate": {"axis": [1, 1, 0], "angle": 30}}]}
    return room(shapes={"pyramid": pyramid, "disk": disk, "needle": needle, "copy": copy})


def leaves(_: Path) -> dict[str, Any]:
    """Surfaces that are not opaque, one by a texture, before lamp and camera."""
    holes = {"type": "checkerboard", "scale": 5, "color0": 1, "color1": 0.3}
    return room(
        materials={"leaf": {"type": "diffuse", "opacity": 0.4}, "net": {"type": "diffuse", "opacity": holes}},
        shapes={
            "low": {"type": "disk", "material": "leaf", "transform": [DOWN, {"scale": 2}, {"translate": [0, 2, 0]}]},
            "near": {"type": "rectangle", "material": "net", "transform": [{"translate": [0, 1, 2]}]},
        },
    )


def textured(folder: Path) -> dict[str, Any]:
    """An image that is filtered, on colour and normals."""
    texels = torch.rand(33, 64, 3, generator=torch.Generator().manual_seed(1)) * 0.8 + 0.1
    torchpt.write_image(folder / "noise.exr", texels)
    image = {
        "type": "image",
        "path": str(folder / "noise.exr"),
        "filter": "trilinear",
        "uv_transform": {"scale": 4},
    }
    cloth = {"type": "diffuse", "reflectance": image, "normal_map": {**image, "scale": [0.6, 0.6, 1]}}
    return room(materials={"cloth": cloth}, shapes={"wall": {"type": "rectangle", "material": "cloth"}})


def mapped(folder: Path) -> dict[str, Any]:
    """An environment map."""
    texels = torch.rand(17, 32, 3, generator=torch.Generator().manual_seed(2)) ** 8 * 4
    torchpt.write_image(folder / "sky.exr", texels)
    return room(lights={"sky": {"type": "envmap", "path": str(folder / "sky.exr")}})


def many(_: Path) -> dict[str, Any]:
    """Lights enough for the light tree, and those of no extent."""
    lamps = {
        f"lamp{k}": {"type": "sphere", "center": [0.3 * k - 1.5, 1.5, -1], "radius": 0.06, "emission": [4, 4, 6]}
        for k in range(12)
    }
    bare = {
        "point": {"type": "point", "position": [1, 2, 1], "intensity": 4},
        "spot": {"type": "spot", "position": [-1, 3, 1], "target": [0, 0, 0], "intensity": 20},
        "sun": {"type": "directional", "direction": [0.2, -1, 0.1], "irradiance": 1},
    }
    return room(shapes=lamps, lights=bare)


def seen_by(**camera: Any) -> Row:
    return Row(lambda _: room(camera={"origin": [0, 1.5, 4], "target": [0, 0.5, 0], **camera}))


PATH = {"type": "path", "max_depth": 4, "rr_depth": 2}
LAYERS = ["albedo", "normal", "depth", "variance"]
ROWS: dict[str, Row] = {
    "plain": Row(lambda _: room()),
    "searched by a tree": Row(lambda _: room(), {"render": {"accel": "numba"}}),
    "every kind of primitive": Row(primitives),
    "some materials": Row(lambda _: showcase("lattice", "glass", "tiles")),
    "every material": Row(lambda _: showcase(), {"integrator": {**PATH, "max_depth": 3}}, ("eager",)),
    "opacity": Row(leaves),
    "textures and normal maps": Row(textured),
    "environment map": Row(mapped),
    "sky and sun": Row(
        lambda _: room(lights={"sky": {"type": "sky", "sun_direction": [0.4, 0.5, 0.7], "sun_aperture": 3}})
    ),
    "many lights": Row(many, {"integrator": {**PATH, "light_choice": "tree"}}),
    "layers": Row(leaves, {"film": {"aovs": LAYERS}}),
    "clamp": Row(lambda _: room(), {"integrator": {**PATH, "clamp": 0.8}}),
    "preview": Row(mapped, {"integrator": {"type": "ibl"}}),
    **{f"strategy {name}": Row(primitives, {"integrator": {**PATH, "strategy": name}}) for name in ("bsdf", "light")},
    "thin lens": seen_by(type="thinlens", aperture_radius=0.3, focus_distance=4.2),
    "lens of six blades": seen_by(type="thinlens", aperture_radius=0.3, focus_distance=4.2, blades=6),
    "parallel projection": seen_by(type="orthographic", width=3.5),
    **{f"sampler {name}": Row(lambda _: room(), {"sampler": {"type": name}}) for name in SAMPLERS},
    **{f"filter {name}": Row(lambda _: room(), {"film": {"filter": name}}) for name in FILTERS if name != "box"},
}
MODES = {"eager": "off", "compiled": "on"}
#: What is asked otherwise. Tensor operations take 20 ms a wave however small it is, so there all is asked at once.
COLUMNS: dict[str, dict[str, dict[str, Any]]] = {
    "eager": {"chunks on two threads": {"threads": 2, "lanes": 307}},
    "compiled": {
        "again": {},
        "chunks": {"lanes": 307},
        "threads": {"threads": 2},
        "chunks on two threads": {"threads": 2, "lanes": 131},
    },
}


def shot(
    scene: torchpt.Scene, wish: dict[str, Any], mode: str, film: Any = None, lanes: int | None = None, **render: Any
) -> Rendering:
    wishes = {
        "integrator": PATH,
        **wish,
        "film": {"filter": "box", **film_of(WIDTH, HEIGHT), **wish.get("film", {}), **(film or {})},
        "render": {"spp": SPP, "seed": 3, "threads": 1, "compile": MODES[mode], **wish.get("render", {}), **render},
    }
    with few_lanes(lanes):
        return render_scene(scene, settings(scene.description, wishes))


def same(a: Rendering, b: Rendering) -> bool:
    """Pictures and layers to the bit, and what the render says of itself."""
    facts = ("rays", "paths", "spp", "relmse", "truncated_paths", "nonfinite_samples", "complete")
    told = all(getattr(a, name) == getattr(b, name) for name in facts)
    return (
        told and torch.equal(a.image, b.image) and all(torch.equal(a.layers[name], b.layers[name]) for name in a.layers)
    )


def one_by_one(self: StopRules, taken: int) -> int:
    """Passes of one sample each."""
    return int(taken < self.render.spp)


@pytest.fixture
def scene_of(tmp_path) -> Callable[[str], torchpt.Scene]:
    return lambda name: torchpt.load(ROWS[name].scene(tmp_path), device="cpu")


def slow(name: str, mode: str) -> list[pytest.MarkDecorator]:
    """Mark jobs whose kernels take long to compile, or of which one of a kind is left that shows the same."""
    rows = ("many lights", "textures and normal maps", "strategy light", "some materials", "preview", "environment map",
            "sky and sun", "searched by a tree", "parallel projection", "lens of six blades", "filter mitchell")  # fmt: skip
    others = name.startswith(("sampler ", "filter ", "strategy ")) and name not in ("sampler sobol", "filter mitchell")
    eager = ("textures and normal maps", "many lights", "layers")  # of the scene of "opacity"
    return [pytest.mark.slow] * (others or (name in rows if mode == "compiled" else name not in eager))


@pytest.mark.parametrize(
    ("name", "mode"),
    [pytest.param(name, mode, marks=slow(name, mode)) for name, row in ROWS.items() for mode in row.modes],
)
def test_the_same_bits(scene_of, monkeypatch, name, mode):
    scene, wish = scene_of(name), ROWS[name].wish
    whole = shot(scene, wish, mode)
    assert whole.complete and float(whole.image.amax()) > 0
    monkeypatch.setattr(threads, "MIN_TASK_LANES", 16)  # else a film so small is one task
    for column, changed in COLUMNS[mode].items():
        assert same(shot(scene, wish, mode, **changed), whole), column
    if mode == "compiled":
        with monkeypatch.context() as patched:
            patched.setattr(StopRules, "next_pass_spp", one_by_one)
            assert same(shot(scene, wish, mode), whole), "passes"
    else:
        monkeypatch.setattr(StopRules, "next_pass_spp", one_by_one)
    part = shot(scene, wish, mode, {"crop": [4, 2, 11, 9]})
    assert torch.equal(part.image, whole.image[2:11, 4:15]), "crop"
    assert all(torch.equal(part.layers[layer], whole.layers[layer][2:11, 4:15]) for layer in part.layers), "crop"


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("lanes", few([3, 1, 7], 1))
def test_chunks_of_a_few_lanes(scene_of, lanes, mode):
    scene, film = scene_of("plain"), film_of(4, 3)
    assert same(shot(scene, {}, mode, film, lanes=lanes), shot(scene, {}, mode, film))


@pytest.mark.slow
def test_waves_that_threads_divide(scene_of):
    """Tensor operations: torch leaves up to 32,768 numbers to one thread. Here is one pass of 33,282 lanes."""
    scene, film = scene_of("every kind of primitive"), film_of(129)
    one = shot(scene, {}, "eager", film, spp=2)
    assert same(shot(scene, {}, "eager", film, spp=2, threads=2), one)
    assert same(shot(scene, {}, "eager", film, spp=2, threads=2, lanes=20_011), one)


@pytest.mark.parametrize(("tasks", "fewest"), [(1, 1), (50, 1), (3, 5000)])
def test_tasks_of_the_loop(scene_of, monkeypatch, tasks, fewest):
    scene, wish = scene_of("opacity"), {"film": {"filter": "mitchell", "aovs": LAYERS, **film_of(37, 23)}}
    whole = shot(scene, wish, "compiled", spp=15)
    monkeypatch.setattr(threads, "TASKS", tasks)
    monkeypatch.setattr(threads, "MIN_TASK_LANES", fewest)
    assert same(shot(scene, wish, "compiled", spp=15, threads=2), whole)


@pytest.mark.parametrize("mode", MODES)
def test_seeds(scene_of, mode):
    one, other, largest = (shot(scene_of("plain"), {}, mode, seed=seed).image for seed in (3, 3 + 2**32, 2**63 - 1))
    assert not torch.equal(one, other) and not torch.equal(one, largest)
