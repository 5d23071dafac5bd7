"""Choices by cumulative sums, several of them one after another among them."""

from __future__ import annotations

import pytest
import torch

from torchpt.math.distributions import Cells, Discrete, Spans


def several(seed, sizes):
    g = torch.Generator().manual_seed(seed)
    return [torch.rand(size, generator=g) * (torch.rand(size, generator=g) < 0.8) for size in sizes]


@pytest.mark.parametrize("sizes", ([1], [1, 1, 1], [5, 1, 300, 2, 17], [64, 63, 65]), ids=str)
def test_spans_search_as_torch_does(sizes):
    arrays = [torch.rand(size, dtype=torch.float64).sort().values.mul(8).floor().div(8) for size in sizes]
    spans, v = Spans.of(sizes, torch.device("cpu")), (torch.arange(4000, dtype=torch.float64) % 11 - 1) / 8
    of = torch.arange(4000) * 7 // 5 % len(sizes)
    found = spans.search(torch.cat(arrays), v, of)
    for number, array in enumerate(arrays):
        mine = of == number
        assert torch.equal(found[mine], torch.searchsorted(array, v[mine], right=True))
        assert set(spans.begin(of)[mine].tolist()) == {sum(sizes[:number])}
        assert set(spans.last(of)[mine].tolist()) == {sum(sizes[: number + 1]) - 1}


def test_several_choices_are_each_its_own():
    choices = [Discrete.of(weights, torch.float32) for weights in several(1, (3, 1, 200, 2))]
    every, of = Discrete.joined(choices), torch.arange(5000) % 4
    u = torch.rand(5000, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    u[:8] = torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    row, rest = every.draw(u, of)
    chance, last = every.chance(row, of), every.chance_of_last(of)
    for number, choice in enumerate(choices):
        mine = of == number
        own, left = choice.draw(u[mine])
        assert torch.equal(row[mine], own)
        assert torch.equal(rest[mine], left)
        assert torch.equal(chance[mine], choice.chance(own))
        assert bool((last[mine] == choice.chance_of_last()).all())
        assert bool((choice.chance(own) > 0).all())


def test_several_grids_are_each_its_own():
    g = torch.Generator().manual_seed(4)
    grids = [Cells.of(torch.rand(rows, columns, generator=g)) for rows, columns in ((1, 1), (5, 9), (30, 2))]
    of, u = torch.arange(3000) % 3, torch.rand(2, 3000, generator=g)
    rows = Spans.of([len(cells.rows) for cells in grids], torch.device("cpu"))
    columns = Spans.of([len(cells.columns) for cells in grids], torch.device("cpu"))
    width = torch.stack([cells.width for cells in grids])[of]
    every = Cells(torch.cat([c.rows for c in grids]), torch.cat([c.columns for c in grids]), width, (rows, columns), of)
    found = every.sample(u)
    for number, cells in enumerate(grids):
        mine = of == number
        for a, b in zip(found, cells.sample(u[:, mine]), strict=True):
            assert torch.equal(a[..., mine], b)
