"""A vertex by tensor operations, for models that no kernel can be made of, on the lanes of an arena."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.engines.kernels.kernels import Kernels
from torchpt.engines.kernels.rows import HIT, Memory, path_state, state_values
from torchpt.integrators.base import check_output
from torchpt.integrators.vertex import Splat, VertexInput, no_shadow
from torchpt.records import Hit, Shadow
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
        check_output(kernels.wave.integrator, output)
        after, none = output.leaving, no_shadow(output.leaving)
        shadow = none if output.shadow is None else output.shadow
        splat = Splat(torch.full_like(after.lane, -1), none) if output.splat is None else output.splat
    values: dict[str, Tensor | None] = {**state_values(after)}
    values |= rows.take(source, lanes, ("weight",))
    values |= {f"shadow_{name}": value for name, value in _named(shadow).items()}
    values |= {f"splat_{name}": value for name, value in _named(splat.light).items()} | {"splat_pixel": splat.pixel}
    rows.put(target, start, values)
    return count * (int(output.shadow is not None) + int(output.splat is not None))


def _named(light: Shadow) -> dict[str, Tensor]:
    return {"o": light.o, "d": light.d, "t": light.t_max, "radiance": light.radiance}
