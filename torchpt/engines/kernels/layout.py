"""What of a render decides the form of its kernels: which numbers a path carries, and which list of lanes is which."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from torchpt import lights
from torchpt.engines.kernels.rows import HIT, PASS, SHADOW, SPLAT, Fields, Rows
from torchpt.integrators.vertex import EXTRA

if TYPE_CHECKING:
    from torchpt.integrators.wave import Wave

__all__ = ["Layout"]


class Layout:
    """The form of a render's kernels.

    Args:
        wave: the render.
        packets: whether primitives are so few that rays are searched by kernels; else the search structure is called.
        fused: whether that is done inside of the stages.

    Attributes:
        state: rows of a path.
        passed: rows of rays that pass surfaces which are not opaque.
        models: how many BSDF models there are.
        has_environment: whether something shines from outside.
        has_emitters: whether a ray may meet an emitter.
        has_opacity: whether a surface may let rays pass.
        passing: whether rays may pass anything, surfaces or what the integrator has between them.
        listed: whether lanes are taken by lists: else all lanes of the arena are of the one model.
        numbers: tensors of the sampler.
    """

    def __init__(self, wave: Wave, packets: bool, fused: bool) -> None:
        self.wave, self.packets, self.fused = wave, packets, fused
        self.plan, self.world = wave.context.plan, wave.context.world
        self.numbers = wave.sampler.numbers(torch.device("cpu"))
        table = self.world.lights
        self.models = len(self.world.materials.models)
        self.has_environment = table is not None and table.environment is not None
        self.has_emitters = table is not None and table.row_of_prim is not None
        self.has_opacity = self.world.materials.opacity is not None
        self.passing = self.has_opacity or wave.integrator.own_transmit
        self.listed = not fused or self.models > 1 or self.has_environment
        self.state = Rows(_path_fields(self))
        self.passed = Rows({**PASS, "clear": ((), "f"), **_key_field(wave), **HIT})

    # Lists 0 .. models - 1 are those of the models. Counter 0 counts the lanes of an arena, counter k + 1 those of list k.

    @property
    def emissive(self) -> int:
        """The list of lanes that met an emitter."""
        return self.models if self.listed else 0

    @property
    def missed(self) -> int:
        """The list of lanes that met nothing, where something shines from there."""
        return self.emissive + int(self.has_emitters)


def _key_field(wave: Wave) -> Fields:
    return {"key": ((wave.sampler.points.rows,), "i")}


def _path_fields(layout: Layout) -> Fields:
    """Fields of a path's state: only what the scene needs."""
    wave, world = layout.wave, layout.world
    fields: Fields = {
        "o": ((3,), "f"),
        "d": ((3,), "f"),
        "t_max": ((), "f"),
        "throughput": ((3,), "f"),
        "radiance": ((3,), "f"),
        "pdf": ((), "f"),
        "lane": ((), "l"),
        **_key_field(wave),
    }
    if any(model.refracts for model in world.materials.models):
        fields["eta"] = ((), "f")
    if lights.local(world.lights):
        fields |= {"p": ((3,), "f"), "n": ((3,), "f")}
    for own in wave.integrator.fields:
        fields[EXTRA + own.name] = ((own.rows,) if own.rows > 1 else (), "l" if own.whole else "f")
    if wave.filter.signed:
        fields["weight"] = ((), "f")
    fields |= HIT
    if wave.integrator.splats:
        fields |= SPLAT
    shadows = world.lights is not None if wave.first is None else wave.first.shadows(world)
    if not layout.fused and (shadows or wave.integrator.splats):
        fields |= SHADOW
        if layout.has_opacity:
            fields["clear"] = ((), "f")
        if not (layout.has_opacity and layout.packets):
            fields["blocked"] = ((), "i")
    return fields
