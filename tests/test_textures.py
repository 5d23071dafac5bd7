"""Look-ups into the atlas, against torch's own sampling of images and against plain loops."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from torchpt.textures import WRAPS, Atlas, Node, atlas_of, look_up, slope

CPU = torch.device("cpu")
SAME = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
PLAIN = (1.0, 1.0, 1.0)
IMAGES = {
    "small": torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64),
    "grey": torch.rand(7, 4, 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64),
    "clear": torch.rand(6, 6, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64),
    "dot": torch.rand(1, 1, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64),
}


def points(n: int = 4000, seed: int = 5) -> Tensor:
    return torch.rand(2, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 8 - 4


def one(node: Node, uv: Tensor, coloured: bool = True, dtype: torch.dtype = torch.float64) -> Tensor:
    atlas = atlas_of([node], IMAGES, dtype, CPU)
    return look_up(atlas, torch.zeros(uv.shape[1], dtype=torch.int64), uv.to(dtype), coloured)


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("wrap", ["clamp", "mirror"])
def test_grid_sample(name: str, nearest: bool, wrap: str):
    image, uv = IMAGES[name], points()
    found = one(Node(name, None, wrap, nearest, SAME, PLAIN), uv)
    expected = torch.nn.functional.grid_sample(
        image[..., :3].permute(2, 0, 1)[None],
        (2 * uv.T - 1)[None, None],
        mode="nearest" if nearest else "bilinear",
        padding_mode={"clamp": "border", "mirror": "reflection"}[wrap],
        align_corners=False,
    )[0, :, 0]
    assert torch.allclose(found, expected.expand_as(found), atol=1e-12)


@pytest.mark.parametrize("name", IMAGES)
def test_repeat_is_grid_sample_of_the_tiled_image(name: str):
    image, uv = IMAGES[name], points() / 4  # tiles -2..2 are at hand
    tiled = image[..., :3].repeat(4, 4, 1)
    expected = torch.nn.functional.grid_sample(
        tiled.permute(2, 0, 1)[None], ((uv.T + 2) / 2 - 1)[None, None], padding_mode="border", align_corners=False
    )[0, :, 0]
    inside = (uv.abs() < 1.5).all(0)
    found = one(Node(name, None, "repeat", False, SAME, PLAIN), uv)
    assert torch.allclose(found[:, inside], expected.expand_as(found)[:, inside], atol=1e-12)


def test_many_nodes_at_once_are_each_alone():
    nodes = [
        Node(name, channel, wrap, nearest, ((1.5, 0.25, 0.1), (-0.5, 2.0, 0.7)), (2.0, 0.5, 3.0))
        for name, channel, wrap, nearest in itertools.product(IMAGES, (None, 0, -1), WRAPS, (False, True))
    ]
    atlas = atlas_of(nodes, IMAGES, torch.float64, CPU)
    uv = points(50)
    for coloured in (True, False):
        chosen = [k for k, node in enumerate(nodes) if (node.channel is None) == coloured]
        index = torch.tensor(chosen).repeat_interleave(50)
        found = look_up(atlas, index, uv.repeat(1, len(chosen)), coloured)
        alone = torch.cat([one(nodes[k], uv, coloured) for k in chosen], -1)
        assert torch.equal(found, alone)


def test_channels():
    uv = points(100)
    rgb = one(Node("clear", None, "repeat", False, SAME, PLAIN), uv)
    for k in range(3):
        assert torch.allclose(one(Node("clear", k, "repeat", False, SAME, PLAIN), uv, False), rgb[k], atol=1e-15)
    grey = 0.212671 * rgb[0] + 0.715160 * rgb[1] + 0.072169 * rgb[2]
    assert torch.allclose(one(Node("clear", -1, "repeat", False, SAME, PLAIN), uv, False), grey, atol=1e-15)


@pytest.mark.parametrize("wrap", WRAPS)
def test_far_coordinates_stay_inside(wrap: str):
    uv = torch.tensor([[1e30, -1e30, 3e8, -3e8], [0.5, -1e20, 1e9, 1e38]])
    found = one(Node("clear", None, wrap, False, SAME, PLAIN), uv, dtype=torch.float32)
    assert torch.isfinite(found).all() and (found >= 0).all() and (found <= 1).all()


def test_gradients():
    texels = IMAGES["small"].clone().requires_grad_()
    uv = points(40).requires_grad_()
    node = Node("small", None, "mirror", False, ((0.7, 0.2, 0.1), (0.3, -0.9, 0.2)), (0.5, 2.0, 1.0))

    def value(texels: Tensor, uv: Tensor) -> Tensor:
        atlas = atlas_of([node], {"small": texels}, torch.float64, CPU)
        return look_up(atlas, torch.zeros(40, dtype=torch.int64), uv, True)

    assert torch.autograd.gradcheck(value, (texels, uv))


@pytest.mark.parametrize("wrap", WRAPS)
def test_slope_is_the_derivative(wrap: str):
    node = Node("grey", 0, wrap, False, ((0.7, 0.2, 0.1), (0.3, -0.9, 0.2)), (1.5, 1.5, 1.5))
    atlas: Atlas = atlas_of([node], IMAGES, torch.float64, CPU)
    uv = points(500).requires_grad_()
    index = torch.zeros(500, dtype=torch.int64)
    (expected,) = torch.autograd.grad(look_up(atlas, index, uv, False).sum(), uv)
    found = torch.stack(slope(atlas, index, uv.detach()))
    assert torch.allclose(found, expected, atol=1e-12)
