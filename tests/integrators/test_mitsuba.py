"""Against Mitsuba 3: per-pixel z-tests of whole pictures, with stored references and live ones.

``tests/references/NAME.exr`` holds Mitsuba's mean over independent seeds and the variance of that mean, made by
``scripts/make_references.py``. The deviate of a pixel is ``z = (ours - theirs) / sqrt(var_ours + var_theirs)``, where our
variance comes from ``SEEDS`` independent pictures. As it is estimated from few of them, z follows Student's t about: mean
square ``n / (n - 2) = 1.07``, and since radiance is skewed (a large mean comes with a large variance) its mean lies a little
below zero. The tolerances are stated for that; block means, where both effects average out, are tested at ``SIGNIFICANCE``.

Where a few paths carry much of a pixel's light (caustics, small bright lights met by chance), its deviate is far from normal
at any affordable number of samples: there block means, shapes and the whole are compared, and of the pixels the median.
"""

from __future__ import annotations

import functools
import math
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from torch import Tensor
from trials import SIGNIFICANCE, chi_square_p, coarse, film_of, shoot, spread, z_limit

import torchpt
from torchpt.scene.formats.description import settings

ROOT = Path(__file__).parent.parent.parent
SEEDS = 32
KEYS = {"max_depth": 8, "rr_depth": 5, "dark_rims": True}


def turn(angle: float) -> dict[str, Any]:
    return {"rotate": {"axis": [0, 1, 0], "angle": angle}}


# Every analytic shape, several lights of different kinds, and the environment.
ZOO: dict[str, Any] = {
    "camera": {"origin": [0.5, 2.2, 6], "target": [0, 0.7, 0], "fov": 38, "fov_axis": "y"},
    "lights": {"sky": {"type": "constant", "radiance": [0.02, 0.025, 0.04]}},
    "materials": {"clay": {"type": "diffuse", "reflectance": [0.7, 0.45, 0.3]}},
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": "clay",
            "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "ball": {"type": "sphere", "center": [-1, 0.6, 0], "radius": 0.6, "material": "clay"},
        "block": {
            "type": "cube",
            "transform": [{"scale": [0.4, 0.5, 0.3]}, turn(30), {"translate": [1.2, 0.5, 0.4]}],
        },
        "bulb": {"type": "sphere", "center": [0.3, 2, 0.6], "radius": 0.1, "emission": [30, 25, 20]},
        "panel": {
            "type": "disk",
            "emission": [3, 4, 5],
            "transform": [{"scale": [0.6, 0.4, 1]}, turn(90), {"translate": [-2, 1, 0]}],
        },
        "gem": {
            "type": "mesh",
            "material": "clay",
            "vertices": [[0, 0.1, 1], [0.6, 0.1, 0.9], [0.3, 0.1, 1.5], [0.3, 0.8, 1.1]],
            "faces": [[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]],
            "face_normals": True,  # so coarse a mesh with smooth normals leaks light in Mitsuba; torchpt lets none through
        },
        "glow": {
            "type": "mesh",
            "emission": [1, 2, 1],
            "vertices": [[1, 0.5, -1], [2, 0.5, -1], [1.5, 1.5, -1]],
            "faces": [[0, 1, 2]],
            "face_normals": True,
        },
    },
}  # fmt: skip


#: A ball of plastic on a floor, under each light that no ray meets and a lamp.
DELTAS: dict[str, Any] = {
    "camera": ZOO["camera"],
    "shapes": {
        "floor": ZOO["shapes"]["floor"],
        "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7, "material": {"type": "plastic"}},
        "block": ZOO["shapes"]["block"],
        "lamp": {"type": "sphere", "center": [-1.5, 2.4, 0.6], "radius": 0.3, "emission": [4, 3, 2]},
    },
    "materials": ZOO["materials"],
    "lights": {
        "bulb": {"type": "point", "position": [1.5, 2, 1], "intensity": [3, 4, 5]},
        "beam": {"type": "spot", "position": [-1, 3, 2], "target": [0.4, 0, 0.3], "intensity": [20, 12, 8]},
        "sun": {"type": "directional", "direction": [0.5, -1, -0.4], "irradiance": [1, 0.9, 0.6]},
    },
}
#: More lights than are chosen by power alone, of unlike power, some behind others.
BULBS: dict[str, Any] = {
    "camera": ZOO["camera"],
    "materials": {**ZOO["materials"], "gloss": {"type": "roughplastic", "alpha": 0.2}},
    "shapes": {
        "floor": ZOO["shapes"]["floor"],
        "ball": {"type": "sphere", "center": [-0.4, 0.6, 0.2], "radius": 0.6, "material": "gloss"},
        "block": ZOO["shapes"]["block"],
        **{
            f"bulb{k}": {
                "type": "sphere",
                "center": [2.2 * math.cos(2.4 * k), 0.5 + 0.08 * k, 2.2 * math.sin(2.4 * k)],
                "radius": 0.12,
                "emission": [4 + k % 3, 4 + k % 5, 3 + k % 4],
            }
            for k in range(20)
        },
    },
}
#: A bunny on a floor in a museum; its files are not everywhere.
MUSEUM: dict[str, Any] = {
    "camera": {"origin": [0, 0.2, 0.35], "target": [-0.02, 0.1, 0], "fov": 35},
    "shapes": {
        "bunny": {
            "type": "mesh",
            "path": "$TORCHPT_ASSETS/bunny.ply",
            "material": {"type": "plastic", "diffuse_reflectance": [0.5, 0.3, 0.2]},
        },
        "floor": {
            "type": "rectangle",
            "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"translate": [0, 0.033, 0]}],
        },
    },
    "lights": {"sky": {"type": "envmap", "path": "$TORCHPT_ASSETS/museum.exr", "transform": [turn(40)]}},
}
#: Scenes that are rendered by both, by name; others ship.
LIVE = {"zoo": ZOO, "deltas": DELTAS, "museum": MUSEUM, "bulbs": BULBS}


def ours(scene: Any, size: int, spp: int = 16, compile: str = "off") -> tuple[Tensor, Tensor]:
    shots = [shoot(scene, spp, 100 + k, "sobol", KEYS, film_of(size), compile=compile) for k in range(SEEDS)]
    return spread([shot.image for shot in shots])


def assert_equal_pictures(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor], pixels: bool = True) -> None:
    """Two pictures ``(mean, variance of the mean)`` estimate the same; ``pixels``: each of them too, not only blocks."""
    difference, variance = a[0] - b[0], a[1] + b[1]
    lit = variance.sqrt() > 1e-5 * b[0]
    assert not difference[~lit].abs().gt(1e-4 * b[0][~lit]).any()  # pixels without noise: the lamp, black
    z = difference[lit] / variance[lit].sqrt()
    if pixels:
        assert 0.9 < float((z**2).mean()) < 1.2
        assert float((z.abs() > 3).double().mean()) < 0.015  # t of 31 degrees: 0.0053; skewed radiance: up to 0.01
        assert float(z.abs().max()) < 8
        assert abs(float(z.mean())) < 0.15
    side = len(difference) // 8
    blocks, noise = pooled(difference, side), pooled(variance * lit, side).sqrt() / side
    deviate = torch.where(noise > 1e-5 * pooled(b[0], side), blocks / noise.clamp_min(1e-30), 0.0)
    assert float(deviate.abs().max()) < 1.1 * z_limit(deviate.numel())
    for channel in deviate:  # channels share their paths: each is a test of its own
        assert chi_square_p(float((channel**2).sum()), channel.numel()) > SIGNIFICANCE / 3
    whole, error = difference.mean((0, 1)), variance.sum((0, 1)).sqrt() / difference[..., 0].numel()
    reference = b[0].mean((0, 1))
    assert (error / reference).max() < 0.004  # the test can see a bias of 1 %
    assert (whole.abs() < z_limit(3) * error).all()


def pooled(picture: Tensor, side: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(picture.permute(2, 0, 1)[None], side)[0]


# By kernels, a tenth of the time of tensor operations: that both show the same is for tests/render/test_loop.py to say.
@pytest.mark.parametrize(
    ("name", "compile"), few([("cornell_box", "on"), ("cornell_box", "off"), ("cornell_bunny", "off")], 1)
)
def test_stored_references(name, compile):
    assets = os.environ.get("TORCHPT_ASSETS")
    if name == "cornell_bunny" and not (assets and (Path(assets) / "bunny.ply").is_file()):
        pytest.skip("$TORCHPT_ASSETS/bunny.ply is not there")
    layers = torchpt.read_layers(ROOT / "tests" / "references" / f"{name}.exr")
    reference = layers["image"].double(), layers["variance"].double()
    assert_equal_pictures(ours(torchpt.load(name, device="cpu"), 64, compile=compile), reference)


#: Scenes of many materials, as ``scripts/make_references.py`` rendered them: width, height, max_depth, and the samples a
#: pixel of a picture ``FINE`` times as fine, whose squares of pixels are averaged: a few large waves, and a variance summed
#: up from ``FINE**2`` independent estimates, instead of many small pictures.
MATERIALS = {"veach_mis": (72, 48, 2, 16), "material_row": (96, 32, 64, 4), "studio": (72, 48, 64, 4),
             "shapes_and_maps": (72, 45, 64, 4)}  # fmt: skip
#: One quickly, all in the long form.
SCENES = [name if name == "material_row" else pytest.param(name, marks=pytest.mark.slow) for name in MATERIALS]
FINE = 8


class Compared:
    """A scene rendered once, beside its reference; pixels that show a light of Veach's are black in both."""

    def __init__(self, name: str, more: int, comparable: Any) -> None:
        width, height, depth, spp = MATERIALS[name]
        scene = comparable(name)
        film = {**film_of(FINE * width, FINE * height), "aovs": ["variance", "object_id"]}
        shot = shoot(scene, more * spp, 1, "sobol", {**KEYS, "max_depth": depth}, film, compile="on")
        layers = torchpt.read_layers(ROOT / "tests" / "references" / f"{name}.exr")
        seen = torch.ones(height, width, 1, dtype=torch.float64)
        if name == "veach_mis":  # the smallest covers a tenth of a pixel, at a radiance of 900: noise, and no material
            lights = shoot(scene, 4, 2, film=film, integrator={"max_depth": 1}).image.amax(-1, keepdim=True)
            lights = torch.nn.functional.max_pool2d(lights.permute(2, 0, 1), 3 * FINE, FINE, FINE)
            seen = (lights == 0).double().permute(1, 2, 0)
        self.ours = coarse(shot.image, FINE) * seen, coarse(shot.layers["variance"], FINE) / FINE**2 * seen
        self.theirs = layers["image"].double() * seen, layers["variance"].double() * seen
        names = enumerate(scene.description.shapes, 1)
        shares = {shape: coarse(shot.layers["object_id"] == k, FINE)[..., 0] for k, shape in names}
        #: Pixels that show nothing but one shape, by its name.
        self.shapes = {shape: share == 1 for shape, share in shares.items() if bool((share * seen[..., 0] == 1).any())}


@pytest.fixture(scope="module")
def compared():
    """Compare a scene by name, at ``more`` times the samples."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "scripts"))
        sys.modules.pop("mitsuba_scene", None)
        from mitsuba_scene import comparable

        yield functools.cache(lambda name, more: Compared(name, more, comparable))


def excess(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """By how much ``a`` is brighter than ``b``, as a share, and the standard error of that; one of each a channel.

    Pixels weigh by their signal over the variance in ``b``, the finer one: of all weights these see a common factor best,
    and they do not depend on the noise of ``a``.
    """
    weight = b[0] / b[1].clamp_min(1e-30) * (b[1].sqrt() > 1e-5 * b[0])
    signal = (weight * b[0]).sum((0, 1))
    return (weight * (a[0] - b[0])).sum((0, 1)) / signal, (weight**2 * (a[1] + b[1])).sum((0, 1)).sqrt() / signal


def assert_equal_materials(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> None:
    """Blocks, the whole, the common factor, and those statistics of the pixels that heavy tails leave alone."""
    assert float(b[1].sum() / a[1].sum()) < 1.0  # the reference is the finer one
    assert_equal_pictures(a, b, pixels=False)
    share, error = excess(a, b)
    assert (share.abs() < z_limit(3) * error).all()
    assert (z_limit(3) * error < 0.01).all()
    variance = a[1] + b[1]
    lit = variance.sqrt() > 1e-5 * b[0]
    z = ((a[0] - b[0])[lit] / variance[lit].sqrt()).abs()
    assert abs(float(z.median()) - 0.6745) < 0.05  # the median of a normal deviate's size
    assert float((z > 3).double().mean()) < 0.02


EFFORTS = [1, pytest.param(8, marks=pytest.mark.slow)]


@pytest.mark.parametrize("more", EFFORTS)
@pytest.mark.parametrize("name", SCENES)
def test_stored_references_of_materials(compared, name, more):
    found = compared(name, more)
    assert_equal_materials(found.ours, found.theirs)


@pytest.mark.parametrize("more", EFFORTS)
@pytest.mark.parametrize("name", SCENES)
def test_every_shape_is_as_bright_as_its_reference(compared, name, more):
    found = compared(name, more)
    limit = 1.1 * z_limit(3 * len(found.shapes))
    for shape, pixels in found.shapes.items():
        difference = (found.ours[0] - found.theirs[0])[pixels].sum(0)
        error = (found.ours[1] + found.theirs[1])[pixels].sum(0).sqrt()
        assert (difference.abs() < limit * error + 1e-4 * found.theirs[0][pixels].sum(0)).all(), shape


# The fast form of shapes_and_maps errs by a quarter of a percent: one percent stands out there only most of the time.
@pytest.mark.parametrize("factor", [0.99, 1.01])
@pytest.mark.parametrize("name", [name for name in MATERIALS if name != "shapes_and_maps"])
@pytest.mark.slow
def test_a_bias_of_one_percent_is_noticed_in_materials(compared, name, factor):
    found = compared(name, 1)
    with pytest.raises(AssertionError):
        assert_equal_materials((factor * found.ours[0], found.ours[1]), found.theirs)


def test_the_test_notices_a_bias_of_one_percent():
    layers = torchpt.read_layers(ROOT / "tests" / "references" / "cornell_box.exr")
    reference = layers["image"].double(), layers["variance"].double()
    g = torch.Generator().manual_seed(0)
    right = reference[0] + 4 * reference[1].sqrt() * torch.randn(reference[0].shape, generator=g)
    assert_equal_pictures((right, 16 * reference[1]), reference)
    with pytest.raises(AssertionError):
        assert_equal_pictures((1.01 * right, 16 * reference[1]), reference)


@pytest.mark.mitsuba
@pytest.mark.parametrize("scene", [*LIVE, "cornell_spheres"])
def test_live(scene, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    sys.modules.pop("mitsuba_scene", None)
    from mitsuba_scene import convert, load_mitsuba

    if scene == "museum" and not os.environ.get("TORCHPT_ASSETS"):
        pytest.skip("$TORCHPT_ASSETS is not set")
    mitsuba = load_mitsuba("scalar_rgb")
    loaded = torchpt.load(LIVE[scene] if scene in LIVE else scene, device="cpu")
    film = {**film_of(48), "filter": "box"}
    wishes = settings(loaded.description, {"film": film, "integrator": {"type": "path", **KEYS}, "render": {"spp": 32}})
    theirs = mitsuba.load_dict(convert(mitsuba, loaded, wishes, tmp_path))
    pictures = [torch.tensor(mitsuba.render(theirs, spp=32, seed=seed).numpy()) for seed in range(SEEDS)]
    assert_equal_pictures(ours(loaded, 48, 64), spread(pictures))
