"""Analyse the runs of a study: errors against a reference, bias tests, slopes, times to an error."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import AssetError
from torchpt.images import colour, metrics, read_image
from torchpt.images.metrics import relative
from torchpt.reports.runs import Curve, Job, Measured, ReferencePicture, Run, film_size, from_file, from_runs
from torchpt.reports.statistics import LARGEST_EXPONENT, Estimate, Fit, estimate, f_tail, fit, t_quantile
from torchpt.reports.study import ERRORS, Extra, Study, denoised_label

__all__ = [
    "SIGNIFICANCE",
    "BiasTest",
    "ErrorCurve",
    "SceneReport",
    "Step",
    "analyse",
    "bias_test",
    "check_files",
    "common_targets",
    "error_map",
    "measures",
    "mse",
    "relmse",
    "relmse_trimmed",
    "tiles",
]


# ---- Bias test: does the mean of the pictures differ from the reference by more than chance explains?
#
# Pictures are averaged over tiles, as a mean over many pixels is nearly normal; independent runs give the variance of
# each tile's mean. Without bias
#
#     F = Σ w (mean of runs - reference)² / Σ w (variance of that mean + variance of the reference)
#
# has expectation 1 and nearly the distribution of Fisher's F, whose degrees of freedom follow from the variances (Box 1954,
# *Some theorems on quadratic forms*, theorem 3.1; Satterthwaite 1946). F finds light that is moved within the picture; light
# lost everywhere shows sooner in the mean over the picture. A firefly raises both sums, and so is no false alarm.
#
# All channels and tile sizes are tested; the verdict is the smallest probability times their number (Bonferroni).


#: Largest probability of flagging an unbiased renderer.
SIGNIFICANCE = 1e-3
#: Tiles along each side.
_GRIDS = (1, 4, 16)
#: Relative difference of equal pictures by rounding.
_ROUNDING = 1e-6
#: Keeps quotients of variances finite where both are 0.
_TINY = 1e-300
#: Degrees of freedom that are as good as infinitely many, for F and for t.
_MANY_FOR_F, _MANY_FOR_T = 1e5, 1e6


@dataclass(frozen=True)
class BiasTest:
    """Result of the bias test.

    Attributes:
        biased: True if chance is ruled out.
        chance: probability of a difference at least as large without bias (p-value).
        squared: relative squared error of the mean picture beyond its variance: the error at which the curve ends.
        share: relative excess of light in the whole picture (negative: missing light), with its 95 % interval.
        low: lower bound of ``share``.
        high: upper bound of ``share``.
    """

    biased: bool
    chance: float
    squared: float
    share: float
    low: float
    high: float

    def plain(self) -> dict[str, Any]:
        """Return the fields, ready for JSON."""
        return asdict(self)


def tiles(image: Tensor, count: int) -> Tensor:
    """Return means ``(C, count²)`` over ``count x count`` disjoint tiles of a picture ``(H, W, C)``."""
    height, width, channels = image.shape
    rows, columns = torch.arange(height) * count // height, torch.arange(width) * count // width
    cells = (rows[:, None] * count + columns).flatten()  # index of each pixel's tile
    sums = torch.zeros(channels, count * count, dtype=image.dtype).index_add_(1, cells, image.movedim(-1, 0).flatten(1))
    return sums / torch.bincount(cells, minlength=count * count)


def bias_test(runs: Sequence[Tensor], reference: ReferencePicture, sample_ratio: float = 0.0) -> BiasTest:
    """Test independent pictures ``(H, W, 3)`` of one setting for bias against their reference.

    Args:
        runs: two or more pictures.
        reference: the reference; a file without variance counts as exact.
        sample_ratio: samples of the reference over those of all runs, if known (else 0). The reference has seen rare bright
            paths that the runs may have missed, so the variance of the runs is taken to be at least the reference's at as many
            samples.
    """
    height, width = reference.image.shape[:2]
    grids = [count for count in _GRIDS if count == 1 or min(height, width) >= 2 * count]
    chances: list[float] = []
    # Twice: with the variance of the runs (0), and with that of the reference. The larger probability of each test counts.
    for ratio in (0.0, sample_ratio):
        differences = [
            _tile_differences(torch.stack([tiles(x, n) for x in runs]), *_reference_tiles(reference, n), ratio)
            for n in grids
        ]
        whole, *finer = differences
        found = [chance for tile_differences in finer for chance in _p_values_of_f(tile_differences)]
        found += _p_values_of_means(whole, differences[-1])
        chances = [max(pair) for pair in zip(chances, found, strict=True)] if chances else found
    chance = min(1.0, min(chances) * len(chances))
    stack = torch.stack(list(runs))
    mean, variance = stack.mean(0), stack.var(0) / len(runs)
    squared = float((((mean - reference.image).square() - variance - reference.variance) * reference.weight).mean())
    share, low, high = _excess_of_light(runs, reference)
    return BiasTest(biased=chance < SIGNIFICANCE, chance=chance, squared=squared, share=share, low=low, high=high)


def _reference_tiles(reference: ReferencePicture, count: int) -> tuple[Tensor, Tensor, float]:
    """Return tiles of the reference, their variances, and the degrees of freedom of those."""
    if len(reference.runs) > 1:
        own = torch.stack([tiles(run, count) for run in reference.runs])
        return own.mean(0), own.var(0) / len(own), len(own) - 1.0
    pixels = reference.image[..., 0].numel() / count**2
    return tiles(reference.image, count), tiles(reference.variance, count) / pixels, math.inf


@dataclass(frozen=True)
class _TileDifferences:
    """Runs and reference compared tile by tile, ``(C, tiles)`` each.

    Attributes:
        difference: mean of the runs minus the reference.
        variance: variance of the difference.
        freedom: degrees of freedom of the variance.
        weight: weight that makes squared differences relative, ``1 / (ref² + 0.01)``.
    """

    difference: Tensor
    variance: Tensor
    freedom: Tensor
    weight: Tensor


def _tile_differences(
    tiles_of_runs: Tensor, reference: Tensor, reference_variance: Tensor, reference_freedom: float, sample_ratio: float
) -> _TileDifferences:
    """Compare the tiles of runs with those of the reference.

    Args:
        tiles_of_runs: ``(runs, C, tiles)``.
        reference: ``(C, tiles)``.
        reference_variance: variance of ``reference``.
        reference_freedom: degrees of freedom of that variance.
        sample_ratio: 0: the variance of the runs is that among them. Above 0: it is the reference's, times this ratio.
    """
    count, rounding = len(tiles_of_runs), (_ROUNDING * reference.abs()).square()
    difference, weight = tiles_of_runs.mean(0) - reference, relative(1.0, reference)
    if sample_ratio > 0:
        variance = (1.0 + sample_ratio) * reference_variance + rounding
        freedom = torch.full_like(variance, reference_freedom)
        return _TileDifferences(difference=difference, variance=variance, freedom=freedom, weight=weight)
    run_variance = tiles_of_runs.var(0) / count + rounding
    variance = run_variance + reference_variance
    parts = run_variance.square() / (count - 1.0) + reference_variance.square() / reference_freedom
    freedom = variance.square() / parts.clamp_min(_TINY)  # Satterthwaite
    freedom = freedom.clamp_min(min(count - 1.0, reference_freedom))  # the true lower bound; 0 / 0 for black tiles
    return _TileDifferences(difference=difference, variance=variance, freedom=freedom, weight=weight)


def _p_values_of_f(tile_differences: _TileDifferences) -> list[float]:
    """Return the p-value of each channel's F."""
    found = []
    # By channel, (tiles,) each: difference, variance, degrees of freedom, weight.
    rows = tile_differences.difference, tile_differences.variance, tile_differences.freedom, tile_differences.weight
    for x, u, d, w in zip(*rows, strict=True):
        explained = w * u
        if not float(explained.sum()) > 0:  # black in all runs and the reference
            found.append(0.0 if float(x.abs().max()) > 0 else 1.0)
            continue
        squares = (explained.square() * d / (d + 2.0)).sum()  # unbiased: E u² exceeds (E u)² by the variance of u
        upper = (explained.sum().square() / squares).clamp(
            1.0, float(len(x))
        )  # degrees of freedom of the numerator (Box)
        ratio = (w * x.square()).sum() / explained.sum()
        found.append(f_tail(float(ratio), float(upper), _freedom(explained, d)))
    return found


def _p_values_of_means(whole: _TileDifferences, fine: _TileDifferences) -> list[float]:
    """Return the p-value of each channel's mean over the picture.

    The variance is estimated twice: from the means of runs, with few degrees of freedom, and from tiles, with many, if those
    are independent. The larger estimate is used.
    """
    found = []
    # By channel: difference (1,) and its variance (1,), variances of the fine tiles (tiles,) and their degrees of freedom.
    for x, u, parts, d in zip(whole.difference, whole.variance, fine.variance, fine.freedom, strict=True):
        pooled = float(parts.sum()) / len(parts) ** 2
        variance = max(float(u), pooled)
        if not variance > 0:
            found.append(0.0 if float(x.abs()) > 0 else 1.0)
            continue
        found.append(f_tail(float(x.square()) / variance, 1.0, _freedom(parts, d)))
    return found


def _freedom(parts: Tensor, freedom: Tensor) -> float:
    """Return the degrees of freedom of a sum of variances (Satterthwaite)."""
    return min(float(parts.sum().square() / (parts.square() / freedom).sum().clamp_min(_TINY)), _MANY_FOR_F)


def _excess_of_light(runs: Sequence[Tensor], reference: ReferencePicture) -> tuple[float, float, float]:
    """Return the relative excess of light of the whole picture, with its interval (Welch)."""
    means = torch.stack([run.mean() for run in runs])
    light = float(reference.image.mean())
    if not light > 0:
        return 0.0, 0.0, 0.0
    variance = float(means.var()) / len(means)
    if len(reference.runs) > 1:
        reference_means = torch.stack([run.mean() for run in reference.runs])
        reference_variance = float(reference_means.var()) / len(reference_means)
        reference_part = reference_variance**2 / (len(reference_means) - 1.0)
    else:  # a file, whose variance counts as known
        reference_variance = float(reference.variance.mean()) / reference.image.numel()
        reference_part = 0.0
    share = float(means.mean()) / light - 1.0
    total = variance + reference_variance
    if total == 0:
        return share, share, share
    freedom = min(total**2 / max(variance**2 / (len(means) - 1.0) + reference_part, _TINY), _MANY_FOR_T)
    half_width = t_quantile(freedom) * math.sqrt(total) / light
    return share, share - half_width, share + half_width


# ---- Error measures against a noisy reference
#
# For independent picture x and reference r, ``E (x - r)² = var x + var r + bias²``. The variance of r is known by pixel and
# subtracted: the rest estimates the picture's own error (and may be negative by chance).


def error_map(image: Tensor, reference: ReferencePicture) -> Tensor:
    """Return ``(x - r)² / (r² + 0.01)``, averaged over channels: ``(H, W)``."""
    return metrics.error_map("relmse", image, reference.image)


def relmse(image: Tensor, reference: ReferencePicture) -> float:
    """Return relMSE without the variance of the reference."""
    return float((((image - reference.image).square() - reference.variance) * reference.weight).mean())


def relmse_trimmed(image: Tensor, reference: ReferencePicture) -> float:
    """Return relMSE without the 0.1 % of pixels with the largest errors (rounded down)."""
    errors = error_map(image, reference).flatten()
    reference_noise = (reference.variance * reference.weight).mean(-1).flatten()
    if not torch.isfinite(errors).all():
        return math.nan
    return float((errors - reference_noise)[metrics.trimmed(errors)].mean())


def mse(image: Tensor, reference: ReferencePicture) -> float:
    """Return MSE without the variance of the reference."""
    return float(((image - reference.image).square() - reference.variance).mean())


#: Measures from which the variance of the reference is subtracted.
_SQUARED: dict[str, Callable[[Tensor, ReferencePicture], float]] = {
    "relmse": relmse,
    "relmse_trimmed": relmse_trimmed,
    "mse": mse,
}
#: Measures of displayed pictures.
_SHOWN = ("psnr", "ssim")


def measures(image: Tensor, reference: ReferencePicture, names: tuple[str, ...], film: Any) -> Mapping[str, float]:
    """Return measures by name; NaN for one that is undefined, as SSIM of a picture smaller than its window.

    Args:
        image: ``(H, W, 3)`` float64, linear.
        reference: the reference.
        names: the measures.
        film: exposure, tonemap and gamma, for PSNR and SSIM of displayed pictures.
    """
    found: dict[str, float] = {}
    linear = displayed = image, reference.image
    if set(_SHOWN) & set(names):
        displayed = colour.display(image, film.exposure, film.tonemap, film.gamma), reference.shown(film)
    for name in names:
        pair = displayed if name in _SHOWN else linear
        try:
            found[name] = _SQUARED[name](image, reference) if name in _SQUARED else metrics.METRICS[name](*pair)
        except ValueError:
            found[name] = math.nan
    return found


# ---- The analysis of a study


#: A reference with a larger share of the least error of a scene is reported as noisy.
_NOISY = 0.5
#: Expensive measures that hardly differ between runs: evaluated for the first run of a step alone, unless curves show them.
_EXPENSIVE = ("flip",)
#: Runs of fewer seconds are mostly fixed cost.
_SHORT = 0.05
#: Largest extrapolation: logarithm of a ratio of times to the first step's.
_FARTHEST = math.log(1e6)


@dataclass
class Step:
    """The runs of one number of samples.

    Attributes:
        spp: samples a pixel; None if an extra picture does not have it.
        seconds: median time of the runs.
        errors: values of the runs by measure; of expensive measures that of the first run.
        nonfinite: number of samples that were NaN or infinite.
        variance: contribution of each run to the variance of a pixel relative to ``ref² + 0.01``, which is their mean.
        pictures: functions that return the picture of each run.
        times: seconds of each run.
        seeds: seed of each run.
    """

    spp: int | None
    seconds: float
    errors: dict[str, list[float]]
    nonfinite: int
    variance: list[float] = field(default_factory=list)
    pictures: list[Any] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)

    def estimate(self, name: str) -> Estimate:
        """Return the mean of a measure over runs."""
        return estimate(self.errors[name], positive=name in ERRORS)

    def efficiency(self) -> Estimate | None:
        """Return ``1 / (variance x seconds)``; None with fewer than two runs."""
        if len(self.variance) < 2:
            return None
        spread = estimate(self.variance)
        # The largest variance gives the least efficiency.
        bounds = (1.0 / (x * self.seconds) if x else None for x in (spread.mean, spread.high, spread.low))
        mean, low, high = bounds
        return None if mean is None else Estimate(mean, low=low, high=high)


@dataclass
class ErrorCurve:
    """A curve of the report.

    Attributes:
        label: name of the curve.
        steps: the steps in the order of time.
        reference: the reference.
        measured: True for runs of the study; False for other renderers' pictures.
        settings: complete settings of the study's runs.
        denoised_from: the curve that this one is denoised from; else None. A denoised curve has no slope and no efficiency.
        style_index: index of colour and marker; that of ``denoised_from`` for a denoised curve.
        by_spp: fit of error over samples.
        by_seconds: fit of error over seconds.
        bias: result of the bias test.
        times: for each target error, when the curve reaches it.
    """

    label: str
    steps: list[Step]
    reference: ReferencePicture
    measured: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    denoised_from: ErrorCurve | None = None
    style_index: int = 0
    by_spp: Fit | None = None
    by_seconds: Fit | None = None
    bias: dict[str, Any] | None = None
    times: list[dict[str, Any]] = field(default_factory=list)

    @property
    def is_render_of_study(self) -> bool:
        """True for pictures that a renderer of the study made: neither other renderers' nor denoised ones."""
        return self.measured and self.denoised_from is None

    @property
    def floor(self) -> float:
        """Error at which the curve ends; 0 if no bias was found. Denoised curves go on falling."""
        return self.bias["squared"] if self.is_render_of_study and self.bias and self.bias["biased"] else 0.0

    def plain(self) -> dict[str, Any]:
        """Return the curve, ready for JSON."""
        return {
            "label": self.label,
            "measured": self.measured,
            "denoised": self.denoised_from is not None,
            "settings": self.settings,
            "reference": {**self.reference.origin, "relmse": self.reference.noise},
            "slope_over_spp": asdict(self.by_spp.slope) if self.by_spp else None,
            "slope_over_seconds": asdict(self.by_seconds.slope) if self.by_seconds else None,
            "bias": self.bias,
            "times": self.times,
            "nonfinite_samples": sum(step.nonfinite for step in self.steps),
            "steps": [_step_plain(step) for step in self.steps],
        }


def _step_plain(step: Step) -> dict[str, Any]:
    efficiency = step.efficiency()
    return {
        "spp": step.spp,
        "seconds": step.seconds,
        "seconds_of_runs": step.times,
        "seeds": step.seeds,
        "nonfinite_samples": step.nonfinite,
        "variance": math.fsum(step.variance) / len(step.variance) if step.variance else None,
        "efficiency": asdict(efficiency) if efficiency else None,
        "errors": {name: {**asdict(step.estimate(name)), "runs": values} for name, values in step.errors.items()},
    }


@dataclass
class SceneReport:
    """A scene of the report.

    Attributes:
        name: name or path of the scene.
        lines: the curves.
        film: film settings, with which pictures are displayed.
        targets: errors for which times are reported.
        notes: remarks for the reader.
    """

    name: str
    lines: list[ErrorCurve]
    film: Any
    targets: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check_files(study: Study, prepared: Sequence[Measured]) -> None:
    """Read the files of references and extra pictures once, before anything is rendered.

    Raises:
        AssetError: a file cannot be used.
    """
    for measured in prepared:
        for size in {film_size(curve.job.settings) for curve in measured.curves}:
            if measured.name in study.reference.files:
                from_file(study.reference.files[measured.name], size)
        for extra in study.extras:
            if extra.scene == measured.name:
                _picture(extra, film_size(measured.curves[0].job.settings))


def analyse(study: Study, measured: Measured) -> SceneReport:
    """Analyse the runs of one scene."""
    names, first = study.options["metrics"], measured.curves[0]
    references: dict[str, ReferencePicture] = {}

    def reference_of(curve: Curve) -> ReferencePicture:
        runs, size = curve.reference_runs, film_size(curve.job.settings)
        key = str(runs[0].file) if runs else repr(size)
        if key not in references:
            file = study.reference.files.get(measured.name, "")
            references[key] = from_runs(runs) if runs else from_file(file, size)
        return references[key]

    scene_report = SceneReport(name=measured.name, lines=[], film=first.job.settings.film)
    for curve in measured.curves:
        line = _line(curve.variant.label, curve.job, curve.steps, reference_of(curve), names)
        scene_report.lines.append(line)
        if curve.denoised is not None:
            label = denoised_label(line.label)
            scene_report.lines.append(
                _line(label, curve.denoised, curve.denoised_steps, line.reference, names, denoised_from=line)
            )
    scene_report.lines += _extra_lines(study, measured, reference_of(first), names)
    for index, line in enumerate(line for line in scene_report.lines if line.denoised_from is None):
        line.style_index = index
    for line in scene_report.lines:
        if line.denoised_from is not None:
            line.style_index = line.denoised_from.style_index
    main = names[0]  # the first measure, which curves, targets and notes are about
    scene_report.targets = list(study.options["target"] or common_targets(scene_report.lines, main))
    for line in scene_report.lines:
        _fits(line, main, scene_report.targets)
    scene_report.notes = _notes(scene_report, main)
    return scene_report


def _line(
    label: str,
    job: Job,
    runs_by_spp: Mapping[int, Sequence[Run]],
    reference: ReferencePicture,
    names: tuple[str, ...],
    denoised_from: ErrorCurve | None = None,
) -> ErrorCurve:
    """Return a curve of the report from its runs by samples a pixel; ``names``: the measures."""
    film, steps = job.settings.film, []
    images: list[Tensor] = []
    for spp, runs in runs_by_spp.items():
        images = [run.image() for run in runs]
        steps.append(_step(spp, runs, images, reference, names, film))
        if denoised_from is not None:
            steps[-1].variance = []  # low variance does not make a denoised picture better
    last, origin = steps[-1], reference.origin  # `made`: rendered by this study, not read from a file
    ratio = origin["spp"] * origin["seeds"] / ((last.spp or 1) * len(images)) if origin["made"] else 0.0
    verdict = bias_test(images, reference, sample_ratio=ratio)  # of the last step
    return ErrorCurve(
        label,
        steps,
        reference,
        settings=job.facts["settings"],
        denoised_from=denoised_from,
        bias=verdict.plain(),
    )


def _step(
    spp: int,
    runs: Sequence[Run],
    images: Sequence[Tensor],
    reference: ReferencePicture,
    names: tuple[str, ...],
    film: Any,
) -> Step:
    """Return the step of runs of one number of samples; ``images`` are their pictures."""
    cheap = tuple(name for name in names if name not in _EXPENSIVE or name == names[0])
    found = [measures(image, reference, cheap if index else names, film) for index, image in enumerate(images)]
    mean, count = torch.stack(list(images)).mean(0), len(images)
    # Relative to ref² + 0.01; count / (count - 1) makes the mean of these unbiased (Bessel).
    variance = [float(((image - mean).square() * reference.weight).mean()) * count / (count - 1) for image in images]
    return Step(
        spp=spp,
        seconds=median(run.seconds for run in runs),
        errors={name: [item[name] for item in found if name in item] for name in names},
        nonfinite=sum(run.facts["nonfinite_samples"] for run in runs),
        variance=variance,
        pictures=[run.image for run in runs],
        times=[run.seconds for run in runs],
        seeds=[run.facts["seed"] for run in runs],
    )


def _extra_lines(
    study: Study, measured: Measured, reference: ReferencePicture, names: tuple[str, ...]
) -> list[ErrorCurve]:
    """Return curves of other renderers' pictures, grouped by name, and into steps by time."""
    settings, lines = measured.curves[0].job.settings, {}
    for extra in sorted(study.extras, key=lambda extra: extra.seconds):
        if extra.scene != measured.name:
            continue
        image = _picture(extra, film_size(settings))
        finite = torch.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)
        found = measures(finite, reference, names, settings.film)
        bad = int((~torch.isfinite(image)).any(-1).sum())
        line = lines.setdefault(extra.name, ErrorCurve(extra.name, [], reference, measured=False))
        step = next((s for s in line.steps if s.seconds == extra.seconds and s.spp == extra.spp), None)
        if step is None:
            step = Step(spp=extra.spp, seconds=extra.seconds, errors={name: [] for name in names}, nonfinite=0)
            line.steps.append(step)
        for name in names:
            step.errors[name].append(found[name])
        step.nonfinite += bad
        step.times.append(extra.seconds)
        step.pictures.append(lambda extra=extra: _picture(extra, film_size(settings)))
    return list(lines.values())


def _picture(extra: Extra, size: tuple[int, int]) -> Tensor:
    """Return another renderer's picture ``(H, W, 3)`` float64; ``size``: width and height that it must have."""
    image = read_image(extra.file)
    image = image.expand(-1, -1, 3) if image.shape[2] == 1 else image[..., :3]
    (height, width), (film_width, film_height) = image.shape[:2], size
    if image.shape[2] != 3 or (width, height) != size:
        expected = f"expected a picture of {film_width} x {film_height} pixels as the film is"
        raise AssetError(extra.file, f"{expected}, got {width} x {height}")
    return image.double()


def common_targets(lines: Sequence[ErrorCurve], main: str) -> tuple[float, ...]:
    """Return an error that all unbiased curves reach: the largest of their least errors."""
    measured = [line for line in lines if line.is_render_of_study]
    lines = [line for line in measured if not (line.bias and line.bias["biased"])] or measured
    least = [min((e.mean for s in line.steps if (e := s.estimate(main)).mean > 0), default=0.0) for line in lines]
    return (float(f"{max(least):.2g}"),) if least and max(least) > 0 else ()


def _fits(line: ErrorCurve, main: str, targets: Sequence[float]) -> None:
    """Fit slopes over samples and seconds, and find when the curve reaches each target; without extrapolation if denoised."""
    values = [step.errors[main] for step in line.steps]
    if all(step.spp for step in line.steps):
        line.by_spp = fit([float(step.spp or 0) for step in line.steps], values)
    line.by_seconds = fit([step.seconds for step in line.steps], values)
    for target in targets:
        found = line.by_seconds.x_at(math.log(target)) if line.by_seconds else None  # x: logarithm of seconds
        reached: dict[str, Any] = {"error": target, "seconds": None}
        if found is not None:
            log_seconds, is_extrapolated = found
            is_near = abs(log_seconds.mean - math.log(line.steps[0].seconds)) < _FARTHEST
            if is_extrapolated and line.denoised_from is not None:  # denoised curves are not extrapolated
                pass
            elif is_extrapolated and line.floor >= target:  # bias keeps the error above the target
                reached["never"] = True
            elif is_near or not is_extrapolated:
                logarithms = (log_seconds.mean, log_seconds.low, log_seconds.high)
                bounds = [None if x is None else _exp(x) for x in logarithms]
                reached |= dict(zip(("seconds", "low", "high"), bounds, strict=True))
                reached["extrapolated"] = is_extrapolated
        line.times.append(reached)
    if line.denoised_from is not None:
        line.by_spp = line.by_seconds = None


def _exp(x: float) -> float | None:
    """Return the exponential; None where a float cannot hold it."""
    return math.exp(x) if x < LARGEST_EXPONENT else None


def _notes(scene_report: SceneReport, main: str) -> list[str]:
    """Return remarks for the reader on what limits the results; ``main``: the first measure."""
    notes = []
    least = min(
        (e.mean for line in scene_report.lines for s in line.steps if (e := s.estimate(main)).mean > 0), default=0.0
    )
    noise = max(line.reference.noise for line in scene_report.lines)
    if main.startswith("relmse") and noise > _NOISY * least:
        notes.append(
            f"The reference is noisy: its own relMSE is {noise:.2g}, the least error here {least:.2g}. "
            "A larger reference.spp or reference.seeds narrows the bands."
        )
    shortest = min(step.seconds for line in scene_report.lines if line.measured for step in line.steps)
    if shortest < _SHORT:
        notes.append(
            f"The shortest runs take {1e3 * shortest:.2g} ms, part of which does not depend on the number of samples: slopes "
            "over seconds are too steep. Use a larger film, or steps of more samples."
        )
    origin = scene_report.lines[0].reference.origin
    if not origin["made"] and not origin["variance"]:
        notes.append("The reference file has no variance, so it is taken to be exact; its noise counts as error.")
    # Curves with steps whose error is not positive once the reference's variance is subtracted.
    drowned = [line.label for line in scene_report.lines if any(s.estimate(main).mean <= 0 for s in line.steps)]
    if any(line.denoised_from is not None for line in scene_report.lines):
        notes.append(
            "Denoised pictures are guesses: their bias falls with samples by no known law. So their curves have no slope, no "
            "efficiency, and no time to an error beyond their runs."
        )
    merged = [line.label for line in scene_report.lines if line.settings.get("integrator", {}).get("type") == "vcm"]
    if merged:
        notes.append(
            f"Pictures of vcm are consistent, not unbiased ({', '.join(merged)}): merges blur light within a radius that falls "
            "with samples, and so does the bias that the test may find."
        )
    if drowned:
        notes.append(
            f"Some steps have errors below the noise of the reference and are left out of curves: {', '.join(drowned)}."
        )
    return notes
