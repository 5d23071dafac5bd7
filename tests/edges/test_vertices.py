"""Directions in which light that edges send goes on from surfaces that are shaded smooth."""

from __future__ import annotations

import math
from typing import Any, cast

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.gradients.edges.vertices import _with_even_directions
from torchpt.math.sampling import uniform_hemisphere
from torchpt.math.vectors import Frame, dot
from torchpt.paths.state import Drawn, Plan
from torchpt.paths.surface import Surface
from torchpt.physics.bsdfs import gather
from torchpt.physics.samplers import Dimension, Draws

COUNT = 1 << 17


class _Draws:
    """Any random numbers, for :class:`Draws`."""

    def __init__(self) -> None:
        self.random = torch.Generator().manual_seed(1)

    def one(self, _: Any) -> Tensor:
        return torch.rand(COUNT, generator=self.random, dtype=torch.float64)

    def two(self, _: Any) -> Tensor:
        return torch.rand(2, COUNT, generator=self.random, dtype=torch.float64)


@pytest.mark.parametrize(
    "material",
    [
        {"type": "diffuse", "reflectance": 0.8},
        {"type": "roughconductor", "roughness": 0.7},
        {"type": "principled", "roughness": 0.5, "metallic": 1, "base_color": 0.8},
        {"type": "roughplastic", "roughness": 0.5},
    ],
    ids=lambda material: material["type"],
)
def test_directions_have_the_density_they_are_drawn_with(material: dict[str, Any]) -> None:
    """The flux of light that leaves, below the shading normal and above it: by these directions and by even ones."""
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0]},
            "materials": {"it": material},
            "shapes": {"it": {"type": "rectangle", "material": "it"}},
        },
        "cpu",
    )
    world, _ = scene.world(torch.float64)
    kind, draws = world.materials.models[0], cast("Draws", _Draws())
    parameters = gather(world.materials.parameters[0], torch.zeros(COUNT, dtype=torch.int64))
    frame = Frame(*torch.eye(3, dtype=torch.float64)[:, :, None].expand(3, 3, COUNT))
    n, wi = (
        torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)[:, None].expand(3, COUNT)
        for angle in (0.5, -1.0)
    )
    surface = Surface(
        frame=frame,
        side=torch.ones_like(n[0]),
        outward=n,
        front_mask=None,
        parameters=parameters,
        wo=wi,
        perturbed_normal=None,
    )
    sample = kind.sample(parameters, wi, draws.one(Dimension.LOBE), draws.two(Dimension.BSDF))
    drawn = Drawn(
        o=n, d=sample.wi, wi=sample.wi, pdf=sample.pdf, weight=sample.weight, least=n[0], sharp=None, eta=None
    )
    plan = Plan(
        sampler=cast("Any", None),
        strategy="mis",
        rr_prob=None,
        dark_rims=False,
        dtype=torch.float64,
        tape=False,
        attached=False,
    )
    found = _with_even_directions(plan, kind, n, surface, drawn, draws)

    def flux(d: Tensor) -> Tensor:
        return torch.where(dot(d, n) > 0, kind.eval(parameters, surface.local_wo(d), wi)[0] * dot(d, n), 0.0)

    usable = (found.pdf > 0) & torch.isfinite(found.pdf)
    ours = torch.where(usable, flux(found.d) / torch.where(usable, found.pdf, 1.0), 0.0)
    even = Frame.about(n).to_world(uniform_hemisphere(draws.two(Dimension.BSDF)))
    theirs = flux(even) * (2.0 * math.pi)
    for a, b in (
        (ours * (found.d[2] < 0), theirs * (even[2] < 0)),
        (ours * (found.d[2] >= 0), theirs * (even[2] >= 0)),
    ):
        error = float(((a.var() + b.var()) / COUNT).sqrt())
        assert abs(float(a.mean() - b.mean())) < 4.0 * error
        assert error < 0.03 * float(b.mean())
