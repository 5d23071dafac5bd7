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
from torchpt.reports.runs import Curve, Job, Measured, Run, Truth, film_size, from_file, from_runs
from torchpt.reports.statistics import Estimate, Fit, estimate, f_tail, fit, t_quantile
from torchpt.reports.study import ERRORS, Extra, Study, denoised_label

__all__ = [
    "SIGNIFICANCE",
    "Line",
    "Step",
    "Topic",
    "Verdict",
    "analyse",
    "bias_of",
    "check_files",
    "common_levels",
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
class Verdict:
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


def bias_of(runs: Sequence[Tensor], truth: Truth, more: float = 0.0) -> Verdict:
    """Test independent pictures ``(H, W, 3)`` of one setting against their reference.

    Args:
        runs: two or more.
        truth: the reference; a file without variances is taken to be exact.
        more: how many times the samples of all runs together the reference has, where that is known: it has seen rare bright
            paths of which the runs may have had none, so the runs' variance is not believed to be less than its own at as
            many samples.
    """
    high, wide = truth.image.shape[:2]
    grids = [count for count in _GRIDS if count == 1 or min(high, wide) >= 2 * count]
    chances: list[float] = []
    for known_by in (0.0, more):
        sides = [_compared(torch.stack([tiles(x, n) for x in runs]), *_known(truth, n), known_by) for n in grids]
        found = [chance for side in sides[1:] for chance in _of_squares(side)] + _of_sums(sides[0], sides[-1])
        chances = [max(pair) for pair in zip(chances, found, strict=True)] if chances else found
    chance = min(1.0, min(chances) * len(chances))
    stack = torch.stack(list(runs))
    mean, variance = stack.mean(0), stack.var(0) / len(runs)
    squared = float((((mean - truth.image).square() - variance - truth.variance) * truth.weight).mean())
    return Verdict(chance < SIGNIFICANCE, chance, squared, *_share(runs, truth))


def _known(truth: Truth, count: int) -> tuple[Tensor, Tensor, float]:
    """Tiles of the reference, the variance of each, and its degrees of freedom."""
    if len(truth.runs) > 1:
        own = torch.stack([tiles(run, count) for run in truth.runs])
        return own.mean(0), own.var(0) / len(own), len(own) - 1.0
    pixels = truth.image[..., 0].numel() / count**2
    return tiles(truth.image, count), tiles(truth.variance, count) / pixels, math.inf


@dataclass(frozen=True)
class _Side:
    """Tiles ``(C, tiles)`` of both: their difference, its variance with the degrees of freedom, and their weight."""

    away: Tensor
    variance: Tensor
    freedom: Tensor
    weight: Tensor


def _compared(own: Tensor, reference: Tensor, known: Tensor, freedom: float, more: float) -> _Side:
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


def _of_squares(side: _Side) -> list[float]:
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


def _of_sums(whole: _Side, fine: _Side) -> list[float]:
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


def _share(runs: Sequence[Tensor], truth: Truth) -> tuple[float, float, float]:
    """How much too bright the whole is, relative, with its interval (Welch)."""
    own = torch.stack([run.mean() for run in runs])
    light = float(truth.image.mean())
    if not light > 0:
        return 0.0, 0.0, 0.0
    spread = float(own.var()) / len(own)
    made = torch.stack([run.mean() for run in truth.runs]) if len(truth.runs) > 1 else None
    known = float(made.var()) / len(made) if made is not None else float(truth.variance.mean()) / truth.image.numel()
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


def error_map(image: Tensor, truth: Truth) -> Tensor:
    """``(x - r)² / (r² + 0.01)``, the mean of the channels: ``(H, W)``."""
    return metrics.error_map("relmse", image, truth.image)


def relmse(image: Tensor, truth: Truth) -> float:
    """Relative mean squared error without the reference's part."""
    return float((((image - truth.image).square() - truth.variance) * truth.weight).mean())


def relmse_trimmed(image: Tensor, truth: Truth) -> float:
    """The same without the 0.1 % of pixels that are furthest off (rounded down)."""
    found, own = error_map(image, truth).flatten(), (truth.variance * truth.weight).mean(-1).flatten()
    if not torch.isfinite(found).all():
        return math.nan
    return float((found - own)[metrics.trimmed(found)].mean())


def mse(image: Tensor, truth: Truth) -> float:
    """Mean squared error without the reference's part."""
    return float(((image - truth.image).square() - truth.variance).mean())


_SQUARED: dict[str, Callable[[Tensor, Truth], float]] = {
    "relmse": relmse,
    "relmse_trimmed": relmse_trimmed,
    "mse": mse,
}
_SHOWN = ("psnr", "ssim")


def measures(image: Tensor, truth: Truth, names: tuple[str, ...], film: Any) -> Mapping[str, float]:
    """The measures by name; NaN where one has no value, as SSIM of a picture smaller than its window.

    Args:
        image: ``(H, W, 3)`` float64, linear.
        truth: the reference.
        names: which.
        film: how a screen shows it (exposure, tonemap, gamma): what PSNR and SSIM look at.
    """
    found: dict[str, float] = {}
    plain = shown = image, truth.image
    if set(_SHOWN) & set(names):
        shown = colour.display(image, film.exposure, film.tonemap, film.gamma), truth.shown(film)
    for name in names:
        pair = shown if name in _SHOWN else plain
        try:
            found[name] = _SQUARED[name](image, truth) if name in _SQUARED else metrics.METRICS[name](*pair)
        except ValueError:
            found[name] = math.nan
    return found


# ---- What the runs of a study come to: errors, slopes, times to an error, efficiency, bias. All that the report says


#: Of the least error of a scene: a reference that is noisier than this share of it is worth a word.
_NOISY = 0.5
#: Measures that take longer than many a run, and hardly differ from one to the next: of the first run of a step only, but
#: where curves show them.
_DEAR = ("flip",)
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
class Line:
    """A curve of the report.

    Attributes:
        label: what it is called.
        steps: in the order of time.
        truth: what it is compared with.
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
    truth: Truth
    measured: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    of: Line | None = None
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
            "reference": {**self.truth.told, "relmse": self.truth.noise},
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
class Topic:
    """A scene of the report.

    Attributes:
        name: as it was asked for.
        lines: the curves.
        film: how a screen shows its pictures.
        targets: errors whose times are told.
        notes: what a reader should know.
    """

    name: str
    lines: list[Line]
    film: Any
    targets: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check_files(study: Study, prepared: Sequence[Measured]) -> None:
    """Read the files of references and extras once, before anything is rendered.

    Raises:
        AssetError: one that cannot be used.
    """
    for measured in prepared:
        for size in {film_size(curve.job.wishes) for curve in measured.curves}:
            if measured.name in study.reference.files:
                from_file(study.reference.files[measured.name], size)
        for extra in study.extras:
            if extra.scene == measured.name:
                _picture(extra, film_size(measured.curves[0].job.wishes))


def analyse(study: Study, measured: Measured) -> Topic:
    """All figures of one scene."""
    names, first = study.asked["metrics"], measured.curves[0]
    truths: dict[str, Truth] = {}

    def truth_of(curve: Curve) -> Truth:
        key = str(curve.truths[0].file) if curve.truths else repr(film_size(curve.job.wishes))
        if key not in truths:
            file = study.reference.files.get(measured.name, "")
            truths[key] = from_runs(curve.truths) if curve.truths else from_file(file, film_size(curve.job.wishes))
        return truths[key]

    topic = Topic(measured.name, [], first.job.wishes.film)
    for curve in measured.curves:
        line = _line(curve.variant.label, curve.job, curve.steps, truth_of(curve), names)
        topic.lines.append(line)
        if curve.denoised is not None:
            label = denoised_label(line.label)
            topic.lines.append(_line(label, curve.denoised, curve.denoised_steps, line.truth, names, line))
    topic.lines += _extra_lines(study, measured, truth_of(first), names)
    for look, line in enumerate(line for line in topic.lines if line.of is None):
        line.look = look
    for line in topic.lines:
        line.look = line.look if line.of is None else line.of.look
    main = names[0]
    topic.targets = list(study.asked["target"] or common_levels(topic.lines, main))
    for line in topic.lines:
        _fits(line, main, topic.targets)
    topic.notes = _notes(topic, main)
    return topic


def _line(
    label: str,
    job: Job,
    steps_of: Mapping[int, Sequence[Run]],
    truth: Truth,
    names: tuple[str, ...],
    of: Line | None = None,
) -> Line:
    film, steps = job.wishes.film, []
    images: list[Tensor] = []
    for spp, runs in steps_of.items():
        images = [run.image() for run in runs]
        steps.append(_step(spp, runs, images, truth, names, film))
        if of is not None:
            steps[-1].variance = []  # a guess that varies little is not better for it
    last, told = steps[-1], truth.told
    more = told["spp"] * told["seeds"] / ((last.spp or 1) * len(images)) if told["made"] else 0.0
    verdict = bias_of(images, truth, more)
    return Line(label, steps, truth, settings=job.facts["settings"], of=of, bias=verdict.plain())


def _step(
    spp: int, runs: Sequence[Run], images: Sequence[Tensor], truth: Truth, names: tuple[str, ...], film: Any
) -> Step:
    cheap = tuple(name for name in names if name not in _DEAR or name == names[0])
    found = [measures(image, truth, cheap if index else names, film) for index, image in enumerate(images)]
    mean, count = torch.stack(list(images)).mean(0), len(images)
    spread = [float(((image - mean).square() * truth.weight).mean()) * count / (count - 1) for image in images]
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


def _extra_lines(study: Study, measured: Measured, truth: Truth, names: tuple[str, ...]) -> list[Line]:
    """Other renderers' pictures: those of one name are one curve, of one time one step."""
    film, lines = measured.curves[0].job.wishes, {}
    for extra in sorted(study.extras, key=lambda extra: extra.seconds):
        if extra.scene != measured.name:
            continue
        image = _picture(extra, film_size(film))
        found = measures(torch.nan_to_num(image, 0.0, 0.0, 0.0), truth, names, film.film)
        bad = int((~torch.isfinite(image)).any(-1).sum())
        line = lines.setdefault(extra.name, Line(extra.name, [], truth, measured=False))
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


def common_levels(lines: Sequence[Line], main: str) -> tuple[float, ...]:
    """An error that all measured curves without bias come down to: the least of the worst of them."""
    measured = [line for line in lines if line.estimates]
    lines = [line for line in measured if not (line.bias and line.bias["biased"])] or measured
    least = [min((e.mean for s in line.steps if (e := s.estimate(main)).mean > 0), default=0.0) for line in lines]
    return (float(f"{max(least):.2g}"),) if least and max(least) > 0 else ()


def _fits(line: Line, main: str, targets: Sequence[float]) -> None:
    """Slopes over samples and seconds, and when the curve reaches each target: of denoised ones only within their runs."""
    values = [step.errors[main] for step in line.steps]
    if all(step.spp for step in line.steps):
        line.by_spp = fit([float(step.spp or 0) for step in line.steps], values)
    line.by_seconds = fit([step.seconds for step in line.steps], values)
    for target in targets:
        found = line.by_seconds.reach(math.log(target)) if line.by_seconds else None
        told: dict[str, Any] = {"error": target, "seconds": None}
        if found is not None:
            place, beyond = found
            inside = abs(place.mean - math.log(line.steps[0].seconds)) < _FARTHEST
            if beyond and line.of is not None:  # no line tells how a guess goes on
                pass
            elif beyond and line.floor >= target:  # it never gets there
                told["never"] = True
            elif inside or not beyond:
                bounds = [None if x is None else _exp(x) for x in (place.mean, place.low, place.high)]
                told |= dict(zip(("seconds", "low", "high"), bounds, strict=True)) | {"extrapolated": beyond}
        line.times.append(told)
    if line.of is not None:
        line.by_spp = line.by_seconds = None


def _exp(x: float) -> float | None:
    return math.exp(x) if x < 700 else None


def _notes(topic: Topic, main: str) -> list[str]:
    notes = []
    least = min((e.mean for line in topic.lines for s in line.steps if (e := s.estimate(main)).mean > 0), default=0.0)
    noise = max(line.truth.noise for line in topic.lines)
    if main.startswith("relmse") and noise > _NOISY * least:
        notes.append(
            f"The reference is noisy: its own relMSE is {noise:.2g}, the least error here {least:.2g}. "
            "A larger reference.spp or reference.seeds narrows the bands."
        )
    shortest = min(step.seconds for line in topic.lines if line.measured for step in line.steps)
    if shortest < _SHORT:
        notes.append(
            f"The shortest runs take {1e3 * shortest:.2g} ms, of which a part is the same for any number of samples: "
            "slopes over seconds come out too steep. A larger film, or steps of more samples, tell more."
        )
    told = topic.lines[0].truth.told
    if not told["made"] and not told["variance"]:
        notes.append(
            "The reference file says nothing of its variance, so it is taken to be exact; its noise counts as error."
        )
    drowned = [line.label for line in topic.lines if any(s.estimate(main).mean <= 0 for s in line.steps)]
    if any(line.of is not None for line in topic.lines):
        notes.append(
            "Denoised pictures are guesses: they are biased by an amount that falls with samples by no known law. So their "
            "curves have no slope and no efficiency, and no time to an error beyond their runs."
        )
    if drowned:
        notes.append(
            f"Some steps lie below what the reference can tell and are left out of curves: {', '.join(drowned)}."
        )
    return notes
