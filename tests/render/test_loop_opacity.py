"""Shadow rays past surfaces that let light pass, compiled beside eager: every search structure, with and without instances."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from scene_makers import lit_floor, turned
from trials import film_of

import torchpt
from torchpt.engines.kernels.programs import _with_arguments, trace_stage
from torchpt.rendering import kernels_of, make_wave
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

MESH = str(Path(__file__).parents[2] / "scenes" / "standin.ply")


def description(copies: bool) -> dict[str, Any]:
    shapes: dict[str, Any] = {
        "pane": turned("film", 90.0, 0.7, [0, 0.9, 0]),
        "tube": {"type": "cylinder", "material": "film", "center": [0.5, 0.4, 0.3], "radius": 0.2, "height": 0.6},
        "ball": {"type": "sphere", "material": "grey", "center": [-0.5, 0.3, 0.2], "radius": 0.3},
    }
    if copies:
        at, there = [{"scale": 3}, {"translate": [-0.3, 0, -0.4]}], [{"translate": [0.2, 0.5, -0.5]}]
        shapes |= {
            "block": {"type": "mesh", "path": MESH, "material": "film", "transform": at},
            "there": {"type": "instance", "of": "block", "material": "film", "transform": there},
        }
    return lit_floor(**shapes)


@pytest.mark.parametrize(
    ("accel", "copies"), few([("brute", False), ("numba", False), ("torch", False), ("numba", True)], 2)
)
def test_light_that_passes_is_the_same_compiled(accel, copies):
    scene = torchpt.load(description(copies), "cpu")
    pictures = []
    for compile in ("on", "off"):
        wish = {
            "film": film_of(24, 16),
            "integrator": {"type": "path", "max_depth": 3},
            "render": {"spp": 16, "seed": 1, "compile": compile, "accel": accel},
        }
        pictures.append(render_scene(scene, settings(scene.description, wish)).image)
    on, off = pictures
    assert float(off.mean()) > 0.01
    far = (on - off).abs() > 1e-3 * (1 + off.abs())
    assert float(far.float().mean()) < 0.01, float((on - off).abs().amax())
    torch.testing.assert_close(on.mean((0, 1)), off.mean((0, 1)), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("accel", ["brute", "numba"])
@pytest.mark.parametrize("lit", [True, False])
def test_kernels_that_are_compiled_ahead_can_be_traced(lit: bool, accel: str) -> None:
    """Where nothing is lit there are no shadow rays, which some of them would be of."""
    described = description(copies=False)
    if not lit:
        described["materials"]["lamp"] = described["materials"]["grey"]
    scene = torchpt.load(described, "cpu")
    wave = make_wave(scene, settings(scene.description, {"render": {"accel": accel}}), None, torch.float32)
    kernels = kernels_of(scene, wave)
    assert kernels.has_opacity and (kernels.world.lights is not None) == lit
    names = []
    for listed, build, arguments in kernels.large_kernels():
        names.append(build.__name__)
        assert trace_stage(kernels._leaves, kernels, partial(_with_arguments, build, arguments), listed)
    assert ("attenuate_shadow_rays" in names) == ("transmittance" in kernels.state)
