"""Values along rays of a scene in Mitsuba's XML, ours beside Mitsuba's: hits, BSDFs, emission, light samples."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from mitsuba_scene import load_mitsuba
from torch import Tensor

import torchpt
from torchpt.core.errors import ImportedSceneWarning
from torchpt.math.vectors import rows
from torchpt.paths.surface import emission_map, opacity_map, surface_at
from torchpt.paths.vertex import shading_weight
from torchpt.physics.lights import table
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.world import World

__all__ = ["Agreement", "agreements", "rays"]

#: Differences below this are none: of values, and of distances against the size of the scene.
_ABSOLUTE = 1e-5
#: Lights of no extent, of which a sample needs no random number.
_DELTA = ("point", "spot", "directional")


@dataclass(frozen=True)
class Agreement:
    """Agreement of two renderers in one kind of value.

    Attributes:
        count: how many were compared.
        median: of the relative differences.
        off: part that differs by more than a thousandth.
    """

    count: int
    median: float
    off: float

    @staticmethod
    def of(ours: Tensor, theirs: Tensor) -> Agreement:
        """Compare numbers ``(K, N)``, each column as a whole; a column that is 0 in both is left out."""
        ours, theirs = ours.double(), theirs.double()
        some = (ours != 0).any(0) | (theirs != 0).any(0)
        ours, theirs = ours[:, some], theirs[:, some]
        if not some.any():
            return Agreement(0, 0.0, 0.0)
        difference = (ours - theirs).abs().amax(0)
        relative = (difference - _ABSOLUTE).clamp_min(0.0) / theirs.abs().amax(0).clamp_min(_ABSOLUTE)
        return Agreement(int(some.sum()), float(relative.median()), float((relative > 1e-3).double().mean()))


def rays(count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return rays toward a ball about the middle of the corpus's scenes, and directions to scatter to, ``(3, N)`` each.

    A quarter of the rays go anywhere.
    """
    g = torch.Generator().manual_seed(seed)

    def unit() -> Tensor:
        v = torch.randn(3, count, generator=g, dtype=torch.float64)
        return v / v.norm(dim=0)

    middle = torch.tensor([[0.0], [0.8], [0.0]], dtype=torch.float64)
    o = (middle + 6.0 * unit()).float()
    aim = middle + unit() * torch.rand(count, generator=g, dtype=torch.float64) * 1.4
    d = torch.where(torch.arange(count) % 4 == 0, unit(), aim - o.double())
    return o, (d / d.norm(dim=0)).float(), unit().float()


def agreements(file: Path, count: int, seed: int = 1) -> dict[str, Agreement]:
    """Return the agreement of ``hit`` (distance, normals), ``value`` and ``pdf`` of BSDFs, ``emission``, and ``light``.

    Rays that meet different primitives, within rounding of an edge, count as off. Mitsuba is its variant ``scalar_rgb``.
    """
    mitsuba = load_mitsuba("scalar_rgb")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ImportedSceneWarning)
        scene = torchpt.load(str(file), "cpu")
    o, d, wi = rays(count, seed)
    world, _ = scene.world(torch.float32)
    inner = torch.stack([scene.space.point(origin) for origin in o.T.double()], 1).float()  # the lanes' coordinates
    found = scene.accel("auto", 1).intersect(inner, d, torch.full((count,), torch.inf))
    hit = found[1] >= 0
    mine = _ours(world, inner[:, hit], d[:, hit], wi[:, hit], Hit(*(x[hit] for x in found)))
    mine["hit"][0] *= scene.space.unit
    outside = torch.zeros(3, count)
    if world.lights is not None and world.lights.environment is not None:
        outside = table.environment(world.lights, d)[0]
    ours = {name: torch.zeros(len(value), count, dtype=torch.float64) for name, value in mine.items()}
    for name, value in mine.items():
        ours[name][:, hit] = value.double()
    ours["emission"][:, ~hit] = outside[:, ~hit].double()
    theirs = _theirs(mitsuba, mitsuba.load_file(str(file)), o, d, wi)
    for name in ("value", "pdf"):
        theirs[name] *= ours["counts"]
    return {name: Agreement.of(ours[name], theirs[name]) for name in ours if name in theirs}


def _ours(world: World, o: Tensor, d: Tensor, wi: Tensor, hit: Hit) -> dict[str, Tensor]:
    at = interact(world, o, d, Hit(hit.t, hit.prim.long(), hit.u, hit.v))
    key, models = world.materials.key[at.slot + 1].long(), len(world.materials.models)
    value, density, emission = torch.zeros(3, len(hit.t)), torch.zeros(1, len(hit.t)), torch.zeros(3, len(hit.t))
    for number, model in enumerate(world.materials.models):
        lanes = (key % models == number).nonzero()[:, 0]
        if not len(lanes) or model.smooth:
            continue
        some = rows(at, lanes)
        surface = surface_at(world, number, d[:, lanes], some, dark_rims=True)
        local = surface.frame.to_local(wi[:, lanes])
        reflected, pdf = model.eval_pdf(surface.parameters, surface.wo, local)
        share = shading_weight(world, number, some, surface, wi[:, lanes], local)
        share = torch.ones_like(pdf) if share is None else share
        if world.materials.opacity is not None:
            share = share * world.materials.opacity[some.slot]
            pdf = pdf * world.materials.opacity[some.slot]
            if world.textures.opacity is not None:
                share, pdf = share * opacity_map(world, some), pdf * opacity_map(world, some)
        value[:, lanes], density[0, lanes] = reflected * share, torch.where(share > 0, pdf, 0.0)
    shining = (key < models).nonzero()[:, 0]
    if len(shining):
        assert world.lights is not None
        some = rows(at, shining)
        light = table.emitted(world.lights, o[:, shining], some, d[:, shining])[0]
        emission[:, shining] = light if world.textures.emission is None else light * emission_map(world, some)
    normal = at.ng * torch.sign(-(at.ng * d).sum(0))
    # Where the geometric and the shading normal see a direction on different sides, ours is black.
    counts = ((at.ng * d).sum(0) * (at.ns * d).sum(0) > 0) & ((at.ng * wi).sum(0) * (at.ns * wi).sum(0) > 0)
    found = {"hit": torch.cat((hit.t[None], normal)), "emission": emission, "counts": counts[None]}
    found |= {"value": value * counts, "pdf": density * counts}
    if world.lights is not None and len(world.lights.area) == 1 and world.lights.kinds[0] in _DELTA:
        half = torch.full((2, len(hit.t)), 0.5)
        light = table.sample(world.lights, at.p, None, half, offset=0.0)
        found["light"] = torch.cat((light.radiance * light.weight, light.wi))
    return found


def _theirs(mitsuba: Any, scene: Any, o: Tensor, d: Tensor, wi: Tensor) -> dict[str, Tensor]:
    count, context = o.shape[1], mitsuba.BSDFContext()
    sizes = {"hit": 4, "value": 3, "pdf": 1, "emission": 3, "light": 6}
    found = {name: torch.zeros(size, count, dtype=torch.float64) for name, size in sizes.items()}
    light = scene.emitters()[0] if len(scene.emitters()) == 1 else None
    lanes = zip(o.T.tolist(), d.T.tolist(), wi.T.tolist(), strict=True)
    for lane, (origin, along, to) in enumerate(lanes):
        si = scene.ray_intersect(mitsuba.Ray3f(origin, along))
        emitter = si.emitter(scene)
        if emitter is not None:
            found["emission"][:, lane] = torch.tensor(list(emitter.eval(si)))
        if not si.is_valid():
            continue
        normal = [float(x) for x in si.n]
        facing = math.copysign(1.0, -sum(a * b for a, b in zip(normal, along, strict=True)))
        found["hit"][:, lane] = torch.tensor([float(si.t), *(facing * x for x in normal)])
        value, density = si.bsdf().eval_pdf(context, si, si.to_local(to))
        found["value"][:, lane], found["pdf"][0, lane] = torch.tensor(list(value)), float(density)
        if light is not None:
            sample, radiance = light.sample_direction(si, [0.5, 0.5])
            found["light"][:, lane] = torch.tensor([*radiance, *sample.d])
    return found
