"""What a scene holds and hands out: parameters changed in place, refused values, lights without power, mirrored shapes."""

from __future__ import annotations

import threading

import pytest
import torch

import torchpt
from torchpt.core.errors import SceneError
from torchpt.core.threads import limited_threads
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings
from torchpt.scene.sources import unique_labels

LAMP = {
    "camera": {"type": "perspective", "origin": [0, 0, 3], "target": [0, 0, 0], "fov": 20},
    "film": {"width": 4, "height": 4, "filter": "box"},
    "shapes": {"lamp": {"type": "rectangle", "emission": 1}},
}


def value(scene, **wish) -> float:
    return float(torchpt.render(scene, spp=1, **wish).mean())


def test_a_parameter_replaced_or_changed_in_place_takes_effect():
    scene = torchpt.load(LAMP, "cpu")
    for number in range(1, 30):  # a freed tensor's id comes again soon
        scene.params["shapes.lamp.emission"] = torch.full((3,), float(number))
        assert value(scene) == pytest.approx(number)
    scene.params["shapes.lamp.emission"].mul_(2)
    assert value(scene) == pytest.approx(58)


@pytest.mark.parametrize("integrator", [{}, {"strategy": "light"}, {"light_choice": "power"}, "ibl"], ids=str)
def test_a_render_makes_one_world(integrator):
    scene = torchpt.load({**LAMP, "lights": {"sky": {"type": "constant"}}}, "cpu")
    torchpt.render(scene, spp=1, integrator=integrator)
    assert len(scene._worlds) == 1  # pyright: ignore[reportPrivateUsage]


@pytest.mark.parametrize("change", [{"width": 6}, {"height": 6}, {"crop": [1, 0, 2, 3]}, {"filter": "tent"}], ids=str)
def test_a_scene_remembers_no_other_film(change):
    """A render leaves tables for the next one, which asks for another film."""
    scene = torchpt.load({**LAMP, "camera": {**LAMP["camera"], "fov": 50}}, "cpu")
    torchpt.render(scene, spp=2)
    film = {**LAMP["film"], **change}
    fresh = torchpt.render(torchpt.load({**LAMP, "camera": {**LAMP["camera"], "fov": 50}}, "cpu"), spp=2, film=film)
    assert torch.equal(torchpt.render(scene, spp=2, film=film), fresh)


@pytest.mark.parametrize("kind", ["rectangle", "disk"])
@pytest.mark.parametrize(("scale", "expected"), [([1, 1, 1], 1), ([-1, 1, 1], 1), ([1, -1, 1], 1), ([1, 1, -1], 0)])
def test_a_mirrored_flat_light_faces_where_its_normal_goes(kind, scale, expected):
    lamp = {"type": kind, "emission": 1, "transform": [{"scale": scale}]}
    assert value(torchpt.load({**LAMP, "shapes": {"lamp": lamp}}, "cpu")) == pytest.approx(expected)


def test_a_light_without_power_seen_from_behind_is_no_nan():
    shapes = {
        "dark": {"type": "rectangle", "emission": 1, "flip_normals": True},
        "ball": {"type": "sphere", "center": [0, 3, 0], "emission": 5},
        "floor": {"type": "rectangle", "transform": [{"scale": 5}, {"translate": [0, 0, -1]}]},
    }
    scene = torchpt.load({**LAMP, "shapes": shapes}, "cpu")
    scene.params["shapes.dark.emission"].zero_()
    found = render_scene(scene, settings(scene.description, {"render": {"spp": 16}}))
    assert found.nonfinite_samples == 0


def test_a_light_too_weak_for_a_24_bit_choice_is_not_amplified():
    huge = [{"scale": 100}, {"translate": [0, 0, -50]}]
    shapes = {
        "weak": {"type": "sphere", "center": [0, 0, 1.5], "radius": 0.1, "emission": 0.01},
        "huge": {"type": "rectangle", "emission": 1e6, "transform": huge, "flip_normals": True},
        "floor": {"type": "rectangle", "transform": [{"scale": 3}]},
    }
    scene = torchpt.load({**LAMP, "shapes": shapes}, "cpu")
    means = [
        torchpt.render(scene, spp=1024, integrator={"type": "direct", "strategy": strategy}).mean()
        for strategy in ("light", "bsdf")
    ]
    assert float(means[0] / means[1]) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    ("name", "tensor", "words"),
    [
        ("shapes.lamp.emission", torch.tensor([1.0, -1.0, 0.0]), ">= 0"),
        ("shapes.lamp.emission", torch.tensor([1.0, torch.inf, 0.0]), "finite"),
        ("shapes.lamp.to_world", torch.zeros(4, 4), "inverted"),
        ("shapes.ball.to_world", torch.diag(torch.tensor([4.0, 0.25, 1.0, 1.0])), "keeps angles"),
    ],
)
def test_parameters_that_no_scene_could_hold_are_refused(name, tensor, words):
    scene = torchpt.load({**LAMP, "shapes": {**LAMP["shapes"], "ball": {"type": "sphere"}}}, "cpu")
    with pytest.raises(SceneError, match=words):
        torchpt.render(scene, params={name: tensor}, spp=1)


@pytest.mark.parametrize(
    "wish", [{"spp_grad": 0}, {"spp_grad": -1}, {"seed_grad": -1}, {"seed_grad": 1.5}, {"device": "foo"}]
)
def test_arguments_out_of_range_are_refused(wish):
    with pytest.raises(SceneError, match=next(iter(wish))):
        torchpt.render(torchpt.load(LAMP, "cpu"), spp=1, **wish)


def test_a_gradient_of_layers_is_refused_before_it_is_rendered():
    scene = torchpt.load(LAMP, "cpu")
    leaf = scene.params["shapes.lamp.emission"].clone().requires_grad_()
    with pytest.raises(SceneError, match=r"integrator\.type"):
        torchpt.render(scene, params={"shapes.lamp.emission": leaf}, spp=1, integrator="aov")


def test_the_scenes_own_device_is_heard():
    with pytest.raises(torchpt.RenderError, match="cuda:63"):
        torchpt.load({**LAMP, "render": {"device": "cuda:63"}})


def test_an_explicit_emission_of_zero_stays_a_parameter():
    scene = torchpt.load({**LAMP, "shapes": {"lamp": {"type": "rectangle", "emission": 0}}}, "cpu")
    assert value(scene, params={"shapes.lamp.emission": torch.ones(3)}) == pytest.approx(1)


def test_labels_of_mesh_parts_are_distinct():
    labels = unique_labels(["a", "a_2", "a", "", "a.b", "a_b"])
    assert len(set(labels)) == 6 and not any("." in label for label in labels)


def test_overlapping_renders_put_the_thread_count_back():
    before = torch.get_num_threads()
    inside, go_on = threading.Event(), threading.Event()

    def first() -> None:
        with limited_threads(1):
            inside.set()
            go_on.wait(10)

    worker = threading.Thread(target=first)
    worker.start()
    inside.wait(10)
    with limited_threads("auto"):
        go_on.set()
        worker.join()
    assert torch.get_num_threads() == before
