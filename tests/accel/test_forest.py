"""The structures of several scenes: a ray meets in its own scene what it meets there alone."""

from __future__ import annotations

import pytest
import torch
from accel_reference import geometry, rays, soup, sphere_mesh, triangles
from test_instances import scene as copied

from torchpt.accel import build
from torchpt.accel.forest import Forest
from torchpt.accel.numbers import Numbers

EMPTY = geometry([], [], [], (0, 0, 0, 0))


def flat(counts):
    return [soup(k, tuple(n + (k if n else 0) for n in counts)) for k in range(3)]


SCENES = {
    "all kinds": lambda: flat((20, 8, 6, 6)),
    "triangles": lambda: [triangles(*sphere_mesh(n)) for n in (4, 9, 6)],
    "one of each": lambda: [soup(k, counts) for k, counts in enumerate([(1, 0, 0, 0), (0, 0, 0, 1), (0, 1, 0, 0)])],
    "an empty one": lambda: [soup(0), EMPTY, soup(1)],
    "nothing": lambda: [EMPTY, EMPTY],
}


def check(geometries, kind, numbers):
    accels = [build(g, kind) for g in geometries]
    forest = Forest(accels, numbers)
    o, d, t_max = rays(1, 3000)
    t_max[::3] = 1.5
    scene = torch.randint(len(accels), (3000,), generator=torch.Generator().manual_seed(2))
    t, prim, u, v = forest.intersect(o, d, t_max, scene)
    blocked = forest.occluded(o, d, t_max, scene)
    met = 0
    for number, accel in enumerate(accels):
        mine = scene == number
        own = accel.intersect(o[:, mine], d[:, mine], t_max[mine])
        assert torch.equal(t[mine], own[0])
        assert torch.equal(u[mine], own[2])
        assert torch.equal(v[mine], own[3])
        assert torch.equal(prim[mine].long(), numbers.among_all(number, own[1].long()))
        assert torch.equal(blocked[mine], accel.occluded(o[:, mine], d[:, mine], t_max[mine]))
        met += int((own[1] >= 0).sum())
    return prim, met


@pytest.mark.parametrize("kind", ("torch", "brute", "numba"))
@pytest.mark.parametrize("name", SCENES)
def test_rays_meet_what_they_meet_alone(name, kind):
    geometries = SCENES[name]()
    numbers = Numbers.by_kind([g.counts for g in geometries], torch.device("cpu"))
    prim, met = check(geometries, kind, numbers)
    assert met > 5 or name == "nothing"
    assert int(prim.max()) < numbers.first[-1]


def test_mixed_structures():
    geometries = flat((20, 8, 6, 6))
    numbers = Numbers.by_kind([g.counts for g in geometries], torch.device("cpu"))
    forest = Forest([build(g, kind) for g, kind in zip(geometries, ("torch", "brute", "numba"), strict=True)], numbers)
    whole = Forest([build(g, "torch") for g in geometries], numbers)
    o, d, t_max = rays(1, 3000)
    scene = torch.arange(3000) % 3
    assert torch.equal(forest.occluded(o, d, t_max, scene), whole.occluded(o, d, t_max, scene))
    found, expected = forest.intersect(o, d, t_max, scene)[1].long(), whole.intersect(o, d, t_max, scene)[1].long()
    assert (found == expected).float().mean() > 0.999  # of primitives that touch either


def test_numbers_are_by_kind_and_then_by_scene():
    numbers = Numbers.by_kind([(2, 1, 0, 0, 1), (1, 2, 0, 0, 0), (0, 0, 0, 0, 1)], torch.device("cpu"))
    assert numbers.counts == (3, 3, 0, 0, 2)
    assert [numbers.own(k).tolist() for k in range(3)] == [[0, 1, 3, 6], [2, 4, 5], [7]]
    assert numbers.order.tolist() == [0, 1, 4, 2, 5, 6, 3, 7]
    columns = [torch.tensor([10, 11, 12, 13]), torch.tensor([20, 21, 22]), torch.tensor([30])]
    assert numbers.primitives(columns).tolist() == [10, 11, 20, 12, 21, 22, 13, 30]
    assert numbers.among_all(1, torch.tensor([-1, 2, 0])).tolist() == [-1, 5, 2]


@pytest.mark.parametrize("kind", ("torch", "numba"))
def test_copies(kind):
    geometries = [copied(count, count)[0] for count in (4, 7, 1)]
    ends = [int(g.size + g.copies[13].sum()) for g in geometries if g.copies is not None]
    numbers = Numbers.by_kind([g.counts for g in geometries], torch.device("cpu"), ends)
    prim, met = check(geometries, kind, numbers)
    assert met > 100
    assert int(prim.max()) >= numbers.first[-1]
    # No number is that of two primitives.
    every = torch.cat([numbers.among_all(k, torch.arange(end)) for k, end in enumerate(ends)])
    assert len(every.unique()) == len(every) == sum(ends)
