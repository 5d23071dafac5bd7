"""Cotangents that are written down: against autograd through where samples are computed to lie."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.cotangents import Cotangents
from torchpt.gradients.edges.gradients import Boundary, boundary_of
from torchpt.gradients.edges.receivers import Prefix
from torchpt.gradients.edges.segments import Segments, SegmentSamples
from torchpt.gradients.edges.shadows import Cast, Shadows
from torchpt.math.guiding import Round
from torchpt.math.vectors import dot, take
from torchpt.scene.formats.description import settings

SCENE: dict[str, Any] = {
    "camera": {"type": "perspective", "origin": [0, -3, 2.2], "target": [0, 0, 0.2], "up": [0, 0, 1], "fov": 50},
    "film": {"width": 24, "height": 24},
    "integrator": {"type": "path", "max_depth": 5},
    "shapes": {
        "floor": {"type": "rectangle", "transform": [{"scale": 2}]},
        "wall": {
            "type": "rectangle",
            "transform": [{"scale": 2}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 1, 1]}],
        },
        "ball": {"type": "sphere", "radius": 0.3, "center": [-0.5, 0, 0.25]},
        "block": {"type": "cube", "transform": [{"scale": [0.2, 0.2, 0.3]}, {"translate": [0.5, 0, 0.2]}]},
    },
    "lights": {"bulb": {"type": "point", "position": [0.3, -1, 1.7], "intensity": [5, 4, 3]}},
}
LENS = {**SCENE["camera"], "type": "thinlens", "aperture_radius": 0.05, "focus_distance": 3.5}
WANTED = ["shapes.ball.to_world", "shapes.block.to_world"]
CASES: dict[str, tuple[dict[str, Any], list[str]]] = {
    "shapes": (SCENE, WANTED),
    "camera": (SCENE, ["camera.to_world", "camera.fov"]),
    "all": (SCENE, [*WANTED, "camera.to_world", "lights.bulb.position"]),
    "lens": ({**SCENE, "camera": LENS}, [*WANTED, "camera.to_world", "camera.aperture_radius"]),
}


def receivers(prefix: Prefix, bodies: Bodies) -> Tensor:
    """Return where receivers are in the interior's frame ``(3, M)``, differentiable in ``bodies``."""
    first, *others = prefix.vertices
    o, d = bodies.camera.rays(prefix.place[0], prefix.place[1], prefix.lens)
    x, before = o + d * (dot(first.n, bodies.points(first.held) - o) / dot(first.n, d)), first.p
    for vertex in others:
        away = vertex.p - before
        at = bodies.points(vertex.held)
        slid = x + away * (dot(vertex.n, at - x) / dot(vertex.n, away))
        share = prefix.frame.share(vertex.held.prim, dot(away, away).sqrt())
        x, before = at + (slid - at) * share, vertex.p
    return x


def sum_of_segments(samples: SegmentSamples, bodies: Bodies) -> Tensor:
    p = bodies.points(samples.edge)
    e = dot(samples.m, p if samples.crossing is None else samples.crossing.moved(bodies, p))
    ends = [dot(samples.m, bodies.points(side.held)) for side in samples.sides]
    value = torch.zeros((), dtype=torch.float64)
    for prefix, light in samples.prefixes:
        lane = prefix.lane
        x = dot(take(samples.m, lane), receivers(prefix, bodies))
        c = take(e, lane) - x
        for side, end, arrives in zip(samples.sides, ends, light, strict=True):
            d = (take(end, lane) - x) * take(samples.r / side.r, lane)
            value = value - side.sign * ((c - (1.0 - take(side.share, lane)) * d) * arrives).sum()
    return value


def sum_of_shadows(cast: Cast, bodies: Bodies) -> Tensor:
    e, w = take(bodies.lights, cast.source.clamp_min(0)), cast.beam.view.w  # the only light is a bulb
    p, held = bodies.points(cast.edge), bodies.points(cast.receiver)
    toward = e - p * w
    x = p - toward * (dot(cast.normal, p - held) / dot(cast.normal, toward))
    value = torch.zeros((), dtype=torch.float64)
    for prefix, weight in cast.prefixes:
        value = value + ((take(x, prefix.lane) - receivers(prefix, bodies)) * weight).sum()
    return value


def boundary(described: dict[str, Any], wanted: list[str]) -> Boundary:
    scene = torchpt.load(described, "cpu")
    params = {name: scene.params[name] for name in wanted}
    cotangent = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found = boundary_of(scene, settings(scene.description, {}), params, wanted, torch.float32, cotangent)
    assert found is not None
    return found


def slopes(still: Bodies, names: list[str], value: Any) -> list[Tensor]:
    """Return the derivatives of a function of bodies by tensors of theirs."""
    tensors = still.tensors()
    own = {name: tensors[name].clone().requires_grad_() for name in names}
    return list(
        torch.autograd.grad(value(still.having({**tensors, **own})), list(own.values()), materialize_grads=True)
    )


@pytest.mark.parametrize("name", CASES)
def test_sums_of_cotangents_are_those_of_autograd(name: str) -> None:
    every = boundary(*CASES[name])
    compared = 0
    for estimator in every._estimators(holds_first=False):
        samples = estimator.samples(Round(0, 1500), 0, 1500)
        if isinstance(estimator, Segments):
            assert isinstance(samples, SegmentSamples)
            expected = slopes(every.still, list(every.moving), lambda bodies, s=samples: sum_of_segments(s, bodies))
        else:
            assert isinstance(estimator, Shadows) and isinstance(samples, Cast)
            expected = slopes(every.still, list(every.moving), lambda bodies, s=samples: sum_of_shadows(s, bodies))
        found = slopes(every.still, list(every.moving), samples.sum)
        moves = every.still.p0.shape[1]
        for tensor, got, wanted in zip(every.moving, found, expected, strict=True):
            if wanted.shape[-1:] == (moves,):  # primitives that do not move are left out
                wanted = wanted * estimator.frame.moves[:moves]
            if tensor == "e3":
                continue  # no quadrics
            torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-10 * float(wanted.abs().max()))
            compared += int((wanted != 0).any())
    assert compared


def test_cotangents_of_what_does_not_move_are_dropped() -> None:
    every = boundary(*CASES["shapes"])
    frame = next(iter(every._estimators(holds_first=False))).frame
    prim = (~frame.moves).nonzero().squeeze(1)
    held = Held(prim, torch.zeros(3, len(prim), dtype=torch.float64))
    cotangents = Cotangents(frame.moves)
    cotangents.add_points(held, torch.ones_like(held.a))
    assert float(cotangents.sum(every.still)) == 0.0
