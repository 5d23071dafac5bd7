"""The :class:`Rendering`: picture, AOVs, error and counts as an object, in files and in notebooks; denoising."""

from __future__ import annotations

import math
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from html import escape
from io import BytesIO
from os import PathLike
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchpt.core.files import as_path
from torchpt.core.threads import limited_threads
from torchpt.images import denoiser, write_image
from torchpt.images.colour import display
from torchpt.scene.settings import Settings

if TYPE_CHECKING:
    from torchpt.scene.settings import Film


__all__ = [
    "Progress",
    "Rendering",
    "denoise_rendering",
    "denoised_path",
    "html_of",
    "png_of",
    "table_of",
    "write_denoised",
    "write_rendered",
]


# ---- The result of a render, and its progress


@dataclass(repr=False, eq=False)
class Rendering:
    """A picture with its AOVs, error, counts and seconds; ``torchpt.render(scene, full=True)`` returns one.

    ``rendering["rgb"]`` is the picture, ``rendering["depth"]`` the AOV of that name, ``dict(rendering)`` has all of them.

    Attributes:
        image: ``(H, W, 3)`` linear RGB; it requires gradients if parameters or rays do.
        layers: the AOVs of ``film.aovs``, each ``(H, W, C)``; averages over first surfaces carry gradients too.
        guides: AOVs for the denoiser, by the names of its arguments, each ``(H, W, 3)``; empty
            without ``film.denoise``.
        denoised: the denoised picture ``(H, W, 3)``; None without ``film.denoise``. All numbers below are of ``image``.
        spp: samples a pixel of the picture.
        load_seconds: reading the scene and its files; 0 if not measured.
        build_seconds: building the world and its search structure.
        compile_seconds: compiling kernels, or loading them from disk.
        render_seconds: sampling, and estimating the error; includes the time before a checkpoint.
        denoise_seconds: denoising.
        write_seconds: writing files: checkpoints, and the pictures of ``torchpt render``.
        paths: number of paths.
        rays: number of rays, with shadow rays.
        nonfinite_samples: number of samples that were NaN or infinite, and counted as black.
        nonfinite_causes: their number by cause, such as ``{"infinite light": 3}``; the sum is ``nonfinite_samples``.
            See :data:`torchpt.paths.explain.CAUSES`. Empty until the render ends.
        nonfinite_first: the first such sample, and the quantity that stopped being finite; "" where there is none.
        truncated_paths: number of paths that ended at the hard limit of depth.
        clamped: fraction of the light that ``integrator.clamp`` removed; None without it.
        relmse: estimate of the picture's relMSE; None without error probes, or where light is missing.
        relmse_interval: its 95 % confidence interval; None where there are too few error probes.
        relmse_unknown: the light that no sample found, so that the error is not known; "" if none is missing.
        heavy_tailed: True if so few pixels carry the error that the interval is not to be trusted.
        stopped_by: the rule that ended the render: spp, time_limit or target_error; "" if ``on_progress`` did.
        complete: True if a rule ended the render.
        peak_memory: largest memory of the process above that after import, in bytes; on CUDA, of tensors.
        lanes: lanes of the last wave, where failed allocations made them fewer; None if memory sufficed.
        eager: stages that ran by tensor operations although kernels were requested, with the reasons.
        scene: name of the scene; "" for a scene from a mapping.
        overrides: overrides of the scene's keys, as words of the command line.
        settings: the complete settings.
    """

    image: Tensor
    layers: dict[str, Tensor] = field(default_factory=dict)
    guides: dict[str, Tensor] = field(default_factory=dict)
    denoised: Tensor | None = None
    spp: int = 0
    load_seconds: float = 0.0
    build_seconds: float = 0.0
    compile_seconds: float = 0.0
    render_seconds: float = 0.0
    denoise_seconds: float = 0.0
    write_seconds: float = 0.0
    paths: int = 0
    rays: int = 0
    nonfinite_samples: int = 0
    nonfinite_causes: dict[str, int] = field(default_factory=dict)
    nonfinite_first: str = ""
    truncated_paths: int = 0
    clamped: float | None = None
    relmse: float | None = None
    relmse_interval: tuple[float, float] | None = None
    relmse_unknown: str = ""
    heavy_tailed: bool = False
    stopped_by: str = ""
    complete: bool = True
    peak_memory: int = 0
    lanes: int | None = None
    eager: tuple[str, ...] = ()
    scene: str = ""
    overrides: tuple[str, ...] = ()
    settings: Settings | None = None

    @property
    def seconds(self) -> float:
        """Return the seconds from reading the scene to writing the picture: the sum of the six above."""
        prepared = self.load_seconds + self.build_seconds + self.compile_seconds
        return prepared + self.render_seconds + self.denoise_seconds + self.write_seconds

    @property
    def variance(self) -> Tensor | None:
        """Variance of each pixel ``(H, W, 3)``; None if ``film.aovs`` does not have it."""
        return self.layers.get("variance")

    @property
    def _has_open_spp(self) -> bool:
        """Return True if anything else than ``render.spp`` decides the number of samples a pixel."""
        if self.settings is None:
            return False
        return self.settings.adaptive or bool(self.settings.render.stops)

    def __getitem__(self, name: str) -> Tensor:
        """Return the picture (``rgb``) or an AOV, by name.

        Raises:
            KeyError: an AOV that ``film.aovs`` does not have.
        """
        if name == "rgb":
            return self.image
        if name not in self.layers:
            raise KeyError(f"{name}: expected one of {', '.join(self)}; film.aovs asks for more")
        return self.layers[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the picture and its AOVs."""
        return iter(("rgb", *self.layers))

    def __contains__(self, name: object) -> bool:
        return name in tuple(self)

    def __len__(self) -> int:
        return 1 + len(self.layers)

    def keys(self) -> tuple[str, ...]:
        """Return the names of the picture and its AOVs."""
        return tuple(self)

    def write(self, path: str | PathLike[str]) -> None:
        """Write the picture as ``torchpt render`` does: atomically, tone-mapped as ``film`` says.

        An ``.exr`` has the AOVs, and the :meth:`header`. A denoised picture is written beside it, as
        ``NAME.denoised.exr``.

        Args:
            path: file name that ends in ``.exr .hdr .png .jpg .jpeg .ppm``.

        Raises:
            SceneError: ``path`` is no path.
            OutputError: the ending is unknown, or the file cannot be written.
        """
        from torchpt.scene.settings import Film

        film = Film() if self.settings is None else self.settings.film
        write_rendered(path, self, film)
        if self.denoised is not None:
            write_denoised(denoised_path(path), self, film)

    def header(self) -> dict[str, str | int | float]:
        """Return the facts for the header of an EXR file, by name; :func:`torchpt.read_header` reads them back."""
        from torchpt.core.version import __version__

        low, high = self.relmse_interval or (None, None)
        facts: dict[str, str | int | float | None] = {
            "version": __version__,
            "scene": self.scene if self.scene.isprintable() else None,
            "overrides": " ".join(_shortened(word) for word in self.overrides if word.isprintable()),
            "spp": self.spp,
            "relmse": self.relmse,
            "relmse_low": low,
            "relmse_high": high,
            "heavy_tailed": 1 if self.heavy_tailed else None,
            "load_seconds": self.load_seconds,
            "build_seconds": self.build_seconds,
            "compile_seconds": self.compile_seconds,
            "render_seconds": self.render_seconds,
            "rays": self.rays,
            "nonfinite_samples": self.nonfinite_samples,
            "nonfinite_causes": "; ".join(f"{count} {name}" for name, count in self.nonfinite_causes.items()),
            "truncated_paths": self.truncated_paths or None,
            "clamped": self.clamped,
            "stopped_by": self.stopped_by,
            "complete": int(self.complete),
        }
        if self.settings is not None:
            facts |= {
                "seed": self.settings.render.seed,
                "integrator": self.settings.integrator.name,
                "sampler": self.settings.sampler.name,
            }
        # A header has no infinite numbers and no empty text.
        return {
            name: value
            for name, value in facts.items()
            if value is not None and value != "" and (isinstance(value, str) or math.isfinite(value))
        }

    def __repr__(self) -> str:
        facts = table_of(self)
        size = facts.pop("size")
        return f"Rendering({size}; {'; '.join(f'{name}: {value}' for name, value in facts.items())})"

    def _repr_png_(self) -> bytes:
        """Return the picture for a notebook, as PNG."""
        return png_of(self.image, None if self.settings is None else self.settings.film)

    def _repr_html_(self) -> str:
        """Return the picture and a table of its facts for a notebook, as HTML."""
        return html_of(self)

    def summary(self) -> dict[str, Any]:
        """Return the facts as plain values, ready for JSON."""
        facts: dict[str, Any] = {
            "spp": self.spp,
            "load_seconds": round(self.load_seconds, 4),
            "build_seconds": round(self.build_seconds, 4),
            "compile_seconds": round(self.compile_seconds, 4),
            "render_seconds": round(self.render_seconds, 4),
            **{
                name: round(value, 4)
                for name, value in (("denoise_seconds", self.denoise_seconds), ("write_seconds", self.write_seconds))
                if value
            },
            "seconds": round(self.seconds, 4),
            "paths_per_second": round(self.paths / max(self.render_seconds, 1e-9)),
            "rays": self.rays,
            "nonfinite_samples": self.nonfinite_samples,
            "mean": [float(x) for x in self.image.detach().double().mean((0, 1))],
            "relmse": self.relmse,
            "relmse_interval": None if self.relmse_interval is None else list(self.relmse_interval),
        }
        if self.relmse_unknown:
            facts["relmse_unknown"] = self.relmse_unknown
        facts["peak_memory"] = self.peak_memory
        if self.lanes is not None:
            facts["lanes"] = self.lanes
        if self.nonfinite_causes:
            facts["nonfinite_causes"] = dict(self.nonfinite_causes)
            facts["nonfinite_first"] = self.nonfinite_first
        if self.heavy_tailed:
            facts["heavy_tailed"] = True
        if self.stopped_by and (self.stopped_by != "spp" or self._has_open_spp):
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


def _shortened(word: str, most: int = 200) -> str:
    """Return a word, cut to ``most`` characters: headers of EXR files stay readable."""
    return word if len(word) <= most else f"{word[: most - 3]}..."


@dataclass
class Progress:
    """The state of a render between two chunks.

    Attributes:
        done: paths traced so far.
        total: number of paths in the end; an estimate where a time limit or target error ends the render.
        rays: rays traced so far.
        seconds: seconds since the start.
        pass_finished: True if a pass over all pixels ends here.
        snapshot: returns the rendering so far.
    """

    done: int
    total: int
    rays: int
    seconds: float
    pass_finished: bool
    snapshot: Callable[[], Rendering]


# ---- A rendering in notebooks: the picture, scaled down, and a table of its facts


#: Longest side of a picture in a notebook, in pixels; larger ones are scaled down.
LONGEST_SIDE = 768


def png_of(image: Tensor, film: Any) -> bytes:
    """Return a picture ``(H, W, 3)`` as PNG, tone-mapped and scaled down to ``LONGEST_SIDE``.

    Args:
        image: linear radiance.
        film: has ``exposure``, ``tonemap`` and ``gamma``; None: the defaults.
    """
    from PIL import Image

    options = {} if film is None else {"exposure": film.exposure, "tonemap": film.tonemap, "gamma": film.gamma}
    shown = display(image.detach().cpu().float(), **options)
    picture = Image.fromarray((shown * 255 + 0.5).byte().numpy())
    picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE), Image.Resampling.BOX)  # leaves what is smaller as it is
    encoded = BytesIO()
    picture.save(encoded, "PNG")
    return encoded.getvalue()


def table_of(rendering: Rendering) -> dict[str, str]:
    """Return the facts for a notebook's table, by name."""
    height, width = rendering.image.shape[:2]
    facts = {"size": f"{width} x {height}", "samples a pixel": str(rendering.spp)}
    if rendering.relmse is not None:
        facts["relMSE"] = f"{rendering.relmse:.3g}"
        if rendering.relmse_interval is not None:
            low, high = rendering.relmse_interval
            doubt = ", not to be trusted: few pixels carry the error" if rendering.heavy_tailed else ""
            facts["relMSE"] += f" ({low:.3g} to {high:.3g}{doubt})"
    parts = {"load": rendering.load_seconds, "build": rendering.build_seconds, "compile": rendering.compile_seconds}
    others = ", ".join(f"{name} {value:.2f}" for name, value in parts.items() if value >= 0.005)  # 0.01 when rounded
    facts["seconds"] = f"{rendering.render_seconds:.2f} of sampling" + (f" ({others})" if others else "")
    facts["rays"] = f"{rendering.rays:,}"
    if rendering.layers:
        facts["layers"] = ", ".join(rendering.layers)
    if rendering.nonfinite_samples:
        causes = "; ".join(f"{name}: {count:,}" for name, count in rendering.nonfinite_causes.items())
        facts["samples not finite"] = f"{rendering.nonfinite_samples:,}" + (f" ({causes})" if causes else "")
    if rendering.truncated_paths:
        facts["paths cut off"] = f"{rendering.truncated_paths:,}"
    if rendering.stopped_by not in ("", "spp"):
        facts["ended by"] = rendering.stopped_by
    if not rendering.complete:
        facts["complete"] = "no"
    return facts


def html_of(rendering: Rendering) -> str:
    """Return picture, denoised picture and table as one self-contained piece of HTML."""
    film = None if rendering.settings is None else rendering.settings.film
    shown = {"rendered": rendering.image}
    if rendering.denoised is not None:
        shown["denoised"] = rendering.denoised
    pictures = "".join(_figure(name, image, film, with_title=len(shown) > 1) for name, image in shown.items())
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in table_of(rendering).items()
    )
    return f"<div>{pictures}<table>{rows}</table></div>"


def _figure(name: str, image: Tensor, film: Any, *, with_title: bool) -> str:
    """Return a picture as HTML, with its PNG inside."""
    data = b64encode(png_of(image, film)).decode("ascii")
    title = f"<figcaption>{name}</figcaption>" if with_title else ""
    picture = f'<img alt="{name} picture" style="max-width:100%" src="data:image/png;base64,{data}">'
    return f'<figure style="display:inline-block;margin:0 8px 0 0">{picture}{title}</figure>'


# ---- A rendering as files: the picture with AOVs and header, and the denoised picture


def denoised_path(path: str | PathLike[str]) -> str:
    """Return the path of a denoised picture: ``a.denoised.exr`` for ``a.exr``."""
    file = as_path(path)
    return str(file.with_name(f"{file.stem}.denoised{file.suffix}"))


def write_rendered(path: str | PathLike[str], rendering: Rendering, film: Film) -> None:
    """Write the picture, tone-mapped as the film says; an ``.exr`` has AOVs, and facts in its header.

    Raises:
        OutputError: the ending is unknown, or the file cannot be written.
    """
    layers = rendering.layers if as_path(path).suffix.lower() == ".exr" else None
    _write(path, rendering, film, rendering.image, layers=layers, header=rendering.header())


def write_denoised(path: str | PathLike[str], rendering: Rendering, film: Film) -> None:
    """Write the denoised picture; its header says that it is denoised, and has no error estimate.

    Raises:
        OutputError: the ending is unknown, or the file cannot be written.
    """
    assert rendering.denoised is not None
    facts = {name: value for name, value in rendering.header().items() if not name.startswith(("relmse", "heavy"))}
    _write(path, rendering, film, rendering.denoised, header={**facts, "denoised": 1})


def _write(path: str | PathLike[str], rendering: Rendering, film: Film, image: Tensor, **more: Any) -> None:
    """Write a picture of a rendering, and add the time to ``write_seconds``."""
    start = time.perf_counter()
    write_image(path, image, exposure=film.exposure, tonemap=film.tonemap, gamma=film.gamma, **more)
    rendering.write_seconds += time.perf_counter() - start


# ---- Denoising


def denoise_rendering(rendering: Rendering, settings: Settings) -> float:
    """Set ``denoised`` of a rendering, on as many threads as it was rendered with; return the seconds.

    Raises:
        RenderError: the denoiser failed.
    """
    start = time.perf_counter()
    with limited_threads(settings.render.threads):
        rendering.denoised = denoiser.denoise(rendering.image.detach(), **rendering.guides)
    rendering.denoise_seconds = time.perf_counter() - start
    return rendering.denoise_seconds
