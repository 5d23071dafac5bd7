"""Textures that are no images: wherever an image may stand, they give what an image of the same values gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from few import few

import torchpt
from torchpt.physics.textures import TexturePoint
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene.formats.description import settings

NOISE: dict[str, Any] = {"type": "noise", "scale": 3, "octaves": 2, "seed": 1}
SIZE = 384
SLOTS: dict[str, dict[str, Any]] = {
    "colour": {"color0": [0.9, 0.1, 0.2], "color1": [0.1, 0.6, 0.9]},
    "number": {"color0": 0.1, "color1": 0.9},
    "normal_map": {"color0": [0.2, 0.4, 0.9], "color1": [0.8, 0.6, 0.9]},
    "bump_map": {"color0": 0.0, "color1": 0.5},
    "opacity": {"color0": 0.0, "color1": 1.0},
    "cutoff": {"color0": 0.0, "color1": 1.0},
    "emission": {"color0": [0.0, 0.5, 0.1], "color1": [3.0, 0.5, 1.0]},
    "displacement": {"color0": 0.0, "color1": 1.0},
    "blend": {"color0": 0.0, "color1": 1.0},
}


def scene(slot: str, texture: dict[str, Any]) -> dict[str, Any]:
    """A card before a grey wall under a sky, with a texture in a slot."""
    material: dict[str, Any] = {"type": "diffuse", "reflectance": [0.7, 0.6, 0.5]}
    card: dict[str, Any] = {
        "type": "mesh",
        "vertices": [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]],
        "uvs": [[0, 0], [1, 0], [1, 1], [0, 1]],
        "faces": [[0, 1, 2, 3]],
    }
    if slot == "displacement":
        card["displacement"] = {"texture": texture, "scale": 0.3, "subdivisions": 5}
    elif slot == "colour":
        material["reflectance"] = texture
    elif slot == "number":
        material = {"type": "principled", "base_color": 0.5, "metallic": 1.0, "roughness": texture}
    elif slot == "cutoff":
        material |= {"opacity": texture, "alpha_cutoff": 0.5}
    elif slot == "blend":
        material = {
            "type": "blend",
            "weight": texture,
            "a": {"type": "diffuse", "reflectance": 0.1},
            "b": {"type": "null"},
        }
    else:
        material[slot] = texture
    return {
        "camera": {"origin": [0.3, 0.2, 4], "target": [0, 0, 0], "fov": 34},
        "materials": {"m": material},
        "shapes": {
            "card": {**card, "material": "m"},
            "wall": {"type": "rectangle", "transform": [{"scale": 3}, {"translate": [0, 0, -1]}]},
        },
        "lights": {"lamp": {"type": "point", "position": [2, 3, 3], "intensity": 20}, "sky": {"type": "constant"}},
        "integrator": {"type": "path", "max_depth": 3},
        "film": {"width": 64, "height": 64, "filter": "box"},
    }  # fmt: skip


def taken(loaded: torchpt.Scene, mode: str, **more: Any) -> Rendering:
    found = render_scene(
        loaded, settings(loaded.description, {"render": {"spp": 4, "compile": mode, "seed": 3, **more}})
    )
    assert found.nonfinite_samples == 0
    return found


def baked(texture: dict[str, Any], folder: Path) -> dict[str, Any]:
    """An image of a texture's values over the unit square."""
    plain = torchpt.load(
        {
            "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
            "shapes": {"s": {"type": "rectangle", "material": {"type": "diffuse", "emission": texture}}},
        }
    )
    (table,) = plain.world(torch.float64)[0].textures.tables
    side = (torch.arange(SIZE, dtype=torch.float64) + 0.5) / SIZE
    uv = torch.stack(torch.meshgrid(side, side, indexing="xy")).reshape(2, -1)
    values = table.look_up(torch.zeros(SIZE**2, dtype=torch.int64), TexturePoint(uv), coloured=True)
    torchpt.write_image(folder / "baked.exr", values.T.reshape(SIZE, SIZE, 3).float())
    return {"type": "image", "path": str(folder / "baked.exr"), "wrap": "clamp"}


@pytest.mark.parametrize("slot", few(SLOTS, 2))
def test_as_an_image_of_the_same_values(slot: str, tmp_path: Path):
    texture = {**NOISE, **SLOTS[slot]}
    loaded = torchpt.load(scene(slot, texture), "cpu")
    image = taken(loaded, "off").image
    plain = torchpt.load(scene(slot, {**texture, "color1": texture["color0"]}), "cpu")
    flat = taken(plain, "off").image
    assert float((image - flat).abs().mean()) > 0.01  # it is seen
    expected = taken(torchpt.load(scene(slot, baked(texture, tmp_path)), "cpu"), "off").image
    # Where values decide by chance or by a cutoff, single samples fall on the other side.
    assert float((image - expected).abs().mean()) < 2e-3, slot
    assert float((image - expected).abs().mean()) < 0.05 * float((image - flat).abs().mean())


@pytest.mark.parametrize("slot", few([slot for slot in SLOTS if slot != "displacement"], 2))
def test_compiled_is_eager(slot: str):
    """Nothing of it falls back to tensor operations, and bits do not depend on threads."""
    loaded = torchpt.load(scene(slot, {**NOISE, **SLOTS[slot]}), "cpu")
    made = taken(loaded, "on", threads=1)
    assert made.eager == ()
    assert float((made.image - taken(loaded, "off").image).abs().mean()) < 1e-4
    assert torch.equal(made.image, taken(loaded, "on", threads=2).image)


@pytest.mark.parametrize("slot", few(["opacity", "emission"], 1))
def test_images_and_others_side_by_side(slot: str, tmp_path: Path):
    """Each surface reads its own, by whichever table: as where all of them are images."""
    squares = {"type": "checkerboard", "color0": 0.9, "color1": 0.2, "scale": 2}
    texture = {**NOISE, **SLOTS[slot]}

    def both(own: dict[str, Any]) -> torchpt.Scene:
        described = scene(slot, own)
        for name, at, inner in (("left", -1.4, squares), ("right", 1.4, own)):
            described["shapes"][name] = {
                "type": "rectangle",
                "material": {"type": "diffuse", slot: inner},
                "transform": [{"scale": 0.3}, {"translate": [at, 0.9, 0.2]}],
            }
        return torchpt.load(described, "cpu")

    mixed = both(texture)
    assert len(mixed.world(torch.float32)[0].textures.tables) == 2
    image, expected = (taken(loaded, "off").image for loaded in (mixed, both(baked(texture, tmp_path))))
    assert float((image - expected).abs().mean()) < 2e-3
    assert float((taken(mixed, "on").image - image).abs().mean()) < 1e-4


def test_materials_of_one_model_are_grouped_by_what_reads_them():
    squares = {"type": "checkerboard"}
    textures = {"a": squares, "b": NOISE, "c": {**NOISE, "seed": 2}, "d": {**NOISE, "octaves": 3}, "e": squares}
    described = scene("colour", squares)
    for name, texture in textures.items():
        described["materials"][name] = {"type": "diffuse", "reflectance": texture}
        described["shapes"][name] = {"type": "sphere", "material": name}
    world, _ = torchpt.load(described, "cpu").world(torch.float32)
    assert [type(table).__name__ for table in world.textures.tables] == ["Atlas", "ComputedTable", "ComputedTable"]
    assert [table.count for table in world.textures.tables] == [3, 2, 1]
    textured = [binding.bindings["reflectance"] for binding in world.materials.textures if binding is not None]
    assert sorted(len(binding.nodes) for binding in textured) == [1, 2, 3]
    assert all(model.name == "diffuse" for model in world.materials.models)


def test_gradients_of_a_render():
    """To every parameter, of a colour, of heights, of light, by finite differences."""
    described = scene("colour", {"texture": "n"})
    keys = {"emission": {"texture": "n"}, "bump_map": {"texture": "h"}}
    described["materials"]["m"] |= keys
    # What is drawn must not depend on the texture: that is no part of a derivative with the same samples.
    described["integrator"] = {"type": "path", "max_depth": 2, "strategy": "light", "light_choice": "uniform"}
    described["textures"] = {"n": {**NOISE, **SLOTS["colour"]}, "h": {**NOISE, **SLOTS["bump_map"], "seed": 9}}
    loaded = torchpt.load(described, "cpu")
    wanted = {k: v.double() for k, v in loaded.params.items() if k.startswith("textures.")}
    assert len(wanted) == 10
    ramp = torch.linspace(0.5, 1.5, 24, dtype=torch.float64)[:, None, None] * torch.tensor([1.0, 0.6, 0.3]).double()

    def loss(params: dict[str, torch.Tensor]) -> torch.Tensor:
        film = {"width": 12, "height": 24, "filter": "box"}
        options: dict[str, Any] = {"spp": 1, "seed": 1, "seed_grad": 1, "dtype": torch.float64, "device": "cpu"}
        return (torchpt.render(loaded, params=params, film=film, **options) * ramp).mean()

    given = {key: value.clone().requires_grad_() for key, value in wanted.items()}
    grads = dict(zip(given, torch.autograd.grad(loss(given), list(given.values())), strict=True))
    for key, value in wanted.items():
        step = torch.full_like(value, 1e-5 * (1.0 + float(value.abs().max())))
        with torch.no_grad():
            low, high = (loss({**wanted, key: value + sign * step}) for sign in (-1, 1))
        expected = float(high - low) / 2
        assert float((grads[key] * step).sum()) == pytest.approx(expected, rel=2e-3, abs=1e-12), key
        assert abs(expected) > 0, key


def test_a_floor_to_the_horizon():
    """Faded octaves give the mean that many samples give, with less noise."""
    floor = {
        "camera": {"origin": [0, 1, 0], "target": [0, 0.6, -4], "fov": 50},
        "shapes": {
            "floor": {
                "type": "rectangle",
                "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 60}],
                "material": {"type": "diffuse", "reflectance": {**NOISE, "scale": 400, "octaves": 5}},
            }
        },
        "lights": {"sky": {"type": "constant"}},
        "integrator": {"type": "path", "max_depth": 2},
        "film": {"width": 32, "height": 24, "filter": "box"},
    }
    plain = torchpt.load(floor, "cpu")
    floor["shapes"]["floor"]["material"]["reflectance"]["filter"] = "fade"
    faded = torchpt.load(floor, "cpu")
    truth = taken(plain, "on", spp=1024, seed=9).image
    errors = [
        sum(float((taken(loaded, "on", spp=4, seed=seed).image - truth)[10:15].square().mean()) for seed in range(6))
        for loaded in (plain, faded)
    ]
    assert errors[1] < 0.7 * errors[0], errors
    many = taken(faded, "on", spp=256, seed=5).image
    assert float((many - truth)[10:].mean().abs()) < 2e-3
