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
from torchpt.stress.case import Case, powers
from torchpt.stress.harness import Harness, relative_difference

__all__ = ["cases_of", "moved"]

#: Pixels of the longer side, and samples a pixel.
SIZE, SPP = 48, 4
#: Bounds of the figure: with the same random numbers, and with others (as after a turn).
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
    extent, pose = (
        bounds_extent(scene.built.parts, scene.built.copies),
        np.asarray(scene.built.parameters["camera.to_world"], np.float64),
    )
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
        """Return the difference of a picture from the plain one, over that of another seed."""
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
        changed = read_description(source, change=lambda raw: moved(raw, matrix, pose), overrides=changes)
        return over_noise(harness, lambda: picture(harness, changed))

    num_primitives = sum(len(part.faces) if part.faces is not None else 1 for part in scene.built.parts)
    searches = ("numba", "torch", *(("brute",) if num_primitives <= BRUTE_MAX_PRIMITIVES else ()))
    return (
        Case("no sample is lost", _NOISE, 0.0, lambda b, _: with_harness(b)),
        Case("in float64", _NOISE, SAME_NUMBERS, lambda b, _: over_noise(b, lambda: picture(b.exact()))),
        Case("by tensor operations", _NOISE, SAME_NUMBERS, lambda b, _: with_harness(b, compile="off")),
        *(Case(f"searched by {x}", _NOISE, SAME_NUMBERS, lambda b, _, a=x: with_harness(b, accel=a)) for x in searches),
        Case("scaled", _NOISE, SAME_NUMBERS, lambda b, s: transformed(b, np.diag([s, s, s, 1.0])), "scale", powers(-12, 12, 4)),
        Case("moved", _NOISE, SAME_NUMBERS, lambda b, d: transformed(b, _step(d * extent)), "times its size", powers(0, 6)),
        Case("turned", _NOISE, OTHER_NUMBERS, lambda b, a: transformed(b, rotate({"axis": [1.0, 2.0, 3.0], "angle": a})),
             "degrees", (1.0, 90.0, 180.0)),
    )  # fmt: skip


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
    """Return a translation ``(4, 4)`` in a skew direction, by 1.15 times ``distance``."""
    matrix = np.eye(4)
    matrix[:3, 3] = np.array([1.0, 0.5, -0.25]) * distance
    return matrix


def moved(raw: dict[str, Any], by: Array, camera: Array) -> dict[str, Any]:
    """Return a scene description transformed by a similarity.

    Args:
        raw: the scene as read from its file.
        by: ``(4, 4)``: rotation, uniform scale and translation.
        camera: pose of its camera ``(4, 4)``.
    """
    scale = float(np.cbrt(np.linalg.det(by[:3, :3])))
    turn = np.eye(4)
    turn[:3, :3] = by[:3, :3] / scale

    def point(p: Any) -> list[float]:
        return (by[:3, :3] @ np.broadcast_to(np.asarray(p, np.float64), 3) + by[:3, 3]).tolist()

    def direction(d: Any) -> list[float]:
        return (turn[:3, :3] @ np.asarray(d, np.float64)).tolist()

    pose = by @ camera
    pose[:3, :3] /= scale
    new_camera = {
        key: value
        for key, value in (raw.get("camera") or {}).items()
        if key not in ("origin", "target", "up", "R", "t")
    }
    new_camera |= {"to_world": pose.tolist()}
    new_camera |= {key: new_camera[key] * scale for key in ("aperture_radius", "focus_distance") if key in new_camera}
    if new_camera.get("type") == "orthographic":
        new_camera["width"] = new_camera.get("width", 2.0) * scale
    shapes = {
        name: {**shape, "transform": [*(shape.get("transform") or []), {"matrix": by.tolist()}]}
        for name, shape in (raw.get("shapes") or {}).items()
    }
    lights = {}
    for name, light in (raw.get("lights") or {}).items():
        changed = dict(light)
        changed |= {key: point(light[key]) for key in ("position", "target") if key in light}
        if "direction" in light:
            changed["direction"] = direction(light["direction"])
        if light.get("type") in ("point", "spot"):  # the same irradiance at scaled distances
            changed["intensity"] = (np.asarray(light.get("intensity", 1.0), np.float64) * scale**2).tolist()
        if light.get("type") == "envmap":
            changed["transform"] = [*(light.get("transform") or []), {"matrix": turn.tolist()}]
        lights[name] = changed
    return {**raw, "camera": new_camera, "shapes": shapes, **({"lights": lights} if lights else {})}
