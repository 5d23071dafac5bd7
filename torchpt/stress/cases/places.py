"""Extreme sizes and distances, and degenerate shapes."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.rendering.api import render
from torchpt.scene import load
from torchpt.stress.case import Case, powers_of_ten
from torchpt.stress.cases._scenes import UNIT_SKY, ball, front_camera, furnace
from torchpt.stress.harness import Harness, relative, relative_difference

__all__ = ["CASES"]

WHITE = {"type": "diffuse", "reflectance": 1.0}


def still_life(scale: float = 1.0, shift: float = 0.0, turn: float = 0.0) -> dict[str, Any]:
    """Return a floor, a ball, a box and a lamp with their camera: turned about x, scaled, and then shifted.

    Args:
        scale: factor of all lengths.
        shift: the longest component of the shift, whose direction lies in no plane of two axes.
        turn: angle in degrees.
    """
    step = [shift, 0.7 * shift, -0.3 * shift]
    moved = [{"rotate": {"axis": [1, 0, 0], "angle": turn}}, {"scale": scale}, {"translate": step}]

    def moved_shape(**keys: Any) -> dict[str, Any]:
        return {**keys, "transform": [*keys.get("transform", []), *moved]}

    angle = np.radians(turn)
    rotation = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])

    def moved_point(x: float, y: float, z: float) -> list[float]:
        return (scale * (rotation @ [x, y, z]) + step).tolist()

    return {
        "camera": {
            "type": "perspective",
            "origin": moved_point(0, 2, 6),
            "target": moved_point(0, 0.5, 0),
            "up": (rotation @ [0, 1, 0]).tolist(),
            "fov": 40,
        },
        "shapes": {
            "floor": moved_shape(
                type="rectangle", transform=[{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]
            ),
            "ball": moved_shape(
                type="sphere", radius=0.7, center=[-1, 0.7, 0], material={"type": "roughplastic", "alpha": 0.2}
            ),
            "box": moved_shape(type="cube", transform=[{"scale": 0.5}, {"translate": [1, 0.5, 0]}]),
            "lamp": moved_shape(type="sphere", radius=0.3, center=[0, 3, 1], emission=10.0),
        },
    }


def at_scale(harness: Harness, scale: float) -> float:
    """Compare the picture of the scaled still life with the plain one."""
    return relative_difference(
        harness.render(still_life(scale), size=24, spp=16), harness.render(still_life(), size=24, spp=16)
    )


def far_away(harness: Harness, shift: float) -> float:
    """Compare the picture of the still life far from the origin with that at the origin."""
    return relative_difference(
        harness.render(still_life(shift=shift), size=24, spp=16), harness.render(still_life(), size=24, spp=16)
    )


def turned(harness: Harness, angle: float) -> float:
    """Compare the picture of the still life turned with its camera with the plain one, over the difference of another seed.

    Its shading frames, and so its noise, differ: 1 is perfect.
    """
    plain, other = (harness.render(still_life(), size=24, spp=64, seed=seed) for seed in (1, 2))
    return relative_difference(harness.render(still_life(turn=angle), size=24, spp=64), plain) / relative_difference(
        other, plain
    )


def little_on_large(harness: Harness, radius: float) -> float:
    """Render a white ball on a white floor of 1e3 in a furnace: 1, unless rays start inside the surface that they leave."""
    scene = {
        "camera": {"type": "perspective", "origin": [0, 6 * radius, 3 * radius], "target": [0, 0, radius], "up": [0, 0, 1],
                   "fov": 20},
        "shapes": {"floor": {"type": "rectangle", "material": WHITE, "transform": [{"scale": 1e3}]},
                   "ball": ball(radius, (0.0, 0.0, radius), material=WHITE)},
        "lights": UNIT_SKY,
    }  # fmt: skip
    return relative(harness.render(scene, spp=64, max_depth=-1), 1.0)


def flat_room(harness: Harness, height: float) -> float:
    """Render a low closed room whose walls emit 1 and reflect half: 2 everywhere, unless it leaks."""
    walls = {"type": "cube", "flip_normals": True, "emission": 1.0, "material": {"type": "diffuse", "reflectance": 0.5}}
    scene = {
        "camera": {
            "type": "perspective",
            "origin": [0, 0, 0],
            "target": [0.3, 0.2, height],
            "up": [0, 1, 0],
            "fov": 60,
        },
        "shapes": {"room": {**walls, "transform": [{"scale": [1, 1, height]}]}},
    }
    return relative(harness.render(scene, spp=256, max_depth=-1), 2.0)


def grid(number: int, material: dict[str, Any] = WHITE, **keys: Any) -> dict[str, Any]:
    """Return a square of side 2 in z = 0, of ``number²`` cells, two triangles each, as a mesh with further ``keys``."""
    x = np.linspace(-1, 1, number + 1)
    points = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((number + 1,) * 2)], -1).reshape(-1, 3)
    lower_left = (np.arange(number)[:, None] * (number + 1) + np.arange(number)).reshape(-1)
    corners = np.stack((lower_left, lower_left + number + 1, lower_left + number + 2, lower_left + 1), 1)
    return {"type": "mesh", "vertices": points.tolist(), "faces": corners.tolist(), "material": material, **keys}


def seams(harness: Harness, number: float) -> float:
    """Render an emissive square of many triangles: pixels differ from 1 where it leaks at a shared edge."""
    scene = {"camera": front_camera(width=1.9), "shapes": {"square": grid(int(number), emission=1.0)}}
    return float((harness.render(scene, size=64, spp=16, max_depth=1) - 1.0).abs().max())


def degenerate(harness: Harness, _: float) -> float:
    """Compare a mesh with slivers and triangles of no area added with the same mesh without them."""
    plain = grid(8)
    bad = {**plain, "vertices": [*plain["vertices"], [0, 0, 0], [1, 1, 0], [0.5, 0.5, 0], [0, 0, 1e-30], [1e-38, 0, 0]]}
    n = len(plain["vertices"])
    # Three points in a line, one point three times, an area below the least float32, an edge.
    bad["faces"] = [*plain["faces"], [n, n + 1, n + 2], [n, n, n], [n, n + 3, n + 4], [0, 0, 1]]
    pictures = [
        harness.render({"camera": front_camera(), "shapes": {"it": it}, "lights": UNIT_SKY}) for it in (bad, plain)
    ]
    return relative_difference(*pictures)


def all_in_one_place(harness: Harness, number: float) -> float:
    """Compare ``number`` equal triangles, whose Morton codes are all the same, with one of them."""
    three = [[-3.0, -3.0, 0.0], [3.0, -3.0, 0.0], [0.0, 6.0, 0.0]]
    mesh = {"type": "mesh", "vertices": three, "faces": [[0, 1, 2]] * int(number), "material": WHITE}
    one = {**mesh, "faces": [[0, 1, 2]]}
    return relative_difference(
        *(
            harness.render({"camera": front_camera(), "shapes": {"it": it}, "lights": UNIT_SKY}, spp=4)
            for it in (mesh, one)
        )
    )


def along_the_axes(harness: Harness, axis: float) -> float:
    """Trace rays along an axis, in planes of boxes: four emissive cubes side by side fill the picture, 1 everywhere.

    Args:
        harness: device, search and engine of the render.
        axis: 0 to 2: from +x, +y, +z; 3 to 5: from -x, -y, -z.
    """
    origin = [0.0, 0.0, 0.0]
    origin[int(axis) % 3] = 4.0 if axis < 3 else -4.0
    up = [0.0, 1.0, 0.0] if int(axis) % 3 != 1 else [1.0, 0.0, 0.0]
    camera = {"type": "orthographic", "origin": origin, "target": [0, 0, 0], "up": up, "width": 2.0}
    cubes = {f"c{k}": {"type": "cube", "emission": 1.0, "transform": [{"scale": 0.5}, {"translate": p}]}
             for k, p in enumerate(([-0.5, -0.5, 0.5], [0.5, -0.5, -0.5], [-0.5, 0.5, -0.5], [0.5, 0.5, 0.5]))}  # fmt: skip
    return float((harness.render({"camera": camera, "shapes": cubes}, size=16, spp=16, max_depth=1) - 1.0).abs().max())


def small_far_sphere(harness: Harness, distance: float) -> float:
    """Compare a distant ball lit from the camera with its mean cosine; its discriminant is a difference of large numbers.

    A point of the white ball has the radiance ``n · (0, 0, 1)``, its own z: the mean of z over the picture is expected.
    """
    half_fov = np.arctan(1.0 / distance) / 2  # the picture holds the inner half of the ball
    scene = {
        "camera": {
            "type": "perspective",
            "origin": [0, 0, distance],
            "target": [0, 0, 0],
            "fov": float(np.degrees(2 * half_fov)),
        },
        "shapes": {"ball": ball(1.0, material=WHITE)},
        "lights": {"sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": np.pi}},
    }
    middles = (np.arange(256) + 0.5) / 128 - 1  # of 256 cells across the picture, in -1..1
    x, y = np.meshgrid(middles * np.tan(half_fov), middles * np.tan(half_fov))
    # Along (x, y, -1): the nearer root, in a form without a difference of large numbers.
    a, outside = x * x + y * y + 1, (distance - 1) * (distance + 1)
    z = distance - outside / (distance + np.sqrt(distance * distance - a * outside))
    return relative(harness.render(scene, spp=256, max_depth=2), float(z.mean()))


def one_pixel_wide(harness: Harness, width: float) -> float:
    """Render a film of ``width`` by one pixel, whose middle shows a ball of radiance 0.5; another shape adds 1."""
    scene = load(furnace({"type": "diffuse"}, emission=0.5), device=harness.device)
    film = {"width": int(width), "height": 1, "filter": "box"}
    emission_alone = {"type": "path", "max_depth": 1}
    picture = render(scene, film=film, spp=1, integrator=emission_alone, accel=harness.accel, compile=harness.compile)
    return float(picture.shape != (1, int(width), 3)) + relative(picture.double()[:, int(width) // 2], 0.5)


CASES = (
    Case(
        name="scale",
        measures="mean difference",
        bound=2e-3,
        figure=at_scale,
        axis="scale",
        sweep=powers_of_ten(-18, 18, step=2),
    ),
    Case(
        name="distance from the origin",
        measures="mean difference",
        bound=5e-3,
        figure=far_away,
        axis="distance",
        sweep=(0.0, *powers_of_ten(0, 9)),
    ),
    Case(
        name="turned",
        measures="mean difference over that of another seed",
        bound=1.2,
        figure=turned,
        axis="degrees",
        sweep=(90.0, 37.0, 180.0, 1e-3),
    ),
    Case(
        name="little things on large ones",
        measures="relative to 1",
        bound=2e-3,
        figure=little_on_large,
        axis="radius",
        sweep=powers_of_ten(-3, 1),
    ),
    Case(
        name="low rooms",
        measures="relative to 2",
        bound=2e-3,
        figure=flat_room,
        axis="height",
        sweep=powers_of_ten(-10, 0),
    ),
    Case(
        name="shared edges",
        measures="largest leak",
        bound=0.0,
        figure=seams,
        axis="cells a side",
        sweep=(1.0, 7.0, 64.0, 200.0),
    ),
    Case(name="triangles without area", measures="mean difference", bound=1e-6, figure=degenerate),
    Case(
        name="triangles in one place",
        measures="mean difference to one",
        bound=0.0,
        figure=all_in_one_place,
        axis="triangles",
        sweep=(2.0, 1e2, 1e4),
    ),
    Case(
        name="rays along the axes",
        measures="largest leak",
        bound=0.0,
        figure=along_the_axes,
        axis="axis",
        sweep=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
    ),
    Case(
        name="small far spheres",
        measures="relative",
        bound=1e-3,
        figure=small_far_sphere,
        axis="distance in radii",
        sweep=powers_of_ten(1, 6),
    ),
    Case(
        name="films one pixel high",
        measures="relative",
        bound=1e-7,
        figure=one_pixel_wide,
        axis="width",
        sweep=(1.0, 2.0, 1023.0, 16384.0),
    ),
)
