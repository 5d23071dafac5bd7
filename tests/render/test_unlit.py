"""Pictures that lack light: their error is not known, and they say why."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from trials import film_of

import torchpt
from torchpt.cli.main import main
from torchpt.core.errors import NoLightWarning
from torchpt.rendering.api import Rendering, render_scene
from torchpt.rendering.missing_light import MissingLight, find_missing_light
from torchpt.rendering.run import Run
from torchpt.scene.formats.description import settings

FLOOR = {"type": "rectangle", "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]}
BULB = {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "material": {"type": "dielectric"}}
CAMERA = {"origin": [0, 2, 6], "target": [0, 0.7, 0], "fov": 40}
POINT = {"type": "point", "position": [0, 1, 0], "intensity": 10}
SPOT = {"type": "spot", "position": [0, 1, 0], "target": [0, 0, 0], "intensity": 10}


def room(lights: Any = None, **shapes: Any) -> torchpt.Scene:
    scene = {"camera": CAMERA, "film": film_of(24, 18), "shapes": {"floor": FLOOR, **shapes}, "lights": lights or {}}
    return torchpt.load(scene, device="cpu")


def shot(scene: torchpt.Scene, integrator: Any = "path", film: Any = None, **render: Any) -> Rendering:
    wishes = {"integrator": integrator, "film": film or {}, "render": {"pilots": True, "spp": 16, **render}}
    return render_scene(scene, settings(scene.description, wishes))


@pytest.mark.parametrize("accel", ["brute", "numba", "torch"])
@pytest.mark.parametrize("light", few([POINT, SPOT], 1))
def test_a_light_inside_of_glass_is_named(light, accel):
    found = shot(room({"p": light}, bulb=BULB), accel=accel)
    assert found.relmse is None and found.relmse_interval is None and not bool(found.image.any())
    inside = f"a {light['type']} light inside bulb (dielectric) cannot be found by integrator path"
    inside += " (bdpt finds it where it is not seen through glass or in a mirror, vcm there too)"
    assert found.relmse_unknown == f"lights.p: {inside}" == found.summary()["relmse_unknown"]
    assert found.summary()["relmse"] is None and "relmse" not in found.header()


def test_it_is_named_beside_other_light():
    """Which a picture shows without a trace of the one that it lacks."""
    found = shot(room({"p": POINT, "sky": {"type": "constant", "radiance": 1.0}}, bulb=BULB))
    assert float(found.image.min()) > 0.0 and found.relmse is None and "lights.p" in found.relmse_unknown


def test_a_sun_behind_panes():
    sun = {"type": "directional", "direction": [0, -1, 0], "irradiance": 3}
    box = {"type": "cube", "transform": [{"scale": [8, 3, 8]}], "material": {"type": "thindielectric"}}
    found = shot(room({"sun": sun}, box=box))
    assert found.relmse_unknown.startswith("lights.sun: a directional light behind box (thindielectric)")
    assert shot(room({"sun": sun})).relmse_unknown == ""
    # The floor in the shadow of a glass ball is lit through it alone, and that no path finds.
    shadow = shot(room({"sun": sun}, bulb=BULB)).relmse_unknown
    assert shadow.startswith("no sample met any light in ")


@pytest.mark.parametrize("strategy", ["bsdf", "uniform"])
def test_a_point_is_not_found_by_chance(strategy):
    found = shot(room({"p": {**POINT, "position": [0, 3, 0]}}), {"type": "path", "strategy": strategy})
    assert (
        found.relmse_unknown == f"lights.p: a point light cannot be found by integrator path with strategy {strategy}"
    )


def test_what_lets_light_out_is_no_lid():
    """A rough bulb scatters, a cut-out lets light pass, and a light beside the bulb shines on the floor."""
    rough = {**BULB, "material": {"type": "roughdielectric", "alpha": 0.3}}
    cut = {**BULB, "material": {"type": "dielectric", "opacity": 0.5}}
    for lights, bulb in (({"p": POINT}, rough), ({"p": POINT}, cut), ({"p": {**POINT, "position": [0, 2, 0]}}, BULB)):
        found = shot(room(lights, bulb=bulb), spp=64)
        assert "cannot be found" not in found.relmse_unknown


@pytest.mark.parametrize("lights", [{}, {"p": {**POINT, "intensity": 0}}])
def test_no_light_at_all(lights):
    found = shot(room(lights), target_error=0.05)
    assert found.relmse_unknown == "there is no light at all in the scene"
    assert (found.relmse, found.spp, found.stopped_by) == (None, 16, "spp")
    variance = shot(room(lights), film={"aovs": ["variance"]}, pilots=False)
    assert variance.relmse is None and variance.relmse_unknown


def test_a_part_without_light():
    """A wall hides the light from half of the floor; what camera rays miss is black too, and known to be.

    Of direct light alone the shadow is known to be black.
    """
    wall = {"type": "rectangle", "transform": [{"scale": 4}, {"rotate": {"axis": [0, 1, 0], "angle": 90}}]}
    part = shot(room({"p": {**POINT, "position": [2, 2, 0]}}, wall=wall), {"type": "path", "max_depth": 3})
    assert part.relmse is None and part.relmse_unknown.startswith("no sample met any light in ")
    assert 20 < float(part.relmse_unknown.split(" % ")[0].split()[-1]) < 60
    direct = shot(room({"p": {**POINT, "position": [2, 2, 0]}}, wall=wall), "direct")
    assert direct.relmse is not None and bool((direct.image == 0.0).all(2).any())
    empty = shot(room({"p": {**POINT, "position": [0, 3, 0]}}))
    assert bool((empty.image == 0.0).all(2).any()) and empty.relmse is not None and not empty.relmse_unknown


def run_of(scene: torchpt.Scene) -> Run:
    with torch.no_grad():
        return Run(scene, settings(scene.description, {"render": {"pilots": True, "spp": 8}}), None, torch.float32)


def test_dark_pixels_count_where_they_show_what_reflects():
    black = {"type": "rectangle", "material": "black", "transform": [{"scale": 0.3}, {"translate": [0, 1, 0]}]}
    scene = {
        "camera": CAMERA,
        "film": film_of(64, 48),
        "materials": {"black": {"type": "diffuse", "reflectance": 0.0}},
        "shapes": {"floor": FLOOR, "black": black},
        "lights": {"sky": {"type": "constant"}},
    }
    run = run_of(torchpt.load(scene, device="cpu"))

    def dark(relmse: float, *pixels: tuple[int, int]) -> MissingLight:
        picture = torch.ones(48, 64, 3, dtype=torch.float64)
        for x, y in pixels:
            picture[y, x] = 0.0
        return find_missing_light(run.scene, run.wave, run.geometry, picture, relmse)

    on_floor, on_black, on_sky = [(x, 40) for x in range(20, 30)], (32, 20), (2, 2)
    assert dark(0.1) == dark(0.1, on_black) == dark(0.1, on_sky) == MissingLight("", 0.0)
    assert dark(0.1, *on_floor, on_black, on_sky) == MissingLight("", 10 / 3072)
    more = dark(0.001, *on_floor).reason  # more than is known
    assert more.startswith("no sample met any light in 0.33 % of the picture (integrator bdpt")
    half = [(x, y) for y in range(40, 48) for x in range(20, 40)]
    found = dark(0.2, *half)
    assert found.reason.startswith("no sample met any light in 5.2 % of the picture") and found.dark_share == 160 / 3072


def test_the_far_side_of_a_ball_that_is_alone_is_known_to_be_black():
    ball = {"type": "sphere", "center": [0, 1, 0], "radius": 1.5}
    lamp = {"type": "sphere", "center": [9, 4, 0], "radius": 0.5, "emission": 50}
    scene = {"camera": CAMERA, "film": film_of(24, 18), "shapes": {"ball": ball, "lamp": lamp}}
    alone = shot(torchpt.load(scene, device="cpu"))
    assert alone.relmse is not None and alone.relmse_unknown == ""
    scene["shapes"] |= {"moon": {"type": "sphere", "center": [-9, 1, 0], "radius": 0.5}}
    assert shot(torchpt.load(scene, device="cpu"), integrator={"type": "path", "max_depth": 3}).relmse is None


def test_few_dark_pixels_widen_the_interval(monkeypatch):
    """A black pixel may be off by 1 at most, in squared error over radiance squared."""
    scene = torchpt.load("cornell_box", device="cpu")
    plain = shot(scene, film=film_of(32))
    monkeypatch.setattr("torchpt.rendering.missing_light.find_missing_light", lambda *_: MissingLight("", 0.003))
    wide = shot(scene, film=film_of(32))
    assert plain.relmse_interval is not None and wide.relmse_interval is not None and wide.relmse == plain.relmse
    low, high = plain.relmse_interval
    assert wide.relmse_interval == (low, pytest.approx(high + 0.003))


@pytest.mark.parametrize("compile", few(["on", "off"], 1))
def test_rare_light_never_ends_a_render(compile):
    """A lamp in a bulb: three samples in four thousand meet it, and until one does the floor looks flawless."""
    lamp = {"type": "sphere", "center": [0, 1, 0], "radius": 0.02, "emission": 5000}
    scene = room(bulb=BULB, lamp=lamp)
    for seed in range(4 if compile == "on" else 1):
        found = shot(scene, target_error=0.05, spp=64, seed=seed, compile=compile)
        assert (found.spp, found.stopped_by, found.relmse, found.heavy_tailed) == (64, "spp", None, True)


def test_python_warns_and_the_command_line_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "s.yaml"
    file.write_text(
        "camera: {origin: [0, 2, 6], target: [0, 0.7, 0], fov: 40}\nfilm: {width: 16, height: 12}\n"
        "shapes:\n  bulb: {type: sphere, center: [0, 1, 0], radius: 0.5, material: {type: dielectric}}\n"
        "lights: {p: {type: point, position: [0, 1, 0]}}\n"
    )
    scene = torchpt.load(file, device="cpu")
    with pytest.warns(NoLightWarning, match="lights.p: a point light inside bulb"):
        torchpt.render(scene, spp=4, pilots=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchpt.render(scene, spp=4)  # nobody asked
    assert main(["render", f"scene={file}", f"out={tmp_path / 'a.exr'}", "render.spp=4"]) == 0
    out, err = capsys.readouterr()
    assert err.count("\n") == 1 and err.startswith("torchpt: warning: the picture's error is not known: lights.p: ")
    facts = json.loads(out.splitlines()[-1])
    assert facts["relmse"] is None and facts["relmse_interval"] is None and facts["relmse_unknown"] in err


def test_the_reason_costs_no_bit():
    scene = room({"p": {**POINT, "position": [0, 3, 0]}}, bulb=BULB)
    assert torch.equal(shot(scene).image, shot(scene).image)
