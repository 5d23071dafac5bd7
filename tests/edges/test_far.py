"""Edges do not depend on where a scene is, how large its surfaces are where no light is, or how far the camera is."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.gradients.edges.bodies import bodies_of
from torchpt.gradients.edges.cuts import cuts_of
from torchpt.gradients.edges.segments import SegmentRays, Segments
from torchpt.gradients.edges.vertices import Spot
from torchpt.scene.formats.description import settings

#: Loss by columns: shadows that move along them count.
WEIGHT = torch.linspace(-10.0, 10.0, 24, dtype=torch.float64)[None, :, None]
TURN = {"rotate": {"axis": [0.3, 0.8, -0.5], "angle": 57}}


Where = tuple[dict[str, Any], Tensor]


def block_by_a_wall(
    *steps: dict[str, Any], floor: float = 3.0, light: str = "spot", clamp: float | None = None
) -> Where:
    """Describe a block on a floor, and return the direction of its x axis; ``steps``: transforms of the whole scene."""
    at = torch.eye(4, dtype=torch.float64)
    for step in steps:
        own = torch.eye(4, dtype=torch.float64)
        if "translate" in step:
            own[:3, 3] = torch.tensor(step["translate"], dtype=torch.float64)
        else:
            own[:3, :3] = _turn(step["rotate"]["axis"], step["rotate"]["angle"])
        at = own @ at

    def point(x: float, y: float, z: float) -> list[float]:
        return (at @ torch.tensor([x, y, z, 1.0], dtype=torch.float64))[:3].tolist()

    camera = {"origin": point(0, -3, 2.2), "target": point(0, 0, 0.2), "up": at[:3, 2].tolist(), "fov": 40}
    spot = {"position": point(0.8, -1, 1.6), "target": point(0.5, 1, 1.2), "cutoff_angle": 16, "intensity": [20] * 3}
    lamp = {"position": point(0.8, -1, 2.0), "intensity": [3] * 3}
    lights = {"it": {"type": "spot", **spot} if light == "spot" else {"type": "point", **lamp}}
    integrator = {"type": "path", "max_depth": 3 if light == "spot" else 2}
    described = {
        "camera": camera,
        "film": {"width": 24, "height": 24},
        "integrator": integrator if clamp is None else {**integrator, "clamp": clamp},
        "materials": {
            "white": {"type": "diffuse", "reflectance": 0.7},
            "dark": {"type": "diffuse", "reflectance": 0.1},
        },
        "shapes": {
            "floor": {"type": "rectangle", "material": "dark", "transform": [{"scale": floor}, *steps]},
            "wall": {
                "type": "rectangle",
                "material": "white",
                "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 1, 1]}, *steps],
            },
            "block": {
                "type": "cube",
                "material": "dark",
                "transform": [
                    {"scale": [0.3, 0.2, 0.25]},
                    {"rotate": {"axis": [0, 0, 1], "angle": 25}},
                    {"translate": [0.1, 0.1, 0.25]},
                    *steps,
                ],
            },
        },
        "lights": lights,
    }
    return described, at[:3, 0]


def _turn(axis: list[float], angle: float) -> Tensor:
    a = torch.tensor(axis, dtype=torch.float64)
    x, y, z = (a / a.norm()).tolist()
    across = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(across * torch.deg2rad(torch.tensor(angle, dtype=torch.float64)))


def slope(where: Where, spp: int = 4, edge_spp: int = 96) -> float:
    """Return the derivative of the loss as the block moves along its x axis."""
    described, axis = where
    name = "shapes.block.to_world"
    found = torchpt.gradient(
        torchpt.load(described, "cpu"),
        lambda p: (p.double() * WEIGHT).mean(),
        [name],
        spp=spp,
        edge_spp=edge_spp,
        seed=3,
    )
    return float((found.gradients[name][:3, 3].double() * axis).sum())


@cache
def here() -> float:
    """Return the derivative where the scene is at the origin."""
    return slope(block_by_a_wall())


AWAY: dict[str, dict[str, Any]] = {
    "moved": {"steps": [{"translate": [20.3, 20.7, 0.1]}]},
    "turned and moved": {"steps": [TURN, {"translate": [20, -30, 10]}]},
    "on a large floor": {"floor": 3e4},
    "on a large floor that is turned": {"floor": 1e3, "steps": [TURN]},
}


@pytest.mark.parametrize("case", AWAY)
def test_light_that_surfaces_reflect_does_not_depend_on_where_the_scene_is(case: str) -> None:
    wish = dict(AWAY[case])
    there = slope(block_by_a_wall(*wish.pop("steps", ()), **wish))
    assert there == pytest.approx(here(), rel=0.12)


def test_shadows_of_a_lamp_do_not_depend_on_where_the_scene_is() -> None:
    """Where coordinates are large, rays past edges do not begin at the lamp."""
    there = slope(block_by_a_wall(TURN, {"translate": [10, -20, 8]}, light="point"), edge_spp=32)
    assert there == pytest.approx(slope(block_by_a_wall(light="point"), edge_spp=32), rel=0.02)


@pytest.mark.parametrize("steps", [(), ({"translate": [20.3, 20.7, 0.1]},), (TURN, {"translate": [20.3, -30, 10.1]})])
@pytest.mark.parametrize("sunk", [0.0, 0.01])
def test_a_body_that_stands_on_a_floor_does_not_cut_it(steps: tuple[dict[str, Any], ...], sunk: float) -> None:
    scene = torchpt.load(block_by_a_wall({"translate": [0, 0, -sunk]}, *steps)[0], "cpu")
    floor = torchpt.load(block_by_a_wall(*steps)[0], "cpu").params["shapes.floor.to_world"]
    poses = scene.merged({"shapes.floor.to_world": floor})
    found = cuts_of(scene, bodies_of(scene, settings(scene.description, {}).film, poses), poses)
    length = 0.0 if found is None else float(found[1].sum()) * scene.space.unit
    around_the_block, along_the_wall = 4 * (0.3 + 0.2), 2.0
    assert length == pytest.approx(around_the_block + along_the_wall if sunk else 0.0, rel=1e-3)


def test_the_clamp_does_not_cut_light_behind_edges() -> None:
    """It is of samples of pixels, of which the darkness of the floor makes small ones."""
    free, bound = block_by_a_wall(), block_by_a_wall(clamp=0.25)
    for described, _ in (free, bound):  # the wall, of which light comes, is seen from behind
        described["camera"] |= {"origin": [0, 1.5, 4], "target": [0, -0.2, 0]}
    shown, clamped = (torchpt.render(torchpt.load(described, "cpu"), spp=64) for described, _ in (free, bound))
    assert torch.equal(clamped, shown)  # no sample is clamped
    assert slope(bound, edge_spp=16) == slope(free, edge_spp=16)


def test_what_a_sheet_hides_from_a_camera_far_away_does_not_count() -> None:
    high = {"origin": [0, 0, 500_000], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 0.00024}
    found = []
    for hidden in (False, True):
        described, axis = block_by_a_wall()
        described["camera"] = high
        if hidden:
            described["shapes"]["sheet"] = {
                "type": "rectangle",
                "transform": [{"scale": 5}, {"translate": [0, 0, 2.5]}],
            }
        found.append(slope((described, axis)))
    assert abs(found[1]) < 0.01 * abs(found[0])  # none of what is left is light that the floor reflects


CORNERS = [[0, 0, 1], [0.9, 0, -0.4], [-0.4, 0.8, -0.4], [-0.5, -0.7, -0.3]]
FACES = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]


def test_rays_toward_smooth_faces_count_once_where_faces_lie_on_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    sums = list[tuple[float, int]]()
    receivers = Segments._receivers

    def recorded(self: Segments, rays: SegmentRays, key: Tensor) -> tuple[SegmentRays, Spot, Tensor]:
        kept, spot, lane = receivers(self, rays, key)
        assert self.sampler.smooth is not None
        shaded = torch.isin(spot.hit.prim, self.sampler.smooth.prim)
        sums.append((float((kept.weight / kept.density)[shaded].sum()), key.shape[1]))
        return kept, spot, lane

    monkeypatch.setattr(Segments, "_receivers", recorded)
    found = []
    for faces in (FACES, FACES + FACES):
        described, axis = block_by_a_wall()
        described["shapes"]["ball"] = {
            "type": "mesh",
            "vertices": CORNERS,
            "normals": CORNERS,
            "faces": faces,
            "transform": [{"scale": 0.3}, {"translate": [-0.6, 0, 0.5]}],
        }
        sums.clear()
        slope((described, axis), spp=1, edge_spp=32)
        found.append(sum(total for total, _ in sums) / sum(count for _, count in sums))
    assert found[1] == pytest.approx(found[0], rel=0.05)
