"""What one more of a kind takes: the files named, and no other.

Held elsewhere: one more BSDF, light, shape, camera, sampler, filter, texture and integrator is a file, and one more layer a
class (``test_extending.py``); a stop rule is its declaration and its use (``render/test_arguments.py``); fields, fogs and
splats are an integrator's (``paths/test_own_integrators.py``, ``paths/test_splats.py``); a form of kernels is a ``Form``
(``render/test_forms.py``).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpt
import torchpt.cli
from torchpt.cli import main as cli
from torchpt.core.memory import Budget
from torchpt.engines.engine import Forward, TaskResult, radiance
from torchpt.extend import Bsdf, BsdfSample, Color, cosine_hemisphere
from torchpt.paths.wave import PixelSet, RayCounts, Wave
from torchpt.rendering import run
from torchpt.scene import meshes


def scene_of(shape: dict[str, Any], material: dict[str, Any]) -> dict[str, Any]:
    return {
        "camera": {"origin": [0, 0, 3], "target": [0, 0, 0], "fov": 40},
        "materials": {"own": material},
        "shapes": {"thing": {**shape, "material": "own"}},
        "lights": {"sky": {"type": "constant", "radiance": 1.0}},
    }


def test_a_mesh_format_is_a_file_and_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Words of a text file as corners of a triangle."""
    module = ModuleType("torchpt.scene.meshes.toy")

    def load_toy(path: Path, data: bytes, materials: bool) -> list[meshes.MeshPart]:
        corners = np.array(data.decode().split(), np.float64).reshape(-1, 3)
        return [meshes.MeshPart("", corners, np.arange(len(corners)).reshape(-1, 3), None, None, None)]

    vars(module)["load_toy"] = load_toy
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(meshes.FORMATS, ".toy", "toy")
    file = tmp_path / "one.toy"
    file.write_text("-1 -1 0  1 -1 0  0 1 0")
    scene = torchpt.load(scene_of({"type": "mesh", "path": str(file)}, {"type": "diffuse"}), "cpu")
    assert scene.params["shapes.thing.vertices"].shape == (3, 3)
    image = torchpt.render(scene, spp=4, film={"width": 16, "height": 16}, compile="off")
    assert 0.45 < float(image[8, 8, 0]) < 0.55  # the triangle's own reflectance, under a sky of 1


class Matte(Bsdf):
    """Diffuse, with a tint whose gradient nobody else knows of."""

    name = "matte"
    parameters: ClassVar = {"tint": Color((0.5, 0.5, 0.5), doc="reflectance")}

    def eval_pdf(self, parameters: Mapping[str, Tensor], wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / torch.pi
        return parameters["tint"] * pdf, pdf

    def sample(self, parameters: Mapping[str, Tensor], wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        return BsdfSample(wi, wi[2] / torch.pi, parameters["tint"].expand_as(wi))

    def albedo(self, parameters: Mapping[str, Tensor]) -> Tensor:
        return parameters["tint"]


def test_a_parameter_with_a_gradient_is_its_declaration() -> None:
    scene = torchpt.load(
        scene_of({"type": "rectangle"}, {"type": "matte", "tint": [0.2, 0.4, 0.6]}), "cpu", bsdfs={"matte": Matte()}
    )
    tint = scene.params["materials.own.tint"].clone().requires_grad_()
    wishes: dict[str, Any] = {
        "spp": 4,
        "film": {"width": 8, "height": 8},
        "integrator": {"type": "path", "strategy": "bsdf"},
    }
    image = torchpt.render(scene, params={"materials.own.tint": tint}, **wishes)
    (gradient,) = torch.autograd.grad(image[3:5, 3:5].mean((0, 1)).sum(), tint)
    torch.testing.assert_close(gradient, torch.ones(3), rtol=1e-3, atol=0)  # under a sky of 1 radiance is the tint


class OneByOne:
    """An engine that takes a sample of all pixels after the other: what :class:`torchpt.engines.engine.Forward` asks of one."""

    compiled, seconds = False, 0.0

    def __init__(self, wave: Wave, budget: Budget) -> None:
        self.wave, self.budget, self.taken = wave, budget, 0

    def rows(self, layers: Mapping[str, Any]) -> int:
        return 0

    def run(self, spans: Sequence[tuple[PixelSet, int, int]], each: Callable[[TaskResult | None], bool]) -> bool:
        for pixel_set, first, count in spans:
            pixels = pixel_set.film.width * pixel_set.film.height
            for sample in range(first, first + count):
                values = radiance(self.wave, 0, pixels, sample, 1, pixel_set)
                for place, value in pixel_set.film.writes_of_add(values, 0, sample):
                    place.copy_(value)
                self.taken += 1
                if each(TaskResult(RayCounts(pixels), pixels)):
                    return False
        return True

    def release_workers(self, keeps: bool) -> None:
        pass


def test_an_engine_is_a_file_and_a_line_of_the_door(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[OneByOne] = []

    def door(wave: Wave, budget: Budget) -> Forward:
        made.append(OneByOne(wave, budget))
        return made[-1]

    scene = torchpt.load(scene_of({"type": "rectangle"}, {"type": "diffuse"}), "cpu")
    wish: dict[str, Any] = {"spp": 6, "film": {"width": 8, "height": 8}, "compile": "off"}
    expected = torchpt.render(scene, **wish)
    monkeypatch.setattr(run, "forward_tensors", door)
    found = torchpt.render(scene, full=True, **wish)
    assert torch.equal(found.image, expected)
    assert made[0].taken == 6 and found.paths == 6 * 64


SHAPES = '''
"""`torchpt shapes`: the names of a scene's shapes."""

from torchpt.cli.interrupt import Interrupt

HELP = "torchpt shapes FILE.yaml\\n\\n  Prints the names of the shapes of a scene.\\n"


def run(words: list[str], _: Interrupt) -> int:
    """Print them, one a line; returns the exit code."""
    from torchpt.scene.formats.description import read_description

    print("\\n".join(read_description(words[0]).shapes))
    return 0
'''
#: In torchpt/cli/main.py: what stands there, and what does with the row.
ROW = {
    "COMMANDS = (\n": 'COMMANDS = (\n    Command("shapes", "cornell_box", "names of shapes", shapes.HELP, shapes.run),\n',
    "from torchpt.cli import compare,": "from torchpt.cli import shapes\nfrom torchpt.cli import compare,",
}


def test_a_command_is_a_file_and_a_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "shapes.py").write_text(SHAPES)
    text = Path(str(cli.__file__)).read_text(encoding="utf-8")
    for before, after in ROW.items():
        assert text.count(before) == 1
        text = text.replace(before, after)
    patched = ModuleType("patched")
    torchpt.cli.__path__.append(str(tmp_path))
    sys.modules["patched"] = patched
    try:
        exec(compile(text, "main.py", "exec"), vars(patched))
        main = vars(patched)["main"]
        assert main(["shapes", "cornell_box"]) == 0
        assert capsys.readouterr().out.split()[:2] == ["floor", "ceiling"]
        assert main(["--help"]) == 0 and "torchpt shapes cornell_box" in capsys.readouterr().out
        assert main(["shapes", "--help"]) == 0 and "Prints the names" in capsys.readouterr().out
        assert main(["shapes", "nope"]) == 2 and "torchpt: scene: expected one of" in capsys.readouterr().err
    finally:
        torchpt.cli.__path__.remove(str(tmp_path))
        for name in ("patched", "torchpt.cli.shapes"):
            sys.modules.pop(name, None)
