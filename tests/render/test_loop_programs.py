"""Programs of the compiled loop: what compiles again and what does not, and models that no kernel can be made of."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from showcase import showcase
from torch import Tensor, nn
from trials import film_of

import torchpt
from torchpt.compiler import cpu
from torchpt.compiler.graph import Unsupported
from torchpt.core.errors import SceneError, warn_once
from torchpt.engines.kernels import engine as chunk
from torchpt.engines.kernels import programs
from torchpt.engines.kernels.programs import Kernels
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs import Parameters
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene.formats.description import settings


def rendered(scene: torchpt.Scene, params: Any = None, **wishes: Any) -> Rendering:
    render = {"spp": 2, "compile": "on", **wishes.pop("render", {})}
    integrator = {"type": "path", "max_depth": 4, "rr_depth": 2, **wishes.pop("integrator", {})}
    wish = {"film": {**film_of(20, 14), **wishes.pop("film", {})}, "integrator": integrator, "render": render, **wishes}
    return render_scene(scene, settings(scene.description, wish), params=params)


@pytest.fixture
def work(monkeypatch) -> Iterator[Any]:
    """Counts kernels compiled and stages traced since it was last asked."""
    traced, kept = [0], programs.trace_stage

    def counting(*args: Any) -> Any:
        traced[0] += 1
        return kept(*args)

    monkeypatch.setattr(programs, "trace_stage", counting)
    before = [cpu.counts()[0], 0]

    def since() -> tuple[int, int]:
        now = [cpu.counts()[0], traced[0]]
        found = now[0] - before[0], now[1] - before[1]
        before[:] = now
        return found

    yield since


TEXTURED: dict[str, Any] = {
    "camera": {"origin": [0, 1.5, 4], "target": [0, 0.5, 0], "fov": 50},
    "textures": {"wood": {"type": "checkerboard", "scale": 4, "color0": [0.6, 0.4, 0.2]}},
    "materials": {
        "wood": {"type": "diffuse", "reflectance": {"texture": "wood"}},
        "gold": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    },
    "lights": {"sky": {"type": "constant", "radiance": [0.3, 0.35, 0.4]}},
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": "wood",
            "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "ball": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.6, "material": "gold"},
        "lamp": {"type": "sphere", "center": [1, 3, 1], "radius": 0.4, "emission": 12},
    },
}


@pytest.mark.parametrize("which", ["cornell_box", "textured"])
@pytest.mark.slow
def test_the_same_scene_otherwise(work, which):
    scene = torchpt.load(TEXTURED if which == "textured" else which, "cpu")
    rendered(scene, render={"spp": 16})  # so many paths that all stages are asked for
    work()
    for change in (
        {"film": film_of(31, 9)},
        {"film": {"crop": [3, 2, 11, 7]}},
        {"film": {"filter": {"type": "gaussian", "radius": 1.1, "stddev": 0.3}}},
        {"render": {"seed": 99}},
        {"render": {"spp": 1}},
        {"render": {"spp": 7}},
        {"render": {"spp": 300}, "film": film_of(3, 2)},  # four randomizations
        {"integrator": {"max_depth": 7}},
        {"integrator": {"clamp": 2.0}, "film": film_of(8)},
        {"integrator": {"clamp": 3.0}, "film": film_of(8)},
        {"render": {"max_memory": "8GB", "threads": 1}},
    ):
        rendered(scene, **copy.deepcopy(change))
        found = work()
        assert found[0] <= ("clamp" in change.get("integrator", {}) and change["integrator"]["clamp"] == 2.0), change
    params = {
        name: value * 0.9 + 0.01 for name, value in scene.params.items() if "reflectance" in name or "fov" in name
    }
    assert params
    picture = rendered(scene, params).image
    assert work() == (0, 0)
    eager = rendered(scene, params, render={"compile": "off"}).image
    assert float((picture - eager).abs().mean()) < 1e-3 * float(eager.mean())
    assert not torch.equal(picture, rendered(scene).image)
    assert work() == (0, 0)


def _other(scene: dict[str, Any]) -> dict[str, Any]:
    """The same structure with other numbers and more of everything."""
    scene = copy.deepcopy(scene)
    scene["camera"] |= {"origin": [1, 2, 3.5], "fov": 35}
    scene["textures"]["wood"] |= {"scale": 9, "color0": [0.1, 0.5, 0.2]}
    scene["materials"]["gold"]["alpha"] = 0.5
    scene["materials"]["brass"] = {"type": "roughconductor", "material": "Cu", "alpha": 0.1}
    for k in range(3):
        ball = {"type": "sphere", "center": [k - 1.0, 0.3, 1], "radius": 0.3, "material": "brass"}
        scene["shapes"][f"more{k}"] = ball
    scene["lights"]["sky"]["radiance"] = 0.7
    return scene


def test_another_scene_of_the_same_structure(work):
    first, second = torchpt.load(TEXTURED, "cpu"), torchpt.load(_other(TEXTURED), "cpu")
    rendered(first)
    work()
    found = rendered(second)
    assert work()[0] == 0 and found.eager == ()
    eager = rendered(second, render={"compile": "off"})
    assert float((found.image - eager.image).abs().mean()) < 1e-3 * float(eager.image.mean())


@pytest.mark.slow
def test_larger_pictures_and_maps(work, tmp_path):
    from torchpt.images import write_image

    def scene(texture: tuple[int, int], sky: tuple[int, int]) -> torchpt.Scene:
        described = copy.deepcopy(TEXTURED)
        generator = torch.Generator().manual_seed(texture[0])
        for name, size in (("wood", texture), ("sky", sky)):
            write_image(tmp_path / f"{name}{size[0]}.exr", torch.rand(*size, 3, generator=generator))
        described["textures"]["wood"] = {
            "type": "image",
            "path": str(tmp_path / f"wood{texture[0]}.exr"),
            "colorspace": "linear",
        }
        described["lights"]["sky"] = {"type": "envmap", "path": str(tmp_path / f"sky{sky[0]}.exr")}
        return torchpt.load(described, "cpu")

    rendered(scene((8, 16), (16, 32)))
    work()
    large = scene((33, 20), (40, 80))
    found = rendered(large)
    assert work()[0] == 0
    eager = rendered(large, render={"compile": "off"})
    assert float((found.image - eager.image).abs().mean()) < 2e-3 * float(eager.image.mean())


AGAIN = """
import sys, torchpt
from torchpt.engines.kernels import programs
from torchpt.compiler import cpu
traced, kept = [0], programs.trace_stage
def counting(*args):
    traced[0] += 1
    return kept(*args)
programs.trace_stage = counting
scene = torchpt.load("cornell_box", "cpu")
wish = dict(film={"width": 16, "height": 16, "aovs": ["albedo"]}, threads=1)
image = torchpt.render(scene, spp=4, full=True, **wish).image
torchpt.render(scene, spp=300, seed=5, full=True, **wish)
print(*cpu.counts(), traced[0], float(image.double().sum()).hex())
"""


@pytest.mark.slow
def test_another_process_compiles_and_traces_nothing(tmp_path):
    folder = tmp_path / "kernels"
    environment = {**os.environ, "TORCHPT_CACHE": str(folder)}

    def run() -> list[str]:
        command = [sys.executable, "-W", "ignore", "-c", AGAIN]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200, check=True)
        return done.stdout.split()

    first, second = run(), run()
    assert int(first[0]) >= 4 and int(first[2]) >= int(first[0])
    assert (int(second[0]), int(second[2])) == (0, 0) and int(second[1]) == int(first[0])
    assert first[3] == second[3]


# -- models of a user's own


class Odd(torchpt.Bsdf):
    """Diffuse, but for an operator that no kernel knows."""

    name = "odd"
    parameters = {"level": 0.5}  # noqa: RUF012

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / torch.pi
        shape = torch.special.bessel_j0(wi[2]) * parameters["level"]
        return (shape * pdf).expand(3, -1), pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        value, pdf = self.eval_pdf(parameters, wo, wi)
        return BsdfSample(wi, pdf, value / torch.where(pdf > 0, pdf, 1.0))

    def albedo(self, parameters: Parameters) -> Tensor:
        return parameters["level"].expand(3, -1)


class Neural(torchpt.Bsdf):
    """Reflectance from a network of operators that kernels know."""

    name = "neural"
    parameters = {"tint": (1.0, 1.0, 1.0)}  # noqa: RUF012

    def __init__(self) -> None:
        self.net = nn.Sequential(nn.Linear(3, 6), nn.ReLU(), nn.Linear(6, 6), nn.Tanh(), nn.Linear(6, 3), nn.Sigmoid())

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / torch.pi
        colour = self.net(torch.stack((wo[2], wi[2], (wo + wi)[2]), 1)).T * parameters["tint"]
        return colour * pdf, pdf

    sample = Odd.sample

    def albedo(self, parameters: Parameters) -> Tensor:
        return parameters["tint"]


def room(*names: str) -> dict[str, Any]:
    described = showcase("gold", "diffuse")
    for k, name in enumerate(names):
        described["materials"][name] = {"type": name}
        described["shapes"][f"own{k}"] = {"type": "sphere", "center": [k, 0.5, 1.6], "radius": 0.5, "material": name}
    return described


def close(a: Rendering, b: Rendering) -> bool:
    return bool(torch.isclose(a.image, b.image, rtol=1e-3, atol=1e-5).all(-1).float().mean() > 0.98)


def test_a_model_that_no_kernel_can_be_made_of(monkeypatch, capsys):
    warn_once.cache_clear()
    scene = torchpt.load(room("odd"), "cpu", bsdfs={"odd": Odd()})
    eager = rendered(scene, render={"compile": "off", "spp": 4})
    asked: list[int] = []
    kept = chunk.bounce_eagerly

    def noted(kernels: Any, context: Any, store: Any, model: int, *args: Any) -> int:
        asked.append(model)
        return kept(kernels, context, store, model, *args)

    capsys.readouterr()
    monkeypatch.setattr(chunk, "bounce_eagerly", noted)
    found = rendered(scene, render={"spp": 4})
    models = scene.world(torch.float32)[0].materials.models
    (own,) = [k for k, model in enumerate(models) if model.name == "odd"]
    assert set(asked) == {own}  # the others run as kernels
    assert len(found.eager) == 1 and "bessel_j0" in found.eager[0] and "odd" in found.eager[0]
    assert found.summary()["eager"] == list(found.eager)
    assert close(found, eager) and found.rays == pytest.approx(eager.rays, rel=1e-3)
    again = rendered(scene, render={"spp": 4, "threads": 2})
    assert torch.equal(again.image, rendered(scene, render={"spp": 4, "threads": 1}).image)
    assert capsys.readouterr().err.count("bessel_j0") == 1  # said once
    assert "eager" not in rendered(torchpt.load(room(), "cpu")).summary()


@pytest.mark.parametrize("name", ["bdpt", "vcm"])
def test_paths_are_connected_and_merged_on_a_model_that_no_kernel_can_be_made_of(name: str):
    """On a film so small that some blocks of the store get a single vertex."""
    scene = torchpt.load(room("odd"), "cpu", bsdfs={"odd": Odd()})
    both = {"type": name, "connections": "one", "light_paths": 1.0}
    keys = {"integrator": both, "film": {"width": 2, "height": 2}}
    eager = rendered(scene, render={"compile": "off"}, **keys)
    found = rendered(scene, **keys)
    assert found.eager and found.rays == eager.rays
    torch.testing.assert_close(found.image, eager.image, rtol=1e-3, atol=1e-5)


def test_a_module_is_compiled_and_its_weights_are_read_anew(work):
    torch.manual_seed(0)
    model = Neural()
    scene = torchpt.load(room("neural"), "cpu", bsdfs={"neural": model})

    def both() -> Rendering:
        with torch.no_grad():
            on, off = (rendered(scene, render={"compile": mode, "spp": 4}) for mode in ("on", "off"))
        assert on.eager == () and close(on, off)
        return on

    before = both()
    work()
    with torch.no_grad():
        for weight in model.net.parameters():
            weight.mul_(0.3).add_(0.2)
    after = both()
    assert work() == (0, 0) and not torch.equal(before.image, after.image)
    model.net.load_state_dict({name: value * 0.5 for name, value in model.net.state_dict().items()})
    assert not torch.equal(both().image, after.image) and work() == (0, 0)
    with torch.no_grad():
        for weight in model.net.parameters():
            weight.data = weight.data.clone() + 0.1  # other memory behind the same parameter
    both()


@pytest.mark.slow
def test_a_model_whose_parts_are_replaced():
    """Not in place: another network, another number."""
    torch.manual_seed(1)
    model, odd = Neural(), Lambert()
    scene = torchpt.load(room("neural", "lambert"), "cpu", bsdfs={"neural": model, "lambert": odd})
    for change in (lambda: None, lambda: setattr(model, "net", Neural().net), lambda: setattr(odd, "gain", 0.2)):
        change()
        with torch.no_grad():
            on, off = (rendered(scene, render={"compile": mode, "spp": 4}) for mode in ("on", "off"))
        assert on.eager == () and close(on, off)


class Lambert(torchpt.Bsdf):
    """Diffuse with a plain number of the object's own."""

    name = "lambert"
    parameters = {"level": 0.9}  # noqa: RUF012

    def __init__(self) -> None:
        self.gain = 1.0

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / torch.pi
        return (parameters["level"] * self.gain * pdf).expand(3, -1), pdf

    sample = Odd.sample

    def albedo(self, parameters: Parameters) -> Tensor:
        return parameters["level"].expand(3, -1)


def test_a_stage_that_turns_out_not_to_compile_renders_all_eagerly(monkeypatch, capsys):
    warn_once.cache_clear()
    scene = torchpt.load("cornell_box", "cpu")
    eager = rendered(scene, render={"compile": "off"})

    def refuses(self: Kernels, *args: Any) -> Any:
        raise Unsupported("the operator nothing_of_the_kind")

    monkeypatch.setattr(Kernels, "emit", refuses)
    monkeypatch.setattr(Kernels, "terminate", refuses)
    for _ in range(2):
        found = rendered(scene, render={"compile": "auto"})
        assert torch.equal(found.image, eager.image) and found.rays == eager.rays
        assert found.eager == ("all stages: the operator nothing_of_the_kind",)
    assert capsys.readouterr().err.count("nothing_of_the_kind") == 1
    said = r"^render.compile: expected auto or off \(no kernel can be made of the operator nothing_of_the_kind\), got 'on'$"
    with pytest.raises(SceneError, match=said):
        rendered(scene, render={"compile": "on"})


@pytest.mark.slow
def test_a_parameter_changed_in_place_reaches_the_tables():
    scene = torchpt.load("env_teapot", device="cpu")
    keys = {"spp": 1, "film": {**film_of(8), "filter": "box"}}
    torchpt.render(scene, **keys)
    for name in ("lights.sky.scale", "lights.sky.texels", "materials.gold.alpha", "materials.table.reflectance"):
        scene.params[name].mul_(0.5)
        found, expected = (float(torchpt.render(scene, compile=mode, **keys).mean()) for mode in ("on", "off"))
        assert found == pytest.approx(expected, rel=1e-4)
