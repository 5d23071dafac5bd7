"""What a checkpoint has to hold for a render to go on from it, and when that render may take more samples than it was of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.errors import AssetError
from torchpt.forward.adaptive import FIRST_ROUND
from torchpt.forward.checkpoint import State
from torchpt.forward.stopping import BLOCK, Stop
from torchpt.integrators.lost import Lost, Place

if TYPE_CHECKING:
    from torchpt.forward.run import Run

__all__ = ["check_samples", "check_whole", "ends_a_pass"]


def check_samples(run: Run, state: State, path: Path) -> None:
    """Refuse a checkpoint of another ``render.spp`` where the picture would not have the bits of one that is taken at once.

    Raises:
        AssetError: says why.
    """
    settings, there, taken = run.settings, state.facts["spp"], state.facts["taken"]
    here, reason = settings.render.spp, ""
    if here == there:
        return
    before = replace(settings, render=settings.render.but(spp=there))
    if settings.sampler.kind.needs_count:
        reason = f"where {settings.sampler.name} points lie depends on how many there are"
    elif before.streams != settings.streams:
        reason = f"the variance is of {before.streams} streams there, of {settings.streams} here"
    elif taken > here:
        reason = f"it holds {taken} samples a pixel already"
    elif settings.adaptive and taken >= FIRST_ROUND and (here < there or state.facts["cut"]):
        reason = "a round of adaptive sampling was as long as spp let it be"
    elif settings.render.target_error is not None and not ends_a_pass(run, taken):
        reason = f"with render.target_error no pass ends at {taken} samples"
    if reason:
        raise AssetError(
            path, f"is the checkpoint of another render (render.spp: {there} there, {here} here; {reason})"
        )


def ends_a_pass(run: Run, taken: int) -> bool:
    """Return True if a render that ends by its error, and is not short of time, asks for that at so many samples."""
    stop = Stop(run.settings.render.but(spp=taken + BLOCK, time_limit=None), run.picture.streams.count)
    end = taken - taken % (4 * BLOCK)  # from there on passes are whole blocks
    while end < taken:
        end += stop.step(end)
    return end == taken


def check_whole(run: Run, state: State, path: Path) -> None:
    """Refuse numbers that no render of these settings comes to.

    Sums may be negative: those of signed filters are. Layers may hold what is not finite, as models of a user's own may.

    Raises:
        AssetError: names the first one.
    """
    facts, arrays = state.facts, state.arrays
    taken, done, lost = facts["taken"], facts["done"], Lost.read(facts["lost"])
    counts = {name: arrays[f"{name}.counts"] for name in run.films()}
    rounds = run.settings.adaptive and taken >= FIRST_ROUND
    problems: dict[str, bool] = {
        "taken": not (taken <= facts["spp"] and (taken == FIRST_ROUND or not rounds)),
        "cut": facts["cut"] > 1,
        "light": not _finite([arrays["light"]]),
    }
    for name, film in run.films().items():
        light = not name.startswith("layers.")
        samples = taken if run.integrator.light or not light else 0
        least = torch.tensor([len(range(k, samples, film.randomizations)) for k in range(film.randomizations)])[:, None]
        problems[f"{name}.counts"] = bool((counts[name] < least).any() if rounds else (counts[name] != least).any())
        problems[f"{name}.sums"] = light and not _finite(arrays[f"{name}.{key}"] for key in ("sums", "first"))
    seen = counts["picture"] if run.integrator.light else next(iter(c for n, c in counts.items() if n != "picture"))
    total = int(seen.sum())
    if rounds:
        assert run.twice is not None and run.twice.plate.places is not None
        pilots = seen.sum(0)[run.twice.plate.places.cpu()]
        problems["pilots.counts"] |= bool((counts["pilots"].sum(0) != pilots).any())
        for name in run.picture.layers:
            problems[f"layers.{name}.counts"] |= bool((counts[f"layers.{name}"].sum(0) != seen.sum(0)).any())
        problems["picture.counts"] |= total > (facts["spp"] + BLOCK) * seen.shape[1]
    if run.twice is not None:
        total += int(counts["pilots"].sum())
    problems["done"] = done != total
    problems["truncated"] = facts["truncated"] > done
    problems["lost"] = lost.count > done or not all(_is_there(run, place, int(seen.max())) for place in lost.places)
    for name, wrong in problems.items():
        if wrong:
            raise AssetError(path, f"is no whole checkpoint (no render comes to its {name})")


def _finite(values: Iterable[Tensor]) -> bool:
    return all(bool(torch.isfinite(value).all()) for value in values)


def _is_there(run: Run, place: Place, samples: int) -> bool:
    """Return True for a sample that a plate of the render takes."""
    x, y, width, height = run.wave.crop
    plates = [run.picture] if run.twice is None else [run.picture, run.twice.plate]
    inside = x <= place.x < x + width and y <= place.y < y + height and place.sample < samples
    return inside and (place.first, place.streams) in [(plate.streams.first, plate.streams.count) for plate in plates]
