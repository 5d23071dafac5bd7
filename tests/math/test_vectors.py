"""Vectors, frames, the power heuristic and discrete choice at their extremes."""

from __future__ import annotations

import math

import pytest
import torch
from trials import SIGNIFICANCE, chi_square_p

from torchpt.math.sampling import Distribution1D, power_heuristic, uniform_sphere
from torchpt.math.vectors import Frame, cross, dot, inverse_square, lanes_of, luminance, normalize, take

G = torch.Generator().manual_seed(4)
AXES = torch.cat((torch.eye(3), -torch.eye(3)), 1)


def directions(n: int) -> torch.Tensor:
    d = uniform_sphere(torch.rand(2, n, generator=G))
    near = normalize(torch.tensor([[1e-4, 1e-20, 0.0], [0.0, 1e-4, 1e-30], [-1.0, 1.0, -1.0]]))
    below = torch.tensor([[1.0, 0.6], [0.0, 0.8], [-0.0, -0.0]])  # n.z = -0
    return torch.cat((d, AXES, near, -near, below), 1)


def test_frames_are_orthonormal_right_handed_and_invert():
    n = directions(20_000)
    frame = Frame.about(n)
    s, t = frame.s, frame.t
    for a, b, expected in ((s, s, 1), (t, t, 1), (s, t, 0), (s, n, 0), (t, n, 0)):
        assert (dot(a.double(), b.double()) - expected).abs().max() < 1e-6
    assert (cross(s, t) - n).abs().max() < 1e-6
    w = directions(20_000)
    assert (frame.to_world(frame.to_local(w)) - w).abs().max() < 1e-6
    assert torch.equal(Frame.about(AXES).to_local(AXES)[2], torch.ones(6))


def test_inverse_squares_of_no_distance_are_finite_and_so_are_their_derivatives():
    square = torch.tensor([0.0, 1e-45, 1e-30, 1e-12, 4.0], requires_grad=True)
    found = inverse_square(square)
    found.sum().backward()
    assert square.grad is not None and torch.isfinite(square.grad).all() and torch.isfinite(found).all()
    torch.testing.assert_close(found.detach()[3:], torch.tensor([1e12, 0.25]))
    torch.testing.assert_close(square.grad[4], torch.tensor(-1 / 16))


def test_dot_and_cross_are_torchs():
    a, b = torch.randn(2, 3, 1000, generator=G, dtype=torch.float64)
    torch.testing.assert_close(dot(a, b), (a * b).sum(0))
    torch.testing.assert_close(cross(a, b), torch.linalg.cross(a, b, dim=0))


@pytest.mark.parametrize("size", [1e-38, 1e-30, 1e-10, 1.0, 1e10, 1e30, 1e38])
def test_normalize_over_the_whole_range(size):
    d = directions(1000)
    out = normalize(d * size)
    assert (out.double().norm(dim=0) - 1).abs().max() < 5e-7
    if size > 1e-37:
        assert (out - d).abs().max() < 1e-5


def test_normalize_of_zero_is_zero_with_zero_gradient():
    a = torch.zeros(3, 2, requires_grad=True)
    out = normalize(a)
    out.sum().backward()
    assert not out.detach().any()
    assert a.grad is not None and not a.grad.any()


def test_luminance_and_take():
    assert float(luminance(torch.ones(3))) == pytest.approx(1, abs=1e-6)
    table = torch.arange(12.0).view(3, 4)
    index = torch.tensor([3, 0, 3])
    assert torch.equal(take(table, index), table[:, index])
    assert torch.equal(take(table[0], index), table[0, index])
    mask = table[0] > table[0].mean()
    assert torch.equal(take(table, lanes_of(mask)), table[:, mask])
    assert lanes_of(mask | ~mask) is None and take(table, None) is table


SCALES = torch.tensor([0.0, 1e-36, 1e-30, 1e-19, 1e-10, 1.0, 1e10, 1.8e19, 1e30, 3e38])


def test_power_heuristic_at_its_extremes():
    a, b = torch.cartesian_prod(SCALES, SCALES).T
    w, v = power_heuristic(a, b), power_heuristic(b, a)
    assert torch.isfinite(w).all()
    assert ((w >= 0) & (w <= 1)).all()
    some = (a > 0) | (b > 0)
    assert (w + v - 1)[some].abs().max() < 1e-6  # also where squares would overflow or vanish
    assert not w[a == 0].any()
    assert (w[(a > 0) & (b == 0)] == 1).all()
    exact = a.double() ** 2 / (a.double() ** 2 + b.double() ** 2)
    torch.testing.assert_close(w[some], exact[some].float(), rtol=1e-5, atol=1e-7)
    assert float(power_heuristic(torch.tensor(1e30), torch.tensor(1e-30))) == 1
    assert float(power_heuristic(torch.tensor(1e-30), torch.tensor(1e30))) == 0


def shares(weights: torch.Tensor) -> torch.Tensor:
    """Probabilities in float64: by weight, but for a hundredth that is even among what has weight."""
    w = weights.double()
    return 0.99 * w / w.sum() + 0.01 * (w > 0) / (w > 0).sum()


def test_discrete_choice_follows_its_weights():
    weights = torch.tensor([0.0, 1.0, 0.0, 3.0, 2.0, 0.0])
    choice = Distribution1D.of(weights, torch.float32)
    drawn = choice.draw(torch.rand(120_000, generator=G))[0]
    counts = torch.bincount(drawn, minlength=6).double()
    assert not counts[weights == 0].any()
    expected = 120_000 * shares(weights)
    some = weights > 0
    assert chi_square_p(float(((counts - expected)[some] ** 2 / expected[some]).sum()), 2) > SIGNIFICANCE
    torch.testing.assert_close(choice.pmf, shares(weights).float())


def test_what_a_choice_leaves_is_the_place_in_its_interval():
    choice = Distribution1D.of(torch.tensor([0.0, 1.0, 0.0, 3.0, 2.0]), torch.float64)
    u = torch.rand(10_000, generator=G, dtype=torch.float64)
    outcome, rest = choice.draw(u)
    low = torch.cat((torch.zeros(1), choice.cdf))[outcome]
    torch.testing.assert_close(low + rest * choice.pmf[outcome], u, rtol=0, atol=1e-14)
    assert choice.draw(torch.tensor([0.0, 1.0]))[1].tolist() == [0.0, 1.0]


def test_a_million_tiny_weights_do_not_collapse():
    n = 1_000_000
    weights = torch.full((n,), 1e-12)
    choice = Distribution1D.of(weights, torch.float32)
    u = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    drawn = torch.searchsorted(choice.cdf, u, right=True)  # float64 u: each outcome exactly once
    assert (drawn - torch.arange(n)).abs().max() <= 1
    assert float(choice.pmf.double().sum()) == pytest.approx(1, abs=1e-6)
    assert int(choice.draw(torch.tensor([1 - 2**-24]))[0]) >= n - 2
    # One a million times brighter takes its share beside 1e5 dim ones (STIFF_CASES 62).
    weights = torch.ones(100_001)
    weights[50_000] = 1e6
    drawn = Distribution1D.of(weights, torch.float32).draw(torch.rand(100_000, generator=G))[0]
    share, expected = float((drawn == 50_000).double().mean()), float(shares(weights)[50_000])
    assert abs(share - expected) < 4 * math.sqrt(expected * (1 - expected) / 1e5)


def test_no_outcome_is_too_rare_for_a_draw_of_24_bits():
    """1,000 lights, one 1e12 times brighter: the others' own share would lie below 2^-24, and their light be lost."""
    weights = torch.ones(1000, dtype=torch.float64)
    weights[500] = 1e12
    choice = Distribution1D.of(weights, torch.float32)
    u = torch.arange(1 << 16).float() / (1 << 16) + 2.0**-20
    drawn = torch.bincount(choice.draw(u)[0], minlength=1000).double() / (1 << 16)
    # One over the probability is what a sampled light weighs: what is never drawn must have none.
    assert (drawn > 0).sum() > 400
    assert float(choice.pmf.min()) > 2.0**-24 * 100


@pytest.mark.parametrize("weights", [[0.0, 0.0, 0.0], [5.0], [0.0, 1e-30, 0.0], [1e30, 1e30], [1.0, 0.0]])
def test_extreme_weights(weights):
    w = torch.tensor(weights)
    choice = Distribution1D.of(w, torch.float32)
    u = torch.tensor([0.0, 2**-24, 0.5, 1 - 2**-24])
    drawn = choice.draw(u)[0]
    assert ((drawn >= 0) & (drawn < len(w))).all()
    if w.any():
        assert (w[drawn] > 0).all()
        assert (choice.pmf[drawn] > 0).all()
    else:
        torch.testing.assert_close(choice.pmf, torch.full((3,), 1 / 3))
