"""A picture and how it came about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

__all__ = ["Progress", "Rendering"]


@dataclass
class Rendering:
    """A picture and how it came about.

    Attributes:
        image: ``(H, W, 3)`` linear RGB.
        layers: what ``film.aovs`` asked for, each ``(H, W, C)``.
        guides: what the denoiser looks at beside the picture, by the names of its arguments, each ``(H, W, 3)``; empty
            without ``film.denoise``.
        denoised: the picture without its noise ``(H, W, 3)``; None where nobody denoised it. No number here is about it.
        spp: samples a pixel that the picture holds.
        seconds: wall time.
        build_seconds: of it, for the world and its search structure.
        compile_seconds: of it, for compiling.
        render_seconds: of it, for sampling.
        paths: camera samples traced.
        rays: rays traced, shadow rays included.
        nonfinite_samples: samples that were NaN or infinite, and counted as black.
        truncated_paths: paths ended by the cap on endless depth.
        clamped: fraction of the light that ``integrator.clamp`` took away; None where it is off.
        relmse: the picture's estimate of its own relMSE; None where it has no pilots.
        relmse_interval: of 95 % for it; None where there are too few pilots.
        heavy_tailed: whether few pixels carry the error, so that the interval is not to be trusted.
        stopped_by: the rule that ended it: spp, time_limit or target_error; "" where it was ended from outside.
        complete: whether a rule ended it.
        eager: stages that ran as tensor operations although kernels were wanted, and why.
    """

    image: Tensor
    layers: dict[str, Tensor] = field(default_factory=dict)
    guides: dict[str, Tensor] = field(default_factory=dict)
    denoised: Tensor | None = None
    spp: int = 0
    seconds: float = 0.0
    build_seconds: float = 0.0
    compile_seconds: float = 0.0
    render_seconds: float = 0.0
    paths: int = 0
    rays: int = 0
    nonfinite_samples: int = 0
    truncated_paths: int = 0
    clamped: float | None = None
    relmse: float | None = None
    relmse_interval: tuple[float, float] | None = None
    heavy_tailed: bool = False
    stopped_by: str = ""
    complete: bool = True
    eager: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """The facts as plain values, ready for JSON."""
        facts: dict[str, Any] = {
            "spp": self.spp,
            "build_seconds": round(self.build_seconds, 4),
            "compile_seconds": round(self.compile_seconds, 4),
            "render_seconds": round(self.render_seconds, 4),
            "seconds": round(self.seconds, 4),
            "paths_per_second": round(self.paths / max(self.render_seconds, 1e-9)),
            "rays": self.rays,
            "nonfinite_samples": self.nonfinite_samples,
            "mean": [float(x) for x in self.image.double().mean((0, 1))],
            "relmse": self.relmse,
            "relmse_interval": None if self.relmse_interval is None else list(self.relmse_interval),
        }
        if self.heavy_tailed:
            facts["heavy_tailed"] = True
        if self.stopped_by not in ("", "spp"):
            facts["stopped_by"] = self.stopped_by
        if self.truncated_paths:
            facts["truncated_paths"] = self.truncated_paths
        if self.clamped is not None:
            facts["clamped"] = self.clamped
        if not self.complete:
            facts["complete"] = False
        if self.eager:
            facts["eager"] = list(self.eager)
        return facts


@dataclass
class Progress:
    """The state of a render between two chunks.

    Attributes:
        done: camera samples taken.
        total: camera samples that there will be; a guess where time or error end the render.
        rays: rays traced.
        seconds: since the start.
        pass_finished: whether a pass over all pixels ends here.
        snapshot: makes the picture so far.
    """

    done: int
    total: int
    rays: int
    seconds: float
    pass_finished: bool
    snapshot: Callable[[], Rendering]
