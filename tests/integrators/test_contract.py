"""What every integrator keeps, one row a kind; and the same of layers."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from few import few
from few_lanes import few_lanes

import torchpt
from torchpt.core.errors import SceneError
from torchpt.paths.integrators import KINDS
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.layers import LAYERS
from torchpt.scene.formats.description import read_description, settings
from torchpt.spec import Scalar, parameters_of

#: What a convex body of this albedo shows in a furnace.
ALBEDO = 0.75
#: A ball in a sky of radiance 1, seen through one point.
FURNACE: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 0.05},
    "film": {"width": 5, "height": 4, "filter": "box"},
    "materials": {"white": {"type": "diffuse", "reflectance": ALBEDO}},
    "shapes": {"ball": {"type": "sphere", "material": "white"}},
    "lights": {"sky": {"type": "constant"}},
}
#: What there is to get wrong: shadows, two models, an emitter, a lamp that is no surface and a sky.
ROOM: dict[str, Any] = {
    "camera": {"origin": [0, 1.2, 4], "target": [0, 0.6, 0], "fov": 40},
    "film": {"width": 23, "height": 17, "filter": "gaussian"},
    "materials": {
        "clay": {"type": "diffuse", "reflectance": [0.6, 0.4, 0.3]},
        "metal": {"type": "roughconductor", "reflectance": [0.8, 0.8, 0.6], "alpha": 0.3},
    },
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": "clay",
            "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "ball": {"type": "sphere", "center": [-0.5, 0.5, 0], "radius": 0.5, "material": "metal"},
        "box": {"type": "cube", "material": "clay", "transform": [{"scale": 0.3}, {"translate": [0.6, 0.3, 0.3]}]},
        "lamp": {"type": "sphere", "center": [1, 2, 1], "radius": 0.2, "emission": 6},
    },
    "lights": {
        "spot": {"type": "point", "position": [-1, 2, 1], "intensity": 3},
        "sky": {"type": "constant", "radiance": 0.2},
    },
}


@dataclass(frozen=True)
class Row:
    """Of an integrator.

    Attributes:
        furnace: what it shows of the ball.
        accepted: settings other than the default that mean something in the room.
        refused: keys with values just out of range.
        gradient: the parameter of the room whose derivative is compared with a difference; None: no material matters.
        smooth: settings under which no decision hangs on that parameter.
    """

    furnace: float = ALBEDO
    accepted: dict[str, Any] = field(default_factory=dict)
    refused: dict[str, Any] = field(default_factory=dict)
    gradient: str | None = "materials.clay.reflectance"
    smooth: dict[str, Any] = field(default_factory=dict)


LIT = {"light_choice": "nearest", "dark_rims": 1, "clamp": 0, "strict": 1}
#: Of integrators with light paths.
BIDIRECTIONAL: dict[str, Any] = {
    "connections": "all",
    "max_depth": -2,
    "rr_depth": 0,
    "rr_prob": 1.01,
    "strategy": "uniform",
    "weighted": 1,
    "light_paths": 0,
    "light_choice": "nearest",
    "dark_rims": 1,
    "strict": 1,
}
ROWS = {
    "path": Row(
        accepted={"max_depth": 3, "rr_depth": 2, "rr_prob": 0.8, "strategy": "light", "clamp": 2.0},
        refused={**LIT, "max_depth": -2, "rr_depth": 0, "rr_prob": 1.01, "strategy": "bdpt"},
        smooth={"max_depth": 4},
    ),
    "direct": Row(
        accepted={"strategy": "uniform", "dark_rims": True, "strict": True}, refused={**LIT, "strategy": "bdpt"}
    ),
    "vcm": Row(
        accepted={"max_depth": 3, "rr_depth": 2, "light_paths": 0.5, "radius": 0.05, "alpha": 0.5},
        refused={**BIDIRECTIONAL, "radius": 0, "alpha": 0},
    ),
    "bdpt": Row(
        accepted={"max_depth": 3, "rr_depth": 2, "rr_prob": 0.8, "light_paths": 0.5, "connections": "one"},
        refused=BIDIRECTIONAL,
    ),
    "ibl": Row(accepted={"light_choice": "power", "clamp": 1.0}, refused=LIT),
    "aov": Row(gradient=None),
}

every = pytest.mark.parametrize("name", ROWS)


def load(scene: dict[str, Any]) -> torchpt.Scene:
    return torchpt.load(scene, device="cpu")


def test_every_integrator_has_a_row():
    assert set(ROWS) == set(KINDS)
    for name, row in ROWS.items():
        assert set(row.refused) == set(parameters_of(KINDS[name]))


@every
@pytest.mark.parametrize("compiled", [False, True])
def test_a_furnace(name, compiled):
    image = torchpt.render(load(FURNACE), integrator=name, spp=256, compile=compiled)
    assert torch.allclose(image.mean((0, 1)), torch.full((3,), ROWS[name].furnace), rtol=1e-2)


def wishes(name: str) -> list[dict[str, Any]]:
    return [{"type": name}, {"type": name, **ROWS[name].accepted}]


@every
@pytest.mark.parametrize("compiled", [False, True])
def test_the_same_bits_in_any_chunks_and_on_any_threads(name, compiled):
    scene = load(ROOM)
    # Tensor operations take as long for few lanes as for many: there all is asked at once, and of short paths.
    for integrator in wishes(name) if compiled else wishes(name)[1:]:
        wish = {"integrator": integrator, "spp": 5, "seed": 3, "compile": compiled}
        whole = torchpt.render(scene, threads=1, **wish)
        assert float(whole.std()) > 0
        if compiled:
            assert torch.equal(whole, torchpt.render(scene, threads=2, **wish))
        with few_lanes(77 if compiled else 777):
            assert torch.equal(whole, torchpt.render(scene, threads=2, **wish))


@every
def test_compiled_it_shows_what_it_shows_eagerly(name):
    scene = load(ROOM)
    for integrator in wishes(name):
        wish = {"integrator": integrator, "spp": 8, "seed": 3}
        eager, compiled = (torchpt.render(scene, compile=mode, **wish) for mode in ("off", "on"))
        assert torch.isclose(eager, compiled, rtol=1e-3, atol=1e-4).all(-1).float().mean() > 0.97


@every
def test_gradients(name):
    scene, key = load(ROOM), ROWS[name].gradient
    integrator = {"type": name, **ROWS[name].smooth}
    wish = {"integrator": integrator, "spp": 4, "seed": 3, "seed_grad": 3, "dtype": torch.float64, "compile": "off"}
    leaf = scene.params["materials.clay.reflectance"].clone().requires_grad_()
    if not KINDS[name].light:
        with pytest.raises(SceneError, match="where gradients are wanted"):
            torchpt.render(scene, params={"materials.clay.reflectance": leaf}, **wish)
        return
    if KINDS[name]().light_walk() is not None:
        with pytest.raises(SceneError, match="expected one of path, direct, .* where gradients are wanted"):
            torchpt.render(scene, params={"materials.clay.reflectance": leaf}, **wish)
        return
    if key is None:
        torchpt.render(scene, params={"materials.clay.reflectance": leaf}, **wish).mean().backward()
        assert leaf.grad is not None and not leaf.grad.any()
        return
    value = scene.params[key].double()
    leaf = value.clone().requires_grad_()
    torchpt.render(scene, params={key: leaf}, **wish).mean().backward()
    assert leaf.grad is not None
    step = 1e-3
    for k in range(value.numel()):
        ends = [value.index_add(0, torch.tensor([k]), torch.tensor([sign * step]).double()) for sign in (1, -1)]
        more, less = (float(torchpt.render(scene, params={key: end}, **wish).mean()) for end in ends)
        assert float(leaf.grad[k]) == pytest.approx((more - less) / (2 * step), rel=1e-2)
        assert float(leaf.grad[k]) > 0


@every
def test_settings_out_of_range_are_refused(name):
    description = read_description(FURNACE)
    for key, spec in parameters_of(KINDS[name]).items():
        for value in (ROWS[name].refused[key], "no such value", {}):
            with pytest.raises(SceneError) as caught:
                settings(description, {"integrator": {"type": name, key: value}})
            assert caught.value.key == f"integrator.{key}" and spec.expected in str(caught.value)
    with pytest.raises(SceneError, match="known key") as caught:
        settings(description, {"integrator": {"type": name, "no_such_key": 1}})
    assert caught.value.key == "integrator.no_such_key"


@every
def test_an_integrator_is_a_plain_frozen_record(name):
    integrator = KINDS[name]()
    assert integrator == KINDS[name](**integrator.values) and hash(integrator) == hash(KINDS[name]())
    assert integrator.but() == integrator and type(integrator).__name__ in repr(integrator)
    with pytest.raises(AttributeError, match="frozen"):
        integrator.clamp = 3.0
    with pytest.raises(TypeError, match="no_such_key"):
        KINDS[name](no_such_key=1)


def test_lengths_are_counted_in_the_lanes_unit():
    class Near(Integrator):
        parameters: ClassVar = {"distance": Scalar(6.0, length=True), "share": Scalar(0.5)}

    assert Near().counted_in(4.0) == Near(distance=1.5, share=0.5)
    assert Near().counted_in(1.0) == Near()


# -- layers


@dataclass(frozen=True)
class Shown:
    """Of a layer: what it shows of the ball in the furnace; None where that is no number to know."""

    values: tuple[float, ...] | None


LAYER_ROWS = {
    "albedo": Shown((ALBEDO, ALBEDO, ALBEDO)),
    "normal": Shown((0.0, 0.0, 1.0)),
    "depth": Shown((3.0,)),
    "position": Shown((0.0, 0.0, 1.0)),
    "uv": Shown(None),  # the ball's pole is seen
    "object_id": Shown((1.0,)),
    "alpha": Shown((1.0,)),
    "variance": Shown(None),
    "samples": Shown((4.0,)),
}


def layers_of(scene: torchpt.Scene, name: str, compiled: bool, **wish: Any) -> torch.Tensor:
    from torchpt.rendering.api import render_scene

    given = {"film": {"aovs": [name]}, "render": {"spp": 4, "compile": compiled}, **wish}
    found = render_scene(scene, settings(scene.description, given))
    assert list(found.layers) == [name]
    return found.layers[name]


def test_every_layer_has_a_row():
    assert set(LAYER_ROWS) == set(LAYERS)


@pytest.mark.parametrize("name", LAYER_ROWS)
@pytest.mark.parametrize("compiled", [False, True])
def test_a_layer_shows_the_ball(name, compiled):
    layer = layers_of(load(FURNACE), name, compiled)
    assert layer.shape == (4, 5, len(LAYERS[name].channels)) and bool(torch.isfinite(layer).all())
    values = LAYER_ROWS[name].values
    if values is not None:
        assert torch.allclose(layer, torch.tensor(values).expand_as(layer), atol=2e-3)


@pytest.mark.parametrize("name", few(LAYER_ROWS, 4))
def test_a_layer_is_the_same_compiled_and_in_files(name, tmp_path: Path):
    scene = load(ROOM)
    eager, compiled = (layers_of(scene, name, mode, film={"aovs": [name], "filter": "box"}) for mode in (False, True))
    assert torch.isclose(eager, compiled, rtol=1e-3, atol=1e-3).all(-1).float().mean() > 0.95
    torchpt.write_image(tmp_path / "a.exr", torch.zeros(*eager.shape[:2], 3), {name: eager})
    assert torch.equal(torchpt.read_layers(tmp_path / "a.exr")[name], eager.float())
