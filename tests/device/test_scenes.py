"""Kernels of shipped scenes as PTX: what calls of real renders leave in memory is the CPU's, bit for bit."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from ptx_calls import LANES, Probe, probed

import torchpt
from torchpt.core.errors import TorchptError

SCENES = sorted(path.stem for path in (Path(__file__).parents[2] / "configs" / "scene").glob("*.yaml"))
LAYERS = ["albedo", "normal", "depth", "position", "uv", "object_id"]
WISH: dict[str, Any] = {"spp": 1, "threads": 1, "compile": "on"}


def forward(scene: torchpt.Scene) -> None:
    """Render a picture, and layers."""
    torchpt.render(scene, film={"width": 64, "height": 64}, **WISH)
    torchpt.render(scene, film={"width": 24, "height": 24, "aovs": LAYERS}, integrator="aov", **WISH)


def backward(scene: torchpt.Scene) -> None:
    """Render a gradient by all parameters; of scenes with opacity by vertices and poses alone.

    Opacity is differentiated by tensor operations, and so is a texture whose table it shares.
    """
    owners, named = (*scene.built.parts, *scene.built.copies), dict(scene.params)
    if any(owner.material.opacity != 1.0 for owner in owners):
        named = {name: value for name, value in named.items() if name.endswith((".vertices", ".to_world"))}
    given = {name: value.clone().requires_grad_() for name, value in named.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # which edges a gradient leaves out does not matter here
        image = torchpt.render(scene, params=given, film={"width": 32, "height": 32}, **WISH)
    torch.autograd.grad(image.mean(), list(given.values()), allow_unused=True)


def check(found: dict[str, Probe], kernels: set[str], record_property: Any) -> None:
    """Compare, and record kernels, numbers and lanes."""
    for name, probe in found.items():
        print(
            f"{name}: {probe.lanes} lanes, {probe.numbers} numbers, {probe.instructions:.0f} instructions and "
            f"{probe.issues:.0f} issues a lane"
        )
    wrong = {name: probe.wrong for name, probe in found.items() if probe.wrong}
    assert not wrong
    assert {name.partition("_")[0] for name in found} >= kernels
    record_property("kernels", len(found))
    record_property("numbers", sum(probe.numbers for probe in found.values()))
    print(
        f"{len(found)} kernels, of these {sum(x.lanes == LANES for x in found.values())} with {LANES} lanes, "
        f"{sum(x.numbers for x in found.values())} numbers"
    )


def _found(name: str, run: Any) -> dict[str, Probe]:
    try:
        return probed(name, run)
    except TorchptError as error:
        if "TORCHPT_ASSETS" in str(error) or "asset" in str(error):
            pytest.skip("a file of this scene is not there")
        raise


def test_cornell_box(record_property):
    """The picture's kernels of one scene; all scenes are slow."""

    def picture(scene: torchpt.Scene) -> None:
        torchpt.render(scene, film={"width": 32, "height": 24}, **WISH)

    check(_found("cornell_box", picture), {"generate", "emit", "bounce", "terminate"}, record_property)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_pictures(name, record_property):
    check(_found(name, forward), {"generate", "bounce", "layers"}, record_property)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_gradients(name, record_property):
    check(_found(name, backward), {"generate", "bounce", "store"}, record_property)
