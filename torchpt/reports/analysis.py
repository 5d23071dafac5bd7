"""What runs come to: errors against a reference, tests for bias, rates, tables."""

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
from torchpt.reports.statistics import Estimate, Fit, estimate, f_tail, fit, t_quantile
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


# ---- Whether pictures converge to their reference: is the error of their mean more than chance explains?
#
# The picture is cut into tiles, since a mean over many pixels is nearly normal where a pixel is not, and independent runs give
# a variance of each tile's mean. Without bias
#
#     F = Σ w (mean of runs - reference)² / Σ w (variance of that mean + variance of the reference)
#
# has expectation 1 and nearly the distribution of Fisher's F, whose degrees of freedom follow from the variances (Box 1954,
# *Some theorems on quadratic forms*, theorem 3.1; Satterthwaite 1946). It finds what is moved from place to place; light that
# is lost everywhere shows sooner in the mean over the picture. A firefly does not alarm either: it raises both sums.
#
# All channels and sizes of tiles are tested; the least chance among them, times their number (Bonferroni), is the verdict's.


#: A right renderer is flagged with at most this chance.
SIGNIFICANCE = 1e-3
#: Tiles along each side.
_GRIDS = (1, 4, 16)
#: Share of a value by which equal pictures may differ in rounding.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class BiasTest:
    """What the test found.

    Attributes:
        biased: whether chance is ruled out.
        chance: of a difference at least as large without bias.
        squared: the mean picture's relative squared error beyond what variance explains: where the error curve ends.
        share: of the picture's light that is too much (negative: missing), with its 95 % interval.
        low: see ``share``.
        high: see ``share``.
    """

    biased: bool
    chance: float
    squared: float
    share: float
    low: float
    high: float

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def tiles(image: Tensor, count: int) -> Tensor:
    """Means over ``count x count`` parts of a picture ``(H, W, C)``, no pixel in two of them: ``(C, count²)``."""
    high, wide, channels = image.shape
    rows, columns = torch.arange(high) * count // high, torch.arange(wide) * count // wide
    cells = (rows[:, None] * count + columns).flatten()
    sums = torch.zeros(channels, count * count, dtype=image.dtype).index_add_(1, cells, image.movedim(-1, 0).flatten(1))
    return sums / torch.bincount(cells, minlength=count * count)


def bias_test(runs: Sequence[Tensor], reference: ReferencePicture, more: float = 0.0) -> BiasTest:
    """Test independent pictures ``(H, W, 3)`` of one setting against their reference.

    Args:
        runs: two or more.
        reference: the reference; a file without variances is taken to be exact.
        more: how many times the samples of all runs together the reference has, where that is known: it has seen rare bright
            paths of which the runs may have had none, so the runs' variance is not believed to be less than its own at as
            many samples.
    """
    high, wide = reference.image.shape[:2]
    grids = [count for count in _GRIDS if count == 1 or min(high, wide) >= 2 * count]
    chances: list[float] = []
    for known_by in (0.0, more):
        sides = [
            _difference(torch.stack([tiles(x, n) for x in runs]), *_reference_tiles(reference, n), known_by)
            for n in grids
        ]
        found = [chance for side in sides[1:] for chance in _p_values_of_f(side)] + _p_values_of_means(
            sides[0], sides[-1]
        )
        chances = [max(pair) for pair in zip(chances, found, strict=True)] if chances else found
    chance = min(1.0, min(chances) * len(chances))
    stack = torch.stack(list(runs))
    mean, variance = stack.mean(0), stack.var(0) / len(runs)
    squared = float((((mean - reference.image).square() - variance - reference.variance) * reference.weight).mean())
    return BiasTest(chance < SIGNIFICANCE, chance, squared, *_share(runs, reference))


def _reference_tiles(reference: ReferencePicture, count: int) -> tuple[Tensor, Tensor, float]:
    """Tiles of the reference, the variance of each, and its degrees of freedom."""
    if len(reference.runs) > 1:
        own = torch.stack([tiles(run, count) for run in reference.runs])
        return own.mean(0), own.var(0) / len(own), len(own) - 1.0
    pixels = reference.image[..., 0].numel() / count**2
    return tiles(reference.image, count), tiles(reference.variance, count) / pixels, math.inf


@dataclass(frozen=True)
class _Side:
    """Tiles ``(C, tiles)`` of both: their difference, its variance with the degrees of freedom, and their weight."""

    away: Tensor
    variance: Tensor
    freedom: Tensor
    weight: Tensor


def _difference(own: Tensor, reference: Tensor, known: Tensor, freedom: float, more: float) -> _Side:
    """``own`` is ``(runs, C, tiles)``; with ``more`` the variance is all the reference's."""
    count, rounding = len(own), (_ROUNDING * reference.abs()).square()
    if more > 0:
        total = (1.0 + more) * known + rounding
        return _Side(own.mean(0) - reference, total, torch.full_like(total, freedom), relative(1.0, reference))
    spread = own.var(0) / count + rounding
    total = spread + known
    freedoms = total.square() / (spread.square() / (count - 1.0) + known.square() / freedom).clamp_min(1e-300)
    freedoms = freedoms.clamp_min(min(count - 1.0, freedom))  # never less; black in all, it would be 0 of 0
    return _Side(own.mean(0) - reference, total, freedoms, relative(1.0, reference))


def _p_values_of_f(side: _Side) -> list[float]:
    """The chance of each channel's F."""
    found = []
    for x, u, d, w in zip(side.away, side.variance, side.freedom, side.weight, strict=True):
        explained = w * u
        if not float(explained.sum()) > 0:  # black in every run and in the reference
            found.append(0.0 if float(x.abs().max()) > 0 else 1.0)
            continue
        squares = (explained.square() * d / (d + 2.0)).sum()  # u² alone is too large by what u itself varies
        upper = (explained.sum().square() / squares).clamp(1.0, float(len(x)))
        ratio = (w * x.square()).sum() / explained.sum()
        found.append(f_tail(float(ratio), float(upper), _freedom(explained, d)))
    return found


def _p_values_of_means(whole: _Side, fine: _Side) -> list[float]:
    """The chance of each channel's mean over the picture.

    Its variance is known twice: from how the runs' means spread, by few degrees of freedom, and from tiles, by many, where
    those are independent. The larger one counts.
    """
    found = []
    for x, u, parts, d in zip(whole.away, whole.variance, fine.variance, fine.freedom, strict=True):
        pooled = float(parts.sum()) / len(parts) ** 2
        variance = max(float(u), pooled)
        if not variance > 0:
            found.append(0.0 if float(x.abs()) > 0 else 1.0)
            continue
        found.append(f_tail(float(x.square()) / variance, 1.0, _freedom(parts, d)))
    return found


def _freedom(parts: Tensor, freedom: Tensor) -> float:
    """Of a sum of variances (Satterthwaite)."""
    return min(float(parts.sum().square() / (parts.square() / freedom).sum().clamp_min(1e-300)), 1e5)


def _share(runs: Sequence[Tensor], reference: ReferencePicture) -> tuple[float, float, float]:
    """How much too bright the whole is, relative, with its interval (Welch)."""
    own = torch.stack([run.mean() for run in runs])
    light = float(reference.image.mean())
    if not light > 0:
        return 0.0, 0.0, 0.0
    spread = float(own.var()) / len(own)
    made = torch.stack([run.mean() for run in reference.runs]) if len(reference.runs) > 1 else None
    known = (
        float(made.var()) / len(made)
        if made is not None
        else float(reference.variance.mean()) / reference.image.numel()
    )
    share = float(own.mean()) / light - 1.0
    total = spread + known
    if total == 0:
        return share, share, share
    rest = known**2 / (len(made) - 1.0) if made is not None else 0.0
    freedom = min(total**2 / max(spread**2 / (len(own) - 1.0) + rest, 1e-300), 1e6)
    reach = t_quantile(freedom) * math.sqrt(total) / light
    return share, share - reach, share + reach


# ---- The measures of one picture against a reference that is noisy itself
#
# Of a picture x and a reference r that are independent, ``E (x - r)² = var x + var r + bias²``. The second is known by pixel
# and taken off, so that what is left is the picture's own error (and may, by chance, be negative where that is small).


def error_map(image: Tensor, reference: ReferencePicture) -> Tensor:
    """``(x - r)² / (r² + 0.01)``, the mean of the channels: ``(H, W)``."""
    return metrics.error_map("relmse", image, reference.image)


def relmse(image: Tensor, reference: ReferencePicture) -> float:
    """Relative mean squared error without the reference's part."""
    return float((((image - reference.image).square() - reference.variance) * reference.weight).mean())


def relmse_trimmed(image: Tensor, reference: ReferencePicture) -> float:
    """The same without the 0.1 % of pixels that are furthest off (rounded down)."""
    found, own = error_map(image, reference).flatten(), (reference.variance * reference.weight).mean(-1).flatten()
    if not torch.isfinite(found).all():
        return math.nan
    return float((found - own)[metrics.trimmed(found)].mean())


def mse(image: Tensor, reference: ReferencePicture) -> float:
    """Mean squared error without the reference's part."""
    return float(((image - reference.image).square() - reference.variance).mean())


_SQUARED: dict[str, Callable[[Tensor, ReferencePicture], float]] = {
    "relmse": relmse,
    "relmse_trimmed": relmse_trimmed,
    "mse": mse,
}
_SHOWN = ("psnr", "ssim")


def measures(image: Tensor, reference: ReferencePicture, names: tuple[str, ...], film: Any) -> Mapping[str, float]:
    """The measures by name; NaN where one has no value, as SSIM of a picture smaller than its window.

    Args:
        image: ``(H, W, 3)`` float64, linear.
        reference: the reference.
        names: which.
        film: how a screen shows it (exposure, tonemap, gamma): what PSNR and SSIM look at.
    """
    found: dict[str, float] = {}
    plain = shown = image, reference.image
    if set(_SHOWN) & set(names):
        shown = colour.display(image, film.exposure, film.tonemap, film.gamma), reference.shown(film)
    for name in names:
        pair = shown if name in _SHOWN else plain
        try:
            found[name] = _SQUARED[name](image, reference) if name in _SQUARED else metrics.METRICS[name](*pair)
        except ValueError:
            found[name] = math.nan
    return found


# ---- What the runs of a study come to: errors, slopes, times to an error, efficiency, bias. All that the report says


#: Of the least error of a scene: a reference that is noisier than this share of it is worth a word.
_NOISY = 0.5
#: Measures that take longer than many a run, and hardly differ from one to the next: of the first run of a step only, but
#: where curves show them.
_EXPENSIVE = ("flip",)
#: Runs of fewer seconds are mostly beginning and end.
_SHORT = 0.05
#: How far a line is followed: the logarithm of a ratio of times to the first step's.
_FARTHEST = math.log(1e6)


@dataclass
class Step:
    """The runs of one number of samples.

    Attributes:
        spp: samples a pixel; None where an extra does not say.
        seconds: the median of its runs.
        errors: measure to the value of each run; of some measures only the first run's.
        nonfinite: samples that were NaN or infinite.
        variance: of a pixel, relative to ``ref² + 0.01``; each run's part, whose mean it is.
        pictures: makes the picture of each run.
        times: of each run, in seconds.
        seeds: of each run.
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
        """The mean over runs of a measure."""
        return estimate(self.errors[name], positive=name in ERRORS)

    def efficiency(self) -> Estimate | None:
        """``1 / (variance x seconds)``."""
        if len(self.variance) < 2:
            return None
        spread = estimate(self.variance)
        bounds = (1.0 / (x * self.seconds) if x else None for x in (spread.mean, spread.high, spread.low))
        middle, low, high = bounds
        return None if middle is None else Estimate(middle, low, high)


@dataclass
class ErrorCurve:
    """A curve of the report.

    Attributes:
        label: what it is called.
        steps: in the order of time.
        reference: what it is compared with.
        measured: whether these are runs of a study; else pictures that others made.
        settings: complete, of a study's runs.
        of: the curve whose runs' pictures these are, denoised; else None. They are guesses: no slope, no efficiency.
        look: number of its colour and mark; that of ``of`` where there is one.
        by_spp: the line through its errors over samples.
        by_seconds: the same over seconds.
        bias: the verdict of the bias test.
        times: error to where the curve reaches it.
    """

    label: str
    steps: list[Step]
    reference: ReferencePicture
    measured: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    of: ErrorCurve | None = None
    look: int = 0
    by_spp: Fit | None = None
    by_seconds: Fit | None = None
    bias: dict[str, Any] | None = None
    times: list[dict[str, Any]] = field(default_factory=list)

    @property
    def estimates(self) -> bool:
        """Whether these are what a renderer of a study gave: neither others' pictures nor denoised ones."""
        return self.measured and self.of is None

    @property
    def floor(self) -> float:
        """The error at which the curve ends; 0 where no bias was found. That of a denoised one still falls with samples."""
        return self.bias["squared"] if self.estimates and self.bias and self.bias["biased"] else 0.0

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "label": self.label,
            "measured": self.measured,
            "denoised": self.of is not None,
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
        name: as it was asked for.
        lines: the curves.
        film: how a screen shows its pictures.
        targets: errors whose times are told.
        notes: what a reader should know.
    """

    name: str
    lines: list[ErrorCurve]
    film: Any
    targets: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check_files(study: Study, prepared: Sequence[Measured]) -> None:
    """Read the files of references and extras once, before anything is rendered.

    Raises:
        AssetError: one that cannot be used.
    """
    for measured in prepared:
        for size in {film_size(curve.job.settings) for curve in measured.curves}:
            if measured.name in study.reference.files:
                from_file(study.reference.files[measured.name], size)
        for extra in study.extras:
            if extra.scene == measured.name:
                _picture(extra, film_size(measured.curves[0].job.settings))


def analyse(study: Study, measured: Measured) -> SceneReport:
    """All figures of one scene."""
    names, first = study.options["metrics"], measured.curves[0]
    truths: dict[str, ReferencePicture] = {}

    def truth_of(curve: Curve) -> ReferencePicture:
        key = str(curve.truths[0].file) if curve.truths else repr(film_size(curve.job.settings))
        if key not in truths:
            file = study.reference.files.get(measured.name, "")
            truths[key] = from_runs(curve.truths) if curve.truths else from_file(file, film_size(curve.job.settings))
        return truths[key]

    scene_report = SceneReport(measured.name, [], first.job.settings.film)
    for curve in measured.curves:
        line = _line(curve.variant.label, curve.job, curve.steps, truth_of(curve), names)
        scene_report.lines.append(line)
        if curve.denoised is not None:
            label = denoised_label(line.label)
            scene_report.lines.append(_line(label, curve.denoised, curve.denoised_steps, line.reference, names, line))
    scene_report.lines += _extra_lines(study, measured, truth_of(first), names)
    for look, line in enumerate(line for line in scene_report.lines if line.of is None):
        line.look = look
    for line in scene_report.lines:
        line.look = line.look if line.of is None else line.of.look
    main = names[0]
    scene_report.targets = list(study.options["target"] or common_targets(scene_report.lines, main))
    for line in scene_report.lines:
        _fits(line, main, scene_report.targets)
    scene_report.notes = _notes(scene_report, main)
    return scene_report


def _line(
    label: str,
    job: Job,
    steps_of: Mapping[int, Sequence[Run]],
    reference: ReferencePicture,
    names: tuple[str, ...],
    of: ErrorCurve | None = None,
) -> ErrorCurve:
    film, steps = job.settings.film, []
    images: list[Tensor] = []
    for spp, runs in steps_of.items():
        images = [run.image() for run in runs]
        steps.append(_step(spp, runs, images, reference, names, film))
        if of is not None:
            steps[-1].variance = []  # a guess that varies little is not better for it
    last, origin = steps[-1], reference.origin
    more = origin["spp"] * origin["seeds"] / ((last.spp or 1) * len(images)) if origin["made"] else 0.0
    verdict = bias_test(images, reference, more)
    return ErrorCurve(label, steps, reference, settings=job.facts["settings"], of=of, bias=verdict.plain())


def _step(
    spp: int,
    runs: Sequence[Run],
    images: Sequence[Tensor],
    reference: ReferencePicture,
    names: tuple[str, ...],
    film: Any,
) -> Step:
    cheap = tuple(name for name in names if name not in _EXPENSIVE or name == names[0])
    found = [measures(image, reference, cheap if index else names, film) for index, image in enumerate(images)]
    mean, count = torch.stack(list(images)).mean(0), len(images)
    spread = [float(((image - mean).square() * reference.weight).mean()) * count / (count - 1) for image in images]
    return Step(
        spp,
        median(run.seconds for run in runs),
        {name: [item[name] for item in found if name in item] for name in names},
        sum(run.facts["nonfinite_samples"] for run in runs),
        spread,
        [run.image for run in runs],
        [run.seconds for run in runs],
        [run.facts["seed"] for run in runs],
    )


def _extra_lines(
    study: Study, measured: Measured, reference: ReferencePicture, names: tuple[str, ...]
) -> list[ErrorCurve]:
    """Other renderers' pictures: those of one name are one curve, of one time one step."""
    film, lines = measured.curves[0].job.settings, {}
    for extra in sorted(study.extras, key=lambda extra: extra.seconds):
        if extra.scene != measured.name:
            continue
        image = _picture(extra, film_size(film))
        found = measures(torch.nan_to_num(image, 0.0, 0.0, 0.0), reference, names, film.film)
        bad = int((~torch.isfinite(image)).any(-1).sum())
        line = lines.setdefault(extra.name, ErrorCurve(extra.name, [], reference, measured=False))
        step = next((s for s in line.steps if s.seconds == extra.seconds and s.spp == extra.spp), None)
        if step is None:
            step = Step(extra.spp, extra.seconds, {name: [] for name in names}, 0)
            line.steps.append(step)
        for name in names:
            step.errors[name].append(found[name])
        step.nonfinite += bad
        step.times.append(extra.seconds)
        step.pictures.append(lambda extra=extra: _picture(extra, film_size(film)))
    return list(lines.values())


def _picture(extra: Extra, size: tuple[int, int]) -> Tensor:
    image = read_image(extra.file)
    image = image.expand(-1, -1, 3) if image.shape[2] == 1 else image[..., :3]
    high, wide = image.shape[:2]
    if image.shape[2] != 3 or (wide, high) != size:
        raise AssetError(
            extra.file, f"expected a picture of {size[0]} x {size[1]} pixels as the film is, got {wide} x {high}"
        )
    return image.double()


def common_targets(lines: Sequence[ErrorCurve], main: str) -> tuple[float, ...]:
    """An error that all measured curves without bias come down to: the least of the worst of them."""
    measured = [line for line in lines if line.estimates]
    lines = [line for line in measured if not (line.bias and line.bias["biased"])] or measured
    least = [min((e.mean for s in line.steps if (e := s.estimate(main)).mean > 0), default=0.0) for line in lines]
    return (float(f"{max(least):.2g}"),) if least and max(least) > 0 else ()


def _fits(line: ErrorCurve, main: str, targets: Sequence[float]) -> None:
    """Slopes over samples and seconds, and when the curve reaches each target: of denoised ones only within their runs."""
    values = [step.errors[main] for step in line.steps]
    if all(step.spp for step in line.steps):
        line.by_spp = fit([float(step.spp or 0) for step in line.steps], values)
    line.by_seconds = fit([step.seconds for step in line.steps], values)
    for target in targets:
        found = line.by_seconds.reach(math.log(target)) if line.by_seconds else None
        origin: dict[str, Any] = {"error": target, "seconds": None}
        if found is not None:
            place, beyond = found
            inside = abs(place.mean - math.log(line.steps[0].seconds)) < _FARTHEST
            if beyond and line.of is not None:  # no line tells how a guess goes on
                pass
            elif beyond and line.floor >= target:  # it never gets there
                origin["never"] = True
            elif inside or not beyond:
                bounds = [None if x is None else _exp(x) for x in (place.mean, place.low, place.high)]
                origin |= dict(zip(("seconds", "low", "high"), bounds, strict=True)) | {"extrapolated": beyond}
        line.times.append(origin)
    if line.of is not None:
        line.by_spp = line.by_seconds = None


def _exp(x: float) -> float | None:
    return math.exp(x) if x < 700 else None


def _notes(scene_report: SceneReport, main: str) -> list[str]:
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
            f"The shortest runs take {1e3 * shortest:.2g} ms, of which a part is the same for any number of samples: "
            "slopes over seconds come out too steep. A larger film, or steps of more samples, tell more."
        )
    origin = scene_report.lines[0].reference.origin
    if not origin["made"] and not origin["variance"]:
        notes.append(
            "The reference file says nothing of its variance, so it is taken to be exact; its noise counts as error."
        )
    drowned = [line.label for line in scene_report.lines if any(s.estimate(main).mean <= 0 for s in line.steps)]
    if any(line.of is not None for line in scene_report.lines):
        notes.append(
            "Denoised pictures are guesses: they are biased by an amount that falls with samples by no known law. So their "
            "curves have no slope and no efficiency, and no time to an error beyond their runs."
        )
    if drowned:
        notes.append(
            f"Some steps lie below what the reference can tell and are left out of curves: {', '.join(drowned)}."
        )
    return notes
