"""What ``torchpt info`` tells: what the scene holds, what was built for it, what was left out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchpt import bsdfs
from torchpt.accel import Accel
from torchpt.records import KINDS, World, tensors_of
from torchpt.scene.settings import Settings

if TYPE_CHECKING:
    from torchpt.scene.build import Built
    from torchpt.scene.description import Description

__all__ = ["describe"]


def describe(description: Description, built: Built, world: World, accel: Accel, settings: Settings) -> dict[str, Any]:
    """A nested dict of plain values: ``scene``, ``shapes``, ``built``, ``left_out``, ``notes``, ``settings``."""
    lights = world.lights
    shapes: dict[str, Any] = {}
    for part in built.parts:
        count = len(part.faces) if part.faces is not None else 1
        row: dict[str, Any] = {"kind": part.quadric or part.kind, "primitives": count, "material": part.material.name}
        if part.emission is not None:
            row["emission"] = list(part.emission)
        if part.source:
            row["file"] = part.source
        if part.dropped:
            row["degenerate_faces_dropped"] = part.dropped
        if part.ignored:
            row["ignored_in_file"] = list(part.ignored)
        if part.kind == "triangle":
            row["normals"] = (
                "face" if not part.smooth else "computed, smooth" if part.normals is None else "from the file"
            )
        shapes[part.name.removeprefix("shapes.") + (f".{part.piece}" if part.piece else "")] = row
    for copy in built.copies:
        shapes[copy.name.removeprefix("shapes.")] = {
            "kind": "instance",
            "of": copy.of.removeprefix("shapes."),
            "material": copy.material.name,
        }
    memory = sum(x.numel() * x.element_size() for x in tensors_of(world))
    made: dict[str, Any] = {
        "accel": accel.describe(),
        "bsdfs": dict(zip(map(str, world.models), map(_rows, world.bsdfs), strict=True)),
        "lights": {} if lights is None else {"rows": len(lights.area), "kinds": list(lights.kinds)},
        "scene_bytes": memory,
    }
    if built.centre.any():
        made["origin_moved_to"] = built.centre.tolist()
    return {
        "scene": {
            "file": description.file,
            "primitives": {kind: n for kind, n in zip(KINDS, world.counts, strict=True) if n},
            **({"instances": len(built.copies)} if built.copies else {}),
            "parameters": len(built.parameters),
        },
        "shapes": shapes,
        "built": made,
        "left_out": _left_out(world, settings),
        "settings": settings.model_dump(mode="json", warnings=False),
    }


def _left_out(world: World, settings: Settings) -> list[str]:
    """Features this scene does not need, for which there is no object, no tensor and no instruction."""
    lights = world.lights
    absent = [f"{kind} primitives" for kind, n in zip(KINDS, world.counts, strict=True) if not n]
    present = {model.name for model in world.models}
    absent += [f"{name} bsdf" for name in dict.fromkeys(model.name for model in bsdfs.MODELS) if name not in present]
    if len(world.models) == 1:
        absent.append("sorting by bsdf (one model)")
    if world.normals is None:
        absent.append("shading normals (all flat)")
    if all(both is None for both in world.two_sided):
        absent.append("one-sided materials")
    if world.opacity is None:
        absent.append("opacity (every surface is met)")
    if world.tangents is None:
        absent.append("tangents (nothing is anisotropic)")
    if not any(model.refracts for model in world.models):
        absent.append("refraction (no index along paths)")
    if not any(model.lobed for model in world.models):
        absent.append("choice among lobes")
    if world.copies is None:
        absent.append("instances")
    if lights is None:
        absent.append("light sampling and MIS (nothing emits)")
    else:
        if lights.choice is None:
            absent.append("choice among lights (one light)")
        if lights.environment is None:
            absent.append("environment")
        if lights.row_of_prim is None:
            absent.append("area lights")
        absent += [f"sampling of {kind} lights" for kind in KINDS if kind not in lights.kinds]
    if settings.film.filter.type == "box":
        absent.append("filter table (box)")
    integrator = settings.integrator
    if getattr(integrator, "clamp", None) is None:
        absent.append("clamp")
    if 0 <= getattr(integrator, "max_depth", 2) < getattr(integrator, "rr_depth", 3) + 1:
        absent.append("Russian roulette (paths end before rr_depth)")
    if not settings.film.aovs:
        absent.append("aov layers")
    absent += ["textures", "volumes", "derivative tape (until a parameter requires gradients)"]
    return absent


def _rows(table: bsdfs.Parameters) -> int:
    """How many materials share a model's stacked parameters."""
    found = tensors_of(table)
    return max((value.shape[-1] if value.dim() < 2 or len(value) == 3 else len(value) for value in found), default=1)
