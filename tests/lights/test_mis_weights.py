"""A light that is drawn and the same light met by chance are told one density: the two weights of a pair sum to 1."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torchpt
from torchpt.math.sampling import power_heuristic
from torchpt.math.vectors import dot
from torchpt.physics import lights
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import KINDS, Hit
from torchpt.physics.shapes.interaction import OFFSET

GLOW = {"emission": [1, 2, 3]}
TILT = {"rotate": {"axis": [1, 2, 0.5], "angle": 100}}
DOWN = {"rotate": {"axis": [1, 0, 0], "angle": 90}}
SKEW = {"matrix": [[0.4, 0.2, 0, -0.5], [0, 0.1, 0.5, 0.8], [0, 0.4, 0, 1], [0, 0, 0, 1]]}
CORNERS = [[-1, 0.4, 0.2], [-0.4, 0.6, 0.3], [-0.8, 0.9, -0.4]]
LIGHTS: dict[str, dict[str, Any]] = {
    "triangles": {"type": "mesh", "vertices": CORNERS, "faces": [[0, 1, 2], [0, 2, 1]], "face_normals": True},
    "rectangle": {"type": "rectangle", "transform": [TILT, {"scale": 0.4}, {"translate": [0.2, 0.6, 0.3]}]},
    "next to the floor": {"type": "rectangle", "transform": [DOWN, {"scale": 0.4}, {"translate": [1, 0.01, -1]}]},
    "parallelogram": {"type": "rectangle", "transform": [SKEW]},
    "disk": {"type": "disk", "transform": [TILT, {"scale": 0.4}, {"translate": [1.2, 0.7, 0.3]}]},
    "ball": {"type": "sphere", "center": [0, 1, -1], "radius": 0.3},
    "can": {"type": "cylinder", "radius": 0.2, "height": 0.6, "transform": [{"translate": [-1.5, 0.3, -0.5]}]},
}
FLOOR = {"type": "rectangle", "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 3}]}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_of_random_pairs_sum_to_one(dtype):
    shapes = {name: {**light, **GLOW} for name, light in LIGHTS.items()}
    view, sky = {"origin": [0, 0, 5], "target": [0, 0, 0]}, {"type": "constant", "radiance": [0.3] * 3}
    scene = torchpt.load({"camera": view, "lights": {"sky": sky}, "shapes": {**shapes, "floor": FLOOR}}, device="cpu")
    world, _ = scene.world(dtype)
    accel, g, n = scene.accel("auto", None), torch.Generator().manual_seed(3), 1 << 15

    def met(o: torch.Tensor, d: torch.Tensor) -> tuple[Any, torch.Tensor]:
        t, prim, u, v = accel.intersect(o.float(), d.float(), torch.full((o.shape[1],), torch.inf))
        hit = prim >= 0
        found = Hit(t[hit].to(dtype), prim[hit].long(), u[hit].to(dtype), v[hit].to(dtype))
        return interact(world, o[:, hit], d[:, hit], found), hit

    above = torch.rand(3, n, generator=g).to(dtype) * 4 - 2
    above[1] = 3
    down = torch.tensor([[0.0], [-1.0], [0.0]], dtype=dtype).expand(3, n)
    at, _ = met(above, down)
    wo, count = -down[:, : at.p.shape[1]], at.p.shape[1]
    assert count == n and world.lights is not None
    x = offset_origin(world, at, wo)
    u = torch.rand(2, n, generator=g).to(dtype)
    drawn = lights.sample(world.lights, x, torch.rand(n, generator=g), u, OFFSET)
    assert drawn.distant is not None
    # What a reflected ray may meet: it leaves from the very point that the light was drawn for.
    pair = (drawn.weight > 0) & ~drawn.distant & (dot(drawn.wi, at.ng) * dot(wo, at.ng) > 0)
    assert torch.equal(offset_origin(world, at, drawn.wi)[:, pair], x[:, pair])
    o, d, target, pdf = x[:, pair], drawn.wi[:, pair], drawn.target[:, pair], drawn.pdf[pair]
    there, hit = met(o, d)
    radiance, told = lights.emitted(world.lights, o[:, hit], there, d[:, hit])
    same = ((there.p - target[:, hit]).norm(dim=0) < 1e-4) & (radiance[0] > 0)
    assert same.double().mean() > 0.5
    pdf = pdf[hit]
    other = pdf * torch.exp(2 * torch.randn(pdf.shape, generator=g)).to(dtype)  # the BSDF's density
    error = (power_heuristic(pdf, other) + power_heuristic(other, told) - 1).abs()
    # Density by area has a cosine and a distance in it, which edge-on are rounding of where the search found the point.
    front = same & (dot(d[:, hit], there.ng).abs() > 0.1)
    of_prim = torch.repeat_interleave(torch.arange(len(KINDS)), torch.tensor(world.geometry.counts))[there.prim]
    for number, kind in enumerate(KINDS):
        found = error[front & (of_prim == number)].double()
        assert len(found) > 50, kind
        sure = kind in ("triangle", "rectangle", "sphere")  # by solid angle, unless far away
        assert float(torch.quantile(found, 1.0 if sure else 0.9)) < 1e-6, kind
