"""Nine inverse problems with fixed starting points: recover parameters of a scene from one picture.

Each has a scene, the numbers that Adam optimises, and functions from these to parameters and to their error. Targets are
rendered from the true numbers with another seed and many samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import known_gradients as known
import torch
from torch import Tensor

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

    def error(self, scene: Scene, numbers: Tensor) -> float:
        """Return the root mean square of the errors of the numbers."""
        off = (numbers.detach() - self.true(scene)).double() ** 2
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
}  # fmt: skip
