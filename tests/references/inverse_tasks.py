"""Seventeen inverse problems with fixed starting points: recover parameters of a scene from one picture, or from several views.

Each has a scene, the numbers that Adam optimises, and functions from these to parameters and to their error. Targets are
rendered from the true numbers with another seed and many samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import known_gradients as known
import torch
import trimesh
from torch import Tensor

from torchpt.nn import LargeSteps, look_at_pose
from torchpt.scene import Scene

__all__ = ["SIZE", "TASKS", "Task", "described"]

SIZE = 32


@dataclass(frozen=True)
class Task:
    """An inverse problem.

    Attributes:
        scene: function that returns a description; ``$FILES`` in a path is the folder of :attr:`files`.
        start: returns the numbers that Adam starts from, given the true scene.
        true: returns the true numbers, given the true scene.
        params: returns parameters of ``torchpt.render``, given the scene and the numbers.
        rate: Adam's initial learning rate; it falls to a hundredth along a cosine.
        steps: number of steps.
        spp: samples a pixel of each picture and each gradient.
        depth: largest path depth.
        bar: factor by which the error must shrink.
        weight: weights of the errors; None: equal weights.
        bounds: range to which the numbers are clamped after each step.
        files: pictures ``(H, W, 3)`` by file name.
        views: where the camera stands, ``(V, 3)``, looking at the origin; None: the scene's own camera alone.
        off: returns the errors of the numbers, given the true scene; None: by how much they differ from the true ones.
    """

    scene: Mapping[str, Any]
    start: Callable[[Scene], Tensor]
    true: Callable[[Scene], Tensor]
    params: Callable[[Scene, Tensor], dict[str, Tensor]]
    rate: float
    steps: int = 150
    spp: int = 16
    depth: int = 3
    bar: float = 10.0
    weight: Callable[[Tensor], Tensor] | None = None
    bounds: tuple[float, float] = (-math.inf, math.inf)
    files: Mapping[str, Callable[[], Tensor]] = field(default_factory=dict)
    views: Sequence[Sequence[float]] | None = None
    off: Callable[[Scene, Tensor], Tensor] | None = None

    def seen(self) -> list[dict[str, Tensor]]:
        """Return the parameters of the views."""
        if self.views is None:
            return [{}]
        places = torch.tensor(self.views)
        return [{"camera.to_world": pose} for pose in look_at_pose(places, torch.zeros(3))]

    def error(self, scene: Scene, numbers: Tensor) -> float:
        """Return the root mean square of the errors of the numbers."""
        numbers = numbers.detach()
        off = (numbers - self.true(scene) if self.off is None else self.off(scene, numbers)).double() ** 2
        if self.weight is None:
            return float(off.mean().sqrt())
        weight = self.weight(off).expand_as(off)
        return float(((off * weight).sum() / weight.sum()).sqrt())


def described(task: Task) -> Scene:
    """Return the true scene of a task."""
    return known.opened(task.scene, task.files, SIZE, task.depth)


def plain(name: str, start: float, rate: float, **more: Any) -> dict[str, Any]:
    """Return fields of a task: a parameter is optimised directly, from one start value for all entries."""
    return {
        "start": lambda scene: torch.full_like(scene.params[name], start),
        "true": lambda scene: scene.params[name].clone(),
        "params": lambda scene, numbers: {name: numbers},
        "rate": rate,
        **more,
    }


def shifted(name: str, axes: tuple[int, ...], start: tuple[float, ...], rate: float, **more: Any) -> dict[str, Any]:
    """Return fields of a task: the position of a pose is optimised along some axes, from a given offset."""

    def params(scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
        base = scene.params[name]
        where = torch.zeros(4, 4, len(axes))
        for k, axis in enumerate(axes):
            where[axis, 3, k] = 1.0
        return {name: base + where @ numbers}

    return {
        "start": lambda scene: torch.tensor(start),
        "true": lambda scene: torch.zeros(len(axes)),
        "params": params,
        "rate": rate,
        **more,
    }


def _albedos(scene: Scene) -> Tensor:
    return torch.stack([scene.params[f"materials.{name}.reflectance"] for name in ("white", "red", "green")])


def _as_albedos(scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
    return {f"materials.{name}.reflectance": numbers[k] for k, name in enumerate(("white", "red", "green"))}


def _twisted(scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
    """Return the parameter of a camera moved by three lengths and rotated by three angles, about its own axes."""
    x, y, z, a, b, c = numbers
    o = torch.zeros_like(x)
    rows = [torch.stack(row) for row in ((o, -c, b, x), (c, o, -a, y), (-b, a, o, z), (o, o, o, o))]
    return {"camera.to_world": scene.params["camera.to_world"] @ torch.matrix_exp(torch.stack(rows))}


def _turned(scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
    """Return the parameter of a camera rotated by three angles about its own axes."""
    return _twisted(scene, torch.cat((torch.zeros(3), numbers)))


def _ball(scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
    """Return the parameter of a ball moved in the image plane, with its radius multiplied by an exponential."""
    base = scene.params["shapes.ball.to_world"]
    x, y, grown = numbers
    o = torch.zeros_like(x)
    size = base[0, 0] * torch.exp(grown)
    middle = base[:3, 3] + torch.stack((x, y, o))
    rows = [torch.stack(row) for row in ((size, o, o), (o, size, o), (o, o, size))]
    return {"shapes.ball.to_world": torch.cat((torch.cat((torch.stack(rows), middle[:, None]), 1), base[3:]))}


def _solid_angle(texels: Tensor) -> Tensor:
    rows = texels.shape[0]
    return torch.sin(torch.arange(rows) * (math.pi / (rows - 1)))[:, None, None].to(texels).clamp_min(0.05)


PICTURE = known.quad([-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], uvs=[[0, 1], [1, 1], [1, 0], [0, 0]])
PICTURE |= {"material": {"type": "diffuse", "reflectance": {"type": "image", "path": "$FILES/paint.exr"}}}
HUNG = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 29},
    "shapes": {
        "picture": PICTURE,
        "lamp": {
            "type": "rectangle", "emission": [12, 12, 12],
            "transform": [{"scale": 0.5}, {"rotate": {"axis": [0, 1, 0], "angle": 180}}, {"translate": [1.5, 1.5, 3]}],
        },
    },
}  # fmt: skip
#: A lamp above a plate with a hole: only the edges of the light spot on the floor depend on the lamp's position.
PLATE = {
    f"plate_{name}": known.quad(*([x, 1.2, z] for x, z in corners), material=known.WHITE)
    for name, corners in {
        "left": ((-4, 4), (-0.3, 4), (-0.3, -4), (-4, -4)),
        "right": ((0.3, 4), (4, 4), (4, -4), (0.3, -4)),
        "near": ((-0.3, 4), (0.3, 4), (0.3, 0.3), (-0.3, 0.3)),
        "far": ((-0.3, -0.3), (0.3, -0.3), (0.3, -4), (-0.3, -4)),
    }.items()
}
HIDDEN = {"type": "rectangle", "emission": [90, 85, 80]}
HIDDEN |= {"transform": [{"scale": 0.2}, known.DOWN, known.moved(0.2, 3, 0.1)]}
UNDER_PLATE = {
    "camera": {"origin": [0, 1, 3.2], "target": [0, 0.1, 0], "fov": 48},
    "shapes": {"floor": known.FLOOR, "lamp": HIDDEN, **PLATE},
}
#: A room that fills the view, with a lamp almost as wide as the ceiling, so that nothing in view is overexposed.
BRIGHT = {
    "type": "rectangle",
    "emission": [2, 1.9, 1.7],
    "transform": [{"scale": 0.8}, known.DOWN, known.moved(0, 0.93, 0)],
}
EVEN_ROOM = {
    **known.with_shapes(known.ROOM, lamp=BRIGHT),
    "camera": {**known.ROOM["camera"], "origin": [0.1, 0.1, 2.6]},
}
MIRROR = {**known.BRUSHED, "alpha": 0.08}
BLACK_BALL = {
    **known.ALONE,
    "shapes": {"ball": {**known.BUST, "radius": 0.5, "material": known.diffuse(0, 0, 0)}},
    "lights": {"sky": {"type": "constant"}},
}
CHECKED = known.quad([-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2], uvs=[[0, 0], [2, 0], [2, 2], [0, 2]])
CHECKED |= {"material": PICTURE["material"]}
GLOSSY = known.with_shapes(known.TABLE, floor={**known.FLOOR, "material": known.BRUSHED})
ON_PICTURE = known.with_shapes(known.TABLE, floor=CHECKED, ball=known.BALL)

#: A block over the view whose shadow alone is seen.
OVER_VIEW = {
    "camera": {"origin": [0.3, 1.1, 2.2], "target": [0.1, 0, 0.1], "fov": 50},
    "shapes": {
        "floor": known.FLOOR,
        "lamp": {**HIDDEN, "transform": [{"scale": 0.2}, known.DOWN, known.moved(0.2, 5, 0.1)]},
        "block": {
            "type": "cube",
            "material": known.WHITE,
            "transform": [{"scale": 0.25}, known.turned([0, 1, 0], 20), known.moved(0.15, 1.9, 0.1)],
        },
    },
}
#: A corridor with a corner: the lamp stands behind it, and lights what is seen by reflection alone.
ROUND_CORNER = {
    "camera": {"origin": [-0.9, 1.0, 3.4], "target": [-0.9, 0.7, 0], "fov": 50},
    "shapes": {
        "floor": known.FLOOR,
        "left": known.quad([-2, 0, 4], [-2, 0, -2], [-2, 2, -2], [-2, 2, 4], material=known.WHITE),
        "back": known.quad([-2, 0, -2], [3, 0, -2], [3, 2, -2], [-2, 2, -2], material=known.WHITE),
        "right": known.quad([0, 0, 4], [0, 2, 4], [0, 2, 0], [0, 0, 0], material=known.WHITE),
        "corner": known.quad([0, 0, 0], [0, 2, 0], [3, 2, 0], [3, 0, 0], material=known.WHITE),
        "lamp": {
            "type": "rectangle", "emission": [30, 28, 25],
            "transform": [{"scale": 0.3}, known.DOWN, known.moved(1.2, 1.9, -1.0)],
        },
    },
}  # fmt: skip
SMOOTH_MIRROR = {"type": "conductor", "eta": [0.3, 0.6, 1.2], "k": [3, 2.5, 2]}
SUNS = {
    "east": {"type": "directional", "direction": [0.8, -1, 0.2], "irradiance": [3, 2.5, 2]},
    "south": {"type": "directional", "direction": [-0.3, -1, -0.9], "irradiance": [1.5, 2, 2.5]},
}
CAN = {"type": "cylinder", "radius": 0.45, "height": 1.1, "center": [0.1, 0.55, 0], "material": known.BLUE}
SIX_SIDES = ((2.6, 0.6, 0.5), (-2.6, 0.5, 0.4), (0.4, 0.6, 2.6), (-0.3, 0.5, -2.6), (0.3, 2.6, 0.4), (0.4, -2.6, -0.3))


def _heights(scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
    x, _, z = scene.params["shapes.field.vertices"].unbind(1)
    return {"shapes.field.vertices": torch.stack((x, numbers, z), 1)}


def _true_heights(scene: Scene) -> Tensor:
    x, _, z = scene.params["shapes.field.vertices"].unbind(1)
    return 0.25 * (2.5 * x + 0.4).cos() * (2.0 * z).cos() + 0.1 * (3 * z - x).sin()


def _can(_: Scene, numbers: Tensor) -> dict[str, Tensor]:
    """Return the parameters of a cylinder that rests on the floor."""
    radius, height = numbers
    center = torch.stack((torch.full_like(height, 0.1), 0.5 * height, torch.zeros_like(height)))
    return {"shapes.can.radius": radius, "shapes.can.height": height, "shapes.can.center": center}


def _sphere(levels: int) -> dict[str, Any]:
    """Return the mesh of a sphere of radius 0.6: an icosahedron, each of whose faces is divided in four ``levels`` times."""
    ball = trimesh.creation.icosphere(levels)
    return {"type": "mesh", "vertices": (0.6 * ball.vertices).tolist(), "faces": ball.faces.tolist()}


def _waved(d: Tensor) -> Tensor:
    """Return distances ``(V,)`` of a figure's surface from the origin along unit directions ``(V, 3)``."""
    return 0.6 * (1 + 0.12 * (3 * d[:, 0] + 0.5).sin() + 0.1 * (2.5 * d[:, 1]).cos() * d[:, 2])


def _bumpy(d: Tensor) -> Tensor:
    return 0.6 * (1 + 0.08 * (5 * d[:, 0]).sin() * (4 * d[:, 1] + 1).cos() + 0.06 * (4 * d[:, 2]).sin())


def _directions(vertices: Tensor) -> Tensor:
    return vertices / vertices.norm(dim=1, keepdim=True)


class _Figure:
    """The vertices of a ball as unknowns, in steps of :class:`torchpt.nn.LargeSteps`, and where a figure's surface is.

    Args:
        surface: distances from the origin by direction.
        smoothness: of the steps.
    """

    def __init__(self, surface: Callable[[Tensor], Tensor], smoothness: float) -> None:
        self.surface, self._smoothness = surface, smoothness
        self._steps: LargeSteps | None = None

    def steps(self, scene: Scene) -> LargeSteps:
        if self._steps is None:
            self._steps = LargeSteps(scene.faces("shapes.ball"), self._smoothness)
        return self._steps

    def start(self, scene: Scene) -> Tensor:
        return self.steps(scene).inverse(scene.params["shapes.ball.vertices"])

    def true(self, scene: Scene) -> Tensor:
        d = _directions(scene.params["shapes.ball.vertices"])
        return self.steps(scene).inverse(d * self.surface(d)[:, None])

    def vertices(self, scene: Scene, numbers: Tensor) -> Tensor:
        return self.steps(scene)(numbers)

    def params(self, scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
        return {"shapes.ball.vertices": self.vertices(scene, numbers)}

    def off(self, scene: Scene, numbers: Tensor) -> Tensor:
        """Return how far vertices are from the surface, along their directions."""
        vertices = self.vertices(scene, numbers)
        return vertices.norm(dim=1) - self.surface(_directions(vertices))


class _PaintedFigure(_Figure):
    """The same with the texels of a texture as further unknowns, behind the vertices."""

    #: Errors of both are divided by these, so that they weigh about the same.
    SCALES = 0.03, 0.2

    def start(self, scene: Scene) -> Tensor:
        return torch.cat((super().start(scene).flatten(), torch.full((8 * 16 * 3,), 0.5)))

    def true(self, scene: Scene) -> Tensor:
        return torch.cat((super().true(scene).flatten(), _paint(8, 16).flatten()))

    def params(self, scene: Scene, numbers: Tensor) -> dict[str, Tensor]:
        count = scene.params["shapes.ball.vertices"].numel()
        texels = numbers[count:].reshape(8, 16, 3)
        return {
            **super().params(scene, numbers[:count].reshape(-1, 3)),
            "materials.paint.reflectance": texels.clamp(0, 1),
        }

    def off(self, scene: Scene, numbers: Tensor) -> Tensor:
        count = scene.params["shapes.ball.vertices"].numel()
        shape = super().off(scene, numbers[:count].reshape(-1, 3)) / self.SCALES[0]
        texels = (numbers[count:].reshape(8, 16, 3) - _paint(8, 16)) / self.SCALES[1]
        latitude = math.pi * ((torch.arange(8) + 0.5) / 8 - 0.5)
        texels = (texels * latitude.cos()[:, None, None].sqrt()).flatten()  # by area: few pixels show the poles
        return torch.cat((shape / len(shape) ** 0.5, texels / len(texels) ** 0.5))


def _paint(rows: int, columns: int) -> Tensor:
    """Return smooth texels ``(rows, columns, 3)`` that join at their sides."""
    v, u = torch.meshgrid(torch.arange(rows) / rows, 2 * math.pi * torch.arange(columns) / columns, indexing="ij")
    return 0.5 + 0.3 * torch.stack(((2 * u).sin(), (u + 4 * v).cos(), (5 * v).sin() * u.cos()), -1)


def _around(mesh: dict[str, Any]) -> dict[str, Any]:
    """Return a mesh about the origin with texture coordinates by longitude and latitude."""
    d = _directions(torch.tensor(mesh["vertices"]))
    u, v = torch.atan2(d[:, 0], d[:, 2]) / (2 * math.pi) + 0.5, 0.5 + torch.asin(d[:, 1].clamp(-1, 1)) / math.pi
    return {**mesh, "uvs": torch.stack((u, v), 1).tolist()}


WAVED, BUMPY = _Figure(_waved, 4.0), _PaintedFigure(_bumpy, 4.0)

TASKS: dict[str, Task] = {
    "albedo": Task(known.ROOM, lambda scene: torch.full((3, 3), 0.4), _albedos, _as_albedos, 0.03, depth=4, bounds=(0, 1)),
    "texture": Task(
        HUNG, **plain("shapes.picture.material.reflectance", 0.5, 0.04), bounds=(0, 1), files={"paint.exr": known.painted},
    ),
    "roughness": Task(GLOSSY, **plain("shapes.floor.material.alpha", 0.7, 0.03, depth=2), bounds=(0.02, 1)),
    "map": Task(
        {**known.UNDER_SKY, "shapes": {"ball": {**known.BUST, "material": MIRROR}}},
        **plain("lights.sky.texels", 0.6, 0.05, steps=250, bar=5.0, weight=_solid_angle),
        bounds=(0, math.inf), files={"sky.exr": known.sky},
    ),
    "free_light": Task(known.FREE, **shifted("shapes.lamp.to_world", (0, 1, 2), (-1.2, 0.6, -1), 0.06, depth=2)),
    "hidden_light": Task(
        UNDER_PLATE, **shifted("shapes.lamp.to_world", (0, 2), (0.9, -0.6), 0.05, depth=2),
    ),
    "camera": Task(
        EVEN_ROOM, lambda scene: torch.tensor([0.15, -0.12, 0.2, 0.04, 0.05, -0.06]), lambda scene: torch.zeros(6),
        _twisted, 0.03, steps=400,
    ),
    "black_ball": Task(
        BLACK_BALL, lambda scene: torch.tensor([0.45, -0.35, 0.4]), lambda scene: torch.zeros(3), _ball, 0.03,
        depth=2,
    ),
    "lit_ball": Task(
        ON_PICTURE, **shifted("shapes.ball.to_world", (0, 1, 2), (0.5, 0.25, 0.4), 0.03),
        files={"paint.exr": known.painted},
    ),
    "shadow": Task(OVER_VIEW, **shifted("shapes.block.to_world", (0, 2), (0.35, -0.3), 0.03, depth=2)),
    "round_corner": Task(
        ROUND_CORNER, **shifted("shapes.lamp.to_world", (0, 2), (-0.5, 0.3), 0.03, depth=4),
    ),
    "mirror_ball": Task(
        {**known.UNDER_SKY, "shapes": {"ball": {**known.BUST, "material": SMOOTH_MIRROR}}},
        **plain("lights.sky.texels", 0.6, 0.05, steps=250, bar=5.0, weight=_solid_angle),
        bounds=(0, math.inf), files={"sky.exr": known.sky},
    ),
    "heights": Task(
        {**known.ABOVE, "shapes": {"field": known.grid(6, lambda x, z: 0 * x, face_normals=True)}, "lights": SUNS},
        lambda scene: torch.zeros(36), _true_heights, _heights, 0.03,
    ),
    "can": Task(
        known.with_shapes(known.CORNER, can=CAN), lambda scene: torch.tensor([0.3, 0.7]),
        lambda scene: torch.tensor([0.45, 1.1]), _can, 0.02, depth=4,
    ),
    "figure": Task(
        {"camera": known.ALONE["camera"], "shapes": {"ball": _sphere(3)}, "lights": {**SUNS, **known.OPEN_SKY}},
        WAVED.start, WAVED.true, WAVED.params, 0.03, steps=60, spp=8, bar=5.0, views=SIX_SIDES, off=WAVED.off,
    ),
    "painted_figure": Task(
        {
            "camera": known.ALONE["camera"],
            "materials": {"paint": {"type": "diffuse", "reflectance": torch.full((8, 16, 3), 0.5)}},
            "shapes": {"ball": {**_around(_sphere(3)), "material": "paint"}},
            "lights": {**SUNS, **known.OPEN_SKY},
        },
        BUMPY.start, BUMPY.true, BUMPY.params, 0.03, steps=60, spp=8, bar=3.0, views=SIX_SIDES, off=BUMPY.off,
    ),
    "turned_camera": Task(  # by five degrees
        {"camera": known.TABLE["camera"], "shapes": {"floor": CHECKED, "lamp": known.OVERHEAD}},
        lambda scene: torch.tensor([0.05, 0.06, 0.04]), lambda scene: torch.zeros(3), _turned, 0.01,
        files={"paint.exr": known.painted},
    ),
}  # fmt: skip
