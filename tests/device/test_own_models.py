"""A model of a user's own as PTX, forward and backward, and the sums of a film: the CPU's bits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from ptx_calls import LANES, differing_kernel, probed, traced_stages
from torch import Tensor

import torchpt
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs import Parameters
from torchpt.physics.bsdfs.records import BsdfSample

WISH: dict[str, Any] = {"spp": 1, "threads": 1, "compile": "on"}


class Velvet(torchpt.Bsdf):
    """Reflects more towards the horizon; ``tint`` is looked up for each hit."""

    name = "velvet"
    parameters = {"tint": (0.5, 0.5, 0.5)}  # noqa: RUF012

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / math.pi
        return parameters["tint"] * (1.0 - wo[2].abs()) ** 1.7 * torch.exp(-wi[2] * wi[2]) * pdf, pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        value, pdf = self.eval_pdf(parameters, wo, wi)
        return BsdfSample(wi, pdf, value / torch.where(pdf > 0, pdf, 1.0))

    def albedo(self, parameters: Parameters) -> Tensor:
        return parameters["tint"]


ROOM = {
    "camera": {"origin": [0, 1, 4], "target": [0, 0.5, 0], "fov": 40},
    "materials": {"mine": {"type": "velvet", "tint": [0.8, 0.6, 0.3]}},
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": "mine",
            "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "lamp": {"type": "sphere", "center": [1, 3, 1], "radius": 0.4, "emission": 12},
    },
    "integrator": {"type": "path", "max_depth": 4, "rr_depth": 100},
}


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [False, True], ids=["picture", "gradient"])
def test_a_users_model(adjoint):
    def run(scene: torchpt.Scene) -> None:
        if not adjoint:
            torchpt.render(scene, film={"width": 40, "height": 30}, **WISH)
            return
        tint = scene.params["materials.mine.tint"].clone().requires_grad_()
        image = torchpt.render(scene, params={"materials.mine.tint": tint}, film={"width": 40, "height": 30}, **WISH)
        image.mean().backward()

    found = probed(ROOM, run, bsdfs={"velvet": Velvet()})
    assert not {name: probe.wrong for name, probe in found.items() if probe.wrong}
    bounce = [probe for name, probe in found.items() if name.startswith("bounce_vjp" if adjoint else "bounce")]
    assert bounce and max(probe.lanes for probe in bounce) == LANES


@pytest.mark.parametrize("clamp", [None, 0.7])
def test_sums_of_a_film(clamp):
    """The kernel that adds samples to sums in float64: values that are not finite are counted, by warps."""
    with traced_stages() as stages:
        torchpt.render(torchpt.load(ROOM, "cpu", bsdfs={"velvet": Velvet()}), film={"width": 8, "height": 8},
                       integrator={"type": "path", "max_depth": 2, "clamp": clamp}, **WISH)  # fmt: skip
        (stage,) = (stage for stage in stages.values() if stage.tensors)
    rng = np.random.default_rng(5)
    samples = rng.random((3, 200), np.float32)
    samples[rng.random((3, 200)) < 0.1] = np.nan
    sums = rng.random((3, 200))
    uniforms = [] if clamp is None else [np.array([clamp], np.float32)]
    outputs = [np.zeros((3, 200))] + ([] if clamp is None else [np.zeros((3, 200), np.float32)])
    counters = np.zeros(1, np.int64)
    wrong = differing_kernel(stage, uniforms, [samples, sums], outputs, counters)
    assert not wrong and counters[0] > 20 and (outputs[0] != 0).any()
