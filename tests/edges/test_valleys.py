"""Gradients of vertices in indirect light: a height field whose faces light each other."""

from __future__ import annotations

import statistics

import torch
from known_gradients import ABOVE, OPEN_SKY, hills

import torchpt


def test_a_height_field_has_gradients_of_the_right_size():
    """Points that slide where rays are short, and segments from edges: seeds agree.

    Central differences along random directions give a gradient of norm .197, and -.0228 and -.0096 for two vertices.
    """
    field = hills(material={"type": "diffuse"})
    vertices = torch.tensor(field["vertices"])
    described = {
        **ABOVE,
        "film": {"width": 32, "height": 32},
        "integrator": {"type": "path", "max_depth": 3},
        "shapes": {"m": field},
        "lights": OPEN_SKY,
    }
    scene, norms, grads = torchpt.load(described, device="cpu"), [], []
    for seed in range(8):
        moved = vertices.clone().requires_grad_()
        torchpt.render(scene, params={"shapes.m.vertices": moved}, spp=16, seed=seed).mean().backward()
        assert moved.grad is not None
        norms.append(float(moved.grad.norm()))
        grads.append(moved.grad)
    assert abs(statistics.median(norms) - 0.197) < 0.006 and max(norms) < 0.22, norms
    mean, spread = torch.stack(grads).mean(0), torch.stack(grads).std(0) / len(norms) ** 0.5
    for vertex, known in ((5, -0.0228), (10, -0.0096)):
        assert abs(float(mean[vertex, 1]) - known) < 4.0 * float(spread[vertex, 1]), (
            vertex,
            mean[vertex],
            spread[vertex],
        )
