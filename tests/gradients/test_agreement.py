"""Both adjoints are derivatives of one estimator: with the same samples they agree but for rounding."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from few import few
from gradient_rooms import gradient_of, room
from torch import Tensor

import torchpt

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

COLOUR = {"plate": {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4]}}
PLATES: dict[str, tuple[dict[str, Any], str]] = {
    "diffuse": (COLOUR["plate"], "reflectance"),
    "roughdiffuse": ({"type": "roughdiffuse", "alpha": 0.4}, "alpha"),
    "conductor": ({"type": "conductor", "eta": [0.2, 0.4, 1.4], "k": [3.2, 2.4, 1.7]}, "eta"),
    "dielectric": ({"type": "dielectric", "int_ior": 1.5}, "int_ior"),
    "thindielectric": ({"type": "thindielectric", "int_ior": 1.5}, "int_ior"),
    "plastic": ({"type": "plastic", "diffuse_reflectance": [0.5, 0.4, 0.3]}, "diffuse_reflectance"),
    "roughplastic": ({"type": "roughplastic", "alpha": 0.2}, "alpha"),
    "roughconductor": ({"type": "roughconductor", "alpha": 0.2, "eta": [0.2, 0.4, 1.4], "k": [3, 2, 1.7]}, "alpha"),
    "roughdielectric": ({"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.5}, "alpha"),
    "roughplastic, beckmann": ({"type": "roughplastic", "distribution": "beckmann", "alpha": 0.2}, "alpha"),
    "roughconductor, beckmann": ({"type": "roughconductor", "distribution": "beckmann", "alpha": 0.2}, "alpha"),
    "roughdielectric, beckmann": ({"type": "roughdielectric", "distribution": "beckmann", "alpha": 0.2}, "alpha"),
    "principled": ({"type": "principled", "base_color": [0.6, 0.5, 0.4], "roughness": 0.4}, "roughness"),
    "phong": ({"type": "phong", "exponent": 20.0}, "exponent"),
    "blinn_phong": ({"type": "blinn_phong", "exponent": 20.0}, "exponent"),
}


def agree(described: dict[str, Any], name: str, limit: float = 1e-4, **wish: Any) -> Tensor:
    """The gradient, once both adjoints gave the same."""
    scene = torchpt.load(described, "cpu")
    one, other = (gradient_of(scene, name, adjoint=kind, **wish) for kind in ("replay", "autograd"))
    size = float(other.norm())
    assert size > 0
    assert float((one - other).norm()) < limit * size
    return one


@pytest.mark.parametrize("kind", ["diffuse", "dielectric", "principled"])
def test_materials(kind):
    plate, key = PLATES[kind]
    agree(room(plate), f"materials.plate.{key}")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in PLATES if kind not in ("diffuse", "dielectric", "principled")])
def test_other_materials(kind):
    plate, key = PLATES[kind]
    agree(room(plate), f"materials.plate.{key}")


LIGHTS = {
    "point": ({"type": "point", "position": [0.5, 1, 2], "intensity": [4, 5, 6]}, "intensity"),
    "spot": ({"type": "spot", "position": [0, 1, 2], "target": [0, 0, 0], "intensity": [9, 8, 7]}, "intensity"),
    "directional": ({"type": "directional", "direction": [-0.2, -0.3, -1], "irradiance": [1, 2, 3]}, "irradiance"),
    "constant": ({"type": "constant", "radiance": [0.5, 0.4, 0.3]}, "radiance"),
}


@pytest.mark.parametrize("kind", ["constant"])
def test_lights(kind):
    light, key = LIGHTS[kind]
    agree(room(COLOUR["plate"], lights={"other": light}), f"lights.other.{key}")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["point", "spot", "directional"])
def test_other_lights(kind):
    light, key = LIGHTS[kind]
    agree(room(COLOUR["plate"], lights={"other": light}), f"lights.other.{key}")


@pytest.mark.parametrize("name", few(["materials.plate.int_ior", "lights.sky.texels"], 1))
def test_tables_by_kernels(name, capfd):
    """Whose entries are made of what is differentiated, or are it: their derivatives are kernels' too."""
    texels = torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(1)) + 0.1
    sky = {"type": "envmap", "data": texels.tolist()}
    agree(room(PLATES["roughplastic"][0], lights={"sky": sky}), name)
    assert "differentiated by tensor operations" not in capfd.readouterr().err


def test_emission_of_one_lamp():
    agree(room(COLOUR["plate"]), "shapes.lamp.emission")


@pytest.mark.parametrize("name", ["shapes.plate.to_world", "camera.to_world"])
def test_geometry(name):
    agree(room(COLOUR["plate"]), name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["shapes.lamp.vertices", "shapes.before.to_world", "camera.fov", "shapes.ball.to_world"]
)
def test_other_geometry(name):
    ball = {"type": "sphere", "center": [0.3, 0.2, 0.7], "radius": 0.3, "material": "plate"}
    limit = 1e-3 if name == "camera.fov" else 1e-4  # a sum that nearly cancels
    agree(room(PLATES["principled"][0], shapes={"ball": ball}), name, limit)


@pytest.mark.parametrize("filter", ["bilinear", "trilinear"])
def test_texels(tmp_path, filter):
    path = tmp_path / "texels.png"
    torchpt.write_image(path, torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0)))
    texture = {"type": "image", "path": str(path), "filter": filter}
    agree(room({"type": "diffuse", "reflectance": texture}), "materials.plate.reflectance")


def test_by_tensor_operations():
    agree(room(COLOUR["plate"]), "materials.plate.reflectance", compile="off")


def test_signed_filters_and_clamps():
    wish = {"film": {"filter": "mitchell"}, "integrator": {"type": "path", "clamp": 2.0, "max_depth": 5}}
    agree(room(COLOUR["plate"]), "materials.plate.reflectance", **wish)


@pytest.mark.parametrize("mode", few(["auto", "off"], 1))
def test_clamped_samples_have_the_derivative_of_what_counts(mode):
    """A grey sample beyond the clamp counts as the clamp, whatever the light: by differences."""
    scene = torchpt.load(room(COLOUR["plate"]), "cpu")
    wish: dict[str, Any] = {"integrator": {"type": "path", "clamp": 0.3, "max_depth": 3}, "compile": mode, "threads": 1}
    base, exact, difference = scene.params["materials.plate.reflectance"], [], []
    for seed in range(4):
        leaf = base.clone().requires_grad_()
        picture = torchpt.render(scene, params={"materials.plate.reflectance": leaf}, spp=64, seed=seed, **wish)
        exact.append(float(torch.autograd.grad(picture.double().sum(), leaf)[0].sum()))
        ends = [
            torchpt.render(scene, params={"materials.plate.reflectance": base + step}, spp=64, seed=seed, **wish)
            for step in (0.02, -0.02)
        ]
        difference.append(float((ends[0].double() - ends[1].double()).sum()) / 0.04)
    a, b = torch.tensor(exact), torch.tensor(difference)
    whole = gradient_of(scene, "materials.plate.reflectance", integrator={"type": "path", "max_depth": 3})
    assert float(whole.norm()) > 0
    assert abs(float(a.mean() - b.mean())) < 4 * float(a.std() + b.std()) / 2 + 0.01 * abs(float(b.mean()))


@pytest.mark.slow
def test_opacity():
    described = room({**COLOUR["plate"], "opacity": 0.5})
    agree(described, "materials.plate.opacity")
    agree(described, "materials.plate.reflectance")
