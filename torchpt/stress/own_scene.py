"""Cases made of any scene: elsewhere, larger, turned, by every search and in float64 it is the same picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.errors import RenderError
from torchpt.format.description import Description, overridden, read_description
from torchpt.math.transforms import rotate
from torchpt.rendering import render_scene
from torchpt.scene.scene import Scene, device_of
from torchpt.scene.space import extent_of
from torchpt.settings import Settings
from torchpt.stress.bench import Bench, apart
from torchpt.stress.case import Case, powers

__all__ = ["cases_of", "moved"]

#: Pixels on the longer side, and samples of each.
SIZE, SPP = 48, 4
#: Primitives up to which a scene is searched one by one, too.
FEW = 2_000

Array = NDArray[np.float64]


def cases_of(source: str, overrides: Mapping[str, Mapping[str, Any]]) -> tuple[Case, ...]:
    """The cases of a scene, rendered small.

    Args:
        source: its name or file.
        overrides: settings by block.

    Raises:
        TorchptError: a scene or setting that cannot be used.
    """
    description, settings = overridden(read_description(source), overrides)
    wishes = _small(settings)
    own = Scene(description, torch.device("cpu"))
    extent, pose = (
        extent_of(own.built.parts, own.built.copies),
        np.asarray(own.built.parameters["camera.to_world"], np.float64),
    )
    known: dict[Bench, Tensor] = {}

    def picture(bench: Bench, description: Description = description) -> Tensor:
        compiled = "off" if bench.dtype == torch.float64 else bench.compile
        given = replace(wishes, render=wishes.render.but(accel=bench.accel, compile=compiled))
        found = render_scene(Scene(description, device_of(bench.device)), given, dtype=bench.dtype)
        if found.nonfinite_samples:
            raise RenderError(f"{found.nonfinite_samples} samples are not finite; the first is {found.nonfinite_first}")
        return found.image.double().cpu()

    def beside(bench: Bench, other: Bench) -> float:
        if bench not in known:
            known[bench] = picture(bench)
        return apart(picture(other), known[bench])

    def elsewhere(bench: Bench, by: Array) -> float:
        if bench not in known:
            known[bench] = picture(bench)
        return apart(picture(bench, read_description(source, change=lambda raw: moved(raw, by, pose))), known[bench])

    def searched(accel: str) -> Case:
        return Case(f"searched by {accel}", "mean difference", 1e-3, lambda b, _: beside(b, replace(b, accel=accel)))

    few = sum(len(part.faces) if part.faces is not None else 1 for part in own.built.parts) <= FEW
    return (
        Case("no sample is lost", "mean difference", 0.0, lambda b, _: beside(b, b)),
        Case("in float64", "mean difference", 2e-2, lambda b, _: beside(b, b.exact())),
        Case("by tensor operations", "mean difference", 2e-2, lambda b, _: beside(b, replace(b, compile="off"))),
        *(searched(accel) for accel in ("numba", "torch", *(("brute",) if few else ()))),
        Case(
            "scaled", "mean difference", 2e-2, lambda b, s: elsewhere(b, np.diag([s, s, s, 1.0])), "scale", powers(-12, 12, 4),
        ),
        Case(
            "moved", "mean difference", 2e-2, lambda b, d: elsewhere(b, _step(d * extent)), "times its size", powers(0, 6),
        ),
        Case(
            "turned", "mean difference", 2e-2, lambda b, a: elsewhere(b, rotate({"axis": [1.0, 2.0, 3.0], "angle": a})),
            "degrees", (1.0, 90.0, 180.0),
        ),
    )  # fmt: skip


def _small(settings: Settings) -> Settings:
    """The same, quickly rendered and nothing written."""
    film, most = settings.film, max(settings.film.width, settings.film.height)
    width, height = (max(round(side * SIZE / most), 1) for side in (film.width, film.height))
    render = settings.render.but(
        spp=SPP, pilots=False, checkpoint=None, resume=False, preview=None, time_limit=None, target_error=None
    )
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
