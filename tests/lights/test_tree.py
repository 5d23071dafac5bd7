"""The light tree: a distribution everywhere, the same for those who draw and those who ask, near to what lights bring."""

from __future__ import annotations

import time
from typing import Any

import pytest
import torch
from torch import Tensor
from trials import SIGNIFICANCE, chi_square_p

import torchpt.engines  # noqa: F401  (takes the walk over)
from torchpt.compiler.function import Lanewise
from torchpt.physics.lights import tree
from torchpt.physics.lights.tree import LightTree

G = torch.Generator().manual_seed(5)
CASES = [
    "one",
    "two",
    "three",
    "nine",
    "twenty, some dark",
    "mixed",
    "coincident",
    "collinear",
    "lopsided",
    "some dark",
    "one bright",
    "all dark",
    "one way",
]
SIZES = {"one": 1, "two": 2, "three": 3, "nine": 9, "twenty, some dark": 20, "lopsided": 3000}


def uniform(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=G)


def unit(count: int) -> Tensor:
    a = torch.randn(3, count, generator=G)
    return a / a.norm(dim=0)


def emitters(case: str, count: int | None = None) -> dict[str, Tensor]:
    """Small emitters in a slab, half of them balls, the others flat."""
    count = count or SIZES.get(case, 300)
    centre = uniform(3, count) * torch.tensor([[8.0], [2.0], [8.0]]) - torch.tensor([[4.0], [0.0], [4.0]])
    radius, intensity = 0.03 * uniform(count), torch.exp(torch.randn(count, generator=G))
    if case == "coincident":
        centre, radius = centre[:, :1].expand(3, count), torch.zeros(count)
    elif case == "collinear":
        centre, radius = centre * torch.tensor([[1.0], [0.0], [0.0]]) + 1.0, torch.zeros(count)
    elif case == "lopsided":
        centre, radius = centre * 1.01 ** -torch.arange(count), torch.zeros(count)
        intensity = 1.02 ** -torch.arange(float(count))
    elif case.endswith("some dark"):
        intensity[uniform(count) < 0.4] = 0.0
    elif case == "one bright":
        intensity[count // 2] = 1e6
    elif case == "all dark":
        intensity = torch.zeros(count)
    cos_o = torch.where(uniform(count) < 0.5, -1.0, 1.0)
    axis = unit(count)
    if (
        case == "one way"
    ):  # the cone of a node is no wider than that of one light: half of them shine all around, by half a turn
        axis, cos_o = axis[:, :1].expand(3, count), torch.where(cos_o < 0, -1e-3, 1.0)
    return {
        "low": centre - radius,
        "high": centre + radius,
        "axis": axis,
        "cos_o": cos_o,
        "cos_e": torch.zeros(count),
        "intensity": intensity,
    }


def points(count: int) -> tuple[Tensor, Tensor]:
    """Points among and around the emitters, and normals, some of them zero."""
    x = uniform(3, count) * torch.tensor([[12.0], [4.0], [12.0]]) - torch.tensor([[6.0], [1.0], [6.0]])
    return x, unit(count) * (uniform(count) < 0.8)


def brought(lights: dict[str, Tensor], x: Tensor, n: Tensor) -> Tensor:
    """Return what each light brings to each point ``(N, K)`` from its centre: I cos cos / d^2, in float64."""
    light = {name: value.double() for name, value in lights.items()}
    to = (0.5 * (light["low"] + light["high"]))[:, None, :] - x.double()[:, :, None]
    square = (to * to).sum(0)
    facing = -(to * light["axis"][:, None, :]).sum(0) / square.sqrt()
    facing = torch.where(light["cos_o"] < 0, 1.0, facing.clamp_min(0))
    received = (to * n.double()[:, :, None]).sum(0) / square.sqrt()
    received = torch.where((n == 0).all(0)[:, None], 1.0, received.clamp_min(0))
    return light["intensity"] * facing * received / square


def table(built: LightTree, count: int, x: Tensor, n: Tensor | None) -> Tensor:
    """Probabilities ``(N, K)`` of all rows."""
    rows = torch.arange(count).repeat(x.shape[1])
    spread = None if n is None else n.repeat_interleave(count, 1)
    return tree.probability(built, rows, x.double().repeat_interleave(count, 1), spread).view(-1, count)


@pytest.mark.parametrize("case", CASES)
def test_what_is_drawn_is_what_is_told(case):
    lights = emitters(case)
    built, count, (x, n) = tree.build(**lights), len(lights["intensity"]), points(40)
    for normal in (n, None):
        p = table(built, count, x, normal)
        torch.testing.assert_close(p.sum(1), torch.ones(40, dtype=torch.float64), rtol=0, atol=1e-9)
        if normal is not None:
            # What brings light can be drawn.
            assert not ((brought(lights, x, n) > 0) & (p == 0)).any()
        y, m = x.repeat(1, 100), None if normal is None else normal.repeat(1, 100)
        row, drawn, _ = tree.sample(built, y, m, tree.from_digits(*uniform(2, 4000)))
        assert (drawn > 0).all()
        assert torch.equal(tree.probability(built, row, y, m), drawn)
        if case not in ("all dark", "lopsided"):
            assert (lights["intensity"][row] > 0).all()


@pytest.mark.parametrize("case", CASES)
def test_the_tensor_form_is_the_kernels_reference(case):
    lights = emitters(case)
    built, (x, n) = tree.build(**lights), points(500)
    u = tree.from_digits(*uniform(2, 500))
    for normal in (n, None):
        row, p, _ = tree.sample(built, x, normal, u)
        same, q, _ = tree.sample.function(built, x, normal, u)
        assert (row == same).double().mean() > 0.99  # a draw on the edge of two lights may take either
        torch.testing.assert_close(p[row == same], q[row == same], rtol=1e-4, atol=0)
        torch.testing.assert_close(tree.probability.function(built, row, x, normal), p, rtol=1e-4, atol=0)
    kernels = [k for form in (tree.sample, tree.probability) for k in form.implementations if isinstance(k, Lanewise)]
    assert len(kernels) == 2 and not any(kernel.refused for kernel in kernels)
    assert (built.levels > tree.STEPS) == (case == "lopsided")  # whose ways take two words


@pytest.mark.parametrize("case", ["nine", "twenty, some dark", "mixed"])
def test_lanes_may_have_a_row_already(case):
    lights = emitters(case)
    built, (x, n) = tree.build(**lights), points(500)
    u, given = tree.from_digits(*uniform(2, 500)), torch.randint(-5, len(lights["intensity"]), (500,), generator=G)
    given = given.clamp_min(-1)
    drawn, p, rest = tree.sample(built, x, n, u)
    row, q, remapped = tree.sample(built, x, n, u, given)
    free = given < 0
    assert 0 < free.sum() < 500
    assert torch.equal(row, torch.where(free, drawn, given))
    assert torch.equal(q, torch.where(free, p, tree.probability(built, row, x, n)))
    assert torch.equal(remapped[free], rest[free])


def test_a_wide_root_has_the_fields_of_a_node():
    """Eight lights are a node by the builder of trees; the same ones beside two more are children of a wide root."""
    eight = emitters("eight", 8)
    eight["axis"][:, 3] = 0.0
    more = {name: torch.cat((value, value[..., :2] * 0.5), -1) for name, value in eight.items()}
    node, wide = tree.build(**eight), tree.build(**more)
    assert node.levels == wide.levels == 1 and wide.child.shape[1] == 2 * tree.WIDTH
    place = [(~built.child[0]).tolist() for built in (node, wide)]
    for light in range(8):
        fields = [built.nodes[0, :, at.index(light)] for built, at in zip((node, wide), place, strict=True)]
        torch.testing.assert_close(*fields, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("case", ["nine", "twenty, some dark", "mixed", "coincident", "one bright"])
def test_frequencies_are_the_probabilities(case):
    lights, n_draws = emitters(case), 1 << 16
    built, count, (x, n) = tree.build(**lights), len(lights["intensity"]), points(3)
    for k in range(3):
        p = table(built, count, x[:, k : k + 1], n[:, k : k + 1])[0]
        row, _, _ = tree.sample(
            built,
            x[:, k : k + 1].expand(3, n_draws),
            n[:, k : k + 1].expand(3, n_draws),
            tree.from_digits(*uniform(2, n_draws)),
        )
        counts = torch.bincount(row, minlength=count).double()
        assert not counts[p == 0].any()
        # Rare lights are counted together.
        rare = p * n_draws < 20
        expected = torch.cat((p[~rare], p[rare].sum()[None])) * n_draws
        counts = torch.cat((counts[~rare], counts[rare].sum()[None]))
        counts, expected = counts[expected > 0], expected[expected > 0]
        if len(expected) > 1:
            statistic = float(((counts - expected) ** 2 / expected).sum())
            assert chi_square_p(statistic, len(expected) - 1) > SIGNIFICANCE / 12


@pytest.mark.parametrize("case", [c for c in CASES if c != "all dark"])
def test_the_estimate_of_all_lights_together_is_unbiased(case):
    """One lane a draw at one point; exact variance from the probabilities, so that no tail hides from the test."""
    lights, n_draws = emitters(case), 1 << 14
    built, count = tree.build(**lights), len(lights["intensity"])
    x, n = torch.tensor([[0.3], [-0.5], [0.2]]), torch.tensor([[0.0], [1.0], [0.0]])
    p, f = table(built, count, x, n)[0], brought(lights, x, n)[0]
    total, square = f.sum(), torch.where(f > 0, f * f / torch.where(p > 0, p, 1.0), 0.0).sum()
    row, drawn, _ = tree.sample(
        built, x.expand(3, n_draws), n.expand(3, n_draws), tree.from_digits(*uniform(2, n_draws))
    )
    mean = (f[row] / drawn.double()).mean()
    error = ((square - total**2).clamp_min(0) / n_draws).sqrt()
    assert abs(float(mean - total)) <= 4 * float(error) + 1e-6 * float(total)


def test_a_thousand_lights_bring_far_less_variance_than_power_alone():
    lights = emitters("mixed", 1000)
    built, count = tree.build(**lights), 1000
    x, n = points(100)
    x[1], n[:] = -0.2, torch.tensor([[0.0], [1.0], [0.0]])
    p, f = table(built, count, x, n), brought(lights, x, n)
    power = (lights["intensity"] / lights["intensity"].sum()).double().expand_as(f)

    def variance(q: Tensor) -> float:
        return float((torch.where(f > 0, f * f / torch.where(q > 0, q, 1.0), 0.0).sum(1) / f.sum(1) ** 2 - 1).mean())

    assert variance(p) < 0.1 * variance(power)


@pytest.mark.slow
def test_a_hundred_thousand_lights_of_which_one_is_a_million_times_brighter():
    count = 100_000
    lights = emitters("mixed", count)
    lights["intensity"][:] = 1.0
    lights["intensity"][777] = 1e6
    lights["cos_o"][:] = -1.0
    small = emitters("mixed", 20)
    tree.build(**small)  # compiled by now
    start = time.process_time()
    built = tree.build(**lights)
    assert time.process_time() - start < 8  # 1 s of one core of a laptop
    assert built.levels <= 21
    x, n = points(8)
    n[:] = 0.0
    p, f = table(built, count, x, n), brought(lights, x, n)
    torch.testing.assert_close(p.sum(1), torch.ones(8, dtype=torch.float64), rtol=0, atol=1e-9)
    # Neither the one light nor the many are starved: a draw weighs at most a few times the whole.
    assert float((torch.where(f > 0, f / p, 0.0).amax(1) / f.sum(1)).max()) < 30
    assert float((f * f / p).sum(1).div(f.sum(1) ** 2).max()) < 2


def test_rounding_hides_no_light_at_the_horizon():
    """Points and lights in each other's plane up to rounding, far from the origin."""
    count = 64
    centre = uniform(3, count) + 1000.0
    lights: dict[str, Any] = {
        "low": centre,
        "high": centre,
        "axis": unit(count),
        "cos_o": torch.ones(count),
        "cos_e": torch.zeros(count),
        "intensity": torch.ones(count),
    }
    built = tree.build(**lights)
    toward = torch.nn.functional.normalize(torch.randn(3, 2000, generator=G), dim=0)
    # Above the edge of light 0 by a part in a million, and the light above the point's horizon by as much.
    across = torch.nn.functional.normalize(
        torch.linalg.cross(lights["axis"][:, :1].expand(3, 2000), toward, dim=0), dim=0
    )
    x = centre[:, :1] + 3.0 * (across + 2e-7 * lights["axis"][:, :1])
    n = torch.nn.functional.normalize(torch.linalg.cross(across, toward, dim=0), dim=0) - 2e-7 * across
    p = tree.probability(built, torch.zeros(2000, dtype=torch.int64), x, n)
    assert (p > 0).all()


def test_place_and_threads_do_not_matter():
    built, (x, n) = tree.build(**emitters("mixed")), points(5003)
    u, before = tree.from_digits(*uniform(2, 5003)), torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        row, p, _ = tree.sample(built, x, n, u)
        for threads in (1, 2):
            torch.set_num_threads(threads)
            for first, size in ((0, 5003), (0, 1), (1, 3), (5, 1024), (11, 2049)):
                part = slice(first, first + size)
                rows, q, _ = tree.sample(built, x[:, part], n[:, part], u[part])
                assert torch.equal(rows, row[part]) and torch.equal(q, p[part])
                assert torch.equal(tree.probability(built, rows, x[:, part], n[:, part]), q)
    finally:
        torch.set_num_threads(before)


def test_a_lane_without_a_place_draws_some_light():
    built = tree.build(**emitters("mixed"))
    x, n = torch.full((3, 4), torch.nan), torch.full((3, 4), torch.nan)
    row, p, _ = tree.sample(built, x, n, torch.zeros(4, dtype=torch.float64))
    assert ((row >= 0) & (row < 300)).all() and (p > 0).all()


def test_two_numbers_are_one_of_48_bits():
    u = tree.from_digits(*torch.tensor([[0.5, 1 - 2**-24], [0.25, 1 - 2**-24]]))
    assert u.tolist() == [0.5 + 2**-26, 1 - 2**-48]
