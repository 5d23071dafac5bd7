"""Make cases of any scene: moved, scaled, turned, by every search and in float64 its picture must not change.

The figure of each case is the difference between the picture rendered in another way and the plain one, divided by the
difference that another seed makes (the noise). With the same random numbers it should be far below 1, else about 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.math.transforms import rotate
from torchpt.rendering.api import render_scene
from torchpt.scene.devices import device_of
from torchpt.scene.formats.description import Description, overridden, read_description
from torchpt.scene.scene import Scene
from torchpt.scene.settings import Settings
from torchpt.scene.space import bounds_extent
from torchpt.spec import Role
from torchpt.stress.case import Case, powers_of_ten
from torchpt.stress.harness import Harness, relative_difference

__all__ = ["cases_of", "moved"]

#: Pixels of the longer side, and samples a pixel: every case renders the scene once or more.
SIZE, SPP = 48, 4
#: Bounds of the figure: with the same random numbers, and with others (as after a turn, which changes the shading frames).
SAME_NUMBERS, OTHER_NUMBERS = 0.2, 1.2
_NOISE = "difference over that of another seed"
#: Largest number of primitives for which brute force is tested too: its time grows with their number.
BRUTE_MAX_PRIMITIVES = 2_000

Array = NDArray[np.float64]


def cases_of(
    source: str, overrides: Mapping[str, Mapping[str, Any]], changes: Mapping[str, Any] | None = None
) -> tuple[Case, ...]:
    """Return the cases of a scene, which render it small.

    Args:
        source: name or file of the scene.
        overrides: overrides of settings by block.
        changes: overrides of the scene's keys, as :func:`torchpt.load` takes them.

    Raises:
        TorchptError: the scene or a setting cannot be used.
    """
    description, settings = overridden(read_description(source, overrides=changes), overrides)
    small = _small(settings)
    scene = Scene(description, torch.device("cpu"))
    extent = bounds_extent(scene.built.parts, scene.built.copies)  # size of the scene, a length
    camera_pose = np.asarray(scene.built.parameters["camera.to_world"], np.float64)
    references: dict[Harness, tuple[Tensor, Tensor]] = {}  # plain picture, and that of another seed

    def picture(harness: Harness, description: Description = description, seed: int = small.render.seed) -> Tensor:
        compiled = "off" if harness.dtype == torch.float64 else harness.compile
        settings = replace(small, render=small.render.but(accel=harness.accel, compile=compiled, seed=seed))
        result = render_scene(Scene(description, device_of(harness.device)), settings, dtype=harness.dtype)
        if result.nonfinite_samples:
            raise RenderError(
                f"{result.nonfinite_samples} samples are not finite; the first is {result.nonfinite_first}"
            )
        return result.image.double().cpu()

    def over_noise(harness: Harness, changed: Callable[[], Tensor]) -> float:
        """Return the difference of the picture that ``changed`` renders from the plain one, over that of another seed."""
        if harness not in references:
            references[harness] = picture(harness), picture(harness, seed=small.render.seed + 1)
        plain, reseeded = references[harness]
        noise = relative_difference(reseeded, plain)
        return relative_difference(changed(), plain) / (noise or 1.0)

    def with_harness(harness: Harness, **changes: Any) -> float:
        """Return the figure of a picture rendered by a harness with other fields."""
        return over_noise(harness, lambda: picture(replace(harness, **changes)))

    def transformed(harness: Harness, matrix: Array) -> float:
        """Return the figure of the scene moved by a similarity ``(4, 4)``."""
        changed = read_description(source, change=lambda raw: moved(raw, matrix, camera_pose), overrides=changes)
        return over_noise(harness, lambda: picture(harness, changed))

    num_primitives = sum(part.primitive_count for part in scene.built.parts)
    searches = ("numba", "torch", *(("brute",) if num_primitives <= BRUTE_MAX_PRIMITIVES else ()))

    # Figures of cases take a point of the sweep; those of cases without one leave it unused.
    def by_search(accel: str) -> Callable[[Harness, float], float]:
        return lambda harness, _: with_harness(harness, accel=accel)

    def by_scale(harness: Harness, scale: float) -> float:
        return transformed(harness, np.diag([scale, scale, scale, 1.0]))

    def by_distance(harness: Harness, sizes: float) -> float:
        return transformed(harness, _step(sizes * extent))

    def by_angle(harness: Harness, degrees: float) -> float:
        return transformed(harness, rotate({"axis": [1.0, 2.0, 3.0], "angle": degrees}))  # in no plane of two axes

    def same_numbers(name: str, figure: Callable[[Harness, float], float], **keys: Any) -> Case:
        return Case(name=name, measures=_NOISE, bound=SAME_NUMBERS, figure=figure, **keys)

    return (
        # The plain picture again: its difference is 0, and the case fails where a sample is not finite.
        Case(name="no sample is lost", measures=_NOISE, bound=0.0, figure=lambda harness, _: with_harness(harness)),
        same_numbers("in float64", lambda harness, _: over_noise(harness, lambda: picture(harness.exact()))),
        same_numbers("by tensor operations", lambda harness, _: with_harness(harness, compile="off")),
        *(same_numbers(f"searched by {accel}", by_search(accel)) for accel in searches),
        same_numbers("scaled", by_scale, axis="scale", sweep=powers_of_ten(-12, 12, step=4)),
        same_numbers("moved", by_distance, axis="times its size", sweep=powers_of_ten(0, 6)),
        Case(
            name="turned",
            measures=_NOISE,
            bound=OTHER_NUMBERS,
            figure=by_angle,
            axis="degrees",
            sweep=(1.0, 90.0, 180.0),
        ),
    )


def _small(settings: Settings) -> Settings:
    """Return settings of a quick render that writes no files."""
    film, longer_side = settings.film, max(settings.film.width, settings.film.height)
    width, height = (max(round(side * SIZE / longer_side), 1) for side in (film.width, film.height))
    render = settings.render.without(Role.FILES | Role.ENDS).but(spp=SPP, pilots=False)
    sampler = settings.sampler
    if settings.adaptive:
        sampler = replace(sampler, values={**sampler.values, "adaptive": False})
    film = film.but(width=width, height=height, crop=None, aovs=(), denoise=False)
    return replace(settings, film=film, sampler=sampler, render=render)


def _step(distance: float) -> Array:
    """Return a translation ``(4, 4)`` by ``distance`` along x, and by less along y and z: 1.15 times ``distance`` in all."""
    matrix = np.eye(4)
    matrix[:3, 3] = np.array([1.0, 0.5, -0.25]) * distance
    return matrix


def moved(raw: dict[str, Any], by: Array, camera: Array) -> dict[str, Any]:
    """Return a scene description transformed by a similarity.

    Args:
        raw: the scene as read from its file.
        by: ``(4, 4)``: rotation, uniform scale and translation.
        camera: pose of its camera ``(4, 4)``, camera to world.
    """
    scale = float(np.cbrt(np.linalg.det(by[:3, :3])))
    rotation = np.eye(4)
    rotation[:3, :3] = by[:3, :3] / scale

    def moved_point(p: Any) -> list[float]:
        return (by[:3, :3] @ np.broadcast_to(np.asarray(p, np.float64), 3) + by[:3, 3]).tolist()

    def moved_direction(d: Any) -> list[float]:
        return (rotation[:3, :3] @ np.asarray(d, np.float64)).tolist()

    pose = by @ camera
    pose[:3, :3] /= scale
    # ``to_world`` replaces the keys that give the pose in other ways.
    new_camera = {
        key: value
        for key, value in (raw.get("camera") or {}).items()
        if key not in ("origin", "target", "up", "R", "t")
    }
    new_camera |= {"to_world": pose.tolist()}
    new_camera |= {key: new_camera[key] * scale for key in ("aperture_radius", "focus_distance") if key in new_camera}
    if new_camera.get("type") == "orthographic":
        new_camera["width"] = new_camera.get("width", 2.0) * scale  # 2: the default
    shapes = {
        name: {**shape, "transform": [*(shape.get("transform") or []), {"matrix": by.tolist()}]}
        for name, shape in (raw.get("shapes") or {}).items()
    }
    lights = {}
    for name, light in (raw.get("lights") or {}).items():
        changed = dict(light)
        changed |= {key: moved_point(light[key]) for key in ("position", "target") if key in light}
        if "direction" in light:
            changed["direction"] = moved_direction(light["direction"])
        if light.get("type") in ("point", "spot"):  # the same irradiance at scaled distances
            changed["intensity"] = (np.asarray(light.get("intensity", 1.0), np.float64) * scale**2).tolist()
        if light.get("type") == "envmap":
            changed["transform"] = [*(light.get("transform") or []), {"matrix": rotation.tolist()}]
        lights[name] = changed
    return {**raw, "camera": new_camera, "shapes": shapes, **({"lights": lights} if lights else {})}
