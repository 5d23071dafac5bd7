"""Render the page of a study: its pictures and tables in one HTML file."""

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

__all__ = ["Figure", "ImageStrip", "Panel", "closest_step", "image_strip_of", "largest_errors", "page"]


# ---- Pictures of the report: crops at equal time, where errors are largest, and maps of the errors


#: Largest side of a map in pixels; larger maps are averaged over squares.
_LONGEST_SIDE = 400
#: A crop has 1 / _CROP_PART of the picture's smaller side, but at least _LEAST_CROP and at most _LARGEST_CROP pixels, which are
#: shown _ENLARGED times as large.
_CROP_PART, _LEAST_CROP, _LARGEST_CROP, _ENLARGED = 5, 16, 64, 3
#: Quantiles of errors that the colour map spans, and its largest number of decades.
_LOW_QUANTILE, _TOP_QUANTILE, _MOST_DECADES = 0.1, 0.995, 4
#: Colours of the key to the colour map, evenly along it.
_RAMP_COLOURS = 9


@dataclass
class Panel:
    """One curve at the common time.

    Attributes:
        line: the curve.
        step: its step whose time is closest to the common one.
        crop: PNG of the cropped picture of the step's first run.
        errors: PNG of the error map of that picture.
    """

    line: ErrorCurve
    step: Step
    crop: bytes
    errors: bytes


@dataclass
class ImageStrip:
    """The pictures of a scene.

    Attributes:
        seconds: the common time.
        place: x, y, width and height of the crop in pixels.
        whole: PNG of the reference.
        crop: PNG of the cropped reference.
        size: width and height of the picture in pixels.
        panels: one for each curve.
        scale: smallest and largest error of the colour map.
    """

    seconds: float
    place: tuple[int, int, int, int]
    whole: bytes
    crop: bytes
    size: tuple[int, int]
    panels: list[Panel]
    scale: tuple[float, float]


def closest_step(line: ErrorCurve, seconds: float) -> Step:
    """Return the step of a curve whose time is closest to ``seconds``, by ratio."""
    return min(line.steps, key=lambda step: abs(math.log(step.seconds / seconds)))


def largest_errors(errors: Tensor, side: int) -> tuple[int, int]:
    """Return x and y of the corner of the ``side``-pixel square with the largest errors in a map ``(H, W)``.

    Square roots of errors are summed, so that a single firefly does not decide.
    """
    sums = torch.nn.functional.avg_pool2d(errors.sqrt()[None, None], side, stride=1)[0, 0]
    y, x = divmod(int(sums.argmax()), sums.shape[1])
    return x, y


def image_strip_of(scene_report: SceneReport) -> ImageStrip | None:
    """Return pictures of all curves with the first one's film, at the longest time that all of them have.

    The position of the crop does not depend on denoised curves.
    """
    reference, film = scene_report.lines[0].reference, scene_report.film
    lines = [line for line in scene_report.lines if line.reference.image.shape == reference.image.shape]
    seconds = min(line.steps[-1].seconds for line in lines)
    chosen = [closest_step(line, seconds) for line in lines]
    # `pictures` are functions that load the pictures of the runs; the first run is shown.
    images = [torch.nan_to_num(step.pictures[0](), nan=0.0, posinf=0.0, neginf=0.0) for step in chosen]
    maps = [error_map(image, line.reference) for image, line in zip(images, lines, strict=True)]
    height, width = maps[0].shape
    side = min(max(min(height, width) // _CROP_PART, _LEAST_CROP), _LARGEST_CROP, height, width)
    rendered = [found for found, line in zip(maps, lines, strict=True) if line.denoised_from is None]
    x, y = largest_errors(torch.stack(rendered).mean(0), side)
    smaller = [_reduced(found) for found in maps]
    scale = _scale(smaller)
    panels = [
        Panel(
            line=line,
            step=step,
            crop=_png(_display_bytes(image[y : y + side, x : x + side], film)),
            errors=_png(_coloured(found, scale)),
        )
        for line, step, image, found in zip(lines, chosen, images, smaller, strict=True)
    ]
    whole = _png(_display_bytes(reference.image, film))
    crop = _png(_display_bytes(reference.image[y : y + side, x : x + side], film))
    return ImageStrip(
        seconds=seconds,
        place=(x, y, side, side),
        whole=whole,
        crop=crop,
        size=(width, height),
        panels=panels,
        scale=scale,
    )


def _display_bytes(image: Tensor, film: Any) -> np.ndarray:
    """Return a linear picture as 8-bit display values, by the exposure, tone map and gamma of the film."""
    levels = colour.display(image, film.exposure, film.tonemap, film.gamma)
    return (levels * 255 + 0.5).to(torch.uint8).numpy()


def _reduced(errors: Tensor) -> Tensor:
    """Return a map averaged over squares, so that no side is larger than _LONGEST_SIDE."""
    side = -(-max(errors.shape) // _LONGEST_SIDE)
    return torch.nn.functional.avg_pool2d(errors[None, None], side, ceil_mode=True)[0, 0]


def _scale(maps: Sequence[Tensor]) -> tuple[float, float]:
    """Return powers of ten that enclose the values between two quantiles, few decades at most."""
    values = torch.cat([found.flatten() for found in maps])
    values = values[values > 0].log10()
    if not len(values):
        return 1e-4, 1.0
    ordered = values.sort().values
    low, top = (float(ordered[int(share * (len(ordered) - 1))]) for share in (_LOW_QUANTILE, _TOP_QUANTILE))
    floor, ceiling = math.floor(low), math.ceil(top)
    return 10.0 ** max(floor, ceiling - _MOST_DECADES), 10.0 ** max(ceiling, floor + 1)


def _coloured(errors: Tensor, scale: tuple[float, float]) -> np.ndarray:
    """Return an error map in false colours, on a logarithmic scale."""
    low, top = (math.log10(x) for x in scale)
    level = (errors.clamp_min(1e-30).log10() - low) / (top - low)  # 0 to 1 between the ends; 1e-30: below any map
    return (false_colour(level, top=1.0).numpy() * 255 + 0.5).astype(np.uint8)


def _png(levels: np.ndarray) -> bytes:
    from PIL import Image

    encoded = BytesIO()
    Image.fromarray(levels).save(encoded, "PNG", optimize=True)
    return encoded.getvalue()


# ---- The page: self-contained HTML, without scripts


#: Characters for the markers of curves, and hollow ones for denoised curves.
_MARKS = "●■▲◆▼✚✖★"
_HOLLOW = "○□△◇▽✛✕☆"
#: A plot as PNG and as SVG.
Figure = tuple[bytes, bytes]


def page(
    study: Study,
    scene_reports: Sequence[SceneReport],
    sheets: Sequence[ImageStrip | None],
    plots: Sequence[dict[str, Figure]],
    made: str,
) -> str:
    """Return the text of ``report.html``.

    Args:
        study: the study.
        scene_reports: the analysed scenes.
        sheets: pictures of each scene.
        plots: figures of each scene: ``seconds``, ``spp`` (if it has one) and ``measures``.
        made: version, date and machine.
    """
    template = (Path(__file__).parent / "report.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(template).render(
        title=study.options["title"],
        made=made,
        ramp=_ramp(),
        scenes=[
            _scene(study, scene_report, sheet, figures)
            for scene_report, sheet, figures in zip(scene_reports, sheets, plots, strict=True)
        ],
        method=_method(study),
        settings=_settings(scene_reports),
    )


def _scene(
    study: Study, scene_report: SceneReport, sheet: ImageStrip | None, plots: dict[str, Figure]
) -> dict[str, Any]:
    """Return the values of the template for one scene."""
    names = study.options["metrics"]
    main, most = NAMES[names[0]], formatting.count(study.options["spp"][-1])  # first measure; samples of the last step
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
    """Return a sentence on the fastest unbiased setting and its lead, or that it is not significant; "" for a single one."""
    unbiased = [
        line for line in scene_report.lines if line.is_render_of_study and not (line.bias and line.bias["biased"])
    ]
    # Of each curve the time to the last target, the smallest error: its label, the seconds and their interval.
    timed = [(line.label, line.times[-1]) for line in unbiased if line.times and line.times[-1]["seconds"]]
    timed.sort(key=lambda item: item[1]["seconds"])
    if len(timed) < 2:
        return ""
    (first, fastest), (second, next_fastest), (last, slowest) = timed[0], timed[1], timed[-1]
    target, least = formatting.number(scene_report.targets[-1], 2), fastest["seconds"]
    if fastest["high"] is None or next_fastest["low"] is None or fastest["high"] >= next_fastest["low"]:
        return (
            f"These runs do not show whether {first} or {second} reaches {main} {target} first: "
            "more runs (seeds=) may show it."
        )
    text = f"{first} reaches {main} {target} first, in {formatting.seconds(least)}: "
    text += f"{formatting.times(next_fastest['seconds'] / least)} as fast as {second}"
    return (
        f"{text}." if len(timed) == 2 else f"{text}, {formatting.times(slowest['seconds'] / least)} as fast as {last}."
    )


def _about(scene_report: SceneReport) -> str:
    """Return sentences on the size of the picture and on the reference."""
    reference = scene_report.lines[0].reference
    height, width = reference.image.shape[:2]
    size = f"{width} × {height} pixels."
    if not reference.origin["made"]:  # not rendered by this study, but read from a file
        return f"{size} Reference: {reference.origin['file']}."
    origin, spp = reference.origin, formatting.count(reference.origin["spp"])
    return (
        f"{size} Reference: the mean of {origin['seeds']} independent runs of {spp} samples a pixel "
        f"({formatting.seconds(origin['seconds'])} in all); its noise (relMSE {formatting.number(reference.noise, 2)}) "
        "is subtracted from relMSE and MSE below."
    )


def _cell(text: str, *small: str, tone: str = "") -> dict[str, Any]:
    """Return a cell of a table: its text, smaller lines below it (empty ones are left out), and ``good``, ``bad`` or ""."""
    return {"text": text, "small": [line for line in small if line], "tone": tone}


def _row(scene_report: SceneReport, line: ErrorCurve, main: str) -> dict[str, Any]:
    """Return a curve's row of the summary; ``main`` is the first measure."""
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
    # A denoised curve has the style of the curve that it is made from, but hollow marks.
    colour, marks = COLOURS[line.style_index % len(COLOURS)], _MARKS if line.denoised_from is None else _HOLLOW
    return {"label": line.label, "mark": marks[line.style_index % len(marks)], "colour": colour, "cells": cells}


def _time_cell(scene_report: SceneReport, line: ErrorCurve, number: int) -> dict[str, Any]:
    """Return the time to target error ``number``, and how it compares with that of the first curve."""
    reached, first = line.times[number], scene_report.lines[0].times[number]
    if reached.get("never"):
        return _cell("never", "its bias is larger", tone="bad")
    if reached["seconds"] is None:
        # Denoised curves are not extrapolated; others are unless they do not fall, or the time is too far from the runs.
        reason = (
            "cannot be extrapolated" if line.by_seconds else "not reached in its runs" if line.denoised_from else ""
        )
        return _cell("–", reason)
    parts = [formatting.span(reached["low"], reached["high"]), "extrapolated" if reached["extrapolated"] else ""]
    if line is not scene_report.lines[0] and first["seconds"]:
        ratio = first["seconds"] / reached["seconds"]
        parts.insert(0, f"{formatting.times(max(ratio, 1 / ratio))} {'faster' if ratio >= 1 else 'slower'}")
    return _cell(formatting.seconds(reached["seconds"]), *parts)


def _efficiency_cell(scene_report: SceneReport, line: ErrorCurve) -> dict[str, Any]:
    found, first = line.steps[-1].efficiency(), scene_report.lines[0].steps[-1].efficiency()
    if found is None:
        return _cell("–")
    ratio = (
        f"{formatting.times(found.mean / first.mean)} that of the first setting"
        if first and line is not scene_report.lines[0]
        else ""
    )
    return _cell(formatting.number(found.mean), formatting.interval(found), ratio)


def _bias_cell(line: ErrorCurve) -> dict[str, Any]:
    if line.bias is None:
        return _cell("–", "a single picture")
    share = f"mean brightness {100 * line.bias['share']:+.2g} %".replace("-", "−")
    if line.bias["biased"]:
        return _cell("biased", share, f"p {_chance(line.bias['chance'])}", tone="bad")
    if line.denoised_from is not None:
        return _cell("none found", share, f"p {_chance(line.bias['chance'])}", "may be hidden by noise")
    return _cell("none found", share, f"p {_chance(line.bias['chance'])}", tone="good")


def _chance(value: float) -> str:
    """Return a p-value with its sign of comparison."""
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
    """Return the values of the template for the pictures of a scene; ``main``: the first measure."""
    # The frame of the crop, as CSS in percent of the whole picture.
    x, y, width, height = sheet.place
    picture_width, picture_height = sheet.size
    frame = "; ".join(
        f"{name}: {100 * part / whole:.3f}%"
        for name, part, whole in (
            ("left", x, picture_width),
            ("top", y, picture_height),
            ("width", width, picture_width),
            ("height", height, picture_height),
        )
    )
    panels = []
    for panel in sheet.panels:
        samples = "" if panel.step.spp is None else f"{formatting.count(panel.step.spp)} samples, "
        error = f"{NAMES[main]} {formatting.number(panel.step.errors[main][0])}"  # of the first run, which is shown
        panels.append(
            {
                "label": panel.line.label,
                "caption": f"{samples}{formatting.seconds(panel.step.times[0])}, {error}",
                "crop": _data(panel.crop, "png"),
                "errors": _data(panel.errors, "png"),
            }
        )
    return {
        "about": f"The run of each setting that is closest to {formatting.seconds(sheet.seconds)}, cropped to the "
        f"{width} × {height} pixels with the largest errors, enlarged. Times differ, as steps of samples do not match exactly.",
        "whole": _data(sheet.whole, "png"),
        "crop": _data(sheet.crop, "png"),
        "side": _ENLARGED * width,
        "frame": frame,
        "panels": panels,
        "low": formatting.number(sheet.scale[0], 1),
        "top": formatting.number(sheet.scale[1], 1),
    }


def _plot(figure: Figure, alt: str) -> dict[str, Any]:
    """Return an SVG and its size in pixels, which reserves its space while it loads."""
    _, svg = figure
    text = svg.decode()
    # Matplotlib writes width="352.8pt".
    width, height = (float(text.partition(f'{name}="')[2].partition("pt")[0]) for name in ("width", "height"))
    return {"data": _data(svg, "svg+xml"), "alt": alt, "width": round(width), "height": round(height)}


def _data(content: bytes, kind: str) -> str:
    """Return a picture as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _ramp() -> str:
    """Return colours of the colour map as CSS, for the key to error maps."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return ", ".join(to_hex(colormaps[MAP](k / (_RAMP_COLOURS - 1))) for k in range(_RAMP_COLOURS))


def _method(study: Study) -> list[str]:
    """Return paragraphs on the method of measurement, for the end of the page."""
    seeds, steps = study.options["seeds"], ", ".join(map(formatting.count, study.options["spp"]))
    denoised = (
        "Denoised curves (loose dashes, hollow markers) show the pictures of the same runs, denoised with albedo and normals "
        "of first surfaces. Their times are those of the runs with these layers, and of denoising."
    )
    return [
        f"Each step ({steps} samples a pixel) was run {seeds} times with independent seeds. Times are of sampling alone, "
        "without loading, building and compiling, after a warm-up run. Runs of different settings are interleaved.",
        "Errors are means over the runs, times are medians. Bands and intervals are 95 % (Student's t of the logarithm). The "
        "variance of the reference is subtracted from relMSE, its trimmed form (without the 0.1 % of pixels with the largest "
        "errors) and MSE; other measures include it. PSNR and SSIM compare displayed pictures. HDR-FLIP is of each step's "
        "first run.",
        "A slope is of the straight line through the logarithms of error and samples; independent samples give −1. The time to "
        "an error is read from the line over seconds, and marked as extrapolated if it lies outside of the runs. Efficiency is "
        "1 / (variance × seconds) at the largest step, with the variance relative to the reference's square + 0.01.",
        "Biased: the mean over the runs of the largest step differs from the reference by more than their variances explain "
        "(p < 0.1 %). A dotted line in a plot is the error that a biased setting keeps however many samples it takes.",
        *((denoised,) if study.options["denoise"] else ()),
    ]


def _settings(scene_reports: Sequence[SceneReport]) -> str:
    """Return the complete settings as YAML, of the curves that the study rendered."""
    import yaml

    shown: dict[str, Any] = {}
    for scene_report in scene_reports:
        shown[scene_report.name] = {
            line.label: _listed(line.settings) for line in scene_report.lines if line.is_render_of_study
        }
    return yaml.safe_dump(shown, sort_keys=False, allow_unicode=True, width=100)


def _listed(value: Any) -> Any:
    """Return a value for YAML: tuples as lists, infinity and NaN as text."""
    if isinstance(value, dict):
        return {key: _listed(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_listed(item) for item in value]
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)
