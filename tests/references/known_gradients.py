"""Scenes with one moving parameter each, whose derivative is known, to test gradients against.

The loss is linear in the picture (a fixed smooth weight times each value), so the mean of a gradient does not depend on
the forward pass. The derivative is taken along one direction in the parameter's space. The true values in
``known_gradients.json`` are central differences of many samples with common random numbers, computed by ``python
scripts/gradient_pairs.py --truths``.

Lengths are about 1, lamps cast soft shadows unless a comment says otherwise, and paths are as short as the pair allows: at
depth 2 only edges seen by the camera and edges of direct shadows move; pairs named ``..._indirect`` also have edges of
indirect shadows.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchpt
from torchpt.scene import Scene

__all__ = ["PAIRS", "SIZE", "Pair", "loaded", "loss_of", "weights"]

#: Width and height of the pictures.
SIZE = 24


@dataclass(frozen=True)
class Pair:
    """A scene and a direction in the space of one parameter.

    Attributes:
        scene: function that returns a description; ``$FILES`` in a path is the folder of :attr:`files`.
        parameter: name of the parameter in ``scene.params``.
        direction: direction of the parameter's shape, as ``{index: value}`` or as a function of the parameter.
        step: step of the finer difference; the coarser step is twice as wide.
        spp: samples a pixel of one gradient.
        depth: largest path depth.
        files: pictures ``(H, W, 3)`` by file name.
        turns: True if the direction rotates a pose, which then stays rigid.
    """

    scene: Mapping[str, Any]
    parameter: str
    direction: Mapping[tuple[int, ...], float] | Callable[[Tensor], Tensor]
    step: float
    spp: int = 64
    depth: int = 2
    files: Mapping[str, Callable[[], Tensor]] = field(default_factory=dict)
    turns: bool = False

    def along(self, base: Tensor) -> Tensor:
        """Return the direction as a tensor of the shape of ``base``."""
        if callable(self.direction):
            return self.direction(base)
        direction = torch.zeros_like(base)
        for index, value in self.direction.items():
            direction[index] = value
        return direction

    def at(self, base: Tensor, step: float) -> Tensor:
        """Return the parameter ``step`` away from ``base``."""
        if not self.turns:
            return base + step * self.along(base)
        return (torch.matrix_exp(step * self.along(base).double() @ base.double().inverse()) @ base.double()).to(base)


def loaded(pair: Pair) -> Scene:
    """Load the scene of a pair."""
    return opened(pair.scene, pair.files, SIZE, pair.depth)


def opened(scene: Mapping[str, Any], files: Mapping[str, Callable[[], Tensor]], size: int, depth: int) -> Scene:
    """Load a scene after writing its pictures; square film, no Russian roulette."""
    with tempfile.TemporaryDirectory() as folder:
        for name, made in files.items():
            torchpt.write_image(str(Path(folder) / name), made())
        whole = {
            **in_folder(scene, folder),
            "film": {"width": size, "height": size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": depth, "rr_depth": 100},
        }
        return torchpt.load(whole, "cpu")


def in_folder(value: Any, folder: str) -> Any:
    if isinstance(value, Mapping):
        return {key: in_folder(entry, folder) for key, entry in value.items()}
    return value.replace("$FILES", folder) if isinstance(value, str) else value


@cache
def weights() -> Tensor:
    """Return the weights of the loss, ``(SIZE, SIZE, 3)`` float64: smooth, and different at every pixel."""
    at = (torch.arange(SIZE, dtype=torch.float64) + 0.5) / SIZE
    x, y = at[None, :, None], at[:, None, None]
    colour = torch.tensor([1.0, 0.8, 0.6], dtype=torch.float64)
    return (0.2 + 2.0 * x * x + 0.7 * y * y + 0.2 * torch.sin(4.0 * x * y)) * colour / (3 * SIZE * SIZE)


def loss_of(picture: Tensor) -> Tensor:
    """Return the loss of a picture ``(SIZE, SIZE, 3)``, a float64 number."""
    return (picture.double() * weights()).sum()


def quad(*corners: list[float], **more: Any) -> dict[str, Any]:
    """Return a flat mesh of four corners, counterclockwise seen from its front."""
    return {"type": "mesh", "vertices": list(corners), "faces": [[0, 1, 2], [0, 2, 3]], "face_normals": True, **more}


def turned(axis: list[float], angle: float) -> dict[str, Any]:
    return {"rotate": {"axis": axis, "angle": angle}}


def moved(*by: float) -> dict[str, Any]:
    return {"translate": list(by)}


def diffuse(*colour: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": list(colour)}


def without(scene: Mapping[str, Any], *names: str, **more: Any) -> dict[str, Any]:
    """Return a scene without some of its shapes, and with other ones."""
    shapes = {name: shape for name, shape in scene["shapes"].items() if name not in names}
    return {**scene, "shapes": {**shapes, **more}}


def with_shapes(scene: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    return without(scene, **more)


WHITE, RED, GREEN = diffuse(0.7, 0.7, 0.7), diffuse(0.6, 0.1, 0.1), diffuse(0.15, 0.5, 0.1)
DOWN = turned([1, 0, 0], 90)
LAMP = {"type": "rectangle", "emission": [9, 8, 6], "transform": [{"scale": 0.3}, DOWN, moved(0.1, 0.93, -0.2)]}
BLOCK = {
    "type": "cube",
    "material": WHITE,
    "transform": [{"scale": 0.3}, turned([0, 1, 0], 25), moved(0.35, -0.6, 0.1)],
}
ROOM: dict[str, Any] = {
    "camera": {"origin": [0.1, 0.1, 3.4], "target": [0, 0, 0], "fov": 42},
    "materials": {"white": WHITE, "red": RED, "green": GREEN},
    "shapes": {
        "floor": quad([-1, -1, 1], [1, -1, 1], [1, -1, -1], [-1, -1, -1], material="white"),
        "ceiling": quad([-1, 1, -1], [1, 1, -1], [1, 1, 1], [-1, 1, 1], material="white"),
        "back": quad([-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], material="white"),
        "left": quad([-1, -1, 1], [-1, -1, -1], [-1, 1, -1], [-1, 1, 1], material="red"),
        "right": quad([1, -1, -1], [1, -1, 1], [1, 1, 1], [1, 1, -1], material="green"),
        "block": BLOCK,
        "lamp": LAMP,
    },
}
#: A floor under a lamp, wide enough to fill the view; the tested shapes stand on it.
FLOOR = quad([-6, 0, 6], [6, 0, 6], [6, 0, -9], [-6, 0, -9], material=WHITE)
OVERHEAD = {
    "type": "rectangle",
    "emission": [30, 28, 25],
    "transform": [{"scale": 0.4}, DOWN, turned([0, 0, 1], -20), moved(-0.8, 3, 0.4)],
}
TABLE: dict[str, Any] = {
    "camera": {"origin": [0.3, 2.2, 4], "target": [0.1, 0.4, 0], "fov": 42},
    "shapes": {"floor": FLOOR, "lamp": OVERHEAD},
}
ORANGE = diffuse(0.8, 0.5, 0.2)
BLUE = diffuse(0.05, 0.1, 0.3)
BALL = {"type": "sphere", "center": [0.1, 0.65, 0], "radius": 0.5, "material": BLUE}
CANVAS = {"floor": FLOOR}
#: The same without the lamp, for point and directional lights.
DARK = {**TABLE, "shapes": CANVAS}
SCREEN = quad([-0.5, 1.1, 0.4], [0.6, 1.1, 0.3], [0.5, 1.2, -0.5], [-0.4, 1.2, -0.6], material=BLUE)


def fan() -> dict[str, Any]:
    """Return a small bent mesh with smooth normals."""
    count, ring = 6, []
    for k in range(count):
        angle = 2 * math.pi * k / count
        ring.append([0.1 + 0.7 * math.cos(angle), 0.5 + 0.15 * math.sin(2 * angle), -0.5 * math.sin(angle)])
    faces = [[0, 1 + k, 1 + (k + 1) % count] for k in range(count)]
    return {"type": "mesh", "vertices": [[0.1, 0.95, 0.05], *ring], "faces": faces, "material": BLUE}


def halves() -> Tensor:
    """Return two texels, a bright one and a dark one."""
    return torch.tensor([0.8, 0.1])[None, :, None].expand(1, 2, 3).contiguous()


def painted() -> Tensor:
    """Return a picture of 8 x 8 texels."""
    return 0.2 + 0.6 * torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(3))


def sky() -> Tensor:
    """Return an environment map of 8 x 16 texels, brighter above and to one side."""
    rows, columns = torch.arange(8.0)[:, None, None], torch.arange(16.0)[None, :, None]
    level = 0.3 + 1.2 * torch.exp(-0.5 * ((rows - 2) / 1.2) ** 2 - 0.5 * ((columns - 10) / 2.0) ** 2)
    return (level * torch.tensor([1.0, 0.9, 0.7])).float().contiguous()


def noise(base: Tensor) -> Tensor:
    """Return positive random weights, one for each entry."""
    return torch.rand(base.shape, generator=torch.Generator().manual_seed(11)).to(base)


def turn(base: Tensor) -> Tensor:
    """Rotate a pose about the world's y axis by an angle in radians."""
    about = torch.zeros_like(base)
    about[0, 2], about[2, 0] = 1.0, -1.0
    return about @ base


def about_own_y(base: Tensor) -> Tensor:
    """Rotate a pose about its own y axis by an angle in radians."""
    about = torch.zeros_like(base)
    about[0, 2], about[2, 0] = 1.0, -1.0
    return base @ about


def grown(base: Tensor) -> Tensor:
    """Scale a sphere's radius through its pose; the centre stays."""
    direction = torch.zeros_like(base)
    direction[:3, :3] = base[:3, :3] / base[:3, 0].norm()
    return direction


X = {(0, 3): 1.0}
Y = {(1, 3): 1.0}
Z = {(2, 3): 1.0}
PAINTED = {**CANVAS["floor"], "uvs": [[0, 0], [3, 0], [3, 3], [0, 3]]}
PAINTED |= {"material": {"type": "diffuse", "reflectance": {"type": "image", "path": "$FILES/paint.exr"}}}
BRUSHED = {"type": "roughconductor", "eta": [0.3, 0.6, 1.2], "k": [3, 2.5, 2], "alpha": 0.25}
PRINCIPLED = {"type": "principled", "base_color": [0.7, 0.4, 0.2], "roughness": 0.45, "metallic": 0.6, "specular": 0.5}
SKY = {"sky": {"type": "envmap", "path": "$FILES/sky.exr"}}
ALONE: dict[str, Any] = {"camera": {"origin": [0, 0, 4], "target": [0.1, 0.05, 0], "fov": 30}}
BUST = {"type": "sphere", "center": [0.1, 0.1, 0], "radius": 0.7}
UNDER_SKY = {**ALONE, "shapes": {"ball": {**BUST, "material": BRUSHED}}, "lights": SKY}
#: Glass over the whole view, and behind it a wall, lit by a lamp at the side that lights only the wall.
GLASS: dict[str, Any] = {
    "camera": {"origin": [0.6, 0.4, 5], "target": [0.45, 0.3, 0], "fov": 6},
    "materials": {"glass": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}},
    "shapes": {
        "ball": {"type": "sphere", "material": "glass"},
        "wall": {"type": "rectangle", "material": ORANGE, "transform": [{"scale": 50}, moved(0, 0, -3)]},
        "lamp": {
            "type": "rectangle",
            "transform": [{"scale": 0.3}, turned([0, 1, 0], 180), moved(2, 1.4, -2)],
            "emission": [40, 50, 60],
        },
    },
}
SUN = {"sun": {"type": "directional", "direction": [0.3, -1, -0.2], "irradiance": [3, 3, 2.5]}}
SPOT = {
    "spot": {
        "type": "spot", "position": [-1, 3.2, 0.8], "target": [0.1, 0.5, 0],
        "intensity": [25, 24, 20], "cutoff_angle": 35, "beam_width": 28,
    }
}  # fmt: skip
BULB = {"bulb": {"type": "point", "position": [-0.9, 2.6, 0.7], "intensity": [14, 13, 11]}}
STANDING = {"material": BLUE, "transform": [turned([0, 0, 1], 20), moved(0.1, 0.1, 0)]}
BOX = {"type": "cube", "material": BLUE, "transform": [{"scale": 0.35}, turned([0, 1, 0], 30), moved(0.1, 0.45, 0)]}
COPY = {"type": "instance", "of": "block", "material": RED, "transform": [{"scale": 0.3}, turned([0, 1, 0], 10)]}
COPY |= {"transform": [*COPY["transform"], moved(0.6, 0.5, 0.5)]}
SMALL_BOX = {"type": "cube", "material": BLUE, "transform": [{"scale": 0.25}, moved(-0.6, 0.3, -0.3)]}
TILTED = [{"scale": 0.6}, turned([1, 0, 0], -65), moved(0.1, 0.8, 0)]
#: A lamp that is never occluded and never in view.
FREE = {**DARK, "shapes": {"floor": FLOOR, "lamp": {**OVERHEAD, "transform": [{"scale": 0.3}, DOWN, moved(0.8, 3, 1)]}}}

#: A corner of a room, whose walls reflect light: what stands on its floor touches it.
CORNER: dict[str, Any] = {
    "camera": {"origin": [0.8, 1.6, 4.2], "target": [0.0, 0.6, 0], "fov": 40},
    "shapes": {
        "floor": FLOOR,
        "wall": quad([-1.2, 0, 3], [-1.2, 0, -3], [-1.2, 3, -3], [-1.2, 3, 3], material=WHITE),
        "back": quad([-1.2, 0, -1.5], [6, 0, -1.5], [6, 3, -1.5], [-1.2, 3, -1.5], material=WHITE),
        "lamp": {
            "type": "rectangle",
            "emission": [30, 28, 25],
            "transform": [{"scale": 0.4}, DOWN, turned([0, 0, 1], -20), moved(-0.2, 3, 0.8)],
        },
    },
}
ON_FLOOR = {"type": "sphere", "center": [0.1, 0.5, 0], "radius": 0.5, "material": ORANGE}
IN_CORNER = [{"scale": 0.4}, turned([0, 1, 0], 25), moved(-0.4, 0.4, -0.7)]
HANGING = {
    "type": "cube",
    "material": ORANGE,
    "transform": [{"scale": 0.3}, turned([0, 1, 0], 25), moved(-0.3, 0.6, -0.5)],
}
SHINY = {"type": "roughconductor", "eta": [0.3, 0.6, 1.2], "k": [3, 2.5, 2], "alpha": 0.35}
FROSTED = {"type": "roughdielectric", "int_ior": 1.4, "ext_ior": 1.0, "alpha": 0.4}
PANE = {
    "type": "rectangle",
    "material": FROSTED,
    "transform": [{"scale": 0.7}, turned([1, 0, 0], -20), moved(0.1, 0.8, 0.9)],
}
LENS = {"type": "thinlens", "origin": [0.8, 1.6, 4.2], "target": [0, 0.6, 0], "fov": 40}
LENS |= {"aperture_radius": 0.2, "focus_distance": 3.5}
VEIL = {**ORANGE, "opacity": 0.5}
#: Between the lamp and the floor, and before the camera.
CURTAIN = {
    "type": "rectangle",
    "material": {**diffuse(0.3, 0.6, 0.3), "opacity": 0.4},
    "transform": [{"scale": 0.6}, turned([0, 1, 0], 20), moved(0.3, 0.7, 0.2)],
}

SQUARES = {
    "type": "diffuse",
    "reflectance": {"type": "checkerboard", "color0": [0.9, 0.8, 0.7], "color1": 0.05, "scale": 2.5},
}
#: A floor of two colours, below what the camera sees of the wall that it lights.
TWO_TONE: dict[str, Any] = {
    "camera": {"origin": [0, 1, 3], "target": [0, 1, -2], "fov": 30},
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": diffuse(0, 0, 0)
            | {"reflectance": {"type": "image", "path": "$FILES/halves.exr", "filter": "nearest"}},
            "transform": [{"scale": 3}, turned([1, 0, 0], -90), moved(0.1, -0.5, 0)],
        },
        "wall": {"type": "rectangle", "material": WHITE, "transform": [{"scale": [2, 1, 1]}, moved(0, 1, -2)]},
    },
    "lights": {"lamp": {"type": "point", "position": [0.5, 3, 0.5], "intensity": 10}},
}
BOARD = {
    "type": "rectangle",
    "material": SQUARES,
    "transform": [{"scale": 0.5}, turned([0, 1, 0], 50), moved(-0.6, 0.6, -0.5)],
}


def grid(count: int, height: Callable[[Tensor, Tensor], Tensor], **more: Any) -> dict[str, Any]:
    """Return a mesh of ``count`` x ``count`` vertices over a square, of heights by x and z."""
    side = torch.linspace(-1, 1, count)
    x, z = torch.meshgrid(side, side, indexing="xy")
    vertices = torch.stack([x.flatten(), height(x, z).flatten(), z.flatten()], 1)
    number = torch.arange(count * count).reshape(count, count)
    a, b, c, d = (part.flatten() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    faces = torch.cat([torch.stack([a, c, b], 1), torch.stack([a, d, c], 1)])
    return {"type": "mesh", "vertices": vertices.tolist(), "faces": faces.tolist(), **more}


def hills(**more: Any) -> dict[str, Any]:
    """Return a mesh of hills and valleys, 4 x 4 vertices."""
    heights = 0.2 * torch.randn(4, 4, generator=torch.Generator().manual_seed(0))
    return {**grid(4, lambda x, z: heights), "material": WHITE, **more}


#: The field seen from above.
ABOVE: dict[str, Any] = {"camera": {"origin": [0, 3, 0.01], "target": [0, 0, 0], "up": [0, 0, -1], "fov": 45}}
OPEN_SKY = {"sky": {"type": "constant"}}

PAIRS: dict[str, Pair] = {
    # Nothing becomes visible or hidden.
    "albedo_room": Pair(ROOM, "materials.red.reflectance", {(0,): 1.0, (1,): 0.5}, 0.05, depth=4),
    "emission_room": Pair(ROOM, "shapes.lamp.emission", {(0,): 1.0, (2,): -0.4}, 0.5, depth=4),
    "texels": Pair(
        with_shapes(TABLE, floor=PAINTED, ball=BALL),
        "shapes.floor.material.reflectance",
        noise,
        0.05,
        depth=3,
        files={"paint.exr": painted},
    ),
    "roughness": Pair(
        with_shapes(TABLE, floor={**FLOOR, "material": BRUSHED}),
        "shapes.floor.material.alpha",
        {(): 1.0},
        0.01,
    ),
    "metal_eta": Pair(UNDER_SKY, "shapes.ball.material.eta", {(0,): 1.0, (1,): 0.5}, 0.05, files={"sky.exr": sky}),
    "principled_roughness": Pair(
        with_shapes(TABLE, floor={**FLOOR, "material": PRINCIPLED}),
        "shapes.floor.material.roughness",
        {(): 1.0},
        0.02,
    ),
    "principled_metallic": Pair(
        with_shapes(TABLE, floor={**FLOOR, "material": PRINCIPLED}),
        "shapes.floor.material.metallic",
        {(): 1.0},
        0.05,
    ),
    "glass_index": Pair(GLASS, "materials.glass.int_ior", {(): 1.0}, 0.01, depth=4, spp=256),
    "sky_texels": Pair(UNDER_SKY, "lights.sky.texels", noise, 0.05, depth=3, files={"sky.exr": sky}),
    "sky_scale": Pair(UNDER_SKY, "lights.sky.scale", {(): 1.0}, 0.1, depth=3, files={"sky.exr": sky}),
    "sky_turned": Pair(UNDER_SKY, "lights.sky.to_world", turn, 0.01, files={"sky.exr": sky}, turns=True),
    "free_lamp": Pair(FREE, "shapes.lamp.to_world", X, 0.05),
    "floor_tilt": Pair(FREE, "shapes.floor.vertices", {(2, 1): 1.0, (3, 1): 0.6}, 0.05),
    "smooth_vertex_up": Pair(
        with_shapes(FREE, bent={**fan(), "material": ORANGE}), "shapes.bent.vertices", {(0, 1): 1.0}, 0.02
    ),
    # The camera moves.
    "camera_x_room": Pair(ROOM, "camera.to_world", X, 0.006, depth=4),
    "camera_z_room": Pair(ROOM, "camera.to_world", Z, 0.006, depth=4),
    "camera_turn_room": Pair(ROOM, "camera.to_world", about_own_y, 0.003, depth=4, turns=True),
    "fov_room": Pair(ROOM, "camera.fov", {(): 1.0}, 0.1, depth=4),
    "camera_x_ball": Pair(with_shapes(TABLE, ball=BALL), "camera.to_world", X, 0.01),
    "camera_x_sky": Pair(
        {
            **ALONE,
            "shapes": {"ball": {**BUST, "material": diffuse(0.1, 0.2, 0.3)}},
            "lights": {"sky": {"type": "constant"}},
        },
        "camera.to_world",
        X,
        0.01,
    ),
    # Shapes move.
    "lamp_pose_room": Pair(ROOM, "shapes.lamp.to_world", X, 0.006),
    "lamp_pose_room_indirect": Pair(ROOM, "shapes.lamp.to_world", X, 0.006, depth=4),
    "block_pose_room_indirect": Pair(ROOM, "shapes.block.to_world", Y, 0.01, depth=4),
    "ball_pose": Pair(with_shapes(TABLE, ball=BALL), "shapes.ball.to_world", Z, 0.02),
    "ball_pose_indirect": Pair(with_shapes(TABLE, ball=BALL), "shapes.ball.to_world", Z, 0.02, depth=3),
    "ball_pose_bulb": Pair({**with_shapes(DARK, ball=BALL), "lights": BULB}, "shapes.ball.to_world", Y, 0.02),
    "silhouette_vertex": Pair(with_shapes(TABLE, screen=SCREEN), "shapes.screen.vertices", {(1, 0): 1.0}, 0.02),
    "sphere_radius_sky": Pair(
        {
            **ALONE,
            "shapes": {"ball": {**BUST, "material": diffuse(0.1, 0.2, 0.3)}},
            "lights": {"sky": {"type": "constant"}},
        },
        "shapes.ball.to_world",
        grown,
        0.01,
    ),
    "ball_under_sky": Pair(
        {**with_shapes(DARK, ball=BALL), "lights": SKY},
        "shapes.ball.to_world",
        X,
        0.02,
        files={"sky.exr": sky},
    ),
    "cylinder_pose": Pair(
        with_shapes(TABLE, it={"type": "cylinder", "radius": 0.4, "height": 0.9, **STANDING}),
        "shapes.it.to_world",
        Y,
        0.02,
    ),
    "cone_pose": Pair(
        with_shapes(TABLE, it={"type": "cone", "apex": [0, 1.1, 0], "height": -1, "slope": 0.5, **STANDING}),
        "shapes.it.to_world",
        Z,
        0.02,
    ),
    "disk_pose": Pair(
        with_shapes(TABLE, it={"type": "disk", "material": BLUE, "transform": TILTED}),
        "shapes.it.to_world",
        Z,
        0.02,
    ),
    "rectangle_pose": Pair(
        with_shapes(TABLE, it={"type": "rectangle", "material": BLUE, "transform": TILTED}),
        "shapes.it.to_world",
        Z,
        0.02,
    ),
    "cube_pose": Pair(with_shapes(TABLE, it=BOX), "shapes.it.to_world", Y, 0.02),
    "instance_pose": Pair(
        with_shapes(TABLE, block=SMALL_BOX, copy=COPY),
        "shapes.copy.to_world",
        Z,
        0.02,
    ),
    "smooth_normals": Pair(with_shapes(TABLE, bent=fan()), "shapes.bent.vertices", {(1, 0): 1.0, (2, 2): 0.5}, 0.02),
    # Lights move whose shadows have hard edges.
    "spot_position": Pair(
        {**with_shapes(DARK, screen=SCREEN), "lights": SPOT}, "lights.spot.position", {(0,): 1.0}, 0.03
    ),
    "point_position": Pair({**with_shapes(DARK, ball=BALL), "lights": BULB}, "lights.bulb.position", {(0,): 1.0}, 0.03),
    "sun_direction": Pair({**with_shapes(DARK, box=BOX), "lights": SUN}, "lights.sun.direction", {(0,): 1.0}, 0.02),
    # Light that surfaces reflect passes moving edges.
    "ball_on_floor_radius": Pair(with_shapes(CORNER, ball=ON_FLOOR), "shapes.ball.to_world", grown, 0.01, depth=3),
    "block_in_corner": Pair(
        with_shapes(CORNER, block={"type": "cube", "material": ORANGE, "transform": IN_CORNER}),
        "shapes.block.to_world",
        X,
        0.02,
        depth=3,
    ),
    "field_vertex": Pair(
        {**ABOVE, "shapes": {"field": hills()}, "lights": OPEN_SKY},
        "shapes.field.vertices",
        {(5, 1): 1.0},
        0.02,
        depth=3,
    ),
    "flat_field_vertex": Pair(
        {**ABOVE, "shapes": {"field": hills(face_normals=True)}, "lights": OPEN_SKY},
        "shapes.field.vertices",
        {(5, 1): 1.0, (10, 0): 0.5},
        0.02,
        depth=4,
        spp=256,
    ),
    "block_over_metal": Pair(
        with_shapes(CORNER, floor={**FLOOR, "material": SHINY}, block=HANGING),
        "shapes.block.to_world",
        Y,
        0.02,
        depth=3,
    ),
    "block_behind_frosted_glass": Pair(
        with_shapes(CORNER, pane=PANE, block=HANGING), "shapes.block.to_world", X, 0.02, depth=4
    ),
    "ball_on_floor_under_sky": Pair(
        {**without(CORNER, "lamp", ball=ON_FLOOR), "lights": SKY},
        "shapes.ball.to_world",
        Y,
        0.02,
        depth=3,
        files={"sky.exr": sky},
    ),
    # Textures that are not interpolated.
    "camera_over_squares": Pair(
        with_shapes(
            CORNER, floor={**FLOOR, "material": SQUARES, "uvs": [[0, 0], [3, 0], [3, 3], [0, 3]]}, block=HANGING
        ),
        "camera.to_world",
        X,
        0.01,
    ),
    "board_in_corner": Pair(with_shapes(CORNER, board=BOARD), "shapes.board.to_world", X, 0.02, depth=3),
    "two_tone_floor": Pair(TWO_TONE, "shapes.floor.to_world", X, 0.02, depth=3, spp=256, files={"halves.exr": halves}),
    # The camera has a lens.
    "ball_through_lens": Pair(
        {**with_shapes(TABLE, ball={**BALL, "material": ORANGE}), "camera": LENS}, "shapes.ball.to_world", Z, 0.02
    ),
    "block_in_corner_through_lens": Pair(
        {**with_shapes(CORNER, block=HANGING), "camera": LENS}, "shapes.block.to_world", X, 0.02, depth=3
    ),
    "lens_moved": Pair({**with_shapes(TABLE, box=BOX), "camera": LENS}, "camera.to_world", X, 0.01),
    # Surfaces that are not opaque.
    "veiled_ball": Pair(with_shapes(TABLE, ball={**BALL, "material": VEIL}), "shapes.ball.to_world", Z, 0.02),
    "veiled_block_in_corner": Pair(
        with_shapes(CORNER, block={**HANGING, "material": VEIL}), "shapes.block.to_world", X, 0.02, depth=3
    ),
    "block_behind_curtain": Pair(
        with_shapes(CORNER, curtain=CURTAIN, block=HANGING), "shapes.block.to_world", Y, 0.02, depth=3
    ),
    "curtain_in_corner": Pair(
        with_shapes(CORNER, curtain=CURTAIN), "shapes.curtain.to_world", X, 0.02, depth=4, spp=512
    ),
}
