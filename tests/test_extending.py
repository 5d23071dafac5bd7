"""docs/guides/extending.md is carried out: its files are put where it says, and a scene uses all of them."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import torchpt

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "guides" / "extending.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"`(torchpt/[\w/]+\.py)`:\n\n```python\n(.*?)```\n", PAGE, re.DOTALL))
KINDS = {
    *(f"physics/{room}/kinds" for room in ("bsdfs", "lights", "shapes", "cameras", "samplers", "film", "textures")),
    "paths/integrators/kinds",
}
#: What is one class more of a file that is there: where, and the class.
ENTRIES = dict(
    re.findall(r"In `(torchpt/[\w/]+\.py)`, among the others:\n\n```python\n(class .*?)```\n", PAGE, re.DOTALL)
)

#: What a process does once its packages also look into the folder of the new files.
USES = """
import json, sys
from importlib import import_module
from pathlib import Path

folder = Path(sys.argv[1])
for package in json.loads(sys.argv[2]):
    import_module("torchpt." + package.replace("/", ".")).__path__.append(str(folder / package))
import torchpt.paths
torchpt.paths.__path__.insert(0, str(folder / "entries"))  # its layers.py comes before the one that is there

import torch
import torchpt

scene = torchpt.load({
    "camera": {"type": "fisheye", "origin": [0, 1, 3], "target": [0, 0.5, 0], "fov": 120},
    "film": {"width": 24, "height": 16, "filter": "lanczos"},
    "sampler": {"type": "lattice"},
    "textures": {"lines": {"type": "stripes", "count": 3}},
    "materials": {"clay": {"type": "minnaert", "reflectance": {"texture": "lines"}, "k": 2}},
    "shapes": {
        "floor": {
            "type": "rectangle", "material": "clay",
            "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 3}],
        },
        "bowl": {"type": "paraboloid", "apex": [0, 1.2, 0], "radius": 0.6, "material": "clay"},
        "glow": {"type": "paraboloid", "apex": [1, 0.5, 0], "radius": 0.2, "height": 0.5, "emission": 2},
    },
    "lights": {"lamp": {"type": "searchlight", "position": [1, 3, 2], "target": [0, 0, 0], "intensity": 20}},
}, device="cpu")
for wish in ({}, {"integrator": "ao"}, {"integrator": "aov", "film": {"aovs": ["facing"]}}):
    eager, compiled = (torchpt.render(scene, spp=32, compile=mode, **wish) for mode in (False, True))
    assert bool(torch.isfinite(eager).all()) and float(eager.mean()) > 0.01, wish
    assert torch.allclose(eager.mean(), compiled.mean(), rtol=1e-3), wish
for name in ("materials.clay.k", "textures.lines.color1", "lights.lamp.exponent", "camera.fov", "shapes.glow.emission"):
    given = {name: scene.params[name].clone().requires_grad_()}
    image = torchpt.render(scene, spp=4, params=given)
    (gradient,) = torch.autograd.grad(image.mean(), given[name])
    assert bool(torch.isfinite(gradient).all()) and bool(gradient.any()), name
for name, value in (("materials.clay.k", 11.0), ("lights.lamp.exponent", -1.0), ("camera.fov", 400.0)):
    try:
        torchpt.render(scene, spp=1, params={name: torch.tensor(value)})
    except torchpt.SceneError as error:
        assert error.key == f"params.{name}"
    else:
        raise AssertionError(name)
"""


def test_there_is_one_file_of_each_kind_and_a_layer() -> None:
    assert {path.removeprefix("torchpt/").rpartition("/")[0] for path in FILES} == KINDS
    assert not [path for path in FILES if (ROOT / path).exists()]
    assert list(ENTRIES) == ["torchpt/paths/layers.py"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_they_work_where_they_are_put(tmp_path: Path) -> None:
    for path, text in FILES.items():
        place = tmp_path / path.removeprefix("torchpt/")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
    for path, text in ENTRIES.items():
        place = tmp_path / "entries" / Path(path).name
        place.parent.mkdir(exist_ok=True)
        head, mark, tail = (ROOT / path).read_text(encoding="utf-8").partition("\n\nclass Alpha(")
        assert mark
        place.write_text(f"{head}\n\n{text}{mark}{tail}", encoding="utf-8")
    packages = str(sorted(KINDS)).replace("'", '"')
    words = [sys.executable, "-W", "ignore", "-c", USES, str(tmp_path), packages]
    done = subprocess.run(words, capture_output=True, text=True, timeout=240, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]


def test_an_integrator_without_lights_has_shadow_rays_in_both_engines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_ao.py").write_text(FILES["torchpt/paths/integrators/kinds/ao.py"], encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    own: Any = importlib.import_module("own_ao")
    balls = {f"ball{k}": {"type": "sphere", "center": [0.7 * k, 0, 0], "radius": 0.5} for k in range(2)}
    scene = torchpt.load(
        {"camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40}, "shapes": balls}, device="cpu"
    )
    wish: dict[str, Any] = {"film": {"width": 16, "height": 16}, "spp": 16, "integrator": own.AmbientOcclusion()}
    eager, compiled = (torchpt.render(scene, compile=mode, **wish) for mode in ("off", "on"))
    torch.testing.assert_close(compiled, eager, rtol=1e-4, atol=1e-4)
    assert 0.1 < float(eager.max()) and float(eager[eager > 0].min()) < 0.9
