"""Gradients at extreme values of parameters: finite, and equal to a closed form or to finite differences."""

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
from torchpt.stress.case import Case, powers_of_ten
from torchpt.stress.cases._scenes import UNIT_SKY, floor_seen, front_camera, furnace
from torchpt.stress.harness import Harness

__all__ = ["CASES"]


def slope(
    harness: Harness,
    description: Mapping[str, Any],
    name: str,
    *,
    value: Any = None,
    spp: int = 64,
    max_depth: int = 2,
    seed: int = 1,
) -> tuple[Tensor, Tensor]:
    """Return the mean of a picture and its derivative by a parameter, in float64.

    The mean is over pixels and channels: the derivatives by the three channels of a colour sum to that by a grey of all three.

    Args:
        harness: device, search and engine of the render.
        description: the scene as a mapping.
        name: dotted name of the parameter.
        value: its value; None: that of the scene.
        spp: samples a pixel.
        max_depth: of the paths.
        seed: seed of the samples.
    """
    scene = load(description, device=harness.device)
    start = scene.params[name] if value is None else torch.as_tensor(value).expand(scene.params[name].shape)
    parameter = start.detach().clone().to(scene.device, scene.params[name].dtype).requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EdgeWarning)  # no edge is visible: only the interior is compared
        picture = render(
            scene,
            params={name: parameter},
            spp=spp,
            seed=seed,
            integrator={"type": "path", "max_depth": max_depth},
            film={"width": 8, "height": 8, "filter": "box"},
            accel=harness.accel,
            compile=harness.compile,
            edges=False,
        )
    picture.mean().backward()
    assert parameter.grad is not None
    return picture.detach().double().mean().cpu(), parameter.grad.double().cpu()


def derivative_error(found: Tensor, expected: float) -> float:
    """Return the relative error of a derivative, the absolute one if 0 is expected; infinite if it is not finite."""
    if not bool(torch.isfinite(found).all()):
        return math.inf
    return abs(float(found.sum()) - expected) / (abs(expected) or 1.0)


def by_albedo(harness: Harness, value: float) -> float:
    """Differentiate the mean by the albedo of a ball in a furnace, which it is equal to: 1."""
    scene = furnace({"type": "diffuse", "reflectance": value})
    _, found = slope(harness, scene, "shapes.ball.material.reflectance", spp=256)
    return derivative_error(found, 1.0)


def by_emission(harness: Harness, value: float) -> float:
    """Differentiate by the emission L of a disk of radius 1 at height 1 above a grey floor: 1/4.

    The floor has the irradiance E = π L / (1 + 1²) and the radiance 0.5 E / π.
    """
    turn = [{"rotate": {"axis": [1, 0, 0], "angle": 180}}, {"translate": [0, 0, 1]}]
    scene = floor_seen(lights=None, shapes={"lamp": {"type": "disk", "emission": value, "transform": turn}})
    _, found = slope(harness, scene, "shapes.lamp.emission", spp=256)
    return derivative_error(found, 0.25)


def by_sky(harness: Harness, value: float) -> float:
    """Differentiate by the environment of a ball of albedo 1/2, whose radiance is half of it: 1/2."""
    scene = {
        **furnace({"type": "diffuse", "reflectance": 0.5}),
        "lights": {"sky": {"type": "constant", "radiance": value}},
    }
    _, found = slope(harness, scene, "lights.sky.radiance", spp=256)
    return derivative_error(found, 0.5)


def by_roughness(harness: Harness, alpha: float) -> float:
    """Differentiate the roughness of a metal ball: equal to finite differences with the same samples."""
    scene, name = furnace({"type": "roughconductor", "reflectance": 1.0, "alpha": alpha}), "shapes.ball.material.alpha"
    _, found = slope(harness, scene, name)
    step = alpha * 2.0**-8  # of central differences
    low, high = (slope(harness, scene, name, value=alpha + offset)[0] for offset in (-step, step))
    expected = float(high - low) / (2 * step)
    return derivative_error(found, expected)


def by_little_roughness(harness: Harness, alpha: float) -> float:
    """Differentiate by a very small roughness: the derivative is all noise, but finite."""
    scene = furnace({"type": "roughconductor", "reflectance": 1.0, "alpha": alpha})
    _, found = slope(harness, scene, "shapes.ball.material.alpha")
    return 0.0 if bool(torch.isfinite(found).all()) else math.inf


def by_index(harness: Harness, index: float) -> float:
    """Differentiate by the index of smooth glass in a furnace, whose radiance is 1 whatever the index: 0."""
    _, found = slope(
        harness, furnace({"type": "dielectric", "int_ior": index}), "shapes.ball.material.int_ior", max_depth=16
    )
    return derivative_error(found, 0.0)


def by_vertices(harness: Harness, size: float) -> float:
    """Differentiate by the vertices of a triangle, and of one without area whose three vertices lie in a line: finite.

    Args:
        harness: device, search and engine of the render.
        size: distance of neighbours in the line.
    """
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
    scene = {"camera": front_camera(width=0.2), "shapes": {"it": mesh}, "lights": {**UNIT_SKY, **sun}}
    _, found = slope(harness, scene, "shapes.it.vertices")
    return 0.0 if bool(torch.isfinite(found).all()) else math.inf


CASES = (
    Case(
        name="derivative by albedo",
        measures="relative",
        bound=5e-3,
        figure=by_albedo,
        axis="albedo",
        sweep=(*powers_of_ten(-30, -2, step=7), 0.5, 0.999, 1.0),
    ),
    Case(
        name="derivative by emission",
        measures="relative",
        bound=5e-3,
        figure=by_emission,
        axis="radiance",
        sweep=(*powers_of_ten(-30, 30, step=10),),
    ),
    Case(
        name="derivative by the sky",
        measures="relative",
        bound=5e-3,
        figure=by_sky,
        axis="radiance",
        sweep=(0.0, *powers_of_ten(-30, 30, step=10)),
    ),
    Case(
        name="derivative by roughness",
        measures="relative",
        bound=5e-2,
        figure=by_roughness,
        axis="alpha",
        sweep=(0.1, 0.2, 0.5, 0.9),
    ),
    Case(
        name="derivative by little roughness",
        measures="infinite if not finite",
        bound=0.0,
        figure=by_little_roughness,
        axis="alpha",
        sweep=powers_of_ten(-4, -1),
    ),
    Case(
        name="derivative by index",
        measures="difference from 0",
        bound=5e-2,
        figure=by_index,
        axis="index",
        sweep=(0.9999, 1.0001, 1.5, 10.0, 1e3),
    ),
    Case(
        name="derivative by corners of nothing",
        measures="infinite if not finite",
        bound=0.0,
        figure=by_vertices,
        axis="size",
        sweep=(0.0, 1e-38, 1e-20, 1e-6),
    ),
)
