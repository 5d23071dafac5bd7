"""Look-ups into the atlas, against torch's own sampling of images and against plain loops."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchpt.core.memory_block import MemoryBlock
from torchpt.physics.textures.atlas import WRAPS, Atlas, ImageNode, atlas_of, look_up, slope

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


def one(node: ImageNode, uv: Tensor, coloured: bool = True, dtype: torch.dtype = torch.float64) -> Tensor:
    atlas = atlas_of([node], IMAGES, dtype, CPU)
    return look_up(atlas, torch.zeros(uv.shape[1], dtype=torch.int64), uv.to(dtype), coloured)


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("wrap", ["clamp", "mirror"])
def test_grid_sample(name: str, nearest: bool, wrap: str):
    image, uv = IMAGES[name], points()
    found = one(ImageNode(name, None, wrap, nearest, SAME, PLAIN), uv)
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
    found = one(ImageNode(name, None, "repeat", False, SAME, PLAIN), uv)
    assert torch.allclose(found[:, inside], expected.expand_as(found)[:, inside], atol=1e-12)


def test_many_nodes_at_once_are_each_alone():
    nodes = [
        ImageNode(name, channel, wrap, nearest, ((1.5, 0.25, 0.1), (-0.5, 2.0, 0.7)), (2.0, 0.5, 3.0))
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
    rgb = one(ImageNode("clear", None, "repeat", False, SAME, PLAIN), uv)
    for k in range(3):
        assert torch.allclose(one(ImageNode("clear", k, "repeat", False, SAME, PLAIN), uv, False), rgb[k], atol=1e-15)
    grey = 0.212671 * rgb[0] + 0.715160 * rgb[1] + 0.072169 * rgb[2]
    assert torch.allclose(one(ImageNode("clear", -1, "repeat", False, SAME, PLAIN), uv, False), grey, atol=1e-15)


@pytest.mark.parametrize("wrap", WRAPS)
def test_far_coordinates_stay_inside(wrap: str):
    uv = torch.tensor([[1e30, -1e30, 3e8, -3e8], [0.5, -1e20, 1e9, 1e38]])
    found = one(ImageNode("clear", None, wrap, False, SAME, PLAIN), uv, dtype=torch.float32)
    assert torch.isfinite(found).all() and (found >= 0).all() and (found <= 1).all()


def test_gradients():
    texels = IMAGES["small"].clone().requires_grad_()
    uv = points(40).requires_grad_()
    node = ImageNode("small", None, "mirror", False, ((0.7, 0.2, 0.1), (0.3, -0.9, 0.2)), (0.5, 2.0, 1.0))

    def value(texels: Tensor, uv: Tensor) -> Tensor:
        atlas = atlas_of([node], {"small": texels}, torch.float64, CPU)
        return look_up(atlas, torch.zeros(40, dtype=torch.int64), uv, True)

    assert torch.autograd.gradcheck(value, (texels, uv))


@pytest.mark.parametrize("wrap", WRAPS)
def test_slope_is_the_derivative(wrap: str):
    node = ImageNode("grey", 0, wrap, False, ((0.7, 0.2, 0.1), (0.3, -0.9, 0.2)), (1.5, 1.5, 1.5))
    atlas: Atlas = atlas_of([node], IMAGES, torch.float64, CPU)
    uv = points(500).requires_grad_()
    index = torch.zeros(500, dtype=torch.int64)
    (expected,) = torch.autograd.grad(look_up(atlas, index, uv, False).sum(), uv)
    found = torch.stack(slope(atlas, index, uv.detach()))
    assert torch.allclose(found, expected, atol=1e-12)


FILTERED = {  # odd and even sizes, grey and colour
    "odd": torch.rand(13, 7, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64),
    "even": torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64),
    "flat": torch.rand(1, 12, 1, generator=torch.Generator().manual_seed(8), dtype=torch.float64),
    "dot": torch.rand(1, 1, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64),
}


def smaller(image: Tensor) -> Tensor:
    """Half as large by exact areas: every old texel is cut at the new ones' edges."""
    for dim in (0, 1):
        n = image.shape[dim]
        m = max(n // 2, 1)
        edges = torch.arange(m + 1, dtype=torch.float64) * (n / m)
        share = torch.zeros(m, n, dtype=torch.float64)
        for new, old in itertools.product(range(m), range(n)):
            share[new, old] = max(0.0, float(min(edges[new + 1], old + 1) - max(edges[new], old))) * m / n
        image = torch.einsum("mn,n...->m...", share, image.movedim(dim, 0)).movedim(0, dim)
    return image


def filtered(node: ImageNode, uv: Tensor, footprint: Tensor, images: dict[str, Tensor] = FILTERED) -> Tensor:
    atlas = atlas_of([node], images, torch.float64, CPU)
    return look_up(atlas, torch.zeros(uv.shape[1], dtype=torch.int64), uv, node.channel is None, footprint)


@pytest.mark.parametrize("name", FILTERED)
@pytest.mark.parametrize("wrap", WRAPS)
def test_filtered_look_ups_lie_between_images_of_half_the_size(name: str, wrap: str):
    uv, image = points(300), FILTERED[name]
    transform = ((0.5, 0.0, 0.1), (0.0, 2.0, 0.2))  # keeps areas
    sizes = [image]
    while max(sizes[-1].shape[:2]) > 1:
        sizes.append(smaller(sizes[-1]))
    texels = image.shape[0] * image.shape[1]
    for level in (0.0, 0.25, 1.0, 1.5, 2.75, 9.0):
        footprint = torch.full((300,), 4.0**level / texels, dtype=torch.float64)
        node = ImageNode(name, None, wrap, False, transform, (2.0, 0.5, 1.0), True)
        low = min(int(level), len(sizes) - 1)
        high, share = min(low + 1, len(sizes) - 1), level - int(level)
        alone = ImageNode("image", None, wrap, False, transform, (2.0, 0.5, 1.0))
        a, b = (
            look_up(
                atlas_of([alone], {"image": sizes[k]}, torch.float64, CPU),
                torch.zeros(300, dtype=torch.int64),
                uv,
                True,
            )
            for k in (low, high)
        )
        assert torch.allclose(filtered(node, uv, footprint), a + (b - a) * share, atol=1e-12)


@pytest.mark.parametrize("name", FILTERED)
def test_the_last_size_is_the_mean(name: str):
    found = filtered(
        ImageNode(name, None, "repeat", False, SAME, PLAIN, True), points(5), torch.full((5,), 1e6).double()
    )
    assert torch.allclose(found, FILTERED[name].mean((0, 1)).expand(3)[:, None].expand(3, 5), atol=1e-14)


def test_up_to_one_texel_a_filtered_look_up_is_bilinear_to_the_bit():
    uv = points(200)
    for footprint in (0.0, 1e-9, 0.999 / (13 * 7)):
        found = filtered(
            ImageNode("odd", None, "repeat", False, SAME, PLAIN, True), uv, torch.full((200,), footprint).double()
        )
        atlas = atlas_of([ImageNode("odd", None, "repeat", False, SAME, PLAIN)], FILTERED, torch.float64, CPU)
        assert torch.equal(found, look_up(atlas, torch.zeros(200, dtype=torch.int64), uv, True))


def test_nodes_that_do_not_filter_are_untouched_by_those_that_do():
    names = list(FILTERED)
    nodes = [
        ImageNode(name, None, "mirror", False, SAME, PLAIN, filtered) for name in names for filtered in (False, True)
    ]
    atlas = atlas_of(nodes, FILTERED, torch.float64, CPU)
    uv = points(50)
    footprint = torch.rand(50, generator=torch.Generator().manual_seed(3)).double()
    for k, node in enumerate(nodes):
        index = torch.full((50,), k)
        alone = filtered(node, uv, footprint)
        assert torch.equal(look_up(atlas, index, uv, True, footprint), alone)
        if not node.filtered:
            assert torch.equal(alone, look_up(atlas, index, uv, True))


def test_gradients_of_filtered_look_ups():
    texels = FILTERED["odd"][:5, :3].clone().requires_grad_()
    heights = FILTERED["flat"][:, :5].clone().requires_grad_()
    uv = points(4).requires_grad_()
    footprint = (0.01 + torch.rand(4, generator=torch.Generator().manual_seed(3)).double()).requires_grad_()
    transform = ((0.7, 0.2, 0.1), (0.3, -0.9, 0.2))
    nodes = [
        ImageNode("odd", None, "mirror", False, transform, (0.5, 2.0, 1.0), True),
        ImageNode("flat", 0, "repeat", False, transform, (3.0, 3.0, 3.0), True),
    ]

    def value(texels: Tensor, heights: Tensor, uv: Tensor, footprint: Tensor) -> Tensor:
        atlas = atlas_of(nodes, {"odd": texels, "flat": heights}, torch.float64, CPU)
        index = torch.zeros(4, dtype=torch.int64)
        return torch.cat(
            (look_up(atlas, index, uv, True, footprint), torch.stack(slope(atlas, index + 1, uv, footprint)))
        )

    assert torch.autograd.gradcheck(value, (texels, heights, uv, footprint), fast_mode=True)


def test_images_in_one_block_are_read_where_they_are():
    images = {name: image.float() for name, image in IMAGES.items()}
    block = MemoryBlock(sum(image.numel() for image in images.values()))
    placed = {name: block.add(image.numpy()) for name, image in images.items()}
    nodes = [ImageNode(name, channel, "mirror", False, SAME, PLAIN) for name in images for channel in (None, 0)]
    copied, shared = (atlas_of(nodes, of, torch.float32, CPU) for of in (images, placed))
    assert shared.texels.data_ptr() == placed["small"].data_ptr() != copied.texels.data_ptr()
    for k, node in enumerate(nodes):
        index, uv, coloured = torch.full((50,), k), points(50).float(), node.channel is None
        assert torch.equal(look_up(shared, index, uv, coloured), look_up(copied, index, uv, coloured))
    # Levels of a mipmap are computed, and another dtype is a copy.
    for others, dtype in (([replace(node, filtered=True) for node in nodes], torch.float32), (nodes, torch.float64)):
        assert atlas_of(others, placed, dtype, CPU).texels.data_ptr() != placed["small"].data_ptr()
