"""Sampling by solid angle: the shares that the map cuts off are exact, and sampling and density switch together."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from few import few
from torch import Tensor
from trials import SIGNIFICANCE, chi_square_p

import torchpt.engines  # noqa: F401  (takes sampling over)
from torchpt.compiler.function import Lanewise
from torchpt.math.sampling import uniform_triangle
from torchpt.math.vectors import affine, cross, dot, normalize
from torchpt.physics.lights import solid_angle
from torchpt.physics.lights.solid_angle import LEAST, MOST, OTHER, RECTANGLE, SKEW, TRIANGLE
from torchpt.physics.lights.surface import flat_inverse_pdf as planar

D = torch.float64


def column(*v: float) -> Tensor:
    return torch.tensor(v, dtype=D)[:, None]


CODES = {"triangle": TRIANGLE, "rectangle": RECTANGLE, "parallelogram": SKEW}
#: p0, e1, e2 of lights about the plane y = 0, shining down.
LIGHTS = {
    "triangle": (column(-0.5, 0, -0.5), column(1, 0, 0), column(0.2, 0, 1)),
    "rectangle": (column(-0.5, 0, -0.5), column(1, 0, 0), column(0, 0, 1)),
    "parallelogram": (column(-0.5, 0, -0.5), column(1, 0, 0), column(0.6, 0, 0.8)),
    "sliver": (column(-0.5, 0, 0), column(1, 0, 0), column(0.3, 0, 1e-3)),
    "strip": (column(-5, 0, 0), column(10, 0, 0), column(0, 0, 0.02)),
}
#: Reference points: near and far, before the middle, an edge, a corner and beyond; the last is seen edge-on.
PLACES = {
    "far": (0.3, -3.0, 0.8),
    "near": (0.1, -0.2, 0.05),
    "beyond": (0.8, -0.1, 0.1),
    "under a corner": (-0.499, -0.01, -0.499),
    "1e-4 away": (0.1, -1e-4, 0.05),
    "edge-on": (2.0, -2e-3, 0.0),
}


def code(name: str) -> int:
    return {"sliver": TRIANGLE, "strip": RECTANGLE}.get(name, CODES.get(name, OTHER))


def told(name: str) -> int:
    return TRIANGLE if code(name) == TRIANGLE else RECTANGLE


def table(name: str, light: tuple[Tensor, Tensor, Tensor] | None = None, near: float = math.inf) -> Tensor:
    """Of one light; without a limit of the distance unless told."""
    found = solid_angle.table_of([told(name)], *(light or LIGHTS[name]), near)
    assert found is not None
    return found


def excess(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Solid angle of a triangle with corners ``(3, N)`` seen from the origin (van Oosterom and Strackee, 1983)."""
    n = torch.linalg.vector_norm
    la, lb, lc = n(a, dim=0), n(b, dim=0), n(c, dim=0)
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return 2 * torch.atan2(dot(a, cross(b, c)).abs(), below)


def covered(corners: list[Tensor]) -> Tensor:
    """Solid angle of a polygon, as a fan of triangles."""
    return sum((excess(corners[0], a, b) for a, b in pairwise(corners[1:])), torch.zeros(()))


def whole(name: str, x: Tensor) -> float:
    p0, e1, e2 = LIGHTS[name]
    a = p0 - x
    corners = [a, a + e1, a + e2] if code(name) == TRIANGLE else [a, a + e1, a + e1 + e2, a + e2]
    return float(covered(corners))


def drawn(name: str, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    return solid_angle.sample(table(name), None, x.expand(3, u.shape[1]), u)


def uniform(n: int, seed: int = 3) -> Tensor:
    return torch.rand(2, n, dtype=D, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("place", list(PLACES))
@pytest.mark.parametrize("name", list(LIGHTS))
def test_the_angle_is_the_formulas(name, place):
    x = column(*PLACES[place])
    angle = solid_angle.angles(table(name), None, x)
    exact = whole(name, x)
    if LEAST < exact < MOST:
        torch.testing.assert_close(float(angle), exact, rtol=1e-8, atol=0)
    else:
        assert float(angle) == 0


def test_the_angle_of_an_octant_and_of_half_a_cube():
    """Closed forms: three right angles, and a face of a cube seen from its middle."""
    octant = (column(1, 0, 0), column(-1, 1, 0), column(-1, 0, 1))
    found = solid_angle.angles(table("triangle", octant), None, column(0, 0, 0))
    assert float(found) == pytest.approx(math.pi / 2, rel=1e-12)
    face = (column(-1, -1, 1), column(2, 0, 0), column(0, 2, 0))
    for code_ in (RECTANGLE, SKEW):
        row = table("rectangle", face)
        row[0, 0] = code_
        found = solid_angle.angles(row, None, column(0, 0, 0))
        assert float(found) == pytest.approx(4 * math.pi / 6, rel=1e-12)


@pytest.mark.parametrize("place", list(PLACES))
@pytest.mark.parametrize("name", list(LIGHTS))
def test_the_first_number_is_the_share_of_the_angle_that_is_cut_off(name, place):
    """The map's definition: what lies before the curve of constant u is the share u of the light."""
    x, (p0, e1, e2) = column(*PLACES[place]), LIGHTS[name]
    u = uniform(2048)
    u[1] = 1 - 2.0**-40  # the far end of the arc
    uv, angle = drawn(name, x, u)
    if not bool((angle > 0).all()):
        assert not angle.any()
        return
    p = affine(p0, e1, uv[0], e2, uv[1]) - x
    hub, a, b, c = ((q - x).expand_as(p) for q in (p0, p0 + e1, p0 + e1 + e2, p0 + e2))
    if code(name) == TRIANGLE:
        share = excess(hub, a, p)
    elif code(name) == RECTANGLE:
        side = e1 * uv[0]
        share = covered([hub, hub + side, hub + side + e2, c])
    else:
        share = torch.where(uv[0] >= uv[1], excess(hub, a, p), excess(hub, a, b) + excess(hub, b, p))
    torch.testing.assert_close(share / angle, u[0], rtol=0, atol=2e-7)


def _cells(name: str, lines: tuple[Tensor, Tensor], x: Tensor) -> Tensor:
    """Solid angles of the cells between lines of constant first and second place, see :func:`_places`."""
    p0, e1, e2 = LIGHTS[name]
    s, t = torch.meshgrid(*lines, indexing="ij")
    at = (s * (1 - t), s * t) if code(name) == TRIANGLE else (s, t)
    p = (p0[:, :, None] - x[:, :, None]) + e1[:, :, None] * at[0] + e2[:, :, None] * at[1]
    corners = [q.reshape(3, -1) for q in (p[:, :-1, :-1], p[:, 1:, :-1], p[:, 1:, 1:], p[:, :-1, 1:])]
    return covered(corners)


def _places(name: str, uv: Tensor) -> Tensor:
    """Of a parallelogram (u, v), of a triangle the distance from its hub and the direction there: both in [0, 1]."""
    if code(name) != TRIANGLE:
        return uv
    s = uv[0] + uv[1]
    return torch.stack((s, uv[1] / torch.where(s > 0, s, 1.0)))


LARGE = [(name, place) for name in LIGHTS for place in PLACES if whole(name, column(*PLACES[place])) > LEAST]


@pytest.mark.parametrize(("name", "place"), LARGE)
def test_directions_are_uniform(name, place):
    """Chi-square over 16 x 16 cells whose solid angles are known; their lines follow other draws of the same light."""
    x, side, number = column(*PLACES[place]), 16, 1 << 15
    scout, _ = drawn(name, x, uniform(1 << 13, 8))
    probe = torch.linspace(0, 1, side + 1, dtype=D)[1:-1]
    ends = torch.zeros(1, dtype=D), torch.ones(1, dtype=D)
    lines = [torch.cat((ends[0], torch.quantile(row, probe), ends[1])) for row in _places(name, scout)]
    expected = _cells(name, (lines[0], lines[1]), x) / whole(name, x) * number
    assert float(expected.sum()) == pytest.approx(number, rel=1e-6)
    points, u = x.float().expand(3, number), uniform(number, 9).float()
    uv, angle = solid_angle.sample(table(name), None, points, u)
    assert bool((angle > 0).all())
    st = _places(name, uv.double())
    cell = [
        torch.searchsorted(line[1:-1].contiguous(), row.contiguous(), right=True)
        for line, row in zip(lines, st, strict=True)
    ]
    counts = torch.bincount(cell[0] * side + cell[1], minlength=side * side).double()
    large = expected > 10
    rest = torch.stack((counts[~large].sum(), expected[~large].sum()))
    counts, expected = torch.cat((counts[large], rest[:1])), torch.cat((expected[large], rest[1:].clamp_min(1e-3)))
    p = chi_square_p(float(((counts - expected) ** 2 / expected.clamp_min(1)).sum()), len(counts) - 1)
    assert p > SIGNIFICANCE / len(LARGE)


@pytest.mark.parametrize("name", few(list(CODES), 1))
def test_the_density_integrates_to_one(name):
    """Over the light's area by a fine grid, where it is sampled by its angle and where by its area."""
    p0, e1, e2 = LIGHTS[name]
    area = torch.linalg.vector_norm(cross(e1, e2)) * (0.5 if name == "triangle" else 1.0)
    n = 256 if name == "triangle" else 512  # what a grid is off by falls with its square
    g = (torch.arange(n, dtype=D) + 0.5) / n
    u = torch.cartesian_prod(g, g).T.contiguous()
    uv = uniform_triangle(u) if name == "triangle" else u
    for place in ("far", "near", "beyond"):
        to = affine(p0, e1, uv[0], e2, uv[1]) - column(*PLACES[place])
        square = dot(to, to)
        by_area = planar(column(0, -1, 0), area, to / square.sqrt(), square)
        for scale in (1.0, 1e-3):  # the second light is too small for its angle
            small = p0 * scale, e1 * scale, e2 * scale
            angle = solid_angle.angles(table(name, small), None, column(*PLACES[place]))
            assert (float(angle) > 0) == (scale == 1)
            here = to if scale == 1 else affine(small[0], small[1], uv[0], small[2], uv[1]) - column(*PLACES[place])
            square = dot(here, here)
            by_area = planar(column(0, -1, 0), area * scale**2, here / square.sqrt(), square)
            # d omega = by_area d(uv): the density over the unit square is by_area / inverse_pdf.
            density = by_area / solid_angle.inverse_pdf(angle.expand_as(by_area), by_area)
            assert float(density.mean()) == pytest.approx(1, rel=1e-5)


def _scatter(n: int, dtype: torch.dtype, near: float = math.inf) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lights of every shape and size, and points about them at every distance."""
    g = torch.Generator().manual_seed(11)
    k = 64
    size = 10.0 ** (torch.rand(k, generator=g) * 6 - 3)
    e1, e2 = torch.randn(3, k, generator=g) * size, torch.randn(3, k, generator=g) * size
    codes = torch.arange(k) % 4
    e2 = torch.where(codes == RECTANGLE, normalize(cross(e1, e2)) * size, e2)
    row = torch.randint(0, k, (n,), generator=g)
    reach = size[row] * 10.0 ** (torch.rand(n, generator=g) * 5 - 3)
    p0 = torch.randn(3, k, generator=g)
    x = p0[:, row] + normalize(torch.randn(3, n, generator=g)) * reach
    told = [(TRIANGLE, RECTANGLE, RECTANGLE, OTHER)[code] for code in codes.tolist()]
    lights = solid_angle.table_of(told, p0, e1, e2, near)
    assert lights is not None and torch.equal(lights[:, 0].long(), codes)
    return lights, row, x.to(dtype), torch.rand(2, n, generator=g).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sampling_and_density_switch_together(dtype):
    lights, row, x, u = _scatter(20_000, dtype)
    uv, angle = solid_angle.sample(lights, row, x, u)
    assert torch.equal(angle, solid_angle.angles(lights, row, x))
    some = angle > 0
    assert 0.2 < some.double().mean() < 0.8
    assert LEAST * (1 - 1e-7) <= float(angle[some].min()) and float(angle.max()) <= MOST * (1 + 1e-7)
    kind = lights[row, 0]
    assert not some[kind == OTHER].any() and torch.equal(uv[:, kind == OTHER], u[:, kind == OTHER])
    assert uv.min() >= 0 and uv.max() <= 1 and (uv[0] + uv[1])[kind == TRIANGLE].max() <= 1 + 2e-7
    by_area = (kind == TRIANGLE) & ~some
    torch.testing.assert_close(uv[:, by_area], uniform_triangle(u[:, by_area]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_kernel_is_the_tensor_form(dtype):
    lights, row, x, u = _scatter(20_000, dtype)
    uv, angle = solid_angle.sample(lights, row, x, u)
    other, of_other = solid_angle.sample.function(lights, row, x, u)
    torch.testing.assert_close(angle, of_other, rtol=1e-6, atol=0)
    torch.testing.assert_close(uv, other, rtol=1e-6, atol=1e-7 if dtype == torch.float32 else 1e-9)
    assert torch.equal(solid_angle.angles.function(lights, row, x), of_other)
    forms = solid_angle.sample, solid_angle.angles
    kernels = [kernel for form in forms for kernel in form.implementations if isinstance(kernel, Lanewise)]
    assert len(kernels) == 2 and not any(kernel.refused for kernel in kernels)


def test_place_and_threads_do_not_matter():
    lights, row, x, u = _scatter(20_003, torch.float32)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        uv, angle = solid_angle.sample(lights, row, x, u)
        for threads in (1, 2):
            torch.set_num_threads(threads)
            for first, size in ((0, 20_003), (0, 1), (1, 3), (5, 128), (11, 12_769), (20_000, 3)):
                part = slice(first, first + size)
                some, of_some = solid_angle.sample(lights, row[part], x[:, part], u[:, part])
                assert torch.equal(some, uv[:, part]) and torch.equal(of_some, angle[part])
                assert torch.equal(solid_angle.angles(lights, row[part], x[:, part]), angle[part])
        none, of_none = solid_angle.sample(lights, row[:0], x[:, :0], u[:, :0])
        assert none.shape == (2, 0) and of_none.shape == (0,)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("name", few(list(LIGHTS), 3))
def test_points_in_the_plane_and_lights_without_area_are_sampled_by_area(name):
    p0, e1, e2 = LIGHTS[name]
    spots = [p0, p0 + e1, p0 + e2, p0 + 0.5 * e1, p0 + 0.3 * e1 + 0.3 * e2, p0 - e1, p0 + 3 * e1 + 1e-30]
    u = uniform(256)
    for x in spots:
        for light in ((p0, e1, e2), (p0, e1, e1 * 0.5), (p0, e1 * 0, e2), (p0, e1 * 0, e2 * 0)):
            for form in (solid_angle.sample, solid_angle.sample.function):
                uv, angle = form(table(name, light), None, x.expand(3, 256), u)
                assert not angle.any()
                torch.testing.assert_close(uv, uniform_triangle(u) if code(name) == TRIANGLE else u)


@pytest.mark.parametrize("near", few([1e-5, 1e-7, 1e-9, 1e-12], 2))
@pytest.mark.parametrize("name", few(list(LIGHTS), 2))
def test_points_drawn_from_beside_an_edge_are_on_the_light(name, near):
    """Its ends are seen in opposite directions there, of which float64 keeps no angle between."""
    p0, e1, e2 = LIGHTS[name]
    g = torch.Generator().manual_seed(0)
    along, away = torch.rand(1, 4096, generator=g), near * (2.0 * torch.rand(3, 4096, generator=g) - 1.0)
    u = torch.rand(2, 4096, generator=g)
    for start, edge in ((p0, e1), (p0, e2), (p0 + e1, e2 - e1)):
        x = start + along * edge + away * e1.norm()
        for form, angles in (
            (solid_angle.sample, solid_angle.angles),
            (solid_angle.sample.function, solid_angle.angles.function),
        ):
            uv, angle = form(table(name), None, x, u)
            assert torch.isfinite(angle).all() and (uv >= 0).all() and (uv <= 1).all()
            assert angle.equal(angles(table(name), None, x))


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e18])
@pytest.mark.parametrize("name", list(LIGHTS))
def test_the_unit_of_length_does_not_matter(name, scale):
    x, u = column(*PLACES["near"]), uniform(512)
    uv, angle = drawn(name, x, u)
    p0, e1, e2 = (a * scale for a in LIGHTS[name])
    other, of_other = solid_angle.sample(table(name, (p0, e1, e2)), None, (x * scale).expand(3, 512), u)
    torch.testing.assert_close(other, uv, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(of_other, angle, rtol=1e-9, atol=0)


#: Triangles of radiance 1 and what a Lambert floor (normal +y, albedo 1/2) at the origin sends out.
FLOOR = [
    ((-0.443432, 0.596366, 0.495985), (-0.320397, 0.0677699, -0.229359), (0.0341197, 0.11415, -0.343049), 0.0898394),
    ((0.461963, 0.397843, 0.412747), (-0.0381582, 0.851323, -0.156872), (0.195443, 0.891957, -0.260672), 0.02292),
    ((0.100871, 0.289075, -0.422609), (-0.308386, 0.629587, 0.423966), (-0.373132, 0.237287, 0.351592), 0.0534198),
    ((-0.17575, 0.639397, 0.151268), (0.318604, 0.732996, 0.459771), (0.139095, 0.294498, 0.478556), 0.0205314),
    ((-0.17487, 0.447916, 0.367201), (-0.405259, 0.249607, -0.354079), (0.356029, 0.0918984, -0.132271), 0.26174),
]


@pytest.mark.parametrize("row", FLOOR)
def test_triangles_over_a_lambert_floor(row):
    """The outgoing radiance is albedo / pi times the mean cosine times the angle: a fine grid gives six digits."""
    a, b, c = (column(*v) for v in row[:3])
    g = (torch.arange(512, dtype=D) + 0.5) / 512
    u = torch.cartesian_prod(g, g).T.contiguous()
    uv, angle = solid_angle.sample(table("triangle", (a, b - a, c - a)), None, torch.zeros(3, u.shape[1], dtype=D), u)
    wi = normalize(affine(a, b - a, uv[0], c - a, uv[1]))
    radiance = 0.5 / math.pi * float((wi[1].clamp_min(0) * angle).mean())
    assert radiance == pytest.approx(row[3], rel=1e-5)


@pytest.mark.parametrize("place", ["near", "1e-4 away", "beyond"])
@pytest.mark.parametrize("name", ["triangle", "rectangle", "parallelogram"])
def test_a_near_light_is_far_less_noisy_than_by_area(name, place):
    """Irradiance of a floor that looks up: the same mean, and at least three times less variance."""
    p0, e1, e2 = LIGHTS[name]
    x, n = column(*PLACES[place]), 1 << 16
    area = torch.linalg.vector_norm(cross(e1, e2)) * (0.5 if name == "triangle" else 1.0)

    def estimate(uv: Tensor, angle: Tensor) -> Tensor:
        to = affine(p0, e1, uv[0], e2, uv[1]) - x
        square = dot(to, to)
        wi = to / square.sqrt()
        by_area = planar(column(0, -1, 0), area, wi, square)
        return wi[1] * solid_angle.inverse_pdf(angle, by_area)

    u = uniform(n)
    uv, angle = drawn(name, x, u)
    assert bool((angle > 0).all())
    ours = estimate(uv, angle)
    # Draws by area seldom find the point that matters: their second moment comes from ours.
    second = float((ours * estimate(uv, torch.zeros_like(angle))).mean())
    assert second - float(ours.mean()) ** 2 > 3 * float(ours.var())
    if place != "1e-4 away":
        flat = estimate(uniform_triangle(u) if name == "triangle" else u, torch.zeros_like(angle))
        assert float(flat.var()) > 3 * float(ours.var())
        assert abs(float(ours.mean() - flat.mean())) < 4 * float((ours.var() + flat.var()) / n) ** 0.5


@pytest.mark.parametrize("name", list(CODES))
def test_the_estimate_is_continuous_across_the_switch(name):
    """The weights of a small light meet at the switch, and their mean is the angle on both sides of it."""
    p0, e1, e2 = LIGHTS[name]
    area = torch.linalg.vector_norm(cross(e1, e2)) * (0.5 if name == "triangle" else 1.0)
    direction, u = normalize(column(0.3, -1, 0.2)), uniform(4096)

    def seen(distance: float) -> tuple[Tensor, float, bool]:
        x = direction * distance
        uv, angle = drawn(name, x, u)
        to = affine(p0, e1, uv[0], e2, uv[1]) - x
        square = dot(to, to)
        weight = solid_angle.inverse_pdf(angle, planar(column(0, -1, 0), area, to / square.sqrt(), square))
        return weight, whole(name, x), bool(angle.any())

    low, high = 1.0, 1e3
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if whole(name, direction * middle) > LEAST else (low, middle)
    (near, of_near, by_angle), (far, of_far, by_area) = seen(low * (1 - 1e-9)), seen(high * (1 + 1e-9))
    assert by_angle and not by_area
    torch.testing.assert_close(near, torch.full_like(near, of_near))
    assert float((far / of_far - 1).abs().max()) < 0.05
    assert float(far.mean()) == pytest.approx(of_far, abs=4 * float(far.std()) / 64)


def test_behind_the_emitter_there_is_nothing_and_gradients_are_those_of_the_area_form():
    angle = torch.tensor([0.5, 0.5, 0.0, 0.0], dtype=D)
    by_area = torch.tensor([0.4, 0.0, 0.4, 0.0], dtype=D, requires_grad=True)
    inverse = solid_angle.inverse_pdf(angle, by_area)
    torch.testing.assert_close(inverse.detach(), torch.tensor([0.5, 0.0, 0.4, 0.0], dtype=D))
    (slope,) = torch.autograd.grad(inverse.sum(), by_area)
    torch.testing.assert_close(slope, torch.tensor([0.5 / 0.4, 0.0, 1.0, 1.0], dtype=D))


@pytest.mark.parametrize("place", few(["near", "beyond"], 1))
@pytest.mark.parametrize("name", ["triangle", "rectangle", "parallelogram"])
def test_derivatives_of_a_moving_light_are_those_of_the_integral(name, place):
    """The draw is held and the weight follows: against differences of the irradiance, each over a fine grid."""
    x = column(*PLACES[place])
    g = (torch.arange(400, dtype=D) + 0.5) / 400
    u = torch.cartesian_prod(g, g).T.contiguous()

    def irradiance(move: Tensor) -> Tensor:
        p0, e1, e2 = LIGHTS[name]
        p0, e1 = p0 + move[0] * column(0.3, 1, -0.2), e1 * (1 + move[1])
        uv, angle = solid_angle.sample(table(name, (p0, e1, e2)), None, x.expand(3, u.shape[1]), u)
        assert bool((angle > 0).all())
        to = affine(p0, e1, uv[0], e2, uv[1]) - x
        square = dot(to, to)
        face = cross(e1, e2)
        area = dot(face, face).sqrt() * (0.5 if name == "triangle" else 1.0)
        wi = to / square.sqrt()
        return (wi[1] * solid_angle.inverse_pdf(angle, planar(column(0, -1, 0), area, wi, square))).mean()

    move = torch.zeros(2, dtype=D, requires_grad=True)
    (slope,) = torch.autograd.grad(irradiance(move), move)
    for k, step in enumerate(1e-3 * torch.eye(2, dtype=D)):
        expected = (irradiance(step) - irradiance(-step)) / 2e-3
        assert float(slope[k]) == pytest.approx(float(expected), rel=1e-3)


def test_beyond_some_radii_lights_are_sampled_by_area():
    lights, row, x, _ = _scatter(20_000, D, 4.0)
    whole, *_ = _scatter(20_000, D)
    distance = torch.linalg.vector_norm(x - lights[row, 2:5].T, dim=0)
    corners = [lights[:, 5:8], lights[:, 5:8] + lights[:, 8:11], lights[:, 5:8] + lights[:, 11:14]]
    corners.append(torch.where(lights[:, :1] == TRIANGLE, corners[2], corners[2] + lights[:, 8:11]))
    radius = torch.stack([torch.linalg.vector_norm(c - lights[:, 2:5], dim=1) for c in corners]).amax(0)
    within = distance < 4 * radius[row] * (1 - 1e-9)
    expected = torch.where(within, solid_angle.angles(whole, row, x), 0.0)
    assert torch.equal(solid_angle.angles(lights, row, x), expected)
    assert torch.equal(solid_angle.angles.function(lights, row, x) > 0, expected > 0)
    assert 0.1 < (expected > 0).double().mean() < 0.6


def test_shapes():
    e1 = torch.tensor([[1.0, 0, 0], [1, 0, 0], [1e3, 0, 0], [1, 0, 0], [1, 0, 0]]).T
    e2 = torch.tensor([[0.0, 2, 0], [1e-3, 1, 0], [1e-9, 1e-3, 0], [1, 1, 0], [1, 1, 0]]).T
    lights = solid_angle.table_of([RECTANGLE, RECTANGLE, RECTANGLE, TRIANGLE, OTHER], e1, e1, e2)
    assert lights is not None and lights[:, 0].tolist() == [RECTANGLE, SKEW, RECTANGLE, TRIANGLE, OTHER]
    assert solid_angle.table_of([OTHER, OTHER], e1[:, :2], e1[:, :2], e2[:, :2]) is None
    turned = torch.linalg.qr(torch.randn(100, 3, 3, generator=torch.Generator().manual_seed(1)))[0]
    a, b = turned[:, :, 0].T * 7, turned[:, :, 1].T * 0.1
    lights = solid_angle.table_of([RECTANGLE] * 100, a, a, b)
    assert lights is not None and bool((lights[:, 0] == RECTANGLE).all())
