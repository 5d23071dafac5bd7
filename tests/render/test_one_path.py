"""One path, vertex by vertex: it is the path of the picture, and its parts come to what it brings."""

from __future__ import annotations

import math
import pathlib
from typing import Any

import pytest
import torch
from few import few

import torchpt
from torchpt.core.errors import SceneError
from torchpt.rendering.api import render_scene
from torchpt.rendering.one_path import Path, one_path
from torchpt.scene.formats.description import settings

#: Shipped scenes that need no file, on films of a few pixels.
SCENES = ["cornell_box", "cornell_transmissive", "cornell_rough_specular", "many_lights", "veach_mis", "noise"]
#: Of them, those that others leave the least to say of.
QUICK = ("cornell_transmissive", "veach_mis")
SIZE = 12

#: Beneath an image of a sky: a mirror, a see-through sheet, and glass.
SKY: dict[str, Any] = {
    "camera": {"origin": [0, 1, -5], "target": [0, 0, 0]},
    "materials": {
        "white": {"type": "diffuse"},
        "sheet": {"type": "diffuse", "opacity": 0.4},
        "mirror": {"type": "conductor"},
        "glass": {"type": "dielectric"},
    },
    "shapes": {
        "ball": {"type": "sphere", "material": "glass"},
        "other": {"type": "sphere", "center": [-1.5, 0, 0], "radius": 0.7, "material": "mirror"},
        "sheet": {"type": "rectangle", "material": "sheet", "transform": [{"translate": [1, 0, -1]}]},
        "ground": {"type": "sphere", "center": [0, -101, 0], "radius": 100, "material": "white"},
    },
    "film": {"filter": "box"},
}


def under(file: pathlib.Path, least: float, power: int) -> torchpt.Scene:
    texels = least + torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(1)) ** power * 20
    torchpt.images.write_image(file, texels)
    return torchpt.load({**SKY, "lights": {"sky": {"type": "envmap", "path": str(file)}}}, "cpu")


@pytest.fixture(scope="module")
def sky(tmp_path_factory: pytest.TempPathFactory) -> torchpt.Scene:
    """So steep that directions rounded otherwise change its light by 1e-4: float32 and float64 differ by as much."""
    return under(tmp_path_factory.mktemp("sky") / "sky.exr", 0, 8)


def wishes(scene: torchpt.Scene, compile: str = "off", spp: int = 1, **integrator: Any) -> Any:
    film = {"width": SIZE, "height": SIZE, "filter": "box"}
    render = {"spp": spp, "compile": compile, "pilots": False}
    return settings(scene.description, {"film": film, "integrator": integrator, "render": render})


def pixels() -> list[tuple[int, int]]:
    return [(x, y) for x in range(0, SIZE, 3) for y in range(1, SIZE, 4)]


def compared(scene: torchpt.Scene, compiled: bool = True, **integrator: Any) -> list[Path]:
    """Paths of some pixels, each compared with a picture of one sample."""
    eager = render_scene(scene, wishes(scene, "off", **integrator)).image
    loop = render_scene(scene, wishes(scene, "on", **integrator)).image if compiled else None
    wish = wishes(scene, **integrator)
    paths = [one_path(scene, wish, pixel, 0) for pixel in pixels()]
    for path in paths:
        x, y = path.pixel
        assert torch.equal(eager[y, x], torch.tensor(path.value)), path.pixel
        if loop is not None:
            torch.testing.assert_close(loop[y, x], torch.tensor(path.value), rtol=2e-5, atol=1e-6)
        assert path.value == path.radiance
    return paths


def check_parts(path: Path) -> None:
    """The contributions come to the radiance, and each is the product of what is told of it."""
    total, throughput = torch.zeros(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    for depth, vertex in enumerate(path.vertices, 1):
        assert vertex.depth == depth
        for part in (vertex.emission, vertex.light, vertex.connection):
            total += torch.tensor(part.contribution if part else (0.0,) * 3, dtype=torch.float64)
        if vertex.emission:
            product = throughput * torch.tensor(vertex.emission.radiance) * vertex.emission.mis_weight
            torch.testing.assert_close(product, doubles(vertex.emission.contribution), rtol=1e-4, atol=1e-9)
        if vertex.light and vertex.light.visible:
            light = vertex.light
            product = (
                throughput * doubles(light.bsdf) * doubles(light.arriving) * light.mis_weight * (light.visible or 0.0)
            )
            torch.testing.assert_close(product, doubles(light.contribution), rtol=1e-4, atol=1e-9)
        torch.testing.assert_close(total, doubles(vertex.radiance), rtol=1e-4, atol=1e-7)
        if vertex.scattered and depth < len(path.vertices):
            found = vertex.scattered
            carried = throughput * doubles(found.weight) / (1.0 if found.survival is None else found.survival)
            torch.testing.assert_close(carried, doubles(found.throughput), rtol=1e-4, atol=1e-9)
            throughput = doubles(found.throughput)
            torch.testing.assert_close(-doubles(found.wi), doubles(path.vertices[depth].wo))
    torch.testing.assert_close(total, doubles(path.radiance), rtol=1e-4, atol=1e-7)


def doubles(values: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_paths_that_are_connected_to_light_paths():
    """Connections alone make no splats, so pixels hold their own samples; among all strategies the parts come to the whole."""
    scene = torchpt.load("cornell_box", "cpu")
    keys: dict[str, Any] = {"type": "bdpt", "connections": "one", "light_paths": 1.0}
    alone = compared(scene, compiled=False, **keys, strategy="connections", weighted=True)
    assert sum(vertex.connection is not None for path in alone for vertex in path.vertices) > 5
    for pixel in pixels():
        check_parts(one_path(scene, wishes(scene, **keys), pixel, 0))
    dark = torchpt.load({**SKY, "lights": {}}, "cpu")
    assert one_path(dark, wishes(dark, **keys), (5, 5), 0).value == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in SCENES]
)
def test_it_is_the_path_of_the_picture(name):
    paths = compared(torchpt.load(name, "cpu"))
    for path in paths:
        check_parts(path)
    assert any(max(path.radiance) > 0 for path in paths)


def test_it_is_the_path_of_the_picture_under_a_sky(sky, tmp_path):
    compared(under(tmp_path / "gentle.exr", 20, 1))
    paths = compared(sky, compiled=False)
    ends = {path.ended for path in paths}
    assert "escaped" in ends
    met = [vertex for path in paths for vertex in path.vertices]
    assert {"ball", "ground", "sheet"} <= {vertex.shape for vertex in met}
    lights = {vertex.light.light for vertex in met if vertex.light} | {v.emission.light for v in met if v.emission}
    assert lights == {"sky"}
    deltas = [vertex.scattered for vertex in met if vertex.material == "glass" and vertex.scattered]
    assert deltas and all(delta.pdf == math.inf and delta.eta is not None for delta in deltas)
    for path in paths:
        check_parts(path)


@pytest.mark.parametrize(
    "integrator", few([{"rr_depth": 1}, {"strategy": "light"}, {"type": "direct"}, {"strategy": "bsdf"}], 2)
)
def test_it_is_the_path_of_the_picture_however_light_is_found(integrator):
    paths = compared(torchpt.load("cornell_box", "cpu"), **integrator)
    if "rr_depth" in integrator:
        assert "roulette" in {path.ended for path in paths}
    if integrator.get("type") == "direct":
        assert "max_depth" in {path.ended for path in paths} and max(len(path.vertices) for path in paths) == 2
    if integrator.get("strategy") == "bsdf":
        assert not any(vertex.light for path in paths for vertex in path.vertices)


def test_weights_are_those_among_light_paths_too():
    scene = torchpt.load("cornell_box", "cpu")
    paths = [one_path(scene, wishes(scene, type="bdpt"), pixel, 0) for pixel in pixels()]
    for path in paths:
        check_parts(path)
    assert any(vertex.light and vertex.light.visible for path in paths for vertex in path.vertices)


def test_samples_come_to_the_pixel():
    scene, spp = torchpt.load("cornell_box", "cpu"), 8
    wish = wishes(scene, spp=spp)
    image = render_scene(scene, wish).image
    for x, y in [(3, 7), (6, 6), (9, 2)]:
        values = [doubles(one_path(scene, wish, (x, y), sample).value) for sample in range(spp)]
        torch.testing.assert_close(torch.stack(values).mean(0).float(), image[y, x], rtol=1e-6, atol=0)
        assert len({tuple(value.tolist()) for value in values}) > 1


def test_a_crop_and_other_samplers_have_the_same_path():
    scene = torchpt.load("cornell_box", "cpu")
    wish = {"film": {"width": SIZE, "height": SIZE, "filter": "box"}, "render": {"spp": 3, "compile": "off"}}
    for sampler in ("independent", "stratified", "zsobol"):
        full = settings(scene.description, {**wish, "sampler": sampler})
        cut = settings(scene.description, {**wish, "sampler": sampler, "film": {**wish["film"], "crop": [2, 3, 4, 5]}})
        assert one_path(scene, full, (4, 5), 2) == one_path(scene, cut, (4, 5), 2)


def test_filters_with_negative_lobes_and_the_clamp_enter_the_value():
    scene = torchpt.load("cornell_box", "cpu")
    film = {"width": SIZE, "height": SIZE, "filter": "mitchell"}
    wish = {"film": film, "integrator": {"clamp": 0.05}, "render": {"spp": 1, "compile": "off", "pilots": False}}
    whole = settings(scene.description, wish)
    image, differs = render_scene(scene, whole).image, 0
    for x, y in pixels():
        path = one_path(scene, whole, (x, y), 0)
        assert torch.equal(image[y, x], torch.tensor(path.value)) and max(map(abs, path.value)) <= 0.05 * 1.000001
        differs += path.value != path.radiance
    assert differs


def test_places_are_the_scenes_own():
    """A scene far from the origin is rendered about an origin of its own, and one of tiny lengths in a unit of its own."""
    for scale, move in ((1.0, 1e6), (1e-12, 0.0)):
        scene = torchpt.load(
            {
                "camera": {"origin": [move, 0, -4 * scale], "target": [move, 0, 0]},
                "materials": {"white": {"type": "diffuse"}},
                "shapes": {"ball": {"type": "sphere", "center": [move, 0, 0], "radius": scale, "material": "white"}},
                "lights": {"sky": {"type": "constant", "radiance": 1}},
                "film": {"width": 9, "height": 9, "filter": "box"},
            },
            "cpu",
        )
        path = one_path(scene, settings(scene.description), (4, 4), 0)
        assert path.origin == pytest.approx((move, 0, -4 * scale), rel=1e-6, abs=1e-6 * scale)
        position = path.vertices[0].position
        assert position is not None
        assert position == pytest.approx((move, 0, -scale), rel=1e-9, abs=0.2 * scale)


def test_parts_and_copies_have_their_names():
    pane = {"type": "cube", "transform": [{"scale": [0.5, 1, 0.1]}, {"translate": [-1, 0, 0]}]}
    copy = {"type": "instance", "of": "pane", "transform": [{"translate": [2, 0, 0]}]}
    back = {"type": "rectangle", "transform": [{"scale": 5}, {"translate": [0, 0, -2]}]}
    camera = {"origin": [0, 0, 6], "target": [0, 0, 0], "fov": 50}
    shapes = {"pane": pane, "copy": copy, "back": back}
    scene = torchpt.load({"camera": camera, "shapes": shapes, "lights": {"sky": {"type": "constant"}}}, "cpu")
    wish = wishes(scene)
    met = [vertex for pixel in pixels() for vertex in one_path(scene, wish, pixel, 0).vertices if vertex.shape]
    assert met and {vertex.shape for vertex in met} <= set(scene.description.shapes)
    copies = {name for name, shape in scene.description.shapes.items() if shape.kind.copies}
    assert copies & {vertex.shape for vertex in met}
    assert all(vertex.primitive is not None and vertex.primitive >= 0 for vertex in met)


def test_a_path_that_is_not_finite_says_so():
    """Numbers of it are told as they are; the picture has black in their place."""
    lights = {"near": {"type": "point", "position": [0, 0, -1.000001], "intensity": 3e38}}
    shapes = {"ball": {"type": "sphere", "material": "white"}}
    plain = {"camera": {"origin": [0, 0, -4], "target": [0, 0, 0], "fov": 1e-3}, "shapes": shapes, "lights": lights}
    scene = torchpt.load({**plain, "materials": {"white": {"type": "diffuse"}}}, "cpu")
    path = one_path(scene, wishes(scene), (6, 6), 0)
    assert not all(map(math.isfinite, path.radiance)) and path.value == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("pixel", "sample", "integrator", "message"),
    [
        (
            (SIZE, 0),
            0,
            {},
            rf"debug.pixel: expected a pixel \[x,y\] of the film of {SIZE} x {SIZE} pixels.*got \[12, 0\]",
        ),
        ((0, SIZE), 0, {}, "debug.pixel: expected a pixel"),
        ((0, 0), 1, {}, "debug.sample: expected a whole number from 0 to 0, as render.spp is 1, got 1"),
        (
            (0, 0),
            0,
            {"type": "aov"},
            r"integrator.type: expected one that follows paths \(path, direct, bdpt\).*got 'aov'",
        ),
        ((0, 0), 0, {"type": "ibl"}, r"integrator.type: expected one that follows paths"),
    ],
)
def test_what_there_is_not_is_refused(pixel, sample, integrator, message):
    scene = torchpt.load("cornell_box", "cpu")
    with pytest.raises(SceneError, match=message):
        one_path(scene, wishes(scene, **integrator), pixel, sample)
