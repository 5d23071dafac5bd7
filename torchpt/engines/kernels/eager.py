"""A vertex by tensor operations, for models that no kernel can be made of, on the lanes of an arena."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.engines.kernels.kernels import Kernels
from torchpt.engines.kernels.rows import HIT, Memory, path_state, state_values
from torchpt.integrators.base import check_fields
from torchpt.integrators.vertex import VertexInput
from torchpt.records import Hit
from torchpt.samplers import salts

__all__ = ["bounce_eagerly"]


def bounce_eagerly(
    kernels: Kernels,
    model: int,
    roulette: float,
    source: Memory,
    target: Memory,
    places: Memory,
    count: int,
    start: int,
    depth: int,
) -> int:
    """Do what the kernel of a bounce does where the search is no part of it.

    Args:
        kernels: of the render.
        model: its number.
        roulette: see :func:`torchpt.integrators.stages.bounce`.
        source: the arena of the paths.
        target: where they go, from lane ``start`` on.
        places: the lanes concerned.
        count: how many.
        start: first place in ``target``.
        depth: of the vertex.

    Returns:
        How many shadow rays it asks for.
    """
    rows, lanes = kernels.state, places.words[0, :count]
    with torch.no_grad():
        state = path_state(rows.take(source, lanes, rows.state))
        vertex = VertexInput(state, Hit(**rows.take(source, lanes, tuple(HIT))))
        context = kernels.wave.context.at(salts(depth, torch.device("cpu")), roulette=roulette)
        output = kernels.wave.bounce(context, model, vertex)
        check_fields(kernels.wave.integrator, output.leaving)
        after, shadow = output.leaving, output.shadow
    values: dict[str, Tensor | None] = {**state_values(after)}
    values |= rows.take(source, lanes, ("weight",))
    if "shadow_o" in rows:
        values |= {
            "shadow_o": after.o if shadow is None else shadow.o,
            "shadow_d": after.d if shadow is None else shadow.d,
            "shadow_t": torch.zeros_like(after.t_max) if shadow is None else shadow.t_max,
            "shadow_radiance": torch.zeros_like(after.o) if shadow is None else shadow.radiance,
        }
    rows.put(target, start, values)
    return 0 if shadow is None else count
