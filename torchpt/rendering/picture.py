"""Make a :class:`Rendering` of a render's films: picture, AOVs and error estimate.

A :class:`~torchpt.rendering.run.Run` calls it at the end, and in between for previews. A film holds sums and counts of samples
by pixel; AOVs of first surfaces (such as depth) have films of their own, others (such as variance) come from the picture's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpt.core.memory import MemoryMeter, mb, retry_out_of_memory
from torchpt.images.denoiser import GUIDES
from torchpt.paths.layers import LAYERS
from torchpt.physics.film import ErrorEstimate
from torchpt.rendering.nonfinite import causes_of
from torchpt.rendering.result import Rendering

if TYPE_CHECKING:
    from torchpt.rendering.run import Run

__all__ = ["error_estimate_of", "finished_rendering", "rendering_of"]


def finished_rendering(run: Run) -> Rendering:
    """Return the finished rendering, with the causes of its non-finite samples."""
    size = mb(run.memory_need.picture)
    return retry_out_of_memory(
        lambda: f"the picture of {run.width} x {run.height} pixels, which takes {size}",
        lambda: _with_nonfinite_causes(run),
    )


def _with_nonfinite_causes(run: Run) -> Rendering:
    """Return the rendering with the causes of its non-finite samples."""
    rendering = rendering_of(run)
    rendering.nonfinite_causes, rendering.nonfinite_first = causes_of(run.scene, run.wave, run.nonfinite)
    return rendering


def rendering_of(run: Run) -> Rendering:
    """Return the rendering of the films as they are; of several ranks they must have been joined."""
    estimates_light, film = run.integrator.light, run.picture.film
    layers = _layers(run)
    estimate, unknown = None, ""
    if estimates_light:
        values = film.mean() if run.probes is None else run.probes.picture(film)
        image, (estimate, unknown) = values.to(run.dtype), error_estimate_of(run, values)
    else:
        # The picture is the first AOV: one channel as grey, two with a blank blue.
        shown = layers[next(iter(run.surface_layers))]
        blank = torch.zeros_like(shown[..., :1]).expand(-1, -1, max(3 - shown.shape[2], 0))
        image = shown.expand(-1, -1, 3).contiguous() if shown.shape[2] == 1 else torch.cat((shown, blank), -1)
    clamped = None
    if estimates_light and run.integrator.clamp is not None:
        before, after = run.clamp_sums.tolist()  # sums of radiance before and after the clamp
        clamped = 1.0 - after / before if before > 0 else 0.0
    counts = (film if estimates_light else next(iter(run.picture.layers.values()))).counts
    names = run.settings.film.aovs or run.integrator.layers
    meter = MemoryMeter(run.device)
    return Rendering(
        image=image,
        layers={name: layers[name] for name in names},
        guides={name: layers[name] for name in GUIDES} if run.settings.film.denoise else {},
        spp=round(float(counts.double().mean())) if run.settings.adaptive else int(counts.sum()) // len(counts),
        load_seconds=run.load_seconds,
        build_seconds=run.build_seconds,
        compile_seconds=run.compile_seconds(),
        render_seconds=run.seconds_of_sampling(),
        write_seconds=run.write_seconds(),
        paths=run.done,
        rays=run.ray_counts.rays,
        nonfinite_samples=run.nonfinite.count,
        truncated_paths=run.ray_counts.truncated,
        clamped=clamped,
        relmse=None if estimate is None or unknown else estimate.relmse,
        relmse_interval=None if estimate is None or unknown else estimate.interval,
        relmse_unknown=unknown,
        heavy_tailed=estimate is not None and estimate.heavy_tailed,
        stopped_by=run.stop_rules.reason,
        complete=bool(run.stop_rules.reason) and not run.stopped_by_caller,
        peak_memory=max(meter.peak() - meter.base(), 0),
        lanes=run.engine.budget.lanes if run.engine.budget.has_shrunk and not run.engine.compiled else None,
        eager=tuple(run.eager_reasons),
        scene=run.name,
        overrides=run.scene.description.overrides,
        settings=run.settings,
    )


def error_estimate_of(run: Run, picture: Tensor) -> tuple[ErrorEstimate | None, str]:
    """Return the error estimate of the picture (None: not estimated), and why it cannot be trusted ("": it can)."""
    film = run.picture.film
    if run.probes is not None:
        estimate = run.probes.estimate(film, picture)
    else:
        relmse = film.relmse()
        estimate = None if relmse is None else ErrorEstimate(relmse, interval=None, heavy_tailed=False)
    if estimate is None or not run.done:
        return estimate, ""
    from torchpt.rendering.missing_light import find_missing_light

    missing = find_missing_light(run.scene, run.wave, run.geometry, picture, estimate.relmse)
    if missing.reason:
        return estimate, missing.reason
    if estimate.interval is not None:
        low, high = estimate.interval
        # A dark pixel adds at most 1 to the sum over pixels, so its share of the picture bounds what it adds.
        estimate = replace(estimate, interval=(low, high + missing.dark_share))
    return estimate, ""


def _layers(run: Run) -> dict[str, Tensor]:
    """Return the AOVs by name: those of first surfaces, and those computed from the film."""
    layers = {}
    film = run.picture.film
    for name, layer in run.surface_layers.items():
        seen = run.picture.layers[name]
        # Lengths were added in world units.
        values = seen.mean() * (run.unit if layer.length else 1.0) if layer.averaged else seen.first_samples()
        layers[name] = values.to(run.dtype)
    for name in run.settings.film.aovs:
        if name not in run.surface_layers:
            film_layer: Any = LAYERS[name]
            counts = film.counts if run.probes is None else run.probes.counts(film)
            layers[name] = film_layer.of(film, counts).to(run.dtype)
    return layers
