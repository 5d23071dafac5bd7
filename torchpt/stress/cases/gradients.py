"""Derivatives at the ends of their parameters: finite, and those of a closed form or of float64."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import EdgeWarning
from torchpt.rendering.api import render
from torchpt.scene import load
from torchpt.stress.case import Case, powers
from torchpt.stress.cases._scenes import SKY, facing, floor_seen, furnace
from torchpt.stress.harness import Harness

__all__ = ["CASES"]


def slope(
    harness: Harness,
    read_typed: Mapping[str, Any],
    name: str,
    value: Any = None,
    spp: int = 64,
    depth: int = 2,
    seed: int = 1,
) -> tuple[Tensor, Tensor]:
    """The mean of a picture, and its derivatives by a parameter, in float64."""
    scene = load(read_typed, device=harness.device)
    given = scene.params[name] if value is None else torch.as_tensor(value).expand(scene.params[name].shape)
    wanted = given.detach().clone().to(scene.device, scene.params[name].dtype).requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EdgeWarning)  # no edge is in sight: the interior alone is compared
        picture = render(
            scene,
            params={name: wanted},
            spp=spp,
            seed=seed,
            integrator={"type": "path", "max_depth": depth},
            film={"width": 8, "height": 8, "filter": "box"},
            accel=harness.accel,
            compile=harness.compile,
            edges=False,
        )
    picture.mean().backward()
    assert wanted.grad is not None
    return picture.detach().double().mean().cpu(), wanted.grad.double().cpu()


def off(found: Tensor, expected: float) -> float:
    """How far a derivative is from what it is to be, relative to that; infinite where it is no number."""
    if not bool(torch.isfinite(found).all()):
        return math.inf
    return abs(float(found.sum()) - expected) / (abs(expected) or 1.0)


def by_albedo(harness: Harness, value: float) -> float:
    """A ball that gives back its albedo: 1."""
    scene = furnace({"type": "diffuse", "reflectance": value})
    _, found = slope(harness, scene, "shapes.ball.material.reflectance", spp=256)
    return off(found, 1.0)


def by_emission(harness: Harness, value: float) -> float:
    """A disk of light one radius above a grey floor: a quarter."""
    turn = [{"rotate": {"axis": [1, 0, 0], "angle": 180}}, {"translate": [0, 0, 1]}]
    scene = floor_seen(None, {"lamp": {"type": "disk", "emission": value, "transform": turn}})
    _, found = slope(harness, scene, "shapes.lamp.emission", spp=256)
    return off(found, 0.25)


def by_sky(harness: Harness, value: float) -> float:
    """Light from everywhere on a grey ball: a half."""
    scene = {
        **furnace({"type": "diffuse", "reflectance": 0.5}),
        "lights": {"sky": {"type": "constant", "radiance": value}},
    }
    _, found = slope(harness, scene, "lights.sky.radiance", spp=256)
    return off(found, 0.5)


def by_roughness(harness: Harness, alpha: float) -> float:
    """A metal ball: no number is lost, and what is found is what differences of the same samples give."""
    scene, name = furnace({"type": "roughconductor", "reflectance": 1.0, "alpha": alpha}), "shapes.ball.material.alpha"
    _, found = slope(harness, scene, name)
    step = alpha * 2.0**-8
    low, high = (slope(harness, scene, name, alpha + d, spp=64)[0] for d in (-step, step))
    expected = float(high - low) / (2 * step)
    return off(found, expected)


def by_little_roughness(harness: Harness, alpha: float) -> float:
    """Where a metal is nearly smooth its derivative is all noise, but made of numbers."""
    scene = furnace({"type": "roughconductor", "reflectance": 1.0, "alpha": alpha})
    _, found = slope(harness, scene, "shapes.ball.material.alpha")
    return 0.0 if bool(torch.isfinite(found).all()) else math.inf


def by_index(harness: Harness, index: float) -> float:
    """Smooth glass under even light gives back 1 whatever its index: 0."""
    _, found = slope(
        harness, furnace({"type": "dielectric", "int_ior": index}), "shapes.ball.material.int_ior", depth=16
    )
    return off(found, 0.0)


def by_a_vertex(harness: Harness, size: float) -> float:
    """A triangle without area among others: its corners have derivatives, and they are numbers."""
    points = [
        [-1.0, -1.0, 0.0],
        [1.0, -1.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0],
        [size, 0.0, 0.0],
        [2 * size, 0.0, 0.0],
    ]
    mesh = {"type": "mesh", "vertices": points, "faces": [[0, 1, 2], [3, 4, 5]], "material": {"type": "diffuse"}}
    sun = {"sun": {"type": "directional", "direction": [0, 0.6, -0.8], "irradiance": 1.0}}
    scene = {"camera": facing(0.2), "shapes": {"it": mesh}, "lights": {**SKY, **sun}}
    _, found = slope(harness, scene, "shapes.it.vertices")
    return 0.0 if bool(torch.isfinite(found).all()) else math.inf


CASES = (
    Case("derivative by albedo", "relative", 5e-3, by_albedo, "albedo", (*powers(-30, -2, 7), 0.5, 0.999, 1.0)),
    Case("derivative by emission", "relative", 5e-3, by_emission, "radiance", (*powers(-30, 30, 10),)),
    Case("derivative by the sky", "relative", 5e-3, by_sky, "radiance", (0.0, *powers(-30, 30, 10))),
    Case("derivative by roughness", "relative", 5e-2, by_roughness, "alpha", (0.1, 0.2, 0.5, 0.9)),
    Case("derivative by little roughness", "infinite if not finite", 0.0, by_little_roughness, "alpha", powers(-4, -1)),
    Case("derivative by index", "difference from 0", 5e-2, by_index, "index", (0.9999, 1.0001, 1.5, 10.0, 1e3)),
    Case("derivative by corners of nothing", "infinite if not finite", 0.0, by_a_vertex, "size", (0.0, 1e-38, 1e-20, 1e-6)),
)  # fmt: skip
