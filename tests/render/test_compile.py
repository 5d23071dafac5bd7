"""``render.compile``: few graphs, no recompiles after the first pass, no silent fall-back, the eager picture."""

from __future__ import annotations

import pytest
import torch

import torchpt
from torchpt import forward
from torchpt.errors import RenderError
from torchpt.integrators import compiled
from torchpt.render import render_scene
from torchpt.scene.description import settings

FILM = {"width": 48, "height": 48, "filter": "box"}

pytestmark = [
    pytest.mark.skipif(not compiled.can_compile(torch.device("cpu")), reason="needs a C++ compiler"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning"),  # torch's own, while compiling
]


def run(scene, spp: int, mode: str, seed: int = 1):
    wish = {"film": FILM, "render": {"spp": spp, "compile": mode, "seed": seed}, "integrator": {"max_depth": 8}}
    return render_scene(scene, settings(scene.description, wish))


def graphs(scene) -> dict[str, int]:
    counts: dict[str, int] = {}
    for stages in forward._compiled[scene].values():
        counts |= stages.graphs
    return counts


def test_two_graphs_a_stage_and_none_later():
    scene = torchpt.load("cornell_box")
    first = run(scene, 4, "on")
    after_first_pass = graphs(scene)
    assert {name.split()[0] for name in after_first_pass} == {"generate", "emit", "bounce"}
    assert all(count <= 2 for count in after_first_pass.values()), after_first_pass
    later = [run(scene, spp, "on", seed) for spp, seed in ((37, 2), (64, 3))]  # other wave sizes, ragged last passes
    assert graphs(scene) == after_first_pass
    # Fused arithmetic rounds differently, and a few paths go elsewhere for it; the picture is the same.
    for compiled_picture, spp, seed in zip((first, *later), (4, 37, 64), (1, 2, 3), strict=True):
        eager = run(scene, spp, "off", seed)
        close = torch.isclose(compiled_picture.image, eager.image, rtol=1e-3, atol=1e-4).all(-1)
        assert close.float().mean() > 0.9
        assert float(compiled_picture.image.mean()) == pytest.approx(float(eager.image.mean()), rel=2e-3)


def test_more_graphs_than_two_are_an_error_not_a_fall_back():
    scene = torchpt.load("cornell_box")
    world, _ = scene.world(torch.float32)
    plan = compiled.Plan("sobol", "mis", None, torch.float32, False, False)
    stages = compiled.CompiledStages(plan, world)

    def stage(x: torch.Tensor) -> torch.Tensor:
        return x * 2

    made = stages._get("stage", (), stage)
    with pytest.raises(Exception, match=r"(?i)recompile"):
        for rank in range(1, 6):  # a graph for each number of axes
            made(torch.ones((2,) * rank))
    assert stages.graphs["stage"] <= 2


def test_without_a_compiler_on_is_an_error_and_auto_stays_eager(monkeypatch):
    monkeypatch.setattr(compiled.shutil, "which", lambda name: None)
    monkeypatch.setattr(forward, "COMPILE_REPAYS", 1)
    scene = torchpt.load("cornell_box")
    with pytest.raises(RenderError, match="C\\+\\+ compiler"):
        run(scene, 1, "on")
    assert run(scene, 1, "auto").complete
    assert scene not in forward._compiled or not forward._compiled[scene]


@pytest.mark.slow
def test_textures_and_maps_compile():
    """Long chains of indices and frames: with inductor's own settings their compilation does not end."""
    squares = {"type": "checkerboard", "scale": 9, "filter": "trilinear"}
    material = {
        "type": "diffuse",
        "reflectance": squares,
        "normal_map": {**squares, "color0": [0.6, 0.45, 0.95], "color1": [0.4, 0.5, 0.95]},
    }
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 1, 4], "target": [0, 0, 0]},
            "shapes": {
                "floor": {
                    "type": "rectangle",
                    "material": material,
                    "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
                },
                "lamp": {
                    "type": "rectangle",
                    "emission": 20,
                    "transform": [
                        {"rotate": {"axis": [1, 0, 0], "angle": 90}},
                        {"scale": 0.3},
                        {"translate": [0, 2, 0]},
                    ],
                },
            },
        }
    )
    wish = {"film": FILM, "render": {"spp": 4}, "integrator": {"max_depth": 3}}
    pictures = [
        render_scene(scene, settings(scene.description, {**wish, "render": {"spp": 4, "compile": mode}})).image
        for mode in ("on", "off")
    ]
    assert torch.isclose(*pictures, rtol=1e-3, atol=1e-4).all(-1).float().mean() > 0.9
    assert float(pictures[0].mean()) == pytest.approx(float(pictures[1].mean()), rel=2e-3)
