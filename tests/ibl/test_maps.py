"""Convolved maps against quadrature over a finer lattice, cube maps there and back, the table against an integral."""

from __future__ import annotations

import math

import pytest
import torch
from few import few
from torch import Tensor

import torchpt
from torchpt.physics.bsdfs.kinds.roughconductor import RoughConductor
from torchpt.physics.ibl import convolve, equirect
from torchpt.physics.ibl.cube import look_up_cube
from torchpt.physics.ibl.pyramid import Pyramid

RESULT = (5, 8)


def sky(height: int = 64, width: int = 128) -> Tensor:
    """Smooth, and no colour the same in any two directions of the lattices here."""
    x, y, z = equirect.directions(height, width)
    return torch.stack((0.3 + 0.3 * y, 0.4 + 0.3 * y.abs(), 0.7 + 0.25 * torch.sin(3.0 * x) * z), -1).float()


def suns() -> Tensor:
    map = sky()
    map[20, 51] = 1e5
    map[2, 7] = 3e4  # beside the pole
    return map


def lamps() -> Tensor:
    map, d = sky(), equirect.directions(64, 128)
    generator = torch.Generator().manual_seed(3)
    for _ in range(20):
        axis = torch.nn.functional.normalize(torch.randn(3, generator=generator).double(), dim=0)
        map[(d * axis[:, None, None]).sum(0) > 0.995] += 200.0
    return map


def noise() -> Tensor:
    return torch.rand(64, 128, 3, generator=torch.Generator().manual_seed(1)).pow(4) * 5.0


MAPS = {"noise": noise, "sky": sky, "suns": suns, "lamps": lamps}


def refined(map: Tensor, times: int) -> Tensor:
    d = equirect.directions((map.shape[0] - 1) * times + 1, map.shape[1] * times)
    return equirect.look_up(map.double(), d.permute(1, 2, 0))


def quadrature(map: Tensor, kernel) -> Tensor:
    """The mean of a map under a kernel of the cosine, by a sum over its texels; ``(h, w, 3)``."""
    d = equirect.directions(*map.shape[:2]).reshape(3, -1)
    area = equirect.solid_angles(*map.shape[:2])[:, None].expand(map.shape[:2]).reshape(-1)
    n = equirect.directions(*RESULT).reshape(3, -1)
    weight = kernel(n.T @ d) * area
    return (weight @ map.double().reshape(-1, 3) / weight.sum(1, keepdim=True)).view(*RESULT, 3)


def ggx(alpha: float):
    def kernel(cos: Tensor) -> Tensor:
        half2 = (1.0 + cos) / 2.0
        return alpha**2 / (math.pi * (1.0 + (alpha**2 - 1.0) * half2).square()) * cos.clamp_min(0.0)

    return kernel


def rms(found: Tensor, wanted: Tensor) -> float:
    return float((found.double() - wanted).square().mean().sqrt() / wanted.square().mean().sqrt())


@pytest.mark.parametrize("name", few(MAPS, 1))
def test_maps_agree_with_quadrature(name: str) -> None:
    map = MAPS[name]()
    fine = refined(map, 3)
    wanted = quadrature(fine, lambda cos: cos.clamp_min(0.0))
    both = [torchpt.ibl.irradiance_map(map, *RESULT, method=method) for method in convolve.METHODS]
    assert [round(rms(found, wanted), 4) for found in both] == pytest.approx([0.0, 0.0], abs=0.005)
    assert rms(both[0], both[1].double()) < 0.005
    levels = torchpt.ibl.prefiltered(map, sizes=[RESULT] * 5)
    assert levels[0] is map
    assert len(levels) == 6
    for level, roughness in zip(levels[1::2], torchpt.ibl.roughnesses(6)[1::2], strict=True):
        assert rms(level, quadrature(fine, ggx(roughness**2))) < 0.01, roughness


def test_a_white_sky_stays_white() -> None:
    maps = torchpt.ibl.maps(torch.ones(5, 7, 3), samples=64, sizes=[(4, 6)] * 5)
    for map in (maps.irradiance, *maps.specular):
        assert torch.allclose(map, torch.ones_like(map), atol=2e-5)


def test_solid_angles_cover_the_sphere() -> None:
    for height, width in ((2, 1), (3, 5), (64, 128)):
        assert float(equirect.solid_angles(height, width).sum() * width) == pytest.approx(4.0 * math.pi, rel=1e-12)


def test_no_level_of_the_pyramid_loses_light() -> None:
    map = noise()[:37, :53].double()
    area = equirect.solid_angles(37, 53)
    whole = (map * area[:, None, None]).sum((0, 1))
    pyramid = Pyramid.of(map)
    for a, height in enumerate(pyramid.heights):
        for b, width in enumerate(pyramid.widths):
            first = int(pyramid.first[a, b])
            level = pyramid.texels[first : first + height * width].view(height, width, 3)
            light = (level * equirect.solid_angles(height, width)[:, None, None]).sum((0, 1))
            assert torch.allclose(light, whole, rtol=1e-10)


@pytest.mark.parametrize("d", [(0, 1, 0), (0, -1, 0), (0, 0, -1), (1, 0, 0), (0.6, 0.0, 0.8)])
def test_directions_are_found_where_they_lie(d: tuple[float, float, float]) -> None:
    """``u = atan2(x, -z) / 2 pi``, ``v = acos(y) / pi``, rows from pole to pole."""
    u, v = equirect.coordinates(torch.tensor(d, dtype=torch.float64)[:, None])
    assert float(v) == pytest.approx(math.acos(d[1]) / math.pi, abs=1e-6)
    if abs(d[1]) < 1:
        assert float(u) == pytest.approx(math.atan2(d[0], -d[2]) / (2.0 * math.pi) % 1.0, abs=1e-9)
    map = sky()
    assert torch.allclose(equirect.look_up(map, equirect.directions(64, 128).permute(1, 2, 0).float()), map, atol=1e-4)


@pytest.mark.slow
def test_gradients_of_maps_are_their_differences() -> None:
    torch.manual_seed(0)
    map = suns().double()[::4, ::4].contiguous().requires_grad_()
    maps = torchpt.ibl.maps(map, levels=3, samples=64, sizes=[(4, 8)] * 2)
    cotangents = [torch.rand_like(t) for t in (maps.irradiance, *maps.specular)]
    pairs = list(zip((maps.irradiance, *maps.specular), cotangents, strict=True))
    value = sum((t * c).sum() for t, c in pairs)
    assert isinstance(value, Tensor)
    (grad,) = torch.autograd.grad(value, map)
    step = torch.rand_like(map) * 1e-3
    moved = torchpt.ibl.maps((map + step).detach(), levels=3, samples=64, sizes=[(4, 8)] * 2)
    after = sum((t * c).sum() for t, c in zip((moved.irradiance, *moved.specular), cotangents, strict=True))
    assert isinstance(after, Tensor)
    assert float((grad * step).sum()) == pytest.approx(float(after - value.detach()), rel=1e-4)


@pytest.mark.parametrize("up", few([False, True], 1))
def test_cube_and_back(up: bool) -> None:
    map = sky(128, 256)
    cube = torchpt.ibl.equirect_to_cube(map, 128)
    back = torchpt.ibl.cube_to_equirect(cube, *((128, 256) if up else (33, 64)))
    wanted = map if up else refined(map, 1)[[round(i * 127 / 32) for i in range(33)]]
    if up:
        assert float((back - wanted).abs().max()) < 2e-3
    else:
        assert rms(back, equirect.look_up(map, equirect.directions(33, 64).permute(1, 2, 0).float()).double()) < 3e-3


def test_faces_of_the_cube() -> None:
    """+X -X +Y -Y +Z -Z, seen from inside; right is forward x up."""
    d = equirect.directions(64, 128).permute(1, 2, 0)
    cube = torchpt.ibl.equirect_to_cube(((d + 1.0) / 2.0).float(), 15) * 2.0 - 1.0
    axis = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]).float()
    up = torch.tensor([[0, 1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1], [0, 1, 0], [0, 1, 0]]).float()
    assert torch.allclose(cube[:, 7, 7], axis, atol=5e-3)
    for face in range(6):
        assert float((cube[face, 0, 7] - cube[face, 14, 7]) @ up[face]) > 1.0
        right = torch.linalg.cross(axis[face], up[face])
        assert float((cube[face, 7, 14] - cube[face, 7, 0]) @ right) > 1.0


def test_neighbouring_faces_meet() -> None:
    """Bilinear look-ups do not jump where one face ends."""
    cube = torchpt.ibl.equirect_to_cube(sky(128, 256), 16).double()
    along = torch.linspace(-0.9, 0.9, 20, dtype=torch.float64)
    ones = torch.ones_like(along)
    a = torch.nn.functional.normalize(torch.stack((ones, along, ones - 1e-6), -1), dim=-1)
    b = torch.nn.functional.normalize(torch.stack((ones - 1e-6, along, ones), -1), dim=-1)
    assert float((look_up_cube(cube, a) - look_up_cube(cube, b)).abs().max()) < 2e-3


@pytest.mark.slow
def test_table_against_an_integral_over_directions() -> None:
    """``f cos`` of ``roughconductor`` with Schlick's term at F0 = 0 and 1, over a lattice of directions."""
    table = torchpt.ibl.brdf_table(21)
    model = RoughConductor(schlick=True)
    u = (torch.arange(700, dtype=torch.float64) + 0.5) / 700
    z, phi = u.repeat_interleave(700), u.repeat(700) * math.pi
    r = (1.0 - z * z).sqrt()
    wi = torch.stack((r * phi.cos(), r * phi.sin(), z))
    for i, j in ((8, 4), (10, 10), (14, 19), (20, 1), (20, 20)):
        cos = j / 20
        wo = torch.tensor([math.sqrt(1.0 - cos * cos), 0.0, cos], dtype=torch.float64)[:, None].expand(3, len(z))
        found = []
        for f0 in (0.0, 1.0):
            values = {"reflectance": torch.full((3, 1), f0).double(), "roughness": torch.full((1,), i / 20).double()}
            value = model.eval_pdf(model.prepare(values), wo, wi)[0][0]
            found.append(float(value.mean()) * 2.0 * math.pi)
        assert float(table[i, j, 1]) == pytest.approx(found[0], abs=1e-3)
        assert float(table[i, j].sum()) == pytest.approx(found[1], abs=1e-3)


def test_hammersley_points() -> None:
    points = torchpt.ibl.hammersley(8)
    assert points[0].tolist() == [i / 8 for i in range(8)]
    assert points[1].tolist() == [0.0, 0.5, 0.25, 0.75, 0.125, 0.625, 0.375, 0.875]


def shaded(map: Tensor, **settings) -> Tensor:
    n = torch.nn.functional.normalize(torch.tensor([[0.2, 0.9, 0.3], [-0.5, 0.1, 0.4]]), dim=-1)
    v = torch.nn.functional.normalize(torch.tensor([[0.0, 0.5, 1.0], [-0.1, 0.2, 1.0]]), dim=-1)
    return torchpt.ibl.shade(torchpt.ibl.maps(map, samples=64, sizes=[(4, 8)] * 5), n, v, **settings)


def test_shading_under_a_white_sky_is_the_table() -> None:
    white = shaded(torch.ones(4, 8, 3), base_color=torch.ones(2, 3), roughness=0.0, metallic=1.0)
    assert torch.allclose(white, torch.ones(2, 3), atol=1e-3)
    matt = shaded(torch.ones(4, 8, 3), base_color=torch.ones(2, 3), roughness=1.0)
    assert float((matt - 1.0).abs().max()) < 0.05
    black = shaded(torch.ones(4, 8, 3), base_color=torch.zeros(2, 3), roughness=1.0, f0=0.0)
    assert float(black.max()) < 0.05


def test_shading_has_gradients_to_everything() -> None:
    map = sky(16, 32).requires_grad_()
    base = torch.full((2, 3), 0.5, requires_grad=True)
    rough, metal = torch.tensor([0.0, 0.33], requires_grad=True), torch.tensor([0.2, 1.0], requires_grad=True)
    n = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], requires_grad=True)
    v = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.6, 0.8]], requires_grad=True)
    out = torchpt.ibl.shade(torchpt.ibl.maps(map, samples=64, sizes=[(4, 8)] * 5), n, v, base, rough, metal)
    grads = torch.autograd.grad(out.sum(), (map, base, rough, metal, n, v))
    assert all(bool(torch.isfinite(g).all()) for g in grads)
    assert all(float(g.abs().max()) > 0 for g in grads[:2])


@pytest.mark.parametrize(
    ("map", "says"),
    [
        (torch.zeros(4, 8), "map: expected the shape"),
        (torch.zeros(1, 8, 3), "map: expected the shape"),
        (torch.zeros(4, 8, 3, dtype=torch.int64), "map: expected a tensor of floats"),
        (torch.full((4, 8, 3), math.nan), "map: expected finite radiance"),
        (torch.full((4, 8, 3), -1.0), "map: expected radiance that is not negative"),
    ],
)
def test_maps_that_are_none(map: Tensor, says: str) -> None:
    for call in (torchpt.ibl.maps, torchpt.ibl.irradiance_map, torchpt.ibl.prefiltered):
        with pytest.raises(torchpt.SceneError, match=says):
            call(map)
    with pytest.raises(torchpt.SceneError, match=says):
        torchpt.ibl.equirect_to_cube(map, 8)


def test_settings_that_are_none() -> None:
    map = torch.ones(4, 8, 3)
    with pytest.raises(torchpt.SceneError, match="method: expected grid or importance"):
        torchpt.ibl.irradiance_map(map, method="random")
    with pytest.raises(torchpt.SceneError, match="levels: expected"):
        torchpt.ibl.prefiltered(map, levels=1)
    with pytest.raises(torchpt.SceneError, match="sizes: expected 5 pairs"):
        torchpt.ibl.prefiltered(map, sizes=[(4, 8)])
    with pytest.raises(torchpt.SceneError, match="height: expected"):
        torchpt.ibl.irradiance_map(map, height=1)
    with pytest.raises(torchpt.SceneError, match="cube: expected the shape"):
        torchpt.ibl.cube_to_equirect(torch.ones(5, 4, 4, 3), 8, 16)
    with pytest.raises(torchpt.SceneError, match="roughness: expected"):
        shaded(map, base_color=torch.ones(2, 3), roughness=torch.ones(3))


def test_a_map_is_convolved_on_its_own_device():
    """Tensors on `meta` are refused beside those of another device, as on CUDA."""
    prepared = convolve._PreparedMap(torch.rand(2, 1, 3).to("meta").requires_grad_())
    _, suns, _ = prepared._prepared(1.0)  # none, as the map is that coarse
    assert suns.device.type == "cpu"  # where they meet directions, though `meta` would take them
    found = prepared.convolved(3, 4, convolve._cosine_lobe(16))
    (gradient,) = torch.autograd.grad(found.sum(), prepared.map)
    assert found.shape == (3, 4, 3) and found.device.type == gradient.device.type == "meta"
