"""Which renders can share a wave, and that wave: their lanes differ in camera and seed, or in their scenes too."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace

from torchpt.core.tree import leaves
from torchpt.integrators.stage_runner import Stages
from torchpt.integrators.wave import Wave

__all__ = ["ROOM", "alike", "common", "room_of", "shared_wave"]

#: Bytes of worlds that are joined, at most: a joined world is a copy, and large scenes fill waves by themselves.
ROOM = 1 << 28


def room_of(wave: Wave) -> int:
    """Bytes of its world."""
    return sum(tensor.nbytes for tensor in leaves(wave.stages.world))


def common(wave: Wave, room: int) -> Hashable | None:
    """What scenes must have in common to share a wave with this one, of so much :func:`room_of`; None where no other may.

    Textures that average over footprints want to know of one camera. Split-sum shading has the scene's environment in advance.
    What models of a caller's own hold may change from scene to scene.
    """
    world = wave.stages.world
    own = wave.first is not None or wave.stages.pixel is not None
    if own or room > ROOM // 2 or any(True for model in world.materials.models for _ in model.weights()):
        return None
    from torchpt.union import form_of

    return tuple(wave.centre.tolist()), form_of(world)


def alike(one: Wave, other: Wave) -> bool:
    """Whether one wave can take the samples of both, their scenes apart."""
    if one.stages.plan != other.stages.plan or one.integrator != other.integrator or one.filter is not other.filter:
        return False
    if one.stages.world is not other.stages.world:
        return True
    return one.stages.pixel is None and one.accel is other.accel


def shared_wave(waves: Sequence[Wave]) -> tuple[Wave, list[int] | None]:
    """The wave that takes the samples of all, and which of its scenes each is of; None where there is one scene."""
    first = waves[0]
    worlds = {id(wave.stages.world): wave for wave in waves}
    if len(worlds) == 1:
        return first, None
    from torchpt.accel.forest import Forest
    from torchpt.union import joined_world

    world, numbers = joined_world([wave.stages.world for wave in worlds.values()])
    forest = Forest([wave.accel for wave in worlds.values()], numbers)
    places = {key: number for number, key in enumerate(worlds)}
    scenes = [places[id(wave.stages.world)] for wave in waves]
    return replace(first, stages=Stages(first.stages.plan, world), forest=forest), scenes
