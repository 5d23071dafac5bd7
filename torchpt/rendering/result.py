"""The picture with all that is known of it: as an object, as files, in notebooks, denoised."""

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
    from torch import Tensor

    from torchpt.scene.settings import Film


__all__ = [
    "Progress",
    "Rendering",
    "beside",
    "denoise_rendering",
    "html_of",
    "png_of",
    "table_of",
    "write_denoised",
    "write_rendered",
]


# ---- A picture and how it came about


@dataclass(repr=False, eq=False)
class Rendering:
    """A picture and how it came about; ``torchpt.render(scene, full=True)`` gives one, and notebooks show it.

    ``rendering["rgb"]`` is the picture, and ``rendering["depth"]`` the layer of that name; ``dict(rendering)`` has all of them.

    Attributes:
        image: ``(H, W, 3)`` linear RGB; it carries gradients, where they are wanted.
        layers: what ``film.aovs`` asked for, each ``(H, W, C)``; those of first surfaces that are averaged carry gradients too.
        guides: what the denoiser looks at beside the picture, by the names of its arguments, each ``(H, W, 3)``; empty
            without ``film.denoise``.
        denoised: the picture without its noise ``(H, W, 3)``; None where nobody denoised it. No number here is about it.
        spp: samples a pixel that the picture holds.
        load_seconds: for reading the scene and its files; 0 where nobody took the time.
        build_seconds: for the world and its search structure.
        compile_seconds: for kernels: compiled, or loaded from disk.
        render_seconds: for sampling, and for what the picture knows of its error; with those before a checkpoint.
        denoise_seconds: for the denoised picture.
        write_seconds: for files: checkpoints, and the pictures of ``torchpt render``.
        paths: camera samples traced.
        rays: rays traced, shadow rays included.
        nonfinite_samples: samples that were NaN or infinite, and counted as black.
        nonfinite_causes: how many of them by cause, such as ``{"infinite light": 3}``; they add up to ``nonfinite_samples``.
            See :data:`torchpt.paths.explain.CAUSES`. Not known yet of a picture that is still being rendered.
        nonfinite_first: which sample was the first of them, and what of it stopped being finite; "" where there is none.
        truncated_paths: paths ended by the cap on endless depth.
        clamped: fraction of the light that ``integrator.clamp`` took away; None where it is off.
        relmse: the picture's estimate of its own relMSE; None where it has no pilots, or where light is missing.
        relmse_interval: of 95 % for it; None where there are too few pilots.
        relmse_unknown: which light is missing, so that no error is known; "" where none is, or where there are no pilots.
        heavy_tailed: whether few pixels carry the error, so that the interval is not to be trusted.
        stopped_by: the rule that ended it: spp, time_limit or target_error; "" where it was ended from outside.
        complete: whether a rule ended it.
        peak_memory: bytes, the most that the process ever held above what it held after import; on CUDA, of tensors.
        lanes: of a wave at the end, where failed allocations made them fewer; None where memory sufficed.
        eager: stages that ran as tensor operations although kernels were wanted, and why.
        scene: name of the scene; "" where it came as a mapping.
        overrides: of the scene's keys, as words of the command line.
        settings: what it was rendered with, complete.
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
        """Return what it took, from reading the scene to writing the picture: the sum of the six above."""
        prepared = self.load_seconds + self.build_seconds + self.compile_seconds
        return prepared + self.render_seconds + self.denoise_seconds + self.write_seconds

    @property
    def variance(self) -> Tensor | None:
        """The variance of each pixel ``(H, W, 3)``; None where ``film.aovs`` does not ask for it."""
        return self.layers.get("variance")

    @property
    def _open(self) -> bool:
        """Return True where anything but ``render.spp`` has a say in how many samples a pixel gets."""
        if self.settings is None:
            return False
        return self.settings.adaptive or bool(self.settings.render.stops)

    def __getitem__(self, name: str) -> Tensor:
        """The picture (``rgb``) or a layer, by name.

        Raises:
            KeyError: a layer that ``film.aovs`` did not ask for.
        """
        if name == "rgb":
            return self.image
        if name not in self.layers:
            raise KeyError(f"{name}: expected one of {', '.join(self)}; film.aovs asks for more")
        return self.layers[name]

    def __iter__(self) -> Iterator[str]:
        """Names of the picture and its layers."""
        return iter(("rgb", *self.layers))

    def __contains__(self, name: object) -> bool:
        return name in tuple(self)

    def __len__(self) -> int:
        return 1 + len(self.layers)

    def keys(self) -> tuple[str, ...]:
        """Names of the picture and its layers."""
        return tuple(self)

    def write(self, path: str | PathLike[str]) -> None:
        """Write it as ``torchpt render`` does: whole or not at all, shown as ``film`` says.

        An ``.exr`` keeps the layers, and the facts of :meth:`header`. Where there is a denoised picture it lies beside it, as
        ``NAME.denoised.exr``.

        Args:
            path: where to, ending in ``.exr .hdr .png .jpg .jpeg .ppm``.

        Raises:
            SceneError: ``path`` is none.
            OutputError: an ending that is not written, or a place that cannot be written.
        """
        from torchpt.scene.settings import Film

        film = Film() if self.settings is None else self.settings.film
        write_rendered(path, self, film)
        if self.denoised is not None:
            write_denoised(beside(path), self, film)

    def header(self) -> dict[str, str | int | float]:
        """Return what the header of an EXR file says of it, by name; :func:`torchpt.read_header` reads it back."""
        from torchpt.core.version import __version__

        low, high = self.relmse_interval or (None, None)
        facts: dict[str, str | int | float | None] = {
            "version": __version__,
            "scene": self.scene if self.scene.isprintable() else None,
            "overrides": " ".join(_short(word) for word in self.overrides if word.isprintable()),
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
        """The picture in a notebook."""
        return png_of(self.image, None if self.settings is None else self.settings.film)

    def _repr_html_(self) -> str:
        """The picture and what is known of it, in a notebook."""
        return html_of(self)

    def summary(self) -> dict[str, Any]:
        """The facts as plain values, ready for JSON."""
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
        if self.stopped_by and (self.stopped_by != "spp" or self._open):
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


def _short(word: str, most: int = 200) -> str:
    return word if len(word) <= most else f"{word[: most - 3]}..."


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


# ---- A rendering as notebooks show it: the picture, no larger than it need be, and a table of what is known


#: Pixels of the longer side from which on a picture is shown scaled down.
LONGEST = 768


def png_of(image: Tensor, film: Any) -> bytes:
    """A picture ``(H, W, 3)`` as a screen shows it, in PNG, scaled down to ``LONGEST``.

    Args:
        image: linear radiance.
        film: says ``exposure``, ``tonemap`` and ``gamma``; None: the defaults.
    """
    from PIL import Image

    options = {} if film is None else {"exposure": film.exposure, "tonemap": film.tonemap, "gamma": film.gamma}
    shown = display(image.detach().cpu().float(), **options)
    picture = Image.fromarray((shown * 255 + 0.5).byte().numpy())
    picture.thumbnail((LONGEST, LONGEST), Image.Resampling.BOX)  # leaves what is smaller as it is
    encoded = BytesIO()
    picture.save(encoded, "PNG")
    return encoded.getvalue()


def table_of(rendering: Rendering) -> dict[str, str]:
    """What is worth a look, by name."""
    height, width = rendering.image.shape[:2]
    facts = {"size": f"{width} x {height}", "samples a pixel": str(rendering.spp)}
    if rendering.relmse is not None:
        facts["relMSE"] = f"{rendering.relmse:.3g}"
        if rendering.relmse_interval is not None:
            low, high = rendering.relmse_interval
            doubt = ", not to be trusted: few pixels carry the error" if rendering.heavy_tailed else ""
            facts["relMSE"] += f" ({low:.3g} to {high:.3g}{doubt})"
    parts = {"load": rendering.load_seconds, "build": rendering.build_seconds, "compile": rendering.compile_seconds}
    others = ", ".join(f"{name} {value:.2f}" for name, value in parts.items() if value >= 0.005)
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
    """The picture, the denoised one beside it, and the table; one piece of HTML without anything outside it."""
    film = None if rendering.settings is None else rendering.settings.film
    shown = {"rendered": rendering.image}
    if rendering.denoised is not None:
        shown["denoised"] = rendering.denoised
    pictures = "".join(_figure(name, image, film, len(shown) > 1) for name, image in shown.items())
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in table_of(rendering).items()
    )
    return f"<div>{pictures}<table>{rows}</table></div>"


def _figure(name: str, image: Tensor, film: Any, titled: bool) -> str:
    data = b64encode(png_of(image, film)).decode("ascii")
    title = f"<figcaption>{name}</figcaption>" if titled else ""
    picture = f'<img alt="{name} picture" style="max-width:100%" src="data:image/png;base64,{data}">'
    return f'<figure style="display:inline-block;margin:0 8px 0 0">{picture}{title}</figure>'


# ---- A rendering as files: the picture with its layers and what is known of it, and the denoised one beside it


def beside(path: str | PathLike[str]) -> str:
    """Where a denoised picture goes: ``a.exr`` as ``a.denoised.exr``."""
    file = as_path(path)
    return str(file.with_name(f"{file.stem}.denoised{file.suffix}"))


def write_rendered(path: str | PathLike[str], rendering: Rendering, film: Film) -> None:
    """Write the picture, shown as the film says; an ``.exr`` keeps layers, and facts in its header.

    Raises:
        OutputError: an ending that is not written, or a place that cannot be written.
    """
    layers = rendering.layers if as_path(path).suffix.lower() == ".exr" else None
    _write(path, rendering, film, rendering.image, layers=layers, header=rendering.header())


def write_denoised(path: str | PathLike[str], rendering: Rendering, film: Film) -> None:
    """Write the denoised picture; its header says that it is one, and nothing of an error, which nobody knows.

    Raises:
        OutputError: an ending that is not written, or a place that cannot be written.
    """
    assert rendering.denoised is not None
    facts = {name: value for name, value in rendering.header().items() if not name.startswith(("relmse", "heavy"))}
    _write(path, rendering, film, rendering.denoised, header={**facts, "denoised": 1})


def _write(path: str | PathLike[str], rendering: Rendering, film: Film, image: Tensor, **more: Any) -> None:
    """Write a picture of a rendering, and count the seconds that it took."""
    start = time.perf_counter()
    write_image(path, image, exposure=film.exposure, tonemap=film.tonemap, gamma=film.gamma, **more)
    rendering.write_seconds += time.perf_counter() - start


# ---- The second picture of `film.denoise`, made of the first one and its layers


def denoise_rendering(rendering: Rendering, settings: Settings) -> float:
    """Give a rendering of ``film.denoise`` its denoised picture, on as many threads as it had; returns the seconds it took.

    Raises:
        RenderError: the denoiser failed.
    """
    start = time.perf_counter()
    with limited_threads(settings.render.threads):
        rendering.denoised = denoiser.denoise(rendering.image.detach(), **rendering.guides)
    rendering.denoise_seconds = time.perf_counter() - start
    return rendering.denoise_seconds
