"""A rendering as notebooks show it: the picture, no larger than it need be, and a table of what is known."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchpt.images.colour import display

if TYPE_CHECKING:
    from torchpt.forward.result import Rendering

__all__ = ["html_of", "png_of", "table_of"]

#: Pixels of the longer side from which on a picture is shown scaled down.
LONGEST = 768


def png_of(image: Tensor, film: Any) -> bytes:
    """A picture ``(H, W, 3)`` as a screen shows it, in PNG, scaled down to ``LONGEST``.

    Args:
        image: linear radiance.
        film: says ``exposure``, ``tonemap`` and ``gamma``; None: the defaults.
    """
    from PIL import Image

    wishes = {} if film is None else {"exposure": film.exposure, "tonemap": film.tonemap, "gamma": film.gamma}
    shown = display(image.detach().cpu().float(), **wishes)
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
