"""What every kind of shape and of primitive keeps, one row a shape (:mod:`shape_rows`)."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from shape_rows import PLACES, ROWS, SIMILAR, Row, Vectors

import torchpt
from torchpt.core.errors import SceneError
from torchpt.math.transforms import compose
from torchpt.physics.shapes import KINDS, interact, quadrics, reattach, surface_uv
from torchpt.physics.shapes.geometry import KINDS as STORED
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.shapes.primitive import PRIMITIVES
from torchpt.physics.shapes.quadrics import Quadric
from torchpt.physics.world import World
from torchpt.spec import parameters_of

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
CAMERA = {"origin": [0.2, 0.4, 6], "target": [0, 0, 0], "fov": 40}
BACKENDS = ("torch", "numba", "brute")
N = 4000
#: Points nearer to where two smooth surfaces meet are left out.
CREASE = 2e-3

QUADRICS = [
    kind for name in KINDS for kind in vars(import_module(KINDS[name].__module__)).values() if isinstance(kind, type)
]
QUADRICS = list(dict.fromkeys(kind for kind in QUADRICS if issubclass(kind, Quadric) and kind is not Quadric))

every_row = pytest.mark.parametrize("name", list(ROWS))


def placed_rows(names: Iterable[str]) -> list[Any]:
    """Return each shape in each place as parameters: in two places it is fast, in the others slow."""
    return [
        pytest.param(name, placed, marks=[] if (j - i) % len(PLACES) in (1, 3) else [pytest.mark.slow])
        for i, name in enumerate(names)
        for j, placed in enumerate(PLACES)
    ]


def in_turn(names: Iterable[str], *places: str) -> list[Any]:
    """Return each shape in each of two places as parameters: in one it is fast, by turns."""
    return [
        pytest.param(name, placed, marks=[pytest.mark.slow] if (i + j) % 2 == 0 else [])
        for i, name in enumerate(names)
        for j, placed in enumerate(places)
    ]


def load(name: str, placed: str, **more: Any) -> tuple[torchpt.Scene, np.ndarray]:
    """A scene of one shape (and of what an instance is of, out of the way), and its transform."""
    shapes: dict[str, Any] = {"s": {**ROWS[name].shape, "transform": PLACES[placed], **more}}
    if name == "instance":
        shapes["other"] = {**ROWS["mesh"].shape, "transform": [{"translate": [40, 0, 0]}]}
    scene = torchpt.load({"camera": CAMERA, "shapes": shapes}, device="cpu")
    key = "shapes.s.to_world"  # not rounded to float32, so that both sides mean the same surface
    scene.params[key] = torch.from_numpy(scene.built.parameters[key])
    return scene, compose(PLACES[placed]) if PLACES[placed] else np.eye(4)


def rays(matrix: np.ndarray, n: int = N, seed: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """From without toward a shape of about unit size under a transform."""
    g, m = torch.Generator().manual_seed(seed), torch.from_numpy(matrix)
    o = torch.randn(3, n, generator=g, dtype=torch.float64)
    o = 3 * o / o.norm(dim=0)
    target = 1.6 * torch.rand(3, n, generator=g, dtype=torch.float64) - 0.8
    o, target = (m[:3, :3] @ x + m[:3, 3:] for x in (o, target))
    return o.float(), ((target - o) / (target - o).norm(dim=0)).float(), torch.full((n,), torch.inf)


def found(scene: torchpt.Scene, o: torch.Tensor, d: torch.Tensor, t_max: torch.Tensor, kind: str = "torch"):
    """Rays that hit the shape, and what they hit."""
    t, prim, u, v = scene.accel(kind, 1).intersect(o, d, t_max)
    keep = (prim >= 0) & (t < 30)
    return o[:, keep], d[:, keep], Hit(t[keep], prim[keep].long(), u[keep], v[keep])


def level(row: Row, matrix: np.ndarray, p: Vectors) -> tuple[Vectors, Vectors]:
    """The shape's level at points of the world ``(3, N)``, and how far its second largest lies below it."""
    inverse = np.linalg.inv(matrix)
    levels = np.sort(np.stack(row.level(inverse[:3, :3] @ p + inverse[:3, 3:])), axis=0)
    return levels[-1], levels[-1] - levels[-2] if len(levels) > 1 else np.full(p.shape[1], np.inf)


def slopes(row: Row, matrix: np.ndarray, p: Vectors) -> Vectors:
    """Unit normals of the world by central differences of the level."""
    h = 1e-5
    rises = [level(row, matrix, p + h * e)[0] - level(row, matrix, p - h * e)[0] for e in np.eye(3)[:, :, None]]
    n = np.stack(rises)
    return n / np.linalg.norm(n, axis=0)


def test_every_kind_has_a_row():
    assert {row.shape["type"] for row in ROWS.values()} == set(KINDS)
    parts = [part for name in ROWS for placed in ("as it is", "sheared") for part in load(name, placed)[0].built.parts]
    assert {part.kind for part in parts} == set(PRIMITIVES) == set(STORED)
    assert {part.quadric for part in parts if part.quadric} == set(QUADRICS)


@pytest.mark.parametrize(("name", "placed"), placed_rows(ROWS))
def test_points_lie_on_the_shape_and_normals_are_its_slopes(name: str, placed: str):
    row, (scene, matrix) = ROWS[name], load(name, placed)
    o, d, hit = found(scene, *rays(matrix))
    assert len(hit.t) > N // 10
    world, _ = scene.world(torch.float64)
    for follow_ray in (False, True):
        real = Hit(hit.t.double(), hit.prim, hit.u.double(), hit.v.double())
        at = interact(world, o.double(), d.double(), real, follow_ray=follow_ray)
        off, apart = level(row, matrix, at.p.numpy())
        sure = apart > CREASE
        assert np.abs(off[sure]).max() < 2e-6 and sure.mean() > 0.9
        along = slopes(row, matrix, at.p.numpy()[:, sure])
        assert np.abs(along - at.ng.numpy()[:, sure]).max() < 2e-4
        assert (at.ng.norm(dim=0) - 1).abs().max() < 1e-9
        if not row.open:  # met from without
            assert ((d.double() * at.ng).sum(0)[torch.from_numpy(sure)] < 1e-3).all()
        # nothing is in front of what was met
        before = o.double() + (hit.t.double() - 3e-3) * d.double()
        assert row.open or (level(row, matrix, before.numpy())[0][sure] > -1e-6).all()


@every_row
def test_flipped_normals(name: str):
    (scene, matrix), (flipped, _) = load(name, "sheared"), load(name, "sheared", flip_normals=True)
    o, d, hit = found(scene, *rays(matrix))
    one, other = (interact(s.world(torch.float32)[0], o, d, hit) for s in (scene, flipped))
    torch.testing.assert_close(one.ng, -other.ng)
    torch.testing.assert_close(one.p, other.p)


@pytest.mark.parametrize(("name", "placed"), placed_rows(name for name, row in ROWS.items() if row.chart))
def test_texture_coordinates_lead_back_to_the_point(name: str, placed: str):
    row, (scene, matrix) = ROWS[name], load(name, placed)
    o, d, hit = found(scene, *rays(matrix))
    world, _ = scene.world(torch.float32, uv=True)
    at = interact(world, o, d, hit)
    u, v = surface_uv(world, at).double().numpy()
    assert min(u.min(), v.min()) >= -1e-6 and max(u.max(), v.max()) <= 1 + 1e-6
    owner = [part.piece for part in scene.built.parts]
    for number, piece in enumerate(owner):  # a primitive each
        mine = at.prim.numpy() == number
        assert mine.any()
        own = row.chart[piece](u[mine], v[mine])
        away = matrix[:3, :3] @ own + matrix[:3, 3:] - at.p.double().numpy()[:, mine]
        assert np.abs(away).max() < 1e-5, piece


@pytest.mark.parametrize("placed", few(["turned", "mirrored", "sheared and mirrored"], 2))
@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.chart])
def test_tangents_are_the_slopes_of_the_charts(name: str, placed: str):
    """How points move with u and with v, which bump maps ask for."""
    bumps = {"type": "diffuse", "bump_map": {"type": "checkerboard", "scale": 4}}
    row, (scene, matrix) = ROWS[name], load(name, placed, material=bumps)
    o, d, hit = found(scene, *rays(matrix))
    world, _ = scene.world(torch.float32)
    at = interact(world, o, d, hit)
    assert at.tangent is not None and at.bitangent is not None
    u, v = surface_uv(world, at).double().numpy()
    h = 1e-5
    for number, part in enumerate(scene.built.parts):
        mine = (at.prim.numpy() == number) & (np.minimum(np.minimum(u, v), np.minimum(1 - u, 1 - v)) > 0.02)
        assert mine.sum() > 10
        chart = row.chart[part.piece]
        for found_, i, j in ((at.tangent, h, 0.0), (at.bitangent, 0.0, h)):
            slope = (chart(u[mine] + i, v[mine] + j) - chart(u[mine] - i, v[mine] - j)) / (2 * h)
            np.testing.assert_allclose(found_.double().numpy()[:, mine], matrix[:3, :3] @ slope, atol=2e-3)


@pytest.mark.parametrize(("name", "placed"), placed_rows(ROWS))
def test_all_searches_find_the_same(name: str, placed: str):
    scene, matrix = load(name, placed)
    o, d, t_max = rays(matrix, seed=2)
    t_max[::7] = 3.0
    hits = {kind: scene.accel(kind, 1).intersect(o, d, t_max) for kind in BACKENDS[: 2 if name == "instance" else 3]}
    for kind, hit in hits.items():
        assert torch.equal(scene.accel(kind, 1).occluded(o, d, t_max), hit[1] >= 0)
    assert all(torch.equal(a, b) for a, b in zip(hits["torch"], hits["numba"], strict=True))
    for t, prim, u, v in [hits["brute"]] if "brute" in hits else []:
        same = prim == hits["torch"][1]
        assert same.float().mean() > 0.995  # edges, where flat primitives accept their rounding error
        for a, b in zip((t, u, v), (hits["torch"][k] for k in (0, 2, 3)), strict=True):
            torch.testing.assert_close(a[same], b[same], rtol=1e-3, atol=1e-4)


def _grid(n: int) -> tuple[Vectors, Vectors, Vectors]:
    """Gauss' points and weights of the unit square."""
    x, w = np.polynomial.legendre.leggauss(n)
    u, v = np.meshgrid(0.5 + 0.5 * x, 0.5 + 0.5 * x)
    return u.reshape(-1), v.reshape(-1), np.outer(w, w).reshape(-1) / 4


@pytest.mark.parametrize(
    ("name", "placed"), in_turn([name for name, row in ROWS.items() if row.chart], "turned", "sheared")
)
def test_areas_are_those_of_the_charts(name: str, placed: str):
    """Of the light table where it has them; of quadrics, whose density follows the map, those that its powers are made of."""
    row, (scene, matrix) = ROWS[name], load(name, placed, emission=1)
    world, geometry = scene.world(torch.float64)
    assert world.lights is not None
    u, v, weight = _grid(32)
    h = 1e-5
    curved = 0
    for number, part in enumerate(scene.built.parts):
        chart = row.chart[part.piece]
        a, b = ((chart(u + i, v + j) - chart(u - i, v - j)) / (2 * h) for i, j in ((h, 0), (0, h)))
        grown = np.cross((matrix[:3, :3] @ a).T, (matrix[:3, :3] @ b).T)
        exact = float(np.linalg.norm(grown, axis=1) @ weight)
        if part.quadric is None:
            area = float(world.lights.area[number])
        else:
            assert geometry.quadrics is not None and world.geometry.quadrics is not None
            area = float(quadrics.areas(world.geometry.quadrics, geometry.quadrics.frame)[1][curved])
            curved += 1
        assert area == pytest.approx(exact, rel=3e-3 if part.quadric else 1e-5), part.piece


@pytest.mark.parametrize("kind", QUADRICS, ids=lambda kind: kind.name)
def test_points_of_a_quadric_are_uniform_by_area_in_its_own_space(kind: type[Quadric]):
    """Moments of what is drawn against those of a fine grid of it, and both lie on the surface, in its box."""
    grid = (torch.arange(512, dtype=torch.float64) + 0.5) / 512
    q = kind.sample(torch.cartesian_prod(grid, grid).T)
    assert quadrics._residual(kind.form, q).abs().max() < 1e-12
    one = torch.eye(3, dtype=torch.float64)[:, :, None]
    low, high = kind.box(*one)
    assert (q >= low - 1e-12).all() and (q <= high + 1e-12).all() and (high - low).max() <= 2
    assert (q.amax(1) - high[:, 0]).abs().max() < 0.05 and (q.amin(1) - low[:, 0]).abs().max() < 0.05  # tips are rare
    # Slices of equal height hold areas that follow from the profile: r sqrt(1 + r'^2), by differences of the equation.
    z = torch.linspace(float(low[2, 0]), float(high[2, 0]), 20_001, dtype=torch.float64)
    form = kind.form
    w = z - form.shift
    radius = (form.level - form.bend * w * w - 2 * form.half * w).clamp_min(0).sqrt()
    band = torch.pi * (radius[1:] + radius[:-1]) * (radius.diff().square() + z.diff().square()).sqrt()
    assert float(band.sum()) == pytest.approx(kind.area, rel=1e-4)
    share = torch.cat((band.new_zeros(1), band.cumsum(0))) / band.sum()
    for at in (4000, 9000, 15_000):
        assert float((q[2] < z[at]).double().mean()) == pytest.approx(float(share[at]), abs=2.5e-3)
    turn = torch.atan2(q[1], q[0])
    assert all((torch.exp(1j * k * turn)).mean().abs() < 2e-3 for k in (1, 2, 3))


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if KINDS[row.shape["type"]].meshed])
def test_an_instance_is_a_shape_elsewhere(name: str):
    """Whatever is made of triangles: a copy under a shear is met where the shape itself would be."""
    there, matrix = load(name, "sheared and mirrored")
    away = {**ROWS[name].shape, "transform": [TURN_AWAY]}
    copy = {"type": "instance", "of": "first", "transform": PLACES["sheared and mirrored"]}
    scene = torchpt.load({"camera": CAMERA, "shapes": {"first": away, "copy": copy}}, device="cpu")
    o, d, t_max = rays(matrix)
    a, b = (found(s, o, d, t_max) for s in (there, scene))
    assert a[0].shape == b[0].shape
    one, other = (interact(s.world(torch.float32)[0], *hits) for s, hits in ((there, a), (scene, b)))
    assert (one.p - other.p).abs().max() < 1e-4
    assert ((one.ng - other.ng).norm(dim=0) < 1e-3).float().mean() > 0.995


TURN_AWAY = {"translate": [0, 60, 0]}


def _inner(name: str, scene: torchpt.Scene, matrix: np.ndarray, n: int) -> tuple[torch.Tensor, torch.Tensor, Hit]:
    """A few rays that meet the shape squarely, far from creases."""
    o, d, hit = found(scene, *rays(matrix, seed=5))
    world, _ = scene.world(torch.float32)
    at = interact(world, o, d, hit)
    apart = level(ROWS[name], matrix, at.p.double().numpy())[1] > 0.05
    square = ((at.ng * d).sum(0).abs() > 0.3).numpy()
    keep = torch.from_numpy(np.flatnonzero(apart & square)[:n])
    assert len(keep) == n
    hit = Hit(*(x[keep].double() if x.is_floating_point() else x[keep] for x in (hit.t, hit.prim, hit.u, hit.v)))
    return o[:, keep].double(), d[:, keep].double(), hit


@pytest.mark.parametrize(("name", "placed"), in_turn(ROWS, "turned", "sheared and mirrored"))
def test_points_follow_transforms_and_vertices(name: str, placed: str):
    """Derivatives of points and normals along a ray, by its place, the shape's transform and its vertices."""
    scene, matrix = load(name, placed)
    o, d, hit = _inner(name, scene, matrix, 12)
    of_mesh = [key for key in scene.params if key.endswith(".vertices") and KINDS[name].meshed] if name in KINDS else []
    for key in ("shapes.s.to_world", *of_mesh):
        if ROWS[name].shape["type"] == "sphere" and placed in SIMILAR and key.endswith("to_world"):
            continue  # it must stay a sphere: below

        def point(value: torch.Tensor, key: str = key) -> tuple[torch.Tensor, torch.Tensor]:
            at = interact(scene.world(torch.float64, {key: value})[0], o, d, hit, follow_ray=True)
            return at.p, at.ng

        given = scene.params[key].double().clone().requires_grad_()
        assert torch.autograd.gradcheck(point, given, eps=1e-5, atol=2e-5, fast_mode=True), key
    if placed in SIMILAR and name == "sphere":

        def moved(by: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            grown = torch.cat((pose[:3, :3] * (1 + by[3]), pose[:3, 3:] + by[:3, None]), 1)
            world, _ = scene.world(torch.float64, {"shapes.s.to_world": torch.cat((grown, pose[3:]))})
            at = interact(world, o, d, hit, follow_ray=True)
            return at.p, at.ng

        pose = scene.params["shapes.s.to_world"].double()
        assert torch.autograd.gradcheck(
            moved, torch.zeros(4, dtype=torch.float64).requires_grad_(), eps=1e-5, atol=2e-5
        )


@every_row
def test_held_points_move_with_the_shape(name: str):
    """A traced direction and its measure follow the place that was hit: derivatives by the transform."""
    placed = "turned" if name == "sphere" else "sheared"  # spheres that stay such are moved and scaled alone
    scene, matrix = load(name, placed)
    o, d, hit = _inner(name, scene, matrix, 12)
    key = "shapes.s.to_world"
    pose = scene.params[key].double()
    at = interact(scene.world(torch.float64)[0], o, d, hit)
    there = torch.linalg.inv(pose)
    own = there[:3, :3] @ at.p + there[:3, 3:]  # in the space that the pose maps
    along = pose[:3, :3].T @ at.ng
    along = along / along.norm(dim=0)
    g = torch.Generator().manual_seed(3)
    shift = 0.3 * torch.randn(4, 4, generator=g, dtype=torch.float64)
    shift[3] = 0
    if name == "sphere":
        shift[:3, :3] = 0.2 * pose[:3, :3]

    def exact(step: float) -> tuple[torch.Tensor, torch.Tensor]:
        m = pose + step * shift
        away = m[:3, :3] @ own + m[:3, 3:] - o
        turned = torch.linalg.det(m[:3, :3]) * torch.linalg.inv(m[:3, :3]).T @ along
        distance = away.norm(dim=0)
        return away / distance, ((away * turned).sum(0).abs() / distance**3).log()

    def held(step: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        near = torch.tensor([1e-3], dtype=torch.float64)  # all points are farther, and held
        return reattach(scene.world(torch.float64, {key: pose + step * shift})[0], o, hit, d, near)

    h = 1e-5
    wanted = [(a - b) / (2 * h) for a, b in zip(exact(h), exact(-h), strict=True)]
    step = torch.zeros((), dtype=torch.float64)
    _, slopes_ = torch.autograd.functional.jvp(held, step, torch.ones_like(step))
    for one, other in zip(slopes_, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@every_row
def test_the_same_by_parameters(name: str):
    """A transform given to ``render`` is one that the file could have."""
    scene, _ = load(name, "mirrored")
    plain, _ = load(name, "as it is")
    film = {"width": 24, "height": 18, "filter": "box", "aovs": ["position", "normal", "depth"]}
    key = "shapes.s.to_world"
    pose = scene.params[key].float()
    scene.params[key] = pose
    pictures = [
        torchpt.render(one, spp=1, film=film, integrator="aov", compile="off", params=params)
        for one, params in ((scene, None), (plain, {key: pose}))
    ]
    assert torch.equal(*pictures) and pictures[0].abs().max() > 0


@every_row
def test_values_that_it_cannot_have_are_named(name: str):
    row = ROWS[name]
    other = {"other": ROWS["mesh"].shape} if name == "instance" else {}

    def refused(**keys: Any) -> SceneError:
        with pytest.raises(SceneError) as caught:
            torchpt.load({"camera": CAMERA, "shapes": {"s": {**row.shape, **keys}, **other}}, device="cpu")
        assert "\n" not in str(caught.value)
        return caught.value

    own = parameters_of(KINDS[row.shape["type"]])
    error = refused(raduis=1)
    assert error.key == "shapes.s.raduis" and all(key in error.expected for key in own)
    for key in own:
        assert refused(**{key: "\n"}).key.startswith(f"shapes.s.{key}")
    for key, value in row.bad.items():
        if value is not None:
            assert refused(**{key: value}).key.startswith((f"shapes.s.{key}", "shapes.s.faces"))
    assert all(spec.doc for spec in own.values())


def test_worlds_hold_the_kinds_that_a_scene_has():
    def of(*names: str) -> World:
        shapes = {name: {**ROWS[name].shape, "transform": PLACES["turned"]} for name in names}
        return torchpt.load({"camera": CAMERA, "shapes": shapes}, device="cpu").world(torch.float32)[0]

    assert [kind.name for kind in of("cone", "mesh").geometry.kinds] == ["triangle", "disk", "quadric"]
    assert of("mesh", "rectangle").geometry.quadrics is None
    both = of("cone", "tube").geometry.quadrics
    assert both is not None and both.code is not None and [kind.name for kind in both.kinds] == ["cone", "cylinder"]
    alone = of("tube").geometry.quadrics
    assert alone is not None and alone.code is None
