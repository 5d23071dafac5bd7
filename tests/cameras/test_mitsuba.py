"""Against Mitsuba 3: the same ray for the same film position and lens sample, and the same pictures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from optics import CAMERAS, POSE, numbers
from trials import coarse, film_of, shoot, spread, z_limit

import torchpt
from torchpt.physics.cameras.pinhole import FOV_AXES
from torchpt.scene.formats.description import settings

pytestmark = pytest.mark.mitsuba
SEEDS = 8
#: Lit by large lamps, so that the noise of block means is close to normal; what is in front and behind is out of focus.
ROOM: dict[str, Any] = {
    "shapes": {
        "floor": {"type": "rectangle", "transform": [{"scale": 6}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]},
        "ball": {"type": "sphere", "center": [0, 0.6, 0.5], "radius": 0.6},
        "near": {"type": "cube", "transform": [{"scale": 0.3}, {"translate": [0.8, 0.6, 2.5]}]},
        "far": {
            "type": "rectangle",
            "transform": [{"scale": [0.5, 1, 1]}, {"translate": [-1, 1, -3]}],
            "emission": [2, 1, 0.5],
        },
        "lamp": {"type": "sphere", "center": [1, 4, 2], "radius": 0.8, "emission": 8},
    },
    "lights": {"sky": {"type": "constant", "radiance": [0.2, 0.3, 0.4]}},
}


@pytest.fixture(scope="module")
def bridge():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent.parent.parent / "scripts"))
        sys.modules.pop("mitsuba_scene", None)
        import mitsuba_scene

        yield mitsuba_scene, mitsuba_scene.load_mitsuba("scalar_rgb")


@pytest.mark.parametrize(
    "camera",
    [
        *({**CAMERAS[name], "fov_axis": axis} for name in ("perspective", "thinlens") for axis in FOV_AXES),
        {**CAMERAS["perspective"], "principal_point_offset_x": 0.13, "principal_point_offset_y": -0.2},
        CAMERAS["orthographic"],
    ],
    ids=lambda camera: "-".join(str(value) for value in camera.values()),
)
@pytest.mark.parametrize("size", [(12, 7), (7, 12)])
def test_rays(bridge, camera, size):
    script, mitsuba = bridge
    scene = torchpt.load({"camera": {**POSE, **camera}}, "cpu")
    width, height = size
    crop = (2, 1, 4, 5)
    film = settings(scene.description, {"film": {"width": width, "height": height, "crop": crop}}).film
    theirs = mitsuba.load_dict({**script.sensor(mitsuba, scene.description.camera), "film": script._film(film)})
    ours = scene.camera(film, scene.params, torch.float32)
    place, u = numbers(2, 64, 3, torch.float32), numbers(2, 64, 4, torch.float32)
    o, d = ours.rays(crop[0] + place[0] * crop[2], crop[1] + place[1] * crop[3], u if ours.lens else None)
    o = o.expand_as(d)
    for k in range(64):
        ray, _ = theirs.sample_ray(0, 0.5, mitsuba.Point2f(place[:, k].tolist()), mitsuba.Point2f(u[:, k].tolist()))
        origin, direction = torch.tensor(list(ray.o)), torch.tensor(list(ray.d))
        assert torch.allclose(d[:, k], direction, atol=2e-6)
        start = o[:, k] + d[:, k] * ((origin - o[:, k]) @ d[:, k])  # theirs starts at the near plane
        assert torch.allclose(start, origin, atol=5e-6)
        assert float((start - o[:, k]).norm()) < 2e-3


@pytest.mark.parametrize("name", ["thinlens", "orthographic"])
def test_pictures(bridge, name, tmp_path):
    script, mitsuba = bridge
    scene = torchpt.load({**ROOM, "camera": {**POSE, **CAMERAS[name]}}, "cpu")
    film, keys = {**film_of(40), "filter": "box", "crop": [4, 4, 32, 32]}, {"max_depth": 3, "rr_depth": 9}
    wishes = settings(scene.description, {"film": film, "integrator": {"type": "path", **keys}, "render": {"spp": 32}})
    world = mitsuba.load_dict(script.convert(mitsuba, scene, wishes, tmp_path))
    theirs = spread([torch.tensor(mitsuba.render(world, spp=32, seed=seed).numpy()) for seed in range(SEEDS)])
    ours = spread([shoot(scene, 32, 50 + k, "independent", keys, film).image for k in range(SEEDS)])
    difference, variance = coarse(ours[0] - theirs[0], 8), coarse(ours[1] + theirs[1], 8) / 64
    variance = variance + (1e-5 * coarse(theirs[0], 8)) ** 2  # rounding, where nothing but the sky is seen
    deviate = difference / variance.sqrt()
    assert deviate.shape == (4, 4, 3)
    assert float(deviate.abs().max()) < 1.1 * z_limit(deviate.numel())
    assert float((variance.sqrt() / coarse(theirs[0], 8)).median()) < 0.02
    whole = difference.mean((0, 1)) / (variance.mean((0, 1)) / 16).sqrt()
    assert float(whole.abs().max()) < z_limit(3)


def test_what_has_no_counterpart(bridge):
    script, mitsuba = bridge
    for camera in (CAMERAS["hexagon"], {**CAMERAS["thinlens"], "aperture_radius": 0}):
        scene = torchpt.load({"camera": {**POSE, **camera}}, "cpu")
        with pytest.raises(script.NoCounterpartError, match="round"):
            script.sensor(mitsuba, scene.description.camera)
