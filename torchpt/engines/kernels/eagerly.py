"""A vertex by tensor operations on lanes of an arena, for BSDF models that cannot be compiled."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.engines.kernels.layout import CONNECTION, HIT, PHOTON, Memory, path_state, photon_values, state_values
from torchpt.engines.kernels.programs import Kernels
from torchpt.paths.integrators.base import check_output
from torchpt.paths.photons import photon_of
from torchpt.paths.state import End, Shadow, Splat, StageContext, VertexInput, no_shadow
from torchpt.paths.store import PARTNER, block_of, kept_values, partner_of, vertex_of
from torchpt.physics.shapes.geometry import Hit

__all__ = ["bounce_eagerly", "connect_eagerly"]


def bounce_eagerly(
    kernels: Kernels,
    context: StageContext,
    store: Memory | None,
    model: int,
    source: Memory,
    target: Memory,
    places: Memory,
    count: int,
    start: int,
) -> int:
    """Run the stage of surfaces in place of its kernel.

    Args:
        kernels: of the render.
        context: of the vertex.
        store: vertices of light paths; None: paths are not connected.
        model: index of the BSDF model.
        source: the arena to read paths from.
        target: the arena to write them to.
        places: list of the lanes.
        count: number of lanes.
        start: first lane in ``target``.

    Returns:
        The number of shadow rays, those of splats included.
    """
    rows, lanes, integrator = kernels.state, places.words[0, :count], kernels.wave.integrator
    with torch.no_grad():
        state = path_state(rows.take(source, lanes, rows.state))
        vertex, sample = VertexInput(state, Hit(**rows.take(source, lanes, tuple(HIT)))), state.lane
        if integrator.connects:
            assert store is not None and kernels.store is not None and isinstance(context.depth, int)
            first = block_of(context.depth) * kernels.store.count
            vertex = replace(vertex, partner=partner_of(kernels.store.take(store, sample, PARTNER, first)))
        if integrator.merges:
            near = rows.take(source, lanes, tuple(PHOTON))
            vertex = replace(vertex, photon=photon_of({k.removeprefix("photon_"): x for k, x in near.items()}))
        output = kernels.wave.bounce(context, model, vertex)
        check_output(integrator, output)
        if output.kept is not None:
            assert store is not None and kernels.store is not None
            kept = kept_values(vertex, output.kept)
            counts = {"count": kept.pop("count")}
            for block, where in enumerate(output.kept.where):
                first, index = block * kernels.store.count, where.nonzero().squeeze(1)
                chosen = {name: value.index_select(-1, index) for name, value in kept.items()}
                kernels.store.scatter(store, sample[index], chosen, first)
                kernels.store.scatter(store, sample, counts, first)
        after, no_ray = output.leaving, no_shadow(output.leaving)
        shadow = no_ray if output.shadow is None else output.shadow
        splat = Splat(torch.full_like(after.lane, -1), no_ray) if output.splat is None else output.splat
    values: dict[str, Tensor | None] = {**state_values(after)}
    values |= rows.take(source, lanes, ("weight",))
    values |= {f"shadow_{name}": value for name, value in _values_of_shadow(shadow).items()}
    values |= {f"splat_{name}": value for name, value in _values_of_shadow(splat.light).items()}
    values["splat_pixel"] = splat.pixel
    if integrator.connects:
        ended = {"end_partner": torch.full_like(after.lane, -1), "connection_t": torch.zeros_like(after.t_max)}
        end = output.end
        values |= ended if end is None else {**ended, **{f"end_{name}": value for name, value in vars(end).items()}}
    if integrator.sends_photons:
        values |= photon_values(output)
    rows.put(target, start, values)
    return count * (int(output.shadow is not None) + int(output.splat is not None))


def connect_eagerly(
    kernels: Kernels, context: StageContext, store: Memory, model: int, arena: Memory, places: Memory, count: int
) -> None:
    """Run the stage of connections in place of its kernel.

    Args:
        kernels: of the render.
        context: of the camera paths' vertex.
        store: vertices of light paths.
        model: index of the BSDF model of these.
        arena: of the camera paths behind their vertex.
        places: list of the lanes.
        count: number of lanes.
    """
    rows, lanes, of_store = kernels.state, places.words[0, :count], kernels.store
    assert of_store is not None and isinstance(context.depth, int)
    with torch.no_grad():
        ends = rows.take(arena, lanes, tuple(name for name in CONNECTION if name.startswith("end_")))
        sample = rows.take(arena, lanes, ("lane",))["lane"]
        values = of_store.take(store, sample, of_store.names, block_of(context.depth) * of_store.count)
        end = End(**{name.removeprefix("end_"): value for name, value in ends.items()})
        light = kernels.wave.integrator.connect(context, model, vertex_of(values), values["depth"], end)
    rows.scatter(arena, lanes, {f"connection_{name}": value for name, value in _values_of_shadow(light).items()})


def _values_of_shadow(light: Shadow) -> dict[str, Tensor]:
    """Return the tensors of shadow rays by the ends of their rows' names."""
    return {"o": light.o, "d": light.d, "t": light.t_max, "radiance": light.radiance}
