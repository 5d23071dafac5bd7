"""Numbers that torch alone would round otherwise on other numbers of threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from torchpt.core.threads import PIECE, map_in_pieces, mean_all, sum_all
from torchpt.images.colour import display, linear_to_srgb, srgb_to_linear
from torchpt.math.sampling import Distribution1D
from torchpt.physics.shapes.normals import smooth_normals

THREADS = (2, 3)
#: Elements: parts of two and of three threads end beside whole vectors.
N = 100_003
X = torch.rand(4, N, generator=torch.Generator().manual_seed(1)) + 1e-3


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def each(function: Callable[[], Tensor]) -> tuple[Tensor, list[Tensor]]:
    """What one thread gives, and what several do."""
    torch.set_num_threads(1)
    one, several = function(), []
    for threads in THREADS:
        torch.set_num_threads(threads)
        several.append(function())
    return one, several


def mesh() -> Tensor:
    vertices = torch.rand(3, 20_000, generator=torch.Generator().manual_seed(2))
    faces = torch.randint(20_000, (N, 3), generator=torch.Generator().manual_seed(3))
    return smooth_normals(vertices, faces)


@pytest.mark.parametrize(
    "function",
    [
        mesh,
        lambda: srgb_to_linear(X[0]),
        lambda: linear_to_srgb(X[0]),
        lambda: display(X[:3].T, gamma=0.6),
        lambda: Distribution1D.of(X[0], torch.float32).cdf,
        lambda: Distribution1D.of(X[0].double() ** 8, torch.float64).pmf,
        lambda: map_in_pieces(torch.atan2, X[0], X[1]),
        lambda: map_in_pieces(torch.pow, X[:2], X[2:]),
        lambda: map_in_pieces(torch.pow, X[0].double(), X[1].double()),
        lambda: sum_all(X),
        lambda: sum_all(X[..., 1:].double()),
        lambda: mean_all(X[:, ::3]),
        lambda: mean_all(X.T[:, 0]),
    ],
)
def test_the_number_of_threads_does_not_matter(function):
    one, several = each(function)
    assert all(torch.equal(other, one) for other in several)


@pytest.mark.parametrize("size", [1, 31, PIECE - 1, PIECE, PIECE + 1, 3 * PIECE + 21, N])
def test_they_are_what_one_thread_gives_at_once(size):
    torch.set_num_threads(1)
    for x, y in ((X[0, :size], X[1, :size]), (X[2, :size].double(), X[3, :size].double())):
        assert torch.equal(map_in_pieces(torch.atan2, x, y), torch.atan2(x, y))
        assert torch.equal(map_in_pieces(torch.pow, x, y), x**y)
        assert torch.equal(sum_all(x), x.sum()) and torch.equal(mean_all(x), x.mean())


def test_they_pass_gradients():
    x, y = (X[k].clone().requires_grad_() for k in range(2))
    a = torch.autograd.grad(map_in_pieces(torch.atan2, x, y).sum(), (x, y))
    b = torch.autograd.grad(torch.atan2(x, y).sum(), (x, y))
    assert all(torch.equal(one, other) for one, other in zip(a, b, strict=True))
    assert torch.equal(torch.autograd.grad(mean_all(x), x)[0], torch.autograd.grad(x.mean(), x)[0])
