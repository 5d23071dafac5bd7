"""The page of a study: its pictures and tables as one HTML file."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import torch
from torch import Tensor

from torchpt.images import colour
from torchpt.images.false_colour import MAP, false_colour
from torchpt.reports import formatting
from torchpt.reports.analysis import ErrorCurve, SceneReport, Step, error_map
from torchpt.reports.plots import COLOURS, NAMES
from torchpt.reports.study import Study

__all__ = ["Figure", "ImageStrip", "Panel", "closest_step", "largest_errors", "page", "sheet_of"]


# ---- Pictures of the report: at equal time, where errors are largest, and maps of the errors


#: Widest map, in pixels; larger ones are means over squares.
_WIDE = 400
#: A crop is so much of the smaller side, within these bounds in pixels.
_PART, _LEAST, _MOST = 5, 16, 64  # 64 pixels are shown at three times their size or more


@dataclass
class Panel:
    """One setting at the common time.

    Attributes:
        line: its curve.
        step: the step nearest in time.
        crop: PNG of the crop.
        errors: PNG of the map.
    """

    line: ErrorCurve
    step: Step
    crop: bytes
    errors: bytes


@dataclass
class ImageStrip:
    """A scene's pictures.

    Attributes:
        seconds: the common time.
        place: x, y, width, height of the crop in pixels.
        whole: PNG of the reference.
        crop: PNG of its crop.
        size: width and height of the picture.
        panels: one a curve.
        scale: least and greatest error of the maps' colours.
    """

    seconds: float
    place: tuple[int, int, int, int]
    whole: bytes
    crop: bytes
    size: tuple[int, int]
    panels: list[Panel]
    scale: tuple[float, float]


def closest_step(line: ErrorCurve, seconds: float) -> Step:
    """The step of a curve whose time is nearest, as a ratio."""
    return min(line.steps, key=lambda step: abs(math.log(step.seconds / seconds)))


def largest_errors(errors: Tensor, side: int) -> tuple[int, int]:
    """Where a square of ``side`` pixels holds most error: x and y of its corner in a map ``(H, W)``.

    Errors count by their root, so that a single firefly does not choose.
    """
    sums = torch.nn.functional.avg_pool2d(errors.sqrt()[None, None], side, stride=1)[0, 0]
    place = int(sums.argmax())
    return place % sums.shape[1], place // sums.shape[1]


def sheet_of(scene_report: SceneReport) -> ImageStrip | None:
    """The pictures of all curves that have the first one's film, at the longest time that each of them has.

    Denoised ones have no say in where the crop lies.
    """
    reference, film = scene_report.lines[0].reference, scene_report.film
    lines = [line for line in scene_report.lines if line.reference.image.shape == reference.image.shape]
    seconds = min(line.steps[-1].seconds for line in lines)
    chosen = [closest_step(line, seconds) for line in lines]
    images = [torch.nan_to_num(step.pictures[0](), 0.0, 0.0, 0.0) for step in chosen]
    maps = [error_map(image, line.reference) for image, line in zip(images, lines, strict=True)]
    high, wide = maps[0].shape
    side = min(max(min(high, wide) // _PART, _LEAST), _MOST, high, wide)
    rendered = [found for found, line in zip(maps, lines, strict=True) if line.of is None]
    x, y = largest_errors(torch.stack(rendered).mean(0), side)
    smaller = [_reduced(found) for found in maps]
    scale = _scale(smaller)
    panels = [
        Panel(line, step, _png(_shown(image[y : y + side, x : x + side], film)), _png(_coloured(found, scale)))
        for line, step, image, found in zip(lines, chosen, images, smaller, strict=True)
    ]
    whole, crop = _png(_shown(reference.image, film)), _png(_shown(reference.image[y : y + side, x : x + side], film))
    return ImageStrip(seconds, (x, y, side, side), whole, crop, (wide, high), panels, scale)


def _shown(image: Tensor, film: Any) -> np.ndarray:
    levels = colour.display(image, film.exposure, film.tonemap, film.gamma)
    return (levels * 255 + 0.5).to(torch.uint8).numpy()


def _reduced(errors: Tensor) -> Tensor:
    by = -(-max(errors.shape) // _WIDE)
    return torch.nn.functional.avg_pool2d(errors[None, None], by, ceil_mode=True)[0, 0]


def _scale(maps: Sequence[Tensor]) -> tuple[float, float]:
    """Whole powers of ten about most values."""
    values = torch.cat([found.flatten() for found in maps])
    values = values[values > 0].log10()
    if not len(values):
        return 1e-4, 1.0
    ordered = values.sort().values
    low, top = (float(ordered[int(share * (len(ordered) - 1))]) for share in (0.1, 0.995))
    floor, ceiling = math.floor(low), math.ceil(top)
    return 10.0 ** max(floor, ceiling - 4), 10.0 ** max(ceiling, floor + 1)


def _coloured(errors: Tensor, scale: tuple[float, float]) -> np.ndarray:
    """A map in colours, by the logarithm."""
    low, top = (math.log10(x) for x in scale)
    level = (errors.clamp_min(1e-30).log10() - low) / (top - low)
    return (false_colour(level, 1.0).numpy() * 255 + 0.5).astype(np.uint8)


def _png(levels: np.ndarray) -> bytes:
    from PIL import Image

    encoded = BytesIO()
    Image.fromarray(levels).save(encoded, "PNG", optimize=True)
    return encoded.getvalue()


# ---- The report as one file: every picture inside, no script, nothing asked of any server


#: As the curves' marks are drawn.
_MARKS = "●■▲◆▼✚✖★"
_HOLLOW = "○□△◇▽✛✕☆"
#: Name -> PNG and SVG.
Figure = tuple[bytes, bytes]


def page(
    study: Study,
    scene_reports: Sequence[SceneReport],
    sheets: Sequence[ImageStrip | None],
    plots: Sequence[dict[str, Figure]],
    made: str,
) -> str:
    """The text of ``report.html``.

    Args:
        study: what was asked.
        scene_reports: a scene each.
        sheets: their pictures.
        plots: their figures: ``seconds``, ``spp`` (where there is one) and ``measures``.
        made: when and on what.
    """
    template = (Path(__file__).parent / "report.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(template).render(
        title=study.options["title"],
        made=made,
        ramp=_ramp(),
        scenes=[_scene(study, *parts) for parts in zip(scene_reports, sheets, plots, strict=True)],
        method=_method(study),
        settings=_settings(scene_reports),
    )


def _scene(
    study: Study, scene_report: SceneReport, sheet: ImageStrip | None, plots: dict[str, Figure]
) -> dict[str, Any]:
    names = study.options["metrics"]
    main, most = NAMES[names[0]], formatting.count(study.options["spp"][-1])
    columns = ["Setting", *(f"Time to {main} {formatting.number(target, 2)}" for target in scene_report.targets)]
    columns += [f"{main} at {most} samples", "Slope over samples", "Efficiency", "Bias", "Not finite"]
    return {
        "name": scene_report.name,
        "about": _about(scene_report),
        "headline": _headline(scene_report, main),
        "notes": scene_report.notes,
        "columns": columns,
        "rows": [_row(scene_report, line, names[0]) for line in scene_report.lines],
        "plots": [_plot(plots[over], f"{main} over {over}") for over in ("seconds", "spp") if over in plots],
        "overview": _plot(plots["measures"], "all measures over seconds") if "measures" in plots else None,
        "sheet": None if sheet is None else _sheet(sheet, names[0]),
        "step_columns": ["Setting", "Samples", "Time", *(NAMES[name] for name in names), "Efficiency"],
        "step_rows": [_step_row(line, step, names) for line in scene_report.lines for step in line.steps],
    }


def _headline(scene_report: SceneReport, main: str) -> str:
    """Who is first, and by how much, among settings without bias; or that the runs do not tell."""
    able = [line for line in scene_report.lines if line.estimates and not (line.bias and line.bias["biased"])]
    lines = sorted(
        (line for line in able if line.times and line.times[-1]["seconds"]), key=lambda line: line.times[-1]["seconds"]
    )
    timed = [(line.times[-1]["seconds"], line.label) for line in lines]
    if len(timed) < 2:
        return ""
    (least, first), (_, second), (most, last) = timed[0], timed[1], timed[-1]
    aim, (high, low) = (
        formatting.number(scene_report.targets[-1], 2),
        (lines[0].times[-1]["high"], lines[1].times[-1]["low"]),
    )
    if high is None or low is None or high >= low:
        return f"Which comes to {main} {aim} first, {first} or {second}, these runs do not tell: more would."
    text = f"{first} comes to {main} {aim} first, in {formatting.seconds(least)}: "
    text += f"{formatting.times(timed[1][0] / least)} as fast as {second}"
    return f"{text}." if len(timed) == 2 else f"{text}, {formatting.times(most / least)} as fast as {last}."


def _about(scene_report: SceneReport) -> str:
    reference = scene_report.lines[0].reference
    high, wide = reference.image.shape[:2]
    size = f"{wide} × {high} pixels."
    if not reference.origin["made"]:
        return f"{size} Reference: {reference.origin['file']}."
    origin, spp = reference.origin, formatting.count(reference.origin["spp"])
    return (
        f"{size} Reference: the mean of {origin['seeds']} independent runs of {spp} samples a pixel "
        f"({formatting.seconds(origin['seconds'])} in all); its own relMSE, {formatting.number(reference.noise, 2)}, is taken off."
    )


def _cell(text: str, *small: str, tone: str = "") -> dict[str, Any]:
    return {"text": text, "small": [line for line in small if line], "tone": tone}


def _row(scene_report: SceneReport, line: ErrorCurve, main: str) -> dict[str, Any]:
    cells = [_time_cell(scene_report, line, number) for number in range(len(scene_report.targets))]
    last = line.steps[-1]
    found = last.estimate(main)
    cells.append(_cell(formatting.number(found.mean), formatting.interval(found)))
    slope = line.by_spp.slope if line.by_spp else None
    cells.append(_cell("–") if slope is None else _cell(formatting.number(slope.mean), formatting.interval(slope)))
    cells.append(_efficiency_cell(scene_report, line))
    cells.append(_bias_cell(line))
    bad = sum(step.nonfinite for step in line.steps)
    cells.append(_cell(formatting.count(bad), tone="bad" if bad else ""))
    colour, marks = COLOURS[line.look % len(COLOURS)], _MARKS if line.of is None else _HOLLOW
    return {"label": line.label, "mark": marks[line.look % len(marks)], "colour": colour, "cells": cells}


def _time_cell(scene_report: SceneReport, line: ErrorCurve, number: int) -> dict[str, Any]:
    origin, first = line.times[number], scene_report.lines[0].times[number]
    if origin.get("never"):
        return _cell("never", "its bias is larger", tone="bad")
    if origin["seconds"] is None:
        return _cell("–", "too far to tell" if line.by_seconds else "beyond its runs" if line.of else "")
    parts = [formatting.span(origin["low"], origin["high"]), "extrapolated" if origin["extrapolated"] else ""]
    if line is not scene_report.lines[0] and first["seconds"]:
        ratio = first["seconds"] / origin["seconds"]
        parts.insert(0, f"{formatting.times(max(ratio, 1 / ratio))} {'faster' if ratio >= 1 else 'slower'}")
    return _cell(formatting.seconds(origin["seconds"]), *parts)


def _efficiency_cell(scene_report: SceneReport, line: ErrorCurve) -> dict[str, Any]:
    found, first = line.steps[-1].efficiency(), scene_report.lines[0].steps[-1].efficiency()
    if found is None:
        return _cell("–")
    ratio = (
        f"{formatting.times(found.mean / first.mean)} that of the first"
        if first and line is not scene_report.lines[0]
        else ""
    )
    return _cell(formatting.number(found.mean), formatting.interval(found), ratio)


def _bias_cell(line: ErrorCurve) -> dict[str, Any]:
    if line.bias is None:
        return _cell("–", "one picture")
    share = f"light {100 * line.bias['share']:+.2g} %".replace("-", "−")
    if line.bias["biased"]:
        return _cell("biased", share, f"p {_chance(line.bias['chance'])}", tone="bad")
    if line.of is not None:
        return _cell("none found", share, f"p {_chance(line.bias['chance'])}", "a guess all the same")
    return _cell("none found", share, f"p {_chance(line.bias['chance'])}", tone="good")


def _chance(value: float) -> str:
    return "< 0.0001" if value < 1e-4 else f"= {value:.2g}"


def _step_row(line: ErrorCurve, step: Any, names: Sequence[str]) -> list[dict[str, Any]]:
    cells = [
        _cell(line.label),
        _cell("–" if step.spp is None else formatting.count(step.spp)),
        _cell(formatting.seconds(step.seconds)),
    ]
    for name in names:
        found = step.estimate(name)
        cells.append(_cell(formatting.number(found.mean), formatting.interval(found)))
    efficiency = step.efficiency()
    return [
        *cells,
        _cell("–")
        if efficiency is None
        else _cell(formatting.number(efficiency.mean), formatting.interval(efficiency)),
    ]


def _sheet(sheet: ImageStrip, main: str) -> dict[str, Any]:
    x, y, wide, high = sheet.place
    across, down = sheet.size
    frame = "; ".join(
        f"{name}: {100 * part / whole:.3f}%"
        for name, part, whole in (
            ("left", x, across),
            ("top", y, down),
            ("width", wide, across),
            ("height", high, down),
        )
    )
    panels = []
    for panel in sheet.panels:
        samples = "" if panel.step.spp is None else f"{formatting.count(panel.step.spp)} samples, "
        error = f"{NAMES[main]} {formatting.number(panel.step.errors[main][0])}"
        panels.append(
            {
                "label": panel.line.label,
                "caption": f"{samples}{formatting.seconds(panel.step.times[0])}, {error}",
                "crop": _data(panel.crop, "png"),
                "errors": _data(panel.errors, "png"),
            }
        )
    return {
        "about": f"Of every setting the run nearest to {formatting.seconds(sheet.seconds)}, where errors are largest: "
        f"{wide} × {high} pixels, enlarged. Times are told, since steps of samples do not meet exactly.",
        "whole": _data(sheet.whole, "png"),
        "crop": _data(sheet.crop, "png"),
        "side": 3 * wide,
        "frame": frame,
        "panels": panels,
        "low": formatting.number(sheet.scale[0], 1),
        "top": formatting.number(sheet.scale[1], 1),
    }


def _plot(figure: Figure, alt: str) -> dict[str, Any]:
    """The vector form, with the size in pixels that keeps its place while it loads."""
    text = figure[1].decode()
    wide, high = (float(text.partition(f'{name}="')[2].partition("pt")[0]) for name in ("width", "height"))
    return {"data": _data(figure[1], "svg+xml"), "alt": alt, "width": round(wide), "height": round(high)}


def _data(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _ramp() -> str:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return ", ".join(to_hex(colormaps[MAP](k / 8)) for k in range(9))


def _method(study: Study) -> list[str]:
    """What a reader must know to trust the figures."""
    seeds, steps = study.options["seeds"], ", ".join(map(formatting.count, study.options["spp"]))
    denoised = (
        "Denoised curves, of loose dashes and hollow marks, show the pictures of the same runs, denoised by what first "
        "surfaces are like (albedo and normals). Their times are those of the runs with these layers, and of denoising."
    )
    return [
        f"Each step ({steps} samples a pixel) was run {seeds} times with independent seeds. Times are those of sampling, "
        "without loading, building and compiling; a run that is thrown away goes before. Settings took turns.",
        "Errors are means over the runs, times medians. Bands and intervals are 95 %, Student's t of the logarithm. From "
        "relMSE, its trimmed form (without the 0.1 % of pixels that are furthest off) and MSE the reference's own variance is "
        "taken off; the other measures include it. PSNR and SSIM look at what a screen shows. HDR-FLIP "
        "is that of a step's first run.",
        "A slope is that of the straight line through the logarithms of error and samples; −1 is what independent samples "
        "give. The time to an error is read from the line over seconds, marked where that lies beyond the runs. Efficiency is "
        "1 / (variance × seconds) at the largest step, the variance relative to the reference's square + 0.01.",
        "Bias: the mean of the runs of the largest step differs from the reference by more than the spread of both explains, "
        "with a chance of less than 0.1 % otherwise. A dotted line is the error at which such a curve ends.",
        *((denoised,) if study.options["denoise"] else ()),
    ]


def _settings(scene_reports: Sequence[SceneReport]) -> str:
    """What ran, as a scene file would state it."""
    import yaml

    shown: dict[str, Any] = {}
    for scene_report in scene_reports:
        shown[scene_report.name] = {line.label: _listed(line.settings) for line in scene_report.lines if line.estimates}
    return yaml.safe_dump(shown, sort_keys=False, allow_unicode=True, width=100)


def _listed(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _listed(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_listed(item) for item in value]
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)
