"""Which renders can share a wave, and that wave: their lanes differ in camera and seed, or in their scenes too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from torchpt.accel.forest import Forest
from torchpt.integrators.compiled import Stages
from torchpt.integrators.wave import Wave
from torchpt.union import form_of, joined_world, size_of

__all__ = ["ROOM", "alike", "joinable", "room_of", "shared_wave"]

#: Bytes of worlds that are joined, at most: a joined world is a copy, and large scenes fill waves by themselves.
ROOM = 1 << 28


def joinable(wave: Wave) -> bool:
    """Whether scenes besides this one may share its waves.

    Textures that average over footprints want to know of one camera. Compiled stages have the scene's tensors in them, and
    split-sum shading has the scene's environment in advance.
    """
    return wave.first is None and wave.stages.pixel is None and not wave.stages.compiled and room_of(wave) <= ROOM // 2


def room_of(wave: Wave) -> int:
    """Bytes of its world."""
    return size_of(wave.stages.world)


def alike(one: Wave, other: Wave) -> bool:
    """Whether one wave can take the samples of both, but for its room."""
    if one.stages.plan != other.stages.plan or one.integrator != other.integrator or one.filter is not other.filter:
        return False
    if one.stages.world is other.stages.world:
        # Compiled stages repeat lanes, which would count for one camera.
        plain = one.stages.pixel is None and not one.stages.compiled and not other.stages.compiled
        return plain and one.accel is other.accel
    if not joinable(one) or not joinable(other) or not torch.equal(one.centre, other.centre):
        return False
    return form_of(one.stages.world) == form_of(other.stages.world)


def shared_wave(waves: Sequence[Wave]) -> tuple[Wave, list[int] | None]:
    """The wave that takes the samples of all, and which of its scenes each is of; None where there is one scene."""
    first = waves[0]
    worlds = {id(wave.stages.world): wave for wave in waves}
    if len(worlds) == 1:
        return first, None
    world, numbers = joined_world([wave.stages.world for wave in worlds.values()])
    forest = Forest([wave.accel for wave in worlds.values()], numbers)
    places = {key: number for number, key in enumerate(worlds)}
    scenes = [places[id(wave.stages.world)] for wave in waves]
    return replace(first, stages=Stages(first.stages.plan, world), forest=forest), scenes
