"""Cases made of any scene: elsewhere, larger, turned, by every search and in float64 it is the same picture."""

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

#: Pixels on the longer side, and samples of each.
SIZE, SPP = 48, 4
#: Difference of two pictures, in that of two seeds: of the same random numbers, and of others (frames turn with a scene).
NEAR, ANOTHER = 0.2, 1.2
_NOISE = "difference over that of another seed"
#: Primitives up to which a scene is searched one by one, too.
FEW = 2_000

Array = NDArray[np.float64]


def cases_of(
    source: str, overrides: Mapping[str, Mapping[str, Any]], changes: Mapping[str, Any] | None = None
) -> tuple[Case, ...]:
    """The cases of a scene, rendered small.

    Args:
        source: its name or file.
        overrides: settings by block.
        changes: overrides of its keys, as :func:`torchpt.load` takes them.

    Raises:
        TorchptError: a scene or setting that cannot be used.
    """
    description, settings = overridden(read_description(source, overrides=changes), overrides)
    wishes = _small(settings)
    own = Scene(description, torch.device("cpu"))
    extent, pose = (
        bounds_extent(own.built.parts, own.built.copies),
        np.asarray(own.built.parameters["camera.to_world"], np.float64),
    )
    known: dict[Harness, tuple[Tensor, Tensor]] = {}

    def picture(harness: Harness, description: Description = description, seed: int = wishes.render.seed) -> Tensor:
        compiled = "off" if harness.dtype == torch.float64 else harness.compile
        given = replace(wishes, render=wishes.render.but(accel=harness.accel, compile=compiled, seed=seed))
        found = render_scene(Scene(description, device_of(harness.device)), given, dtype=harness.dtype)
        if found.nonfinite_samples:
            raise RenderError(f"{found.nonfinite_samples} samples are not finite; the first is {found.nonfinite_first}")
        return found.image.double().cpu()

    def beside(harness: Harness, found: Callable[[], Tensor]) -> float:
        if harness not in known:
            known[harness] = picture(harness), picture(harness, seed=wishes.render.seed + 1)
        plain, other = known[harness]
        noise = relative_difference(other, plain)
        return relative_difference(found(), plain) / (noise or 1.0)

    def by(harness: Harness, **other: Any) -> float:
        return beside(harness, lambda: picture(replace(harness, **other)))

    def elsewhere(harness: Harness, way: Array) -> float:
        changed = read_description(source, change=lambda raw: moved(raw, way, pose), overrides=changes)
        return beside(harness, lambda: picture(harness, changed))

    few = sum(len(part.faces) if part.faces is not None else 1 for part in own.built.parts) <= FEW
    searches = ("numba", "torch", *(("brute",) if few else ()))
    return (
        Case("no sample is lost", _NOISE, 0.0, lambda b, _: by(b)),
        Case("in float64", _NOISE, NEAR, lambda b, _: beside(b, lambda: picture(b.exact()))),
        Case("by tensor operations", _NOISE, NEAR, lambda b, _: by(b, compile="off")),
        *(Case(f"searched by {accel}", _NOISE, NEAR, lambda b, _, a=accel: by(b, accel=a)) for accel in searches),
        Case("scaled", _NOISE, NEAR, lambda b, s: elsewhere(b, np.diag([s, s, s, 1.0])), "scale", powers(-12, 12, 4)),
        Case("moved", _NOISE, NEAR, lambda b, d: elsewhere(b, _step(d * extent)), "times its size", powers(0, 6)),
        Case("turned", _NOISE, ANOTHER, lambda b, a: elsewhere(b, rotate({"axis": [1.0, 2.0, 3.0], "angle": a})), "degrees",
             (1.0, 90.0, 180.0)),
    )  # fmt: skip


def _small(settings: Settings) -> Settings:
    """The same, quickly rendered and nothing written."""
    film, most = settings.film, max(settings.film.width, settings.film.height)
    width, height = (max(round(side * SIZE / most), 1) for side in (film.width, film.height))
    render = settings.render.without(Role.FILES | Role.ENDS).but(spp=SPP, pilots=False)
    sampler = settings.sampler
    if settings.adaptive:
        sampler = replace(sampler, values={**sampler.values, "adaptive": False})
    film = film.but(width=width, height=height, crop=None, aovs=(), denoise=False)
    return replace(settings, film=film, sampler=sampler, render=render)


def _step(distance: float) -> Array:
    matrix = np.eye(4)
    matrix[:3, 3] = np.array([1.0, 0.5, -0.25]) * distance
    return matrix


def moved(raw: dict[str, Any], by: Array, camera: Array) -> dict[str, Any]:
    """A scene, as it is written, under a similarity.

    Args:
        raw: what was written.
        by: ``(4, 4)``: rotation, uniform scale and translation.
        camera: its pose ``(4, 4)``.
    """
    scale = float(np.cbrt(np.linalg.det(by[:3, :3])))
    turn = np.eye(4)
    turn[:3, :3] = by[:3, :3] / scale

    def point(p: Any) -> list[float]:
        return (by[:3, :3] @ np.broadcast_to(np.asarray(p, np.float64), 3) + by[:3, 3]).tolist()

    def way(d: Any) -> list[float]:
        return (turn[:3, :3] @ np.asarray(d, np.float64)).tolist()

    pose = by @ camera
    pose[:3, :3] /= scale
    seen = {
        key: value
        for key, value in (raw.get("camera") or {}).items()
        if key not in ("origin", "target", "up", "R", "t")
    }
    seen |= {"to_world": pose.tolist()}
    seen |= {key: seen[key] * scale for key in ("aperture_radius", "focus_distance") if key in seen}
    if seen.get("type") == "orthographic":
        seen["width"] = seen.get("width", 2.0) * scale
    shapes = {
        name: {**shape, "transform": [*(shape.get("transform") or []), {"matrix": by.tolist()}]}
        for name, shape in (raw.get("shapes") or {}).items()
    }
    lights = {}
    for name, light in (raw.get("lights") or {}).items():
        changed = dict(light)
        changed |= {key: point(light[key]) for key in ("position", "target") if key in light}
        if "direction" in light:
            changed["direction"] = way(light["direction"])
        if light.get("type") in ("point", "spot"):
            changed["intensity"] = (np.asarray(light.get("intensity", 1.0), np.float64) * scale**2).tolist()
        if light.get("type") == "envmap":
            changed["transform"] = [*(light.get("transform") or []), {"matrix": turn.tolist()}]
        lights[name] = changed
    return {**raw, "camera": seen, "shapes": shapes, **({"lights": lights} if lights else {})}
