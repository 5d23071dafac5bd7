"""Warnings name the line of the caller, whichever way leads to them."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch

import torchpt

POSE = "shapes.it.to_world"
ROOM: dict[str, Any] = {
    "camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0]},
    "shapes": {"it": {"type": "rectangle"}},
    "lights": {"sky": {"type": "constant"}},
}
BRIGHT = {**ROOM, "materials": {"much": {"type": "phong", "diffuse": 0.9, "specular": 0.9}}}
WISHES: dict[str, Any] = {"spp": 1, "threads": 1, "compile": "off", "film": {"width": 4, "height": 4}}


def moved() -> tuple[torchpt.Scene, dict[str, torch.Tensor]]:
    scene = torchpt.load(ROOM, "cpu")
    return scene, {POSE: scene.params[POSE].clone().requires_grad_()}


def by_render() -> int:
    scene, params = moved()
    torchpt.render(scene, params=params, edges=False, **WISHES)
    return line() - 1


def by_render_batch() -> int:
    scene, params = moved()
    torchpt.render_batch([scene], params=[params], edges=False, **WISHES)
    return line() - 1


def by_a_module() -> int:
    renderer = torchpt.nn.Renderer(torchpt.load(ROOM, "cpu"), POSE, edges=False, **WISHES)
    renderer()
    return line() - 1


def by_load() -> int:
    torchpt.load(BRIGHT, "cpu")
    return line() - 1


def by_a_data_set() -> int:
    pictures = torchpt.data.RenderDataset(lambda _: BRIGHT, 1, **WISHES)
    pictures[0]
    return line() - 1


def line() -> int:
    """Of the caller."""
    frame = inspect.currentframe()
    assert frame is not None and frame.f_back is not None
    return frame.f_back.f_lineno


@pytest.mark.parametrize(
    ("call", "kind"),
    [
        (by_render, torchpt.EdgeWarning),
        (by_render_batch, torchpt.EdgeWarning),
        (by_a_module, torchpt.EdgeWarning),
        (by_load, torchpt.EnergyWarning),
        (by_a_data_set, torchpt.EnergyWarning),
    ],
)
def test_a_warning_names_the_line_of_the_caller(call: Callable[[], int], kind: type[Warning]) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        expected = call()
    assert [(one.category, one.filename, one.lineno) for one in found] == [(kind, __file__, expected)]
