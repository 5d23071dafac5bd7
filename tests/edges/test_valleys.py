"""Gradients of vertices in indirect light: a height field whose faces light each other."""

from __future__ import annotations

import statistics

import torch

import torchpt


def test_a_height_field_has_gradients_of_the_right_size():
    """Points that slide where rays are short, and segments from edges: seeds agree.

    Central differences along random directions give a gradient of norm .197, and -.0228 and -.0096 for two vertices.
    """
    draw = torch.Generator().manual_seed(0)
    side = torch.linspace(-1, 1, 4)
    x, z = torch.meshgrid(side, side, indexing="xy")
    vertices = torch.stack([x.flatten(), 0.2 * torch.randn(16, generator=draw), z.flatten()], 1)
    grid = torch.arange(16).reshape(4, 4)
    a, b, c, d = (part.flatten() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    faces = torch.cat([torch.stack([a, c, b], 1), torch.stack([a, d, c], 1)])
    described = {
        "camera": {"origin": [0, 3, 0.01], "target": [0, 0, 0], "up": [0, 0, -1], "fov": 45},
        "film": {"width": 32, "height": 32},
        "integrator": {"type": "path", "max_depth": 3},
        "shapes": {"m": {"type": "mesh", "vertices": vertices, "faces": faces}},
        "lights": {"sky": {"type": "constant"}},
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
