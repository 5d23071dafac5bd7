"""Trees whose primitives have moved: the hits of a tree built anew, and when one is built."""

import math
from itertools import product

import numba
import numpy as np
import pytest
import torch
from accel_reference import geometry, quadric_table, soup, sphere_mesh, triangles
from few import few
from scalar_search import _triangle
from test_arrays import with_copies, with_quadrics
from test_bits import KINDS, equal_bits, found, make_rays

import torchpt
from torchpt.physics.shapes.geometry import Geometry
from torchpt.physics.shapes.kinds.cylinder import Cylinder
from torchpt.physics.shapes.kinds.sphere import Ellipsoid
from torchpt.search import build
from torchpt.search import tree as wide
from torchpt.search.bounds import primitive_bounds
from torchpt.search.tables import affine_rows
from torchpt.search.tree import REBUILD_THRESHOLD, WideBvh
from torchpt.search.tree_build import mesh_tree
from torchpt.search.tree_instances import InstancedWideBvh
from torchpt.search.tree_layout import CHILDREN, FLOOR, IDS, LINE, PLANES

EMPTY = np.array([np.inf] * 3 + [-np.inf] * 3, np.float32)


@pytest.fixture
def whatever_it_costs(monkeypatch):
    """Refits however far things have moved."""
    monkeypatch.setattr(wide, "REBUILD_THRESHOLD", np.inf)


def refitted(before, g) -> WideBvh:
    tree = before.refit(g)
    assert tree is not None
    return tree


def moved(g, seed, size):
    """All corners and radii changed at random."""
    rng = np.random.default_rng(seed)
    p = [p + size * torch.from_numpy(rng.normal(size=p.shape)).float() for p in (g.p0, g.p1, g.p2)]
    q = g.quadrics
    if q is not None:
        frame = q.frame + size * torch.from_numpy(rng.normal(size=q.frame.shape))
        q = quadric_table((Ellipsoid, Cylinder), frame)
        first = sum(g.counts[:4])
        for corner, at in zip(p, (0, 3, 6), strict=True):
            corner[:, first:] = frame[at : at + 3].float()
    return Geometry(p[0], p[1], p[2], g.counts, q, g.copies)


def nodes_of(accel):
    """The nodes of a tree as ``(box, code)`` of their children, by code; children's ids where the code is a leaf's."""
    tree = accel.tables[0]
    codes = tree.view(np.int32)
    nodes, leaves, todo = {}, {}, [0]
    while todo:
        line = todo.pop() >> 2
        at = line * LINE
        children = codes[at + CHILDREN : at + CHILDREN + 8].tolist()
        boxes = tree[at : at + CHILDREN].reshape(6, 8).T
        nodes[4 * line] = [(box, code) for box, code in zip(boxes, children, strict=True) if code]
        todo += [code for code in children if code > 0]
        for code in children:
            if code < 0:
                start = (~code >> 2) * LINE
                ids = codes[start + IDS : start + IDS + 8]
                leaves[code] = (start, [int(q) if q >= -1 else -2 - int(q) for q in ids])
    return nodes, leaves


def union(boxes):
    boxes = np.array(boxes)
    return np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)])


def check_blocks(accel, g):
    """Every box is the one about what it holds, every triangle is where the geometry has it."""
    (nodes, leaves), tree = nodes_of(accel), accel.tables[0]
    area = affine_rows(g).area.numpy()
    bounds = torch.cat(primitive_bounds(g)).T.numpy()
    corners = torch.cat([g.p0, g.p1, g.p2]).T.numpy()
    planes, held = mesh_tree(g)[1], []
    for children in nodes.values():
        for box, code in children:
            if code > 0:
                assert np.array_equal(box, union([b for b, _ in nodes[code]]))
                continue
            start, ids = leaves[code]
            assert np.array_equal(box, union([bounds[q] if q >= 0 and area[q] else EMPTY for q in ids]))
            for k, q in enumerate(ids):
                here = 0 <= q < g.counts[0] and area[q]
                block = tree[start + k : start + PLANES + 32 : 8]
                expected = np.concatenate([corners[q], planes[q]]) if here else np.full(13, np.nan)
                assert np.array_equal(block, expected.astype(np.float32), equal_nan=True)
                held += [q] if q >= 0 and area[q] else []
    assert sorted(held) == np.flatnonzero(area).tolist()


@numba.njit(error_model="numpy")
def _nearest_of_all(o, d, p, rows, t, prim):
    for i in range(o.shape[1]):
        t[i], prim[i] = np.inf, -1
        size = np.abs(d[:, i])
        z = 0 if size[0] >= size[1] and size[0] >= size[2] else (1 if size[1] >= size[2] else 2)
        for q in range(len(p)):
            s, _, _ = _triangle(p[q], rows[q], o[:, i], d[:, i], ((z + 1) % 3, (z + 2) % 3, z))
            if s > 0 and s < t[i]:
                t[i], prim[i] = s, q


def raised(accel, o, d, t, prim):
    """Of rays whose nearest triangle of all is ``prim`` at ``t``: where that lies before its leaf is entered."""
    nodes, leaves = nodes_of(accel)
    boxes = np.zeros((accel.counts[0], 6), np.float32)
    for children in nodes.values():
        for box, code in children:
            if code < 0:
                boxes[[q for q in leaves[code][1] if q >= 0]] = box
    box = boxes[prim]
    least = np.maximum(np.abs(d).max(0) * np.float32(1e-20), np.float32(1e-37))
    inverse = np.float32(1) / np.where(np.abs(d) >= least, d, np.copysign(least, d))
    near = np.where(inverse.T > 0, box[:, :3], box[:, 3:])
    entry = np.maximum(((near - o.T) * inverse.T).max(1), np.float32(0))
    return (entry.view(np.int32) & -8).view(np.float32) * FLOOR > t


def same_but_grazed(a, b):
    """The same hits to the bit, but for distances of a few grazed triangles, which their leaves decide."""
    unlike = a[0].view(np.int32) != b[0].view(np.int32)
    near = np.allclose(a[0][unlike], b[0][unlike], rtol=0.01, atol=0)
    return near and unlike.mean() < 1e-3 and equal_bits(a[1:], b[1:])


MOVES = {
    "slightly": lambda v, rng: v * (1 + 0.02 * rng.normal(size=(len(v), 1))),
    "by an edge": lambda v, rng: v + 0.1 * rng.normal(size=v.shape),
    "anywhere": lambda v, rng: rng.normal(size=v.shape),
    "far": lambda v, rng: v + 300 + 0.05 * rng.normal(size=v.shape),
    "flat": lambda v, rng: v * [1, 1e-3, 1],
}


@pytest.mark.parametrize("how", few(MOVES, 2))
def test_hits_are_those_of_a_tree_built_anew(how, whatever_it_costs):
    """To the bit, but where the nearest triangle is grazed and its distance lies before its leaf: there the leaf decides."""
    v, f = sphere_mesh(20)
    g = triangles(MOVES[how](v, np.random.default_rng(1)), f)
    old, new = refitted(WideBvh(triangles(v, f), 1), g), WideBvh(g, 1)
    check_blocks(old, g)
    p = torch.stack((g.p0, g.p1, g.p2)).permute(2, 0, 1).contiguous().numpy()
    rows, differ, hits = mesh_tree(g)[1], 0, 0
    for kind in KINDS:
        rays = make_rays(kind, g, 20_000, 4)
        a, b = found(old, *rays), found(new, *rays)
        unlike = np.any([x.view(np.int32) != y.view(np.int32) for x, y in zip(a, b, strict=True)], 0)
        o, d = (x[:, unlike].copy() for x in rays[:2])
        t, prim = np.empty(o.shape[1], np.float32), np.empty(o.shape[1], np.int32)
        _nearest_of_all(o, d, p, rows, t, prim)
        assert (raised(old, o, d, t, prim) | raised(new, o, d, t, prim)).all()
        assert unlike.mean() < (0.01 if how == "far" else 0.001)  # and a third of the rays is aimed at edges
        differ += unlike.sum()
        hits += (a[1] >= 0).sum()
    assert hits > 10_000
    assert differ > 0 or how in ("anywhere", "flat")  # or nothing was told of the rays that differ


@pytest.mark.parametrize(
    ("size", "make"), few(product([0.01, 1.0], [lambda: soup(3, (400, 20, 15, 15)), with_quadrics]), 2)
)
def test_all_kinds_move(make, size, whatever_it_costs):
    g = make()
    there = moved(g, 1, size)
    old, new = refitted(WideBvh(g, 1), there), WideBvh(there, 1)
    check_blocks(old, there)
    for kind in ("random", "axes"):
        rays = make_rays(kind, there, 30_000, 2)
        a, b = found(old, *rays), found(new, *rays)
        assert equal_bits(a, b) and len(np.unique(a[1])) > min(g.size // 2, 100)
    last = refitted(refitted(old, g), there)  # and back, and there again
    assert equal_bits(found(last, *rays), a)


def test_the_same_places_give_the_same_blocks():
    g = soup(5, (300, 8, 6, 6))
    tree = WideBvh(g, 1)
    again = refitted(tree, g)
    for a, b in zip(tree.tables, again.tables, strict=True):
        assert a is not b and np.array_equal(a, b, equal_nan=a.dtype != np.int32)
    assert again.refit_state.sah_ratio == 1.0 and tree.describe() == again.describe() | {
        "build_seconds": tree.describe()["build_seconds"]
    }


def test_a_tree_in_use_stays_as_it_is(whatever_it_costs):
    g = soup(6, (300, 8, 6, 6))
    tree = WideBvh(g, 1)
    before, rays = [x.copy() for x in tree.tables], make_rays("random", g, 5000)
    hits, facts = found(tree, *rays), tree.describe()
    other = refitted(tree, moved(g, 2, 0.5))
    assert not equal_bits(found(other, *rays), hits)
    assert equal_bits(found(tree, *rays), hits) and tree.describe() == facts
    for a, b in zip(before, tree.tables, strict=True):
        assert np.array_equal(a, b, equal_nan=a.dtype != np.int32)


#: Quadrics without volume, balls without radius, flat and vague triangles.
LOST = {
    "a point": (3, lambda p: p[1:, :, 3].copy_(p[0, :, 3])),
    "a line": (7, lambda p: p[2, :, 7].copy_(2 * p[1, :, 7] - p[0, :, 7])),
    "NaN": (11, lambda p: p[1, 0, 11].fill_(math.nan)),
    "infinite": (12, lambda p: p[0, 2, 12].fill_(math.inf)),
    "a rectangle": (402, lambda p: p[1, :, 402].copy_(p[0, :, 402])),
    "a disk": (425, lambda p: p[2, :, 425].copy_(p[0, :, 425])),
    "a ball": (440, lambda p: p[1, 0, 440].zero_()),
    "a ball nowhere": (441, lambda p: p[0, 0, 441].fill_(math.nan)),
}


def without(g, name):
    p = torch.stack((g.p0, g.p1, g.p2))
    number, change = LOST[name]
    change(p)
    return number, Geometry(p[0], p[1], p[2], g.counts)


@pytest.mark.parametrize("name", few(LOST, 2))
def test_what_loses_its_area_is_not_hit_and_may_return(name, whatever_it_costs):
    g = soup(3, (400, 20, 15, 15))
    p = torch.cat([(g.p0 * 4).round() / 4, (g.p1 * 4).round() / 4, (g.p2 * 4).round() / 4])  # so that lines are lines
    g = Geometry(p[:3].clone(), p[3:6].clone(), p[6:].clone(), g.counts)
    number, there = without(g, name)
    assert affine_rows(g).area[number] and not affine_rows(there).area[number]
    tree = WideBvh(g, 1)
    flat = refitted(tree, there)
    check_blocks(flat, there)
    share = [1, 1, 1] if number < 400 else [0, 1.5, 1.5] if number < 420 else [3, 0, 0]
    centre = np.sum([k * x[:, number].numpy() for k, x in zip(share, (g.p0, g.p1, g.p2), strict=True)], 0) / 3
    o, d, t_max = make_rays("random", g, 40_000, 3)
    o[:, ::2] = centre[:, None] + 0.01 * d[:, ::2]  # close by, at where it was
    d[:, ::2] *= -1
    before, hits = found(tree, o, d, t_max), found(flat, o, d, t_max)
    assert not (hits[1] == number).any() and same_but_grazed(hits, found(WideBvh(there, 1), o, d, t_max))
    assert (before[1] == number).sum() > 50
    assert equal_bits(found(refitted(flat, g), o, d, t_max), before)
    # A tree that was built without it has no place for it.
    bare = WideBvh(there, 1)
    assert bare.refit(g) is None and same_but_grazed(found(refitted(bare, there), o, d, t_max), hits)


def test_a_ball_without_a_radius_is_no_point_to_be_hit():
    """Its leaf is entered for the sake of others."""
    centres = np.array([[0, 0, 0], [3, 1, 1], [-3, -1, -1]])
    big, none = (
        geometry(centres, [[r, 0, 0], [0.5, 0, 0], [0.5, 0, 0]], centres * 0, (0, 0, 0, 3)) for r in (0.5, 0.0)
    )
    o, d = np.array([[-1], [0], [0]], np.float32), np.array([[1], [0], [0]], np.float32)
    ray = o, d, np.full(1, np.inf, np.float32)
    tree = WideBvh(big, 1)
    assert [found(x, *ray)[1][0] for x in (tree, refitted(tree, none), WideBvh(none, 1))] == [0, -1, -1]


def test_quadrics_lose_their_volume_and_get_it_back(whatever_it_costs):
    g = with_quadrics()
    assert g.quadrics is not None
    frame = g.quadrics.frame.clone()
    frame[3:6, 1] = 0
    flat = Geometry(g.p0, g.p1, g.p2, g.counts, quadric_table((Ellipsoid, Cylinder), frame))
    rays = make_rays("random", g, 40_000)
    a, b = WideBvh(g, 1), refitted(WideBvh(g, 1), flat)
    assert (found(a, *rays)[1] == g.size - 1).sum() > 50 and not (found(b, *rays)[1] == g.size - 1).any()
    assert equal_bits(found(b, *rays), found(WideBvh(flat, 1), *rays))
    assert WideBvh(flat, 1).refit(g) is None and equal_bits(found(refitted(b, g), *rays), found(a, *rays))


def test_nothing_left_is_built_anew():
    v, f = sphere_mesh(6)
    point = triangles(v * 0, f)
    assert WideBvh(triangles(v, f), 1).refit(point) is None
    nothing = geometry([], [], [], (0, 0, 0, 0))
    assert WideBvh(nothing, 1).refit(nothing) is None and WideBvh(point, 1).refit(point) is None


def test_other_primitives_are_built_anew():
    g, more = soup(1, (20, 4, 3, 3)), soup(1, (20, 3, 4, 3))
    tree = WideBvh(g, 1)
    assert tree.refit(more) is None and tree.refit(soup(1, (21, 4, 3, 3))) is None
    assert build(more, "numba", 1, before=tree).describe()["primitives"] == more.size
    assert tree.refit(with_copies()) is None
    for kind in ("torch", "brute"):  # other kinds are neither refitted nor taken for one
        assert not build(g, kind, 1).refits and build(g, kind, 1).refit(g) is None
        assert build(g, kind, 1, before=tree).name == kind
        assert build(g, "numba", 1, before=build(g, kind, 1)).name == "numba"


def cost(accel):
    """Expected work of a random ray, 1 a node and 1 a leaf, by numpy."""

    def area(box):
        x, y, z = np.maximum(box[3:].astype(np.float64) - box[:3], 0)
        return x * y + y * z + z * x

    nodes, _ = nodes_of(accel)
    root = area(union([box for box, _ in nodes[0]]))
    return 1 + sum(area(box) for children in nodes.values() for box, _ in children) / root


def test_the_cost_is_that_of_the_tree_as_it_was_built(whatever_it_costs):
    v, f = sphere_mesh(20)
    rng = np.random.default_rng(2)
    first = tree = WideBvh(triangles(v, f), 1)
    for _ in range(3):
        v = v + 0.05 * rng.normal(size=v.shape).astype(np.float32)
        tree = refitted(tree, triangles(v, f))
        assert tree.refit_state.sah_ratio == pytest.approx(cost(tree) / cost(first), rel=1e-9)
        assert tree.describe()["sah_cost"] == pytest.approx(first.sah_cost * tree.refit_state.sah_ratio)
    assert tree.refit_state.sah_ratio > 1.5


def test_a_tree_is_built_anew_once_it_costs_too_much():
    """Small steps add up: what counts is the tree as it was built, not the one before."""
    v, f = sphere_mesh(20)
    rng = np.random.default_rng(3)
    first = tree = last = WideBvh(g := triangles(v, f), 1)
    steps = []
    for _ in range(60):
        v = v + 0.012 * rng.normal(size=v.shape).astype(np.float32)
        g = triangles(v, f)
        tree, last = tree.refit(g), tree
        if tree is None:
            break
        steps.append(tree.refit_state.sah_ratio)
    assert tree is None and len(steps) > 5 and steps[-1] <= REBUILD_THRESHOLD and max(np.diff(steps)) < 0.1
    assert first.refit(g) is None and last.refit(triangles(sphere_mesh(20)[0], f)) is not None
    assert cost(build(g, "numba", 1, before=last)) < cost(first) * REBUILD_THRESHOLD  # a new one
    turned = triangles(sphere_mesh(20)[0][:, [1, 2, 0]], f)  # axes for axes: costs what it did
    assert refitted(first, turned).refit_state.sah_ratio == pytest.approx(1.0)


@pytest.mark.parametrize("size", [0.001, 1.0])
def test_copies_move_with_their_meshes(size, whatever_it_costs):
    g = with_copies()
    assert g.copies is not None
    there = moved(g, 4, size)
    turn = g.copies.clone()
    turn[3] += size
    there = Geometry(there.p0, there.p1, there.p2, there.counts, None, turn)
    tree = build(g, "numba", 1)
    old, new = tree.refit(there), build(there, "numba", 1)
    assert isinstance(old, InstancedWideBvh) and isinstance(tree, InstancedWideBvh)
    assert len(old.tables[1]) == len(tree.tables[1])  # the meshes' blocks; those of the upper level are new
    rays = make_rays("random", there, 30_000, 2)
    hits = found(old, *rays)
    assert equal_bits(hits, found(new, *rays)) and (hits[1] >= g.size).sum() > 500
    assert not equal_bits(hits, found(tree, *rays))


def test_copies_of_other_meshes_are_built_anew(whatever_it_costs):
    g = with_copies()
    assert g.copies is not None
    tree, fewer = build(g, "numba", 1), g.copies.clone()
    fewer[13] -= 2
    assert tree.refit(Geometry(g.p0, g.p1, g.p2, g.counts, None, fewer)) is None
    assert tree.refit(Geometry(g.p0, g.p1, g.p2, g.counts)) is None
    first = int(g.copies[12, 0])
    p0, p1, p2 = (p.clone() for p in (g.p0, g.p1, g.p2))
    p1[:, first], p2[:, first] = p0[:, first], p0[:, first]
    flat = Geometry(p0, p1, p2, g.counts, None, g.copies)
    assert tree.refit(flat) is not None and build(flat, "numba", 1).refit(g) is None


def test_copies_are_built_anew_once_a_mesh_costs_too_much():
    g = with_copies()
    assert build(g, "numba", 1).refit(moved(g, 4, 0.001)) is not None
    assert build(g, "numba", 1).refit(moved(g, 4, 0.3)) is None


# --- a scene -----------------------------------------------------------------------------------------------------------


def ball_in_light():
    v, f = sphere_mesh(12)
    return {
        "camera": {"type": "perspective", "origin": [0, 0.5, 4], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 40},
        "film": {"width": 24, "height": 24, "filter": "box"},
        "integrator": {"type": "path", "max_depth": 4},
        "render": {"threads": 1, "spp": 4},
        "materials": {"grey": {"type": "diffuse", "reflectance": [0.8, 0.7, 0.6]}},
        "shapes": {
            "ball": {"type": "mesh", "vertices": v.tolist(), "faces": f.tolist(), "material": "grey"},
            "floor": {
                "type": "rectangle",
                "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 3}, {"translate": [0, -1.2, 0]}],
                "material": "grey",
            },
        },
        "lights": {"sky": {"type": "constant", "radiance": [1, 1, 1]}},
    }


@pytest.fixture
def builds(monkeypatch):
    """Primitives of each tree that is built."""
    sizes, original = [], wide.mesh_tree
    monkeypatch.setattr(wide, "mesh_tree", lambda g: sizes.append(g.size) or original(g))
    return sizes


def picture_and_gradient(scene, vertices, seed):
    leaf = vertices.clone().requires_grad_()
    image = torchpt.render(scene, params={"shapes.ball.vertices": leaf}, seed=seed)
    image.square().mean().backward()
    assert leaf.grad is not None
    return image.detach(), leaf.grad


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
@pytest.mark.slow
def test_an_optimization_refits_and_gives_the_pictures_of_fresh_scenes(builds):
    scene = torchpt.load(ball_in_light(), "cpu")
    vertices = scene.params["shapes.ball.vertices"].clone()
    steps = []
    for k in range(5):
        image, grad = picture_and_gradient(scene, vertices, k)
        steps.append((vertices, image, grad))
        assert torch.isfinite(grad).all() and grad.any()
        vertices = vertices - 0.005 * grad / grad.norm(dim=1).max()
    assert len(builds) == 1
    for k, (vertices, image, grad) in enumerate(steps):
        other = picture_and_gradient(torchpt.load(ball_in_light(), "cpu"), vertices, k)
        assert torch.equal(image, other[0]) and torch.equal(grad, other[1])
    assert len(builds) == 6 and not torch.equal(steps[0][1], steps[-1][1])
    generator = torch.Generator().manual_seed(0)
    far = vertices + 0.3 * torch.randn(vertices.shape, generator=generator)
    image, _ = picture_and_gradient(scene, far, 9)
    assert len(builds) == 7
    assert torch.equal(
        image, torchpt.render(torchpt.load(ball_in_light(), "cpu"), params={"shapes.ball.vertices": far}, seed=9)
    )


def test_parameters_changed_in_place_refit_too(builds):
    scene = torchpt.load(ball_in_light(), "cpu")
    first = torchpt.render(scene)
    scene.params["shapes.ball.vertices"].mul_(1.02)
    second = torchpt.render(scene)
    assert len(builds) == 1 and not torch.equal(first, second)
    other = torchpt.load(ball_in_light(), "cpu")
    other.params["shapes.ball.vertices"].mul_(1.02)
    assert torch.equal(second, torchpt.render(other)) and len(builds) == 2


def test_a_scene_keeps_no_structure_that_cannot_be_refitted():
    scene = torchpt.load(ball_in_light(), "cpu")
    _, own = scene.world(torch.float32)
    for kind in ("torch", "numba"):
        a, b = (scene.accel(kind, 1, own) for _ in range(2))
        assert a is not b and (a in scene._latest_accels.values(), b in scene._latest_accels.values()) == (
            False,
            kind == "numba",
        )
