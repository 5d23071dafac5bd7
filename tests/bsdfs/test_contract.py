"""What every BSDF promises, over the table of models: a new one is tested the moment its file is there.

Each promise is tested as if the model broke it. Statistics are judged at one significance over the whole file (Šidák),
against float64 cubature of the model's own ``eval`` and ``pdf``, on float32 lanes as a render runs them.

All cases from all directions are slow tests, with a quarter of a million draws each: a million would find errors half the
size, and take an hour. One case of each model is fast. A test takes the cases of one model: its failure names the one that
broke the promise.
"""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import pytest
import torch
from cases import BUILDERS, Case, Values, cases_of, edges_of, lanes, leaves, tensors
from chi_square import Chart, Integral, SlopeChart, Tree, counts_p, integrate
from significance import SIGNIFICANCE, z_limit
from torch import Tensor

from torchpt.math.sampling import uniform_sphere
from torchpt.math.vectors import normalize
from torchpt.physics import bsdfs
from torchpt.physics.bsdfs.records import BsdfSample

ANGLES = (0.0, 30.0, 60.0, 85.0, 89.9)
AZIMUTH = 0.7  # of wo: on no axis, so that no anisotropy is hidden
FAST, FULL = 1 << 15, 1 << 18
LANES = 1 << 16

MODELS = bsdfs.variants()
CASES = [case for model in MODELS for case in cases_of(model)]
EDGES = [case for model in MODELS for case in edges_of(model)] + CASES


#: Variants whose first draws are slow tests, because a near relative's are fast: of the same lobes, and as many or more.
LATER = {
    "blend (blend (diffuse, conductor (schlick)), roughdielectric)",
    "principled (transmissive, transmits, refracts)",
    "roughdielectric (anisotropic)",
    "roughplastic",
}


def heavy(model: bsdfs.Bsdf) -> bool:
    """Energy tables of glass and of anisotropic facets take a second, their derivatives several."""
    return getattr(model, "energy_compensation", False) and (model.refracts or model.anisotropic)


def by_model(cases: list[Case], tables: bool = False, later: Collection[str] = ()) -> list[Any]:
    """Return lists of cases of one model as parameters: the first case is fast, the others together are slow.

    With ``tables`` that are asked for, the first of a heavy model is slow too, and of one whose variant has the same tables;
    those of models named ``later`` are slow in any case.
    """
    groups: dict[str, list[Case]] = {}
    for case in cases:
        groups.setdefault(str(case.model), []).append(case)
    slow, parameters = [pytest.mark.slow], []
    for name, (first, *others) in groups.items():
        late = name in later or (tables and (heavy(first.model) or name == "roughplastic"))
        parameters.append(pytest.param([first], marks=slow if late else [], id=name))
        if others:
            parameters.append(pytest.param(others, marks=slow, id=f"{name} others"))
    return parameters


def each(
    cases: list[Case], tables: bool = False, later: Collection[str] = ()
) -> Callable[[Callable[[Case], None]], Callable[[list[Case]], None]]:
    """Make a test of a check of one case, see :func:`by_model`."""

    def made(check: Callable[[Case], None]) -> Callable[[list[Case]], None]:
        @pytest.mark.parametrize("cases", by_model(cases, tables, later))
        def test(cases: list[Case]) -> None:
            for case in cases:
                with named(case):
                    check(case)

        test.__doc__ = check.__doc__
        return test

    return made


@contextmanager
def named(what: object) -> Iterator[None]:
    """Say which case an assertion failed for."""
    try:
        yield
    except AssertionError as error:
        error.add_note(f"of {what}")
        raise


def towards(angle: float, below: bool = False, azimuth: float = AZIMUTH) -> Tensor:
    """Unit direction ``(3, 1)`` float32 at ``angle`` degrees from the normal."""
    a = math.radians(angle)
    z = -math.cos(a) if below else math.cos(a)
    return torch.tensor([[math.sin(a) * math.cos(azimuth)], [math.sin(a) * math.sin(azimuth)], [z]])


def refracted(wo: Tensor, eta: float) -> Tensor | None:
    """Return where Snell sends a ray that comes from ``wo (3, 1)``; None where all is reflected."""
    ratio = 1 / eta if float(wo[2]) > 0 else eta
    cos2 = 1 - ratio**2 * (1 - float(wo[2]) ** 2)
    if cos2 <= 0:
        return None
    out = -ratio * wo
    out[2] = -math.copysign(math.sqrt(cos2), float(wo[2]))
    return out


def mirrored(w: Tensor) -> Tensor:
    return torch.stack((-w[0], -w[1], w[2]))


@dataclass(frozen=True)
class Setting:
    """One material seen from one direction."""

    case: Case
    angle: float
    below: bool
    full: bool

    def __str__(self) -> str:
        return f"{self.case} at {self.angle:g}{' below' if self.below else ''}{' full' if self.full else ''}"


def settings() -> Iterator[Setting]:
    """All of them are slow; of each model one case is fast, from one direction (and one from below), another for the next."""
    seen: set[str] = set()
    for i, case in enumerate(CASES):
        first = str(case.model) not in seen
        seen.add(str(case.model))
        for below in (False, True) if case.model.transmits else (False,):
            chosen = {ANGLES[(i + 3) % 5] if below else ANGLES[i % 5]} if first else set()
            for angle in ANGLES:
                if angle in chosen:
                    yield Setting(case, angle, below, False)
                yield Setting(case, angle, below, True)


SETTINGS = list(settings())
EACH = 1.0 - (1.0 - SIGNIFICANCE) ** (1.0 / max(len(SETTINGS), 1))  # Šidák
Z = z_limit(3 * max(len(SETTINGS), 1))


@dataclass(frozen=True)
class Half:
    """Bins on one side of the surface."""

    below: bool
    chart: Chart | SlopeChart
    tree: Tree
    integral: Integral
    density: Tensor  # of the leaves, roughly


class Experiment:
    """Draws of a material from one direction, and the integrals that they estimate."""

    def __init__(
        self, setting: Setting, number: int | None = None, drawn: Values | None = None, again: int = 0
    ) -> None:
        self.setting, self.case, self.model = setting, setting.case, setting.case.model
        # A lobe is narrower across, by the cosine, than along. Where it is so by a few units of float32's last place, its
        # shape is judged in float64.
        narrow = self.case.narrowest * math.cos(math.radians(setting.angle)) < 1e-6
        self.dtype = torch.float64 if narrow else torch.float32
        self.wo = towards(setting.angle, setting.below)
        if narrow:
            self.wo = normalize(self.wo.double())
        self.number = number or (FULL if setting.full else FAST)
        self.generator = torch.Generator().manual_seed(zlib.crc32(str(setting).encode()) + again)
        self.sampled_rows = (replace(self.case, values=drawn) if drawn else self.case).rows(self.dtype)
        self.rows = self.case.rows(torch.float64)
        self.draws = self.drawn(self.number)

    def drawn(self, number: int) -> BsdfSample:
        """``number`` draws, wave by wave."""
        out = []
        for start in range(0, number, LANES):
            n = min(LANES, number - start)
            u = torch.rand(3, n, generator=self.generator, dtype=self.dtype)
            lobe = u[2] if self.model.lobed else None
            out.append(self.model.sample(lanes(self.sampled_rows, n), self.wo.expand(3, n), lobe, u[:2]))
        eta = [one.eta for one in out if one.eta is not None]
        return BsdfSample(
            torch.cat([one.wi for one in out], 1),
            torch.cat([one.pdf for one in out]),
            torch.cat([one.weight.expand(3, one.pdf.shape[0]) for one in out], 1),
            torch.cat(eta) if eta else None,
        )

    @cached_property
    def spread(self) -> Tensor:
        """Lanes that a lobe with a density has drawn."""
        return (self.draws.pdf > 0) & torch.isfinite(self.draws.pdf)

    @cached_property
    def delta(self) -> Tensor:
        """Lanes that a delta has drawn."""
        return torch.isinf(self.draws.pdf)

    def values(self, wi: Tensor) -> Tensor:
        """``pdf`` and ``eval`` ``(4, n)`` in float64."""
        n = wi.shape[1]
        value, pdf = self.model.eval_pdf(lanes(self.rows, n), normalize(self.wo.double()).expand(3, n), wi)
        return torch.cat((pdf[None], value.expand(3, n)))

    def guides(self, below: bool, n: int) -> Tensor:
        """Directions ``(3, n)`` in one half that owe nothing to the sampler: uniform, and close about where lobes may be."""
        wo = self.wo.double()
        up = wo if self.setting.below == below else -wo
        centres = [mirrored(up), up]
        bent = refracted(wo, self.case.eta)
        if bent is not None and self.setting.below != below:
            centres.append(bent)
        u = torch.rand(4, n, generator=self.generator).double()
        centre = torch.cat(centres, 1)[:, (u[2] * len(centres)).long()]
        near = normalize(centre + 10 ** (-6 * u[3]) * uniform_sphere(u[:2]))
        w = torch.where(torch.arange(n) % 2 == 0, near, uniform_sphere(u[:2]))
        return torch.stack((w[0], w[1], w[2].abs() * (-1 if below else 1)))

    def chart(self, below: bool) -> Chart | SlopeChart:
        """Of one half of the directions: that in which this material's lobes are widest."""
        height = abs(float(self.wo[2]))
        # Phong's lobe is about the mirror direction, as wide across as along, and not made of facets.
        if self.case.narrowest * height > 0.02 or self.model.name == "phong":
            return Chart(AZIMUTH + math.pi, max(height, 1e-3))
        wo = normalize(self.wo.double())
        if self.setting.below == below:
            return SlopeChart(wo)
        if self.case.eta == 1.0:
            return Chart(AZIMUTH + math.pi, max(height, 1e-3))
        return SlopeChart(wo, 1 / self.case.eta if self.setting.below else self.case.eta)

    @cached_property
    def halves(self) -> list[Half]:
        """Above and, where light can pass, below."""
        depth = 7 if self.setting.full else 6 if self.number > FAST else 5
        # In draws: 0.02 of a leaf's deviation, or 0.06 where few are drawn.
        tolerance = (0.02 if self.number > FAST else 0.06) / math.sqrt(self.number * 2**depth)
        scout = self.drawn(1 << 14)
        known = scout.wi[:, (scout.pdf > 0) & torch.isfinite(scout.pdf)].double()
        halves = []
        for below in (False, True) if self.model.transmits else (False,):
            chart = self.chart(below)
            here = known[:, (known[2] < 0) == below]
            here = here[:, chart.covers(here)]
            points = self.guides(below, 1 << 14)
            points = points[:, chart.covers(points)]
            points = points[:, torch.randint(points.shape[1], (1 << 13,), generator=self.generator)]
            if here.shape[1] > 100:
                pick = torch.randint(here.shape[1], (3 << 11,), generator=self.generator)
                points = torch.cat((here[:, pick], points[:, : 1 << 11]), 1)
            places = chart.places(points)
            tree = Tree.over(places, depth, chart.ends(below))
            integral = integrate(self.values, tree.rects, chart, tolerance, (places, tree.leaf(places)))
            density = (
                torch.zeros(1 << depth).double().scatter_reduce_(0, tree.leaf(places), self.values(points)[0], "mean")
            )
            halves.append(Half(below, chart, tree, integral, density))
        return halves

    @cached_property
    def integral(self) -> Integral:
        return Integral(
            torch.cat([half.integral.value for half in self.halves], 1),
            torch.cat([half.integral.error for half in self.halves], 1),
        )

    def counts(self) -> Tensor:
        """Draws in each leaf."""
        wi = self.draws.wi[:, self.spread]
        out = []
        for half in self.halves:
            here = wi[:, (wi[2] < 0) == half.below]
            here = here[:, half.chart.covers(here)]
            out.append(torch.bincount(half.tree.leaf(half.chart.places(here)), minlength=half.tree.rects.shape[1]))
        return torch.cat(out)

    def p_value(self) -> float:
        """Of the hypothesis that the draws follow the density."""
        density = torch.cat([half.density for half in self.halves])
        n = self.number
        return counts_p(self.counts(), n * self.integral.value[0], density, n, n * self.integral.error[0])

    def mean(self, where: Tensor, radiance: bool = False) -> tuple[Tensor, Tensor]:
        """Mean weight ``(3,)`` over all draws of those ``where``, and its standard error.

        With ``radiance``, in units of what the far side holds in a furnace: there it is ``eta^2`` times this side's.
        """
        weight = torch.where(where, self.draws.weight, 0.0).double()
        if radiance and self.draws.eta is not None:
            weight = weight * self.draws.eta.double() ** 2
        return weight.mean(1), weight.std(1) / math.sqrt(self.number)


def test_every_model_has_cases_and_edges():
    missing = [str(model) for model in MODELS if not cases_of(model) or not edges_of(model)]
    assert not missing, f"no case for {missing}"
    assert len({str(model) for model in MODELS}) == len(MODELS)
    assert set(BUILDERS) <= {model.name for model in MODELS} == set(bsdfs.KINDS)


def test_variants_are_what_scenes_ask_for():
    """Every flag that a model has is set in one of its variants: one that is not is tested by nobody."""
    for name, kind in bsdfs.KINDS.items():
        flags = [field.name for field in fields(kind) if isinstance(field.default, bool)]  # type: ignore[arg-type]
        for flag in flags:
            assert {getattr(model, flag) for model in MODELS if model.name == name} == {False, True}, (name, flag)


# --- Draws against the density


def draws_follow_the_density(experiment: Experiment) -> None:
    if experiment.case.smooth:
        assert not experiment.spread.any()
        assert experiment.integral.value.abs().max() == 0
        return
    p = experiment.p_value()
    assert p > EACH, f"p = {p:.3g}, limit {EACH:.2g}"


def the_density_holds_at_most_one(experiment: Experiment) -> None:
    integral = experiment.integral
    mass, error = float(integral.value[0].sum()), float(integral.error[0].sum())
    assert error < 2e-3, f"the cubature is known to {error:.2g} only"
    share = float((~experiment.spread).double().mean())
    assert mass <= 1 + error + 1e-5, f"1 + {mass - 1:.3g} +- {error:.2g}"
    assert abs(mass - (1 - share)) < error + 1e-5 + 5 * math.sqrt(max(share * (1 - share), 1e-9) / experiment.number)


def the_mean_weight_is_the_integral_of_eval(experiment: Experiment) -> None:
    integral = experiment.integral
    mean, error = experiment.mean(experiment.spread)
    expected, doubt = integral.value[1:].sum(1), integral.error[1:].sum(1)
    assert (doubt < 2e-3 * (1 + expected)).all(), f"the cubature is known to {doubt.tolist()} only"
    limit = Z * error + doubt + 1e-4 * expected + 1e-6
    assert ((mean - expected).abs() <= limit).all(), f"{mean.tolist()} against {expected.tolist()} +- {limit.tolist()}"


def no_energy_is_created(experiment: Experiment) -> None:
    if not (experiment.model.conserves and experiment.case.conserves):
        return  # this material may reflect more than it receives
    mean, error = experiment.mean(experiment.draws.pdf > 0, radiance=True)
    assert (mean <= 1 + experiment.case.furnace + Z * error + 2e-5).all(), f"albedo {mean.tolist()} +- {error.tolist()}"


def white_furnace(experiment: Experiment) -> None:
    case = experiment.case
    if not case.lossless:
        return  # this material absorbs, or loses light between its facets
    mean, error = experiment.mean(experiment.draws.pdf > 0, radiance=True)
    assert ((mean - 1).abs() <= case.furnace + Z * error + 2e-5).all(), f"{mean.tolist()} +- {error.tolist()}"


def weight_is_eval_over_pdf(experiment: Experiment) -> None:
    """The draw's density and weight are those of ``eval`` and ``pdf`` asked anew for the same directions, in other company."""
    n = LANES if experiment.setting.full else 1 << 13
    wi, pdf, weight = (x[..., :n] for x in (experiment.draws.wi, experiment.draws.pdf, experiment.draws.weight))
    spread = experiment.spread[:n]
    live = pdf > 0
    if experiment.setting.below and not live.any():  # nothing comes out of a metal's back
        assert not experiment.model.eval(
            lanes(experiment.sampled_rows, wi.shape[1]), experiment.wo.expand(3, wi.shape[1]), wi
        ).any()
        return
    assert live.any() and bool(spread.any()) == (not experiment.case.smooth)
    assert ((wi[:, live].double() ** 2).sum(0) - 1).abs().max() < 2e-6
    # Every third lane alone: what a lane comes to may depend on no other, and each of the three functions says the same.
    some = torch.arange(wi.shape[1]) % 3 == 1
    wo = experiment.wo.expand(3, wi.shape[1])
    value, density = experiment.model.eval_pdf(lanes(experiment.sampled_rows, wi.shape[1]), wo, wi)
    alone = lanes(experiment.sampled_rows, int(some.sum())), wo[:, some], wi[:, some]
    assert torch.equal(experiment.model.eval(*alone), value[:, some])
    assert torch.equal(experiment.model.pdf(*alone), density[some])
    value = value.expand(3, wi.shape[1])
    torch.testing.assert_close(density[spread], pdf[spread], rtol=1e-3, atol=1e-7)
    torch.testing.assert_close(value[:, spread], (weight * pdf)[:, spread], rtol=1e-3, atol=1e-7)


def deltas_go_where_they_may(experiment: Experiment) -> None:
    """A delta reflects by the mirror's law, refracts by Snell's or passes straight; ``eta`` says which."""
    case, wi = experiment.case, experiment.draws.wi[:, experiment.delta].double()
    sides = experiment.draws.eta
    assert experiment.delta.any() <= experiment.model.delta
    if experiment.model.smooth:
        assert case.smooth and not experiment.spread.any()
    assert (sides is not None) == experiment.model.refracts
    wo = experiment.wo.double()
    off = torch.full((wi.shape[1],), 9.0, dtype=torch.float64)
    for aim in (mirrored(wo), -wo, refracted(wo, case.eta)):
        if aim is not None:
            off = torch.minimum(off, (wi - aim).abs().amax(0))
    assert not (off > 2e-6).any(), f"a delta leaves by {off.max():.3g}"
    if sides is not None and "b" not in case.values:
        live = experiment.draws.pdf > 0
        through = experiment.draws.wi[2] * wo[2] < 0
        index = 1 / case.eta if experiment.setting.below else case.eta
        torch.testing.assert_close(
            sides[live].double(), torch.where(through, index, 1.0)[live].double(), rtol=1e-6, atol=0
        )


PROMISES: tuple[Callable[[Experiment], None], ...] = (
    draws_follow_the_density,
    the_density_holds_at_most_one,
    the_mean_weight_is_the_integral_of_eval,
    no_energy_is_created,
    white_furnace,
    weight_is_eval_over_pdf,
    deltas_go_where_they_may,
)


def by_case() -> Iterator[Any]:
    """Lists of settings: the fast ones of a model, and all directions of all its cases, which are slow."""
    groups: dict[tuple[str, bool], list[Setting]] = {}
    for setting in SETTINGS:
        groups.setdefault((str(setting.case.model), setting.full), []).append(setting)
    for (name, full), group in groups.items():
        slow = full or heavy(group[0].case.model) or name in LATER
        yield pytest.param(group, marks=[pytest.mark.slow] if slow else [], id=f"{name} full" if full else name)


@pytest.mark.parametrize("settings", list(by_case()))
def test_draws_keep_all_promises(settings):
    for setting in settings:
        experiment = Experiment(setting)
        for promise in PROMISES:
            with named(f"{setting}: {promise.__name__}"):
                promise(experiment)


# --- Delta lobes against closed forms


def fresnel(cos: Tensor, eta: Tensor) -> Tensor:
    """Unpolarized reflectance from the side of index 1 into the side of index ``eta``; 1 beyond the critical angle."""
    cos2 = 1 - (1 - cos * cos) / (eta * eta)
    inside = torch.where(cos2 > 0, cos2, 1.0).sqrt()
    s = (cos - eta * inside) / (cos + eta * inside)
    p = (eta * cos - inside) / (eta * cos + inside)
    return torch.where(cos2 > 0, 0.5 * (s * s + p * p), 1.0)


CLOSED = ("null", "dielectric", "thindielectric", "plastic")


def delta_amounts(case: Case, values: bsdfs.Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
    """Radiance ``(3,)`` reflected and transmitted by the deltas of the models that have a ``CLOSED`` form."""
    name, one = case.model.name, torch.ones(3, dtype=torch.float64)
    if name == "null":
        return 0 * one, one
    ratio = values["int_ior"] / values["ext_ior"]
    if case.eta == 1.0:
        ratio = ratio.detach()  # equal indices count as no boundary at all, see INDEX_MATCHED
    side = ratio if name != "dielectric" or float(wo[2]) > 0 else 1 / ratio
    f = fresnel(wo[2].abs(), side)
    reflectance = values["specular_reflectance"][:, 0] if "specular_reflectance" in values else one
    transmittance = values["specular_transmittance"][:, 0] if "specular_transmittance" in values else one
    if name == "plastic":
        return f * reflectance, 0 * one
    if name == "thindielectric":  # the series of reflections between both faces
        f = 2 * f / (1 + f)
    # Radiance that is refracted is carried into a wider or narrower cone.
    narrowed = 1 / (side * side) if name == "dielectric" else 1.0
    return f * reflectance, (1 - f) * transmittance * narrowed


def gradients(value: Tensor, inputs: list[Tensor]) -> list[Tensor]:
    """Derivatives of a sum; 0 where it does not depend on an input."""
    if not value.requires_grad:
        return [torch.zeros_like(x) for x in inputs]
    found = torch.autograd.grad(value.sum(), inputs, retain_graph=True, allow_unused=True)
    return [torch.zeros_like(x) if g is None else g for g, x in zip(found, inputs, strict=True)]


@each([case for case in CASES if case.model.name in CLOSED])
def test_deltas_carry_what_fresnel_gives_them(case):
    """In the mean over ``lobe``, with its gradient in every number: a probability is detached, an amount is not."""
    for angle, below in itertools.product(ANGLES, (False, True) if case.model.transmits else (False,)):
        wo = towards(angle, below).double()
        values = tensors(case.values, torch.float64)
        inputs = [t.requires_grad_() for t in leaves(values)]
        expected = delta_amounts(case, values, wo)
        n = 1 << 12
        rows = bsdfs.stacked([case.model.prepare(values)], case.model.factors)
        u = torch.full((2, n), 0.3, dtype=torch.float64)
        # An even lattice rounds each probability to 1/n, so the shares are weighted by how often they came up.
        lobe = (torch.arange(n, dtype=torch.float64) + 0.5) / n
        out = case.model.sample(lanes(rows, n), wo.expand(3, n), lobe if case.model.lobed else None, u)
        up = torch.isinf(out.pdf) & (out.wi[2] * wo[2] > 0)
        down = torch.isinf(out.pdf) & (out.wi[2] * wo[2] < 0)
        for lanes_of, amount in ((up, expected[0]), (down, expected[1])):
            mean = torch.where(lanes_of, out.weight, 0.0).mean(1)
            most = float(out.weight.detach().abs().max()) / n
            assert ((mean - amount).abs() < 1e-6 + 1.1 * most).all(), f"{mean.tolist()} against {amount.tolist()}"
            ours, theirs = gradients(mean, inputs), gradients(amount, inputs)
            scale = max(float(amount.detach().min()), 1e-3)
            for a, b in zip(ours, theirs, strict=True):
                torch.testing.assert_close(a, b, rtol=2e-3 + 5 / n / scale, atol=2e-3)


# --- Values


def pairs(case: Case, n: int, dtype: torch.dtype, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Half of the pairs at random, half drawn by the model, so that narrow lobes are met."""
    wo = uniform_sphere(torch.rand(2, n, generator=generator))
    wi = uniform_sphere(torch.rand(2, n, generator=generator))
    if not case.model.transmits:
        wo, wi = (torch.stack((w[0], w[1], w[2].abs())) for w in (wo, wi))
    u = torch.rand(3, n, generator=generator)
    out = case.model.sample(lanes(case.rows(), n), wo, u[2] if case.model.lobed else None, u[:2])
    drawn = (out.pdf > 0) & torch.isfinite(out.pdf) & (torch.arange(n) % 2 == 0)
    wi = torch.where(drawn, out.wi, wi)
    return normalize(wo.to(dtype)), normalize(wi.to(dtype))


@each([case for case in CASES if case.model.reciprocal])
def test_reciprocity(case):
    """``f(wo, wi) = f(wi, wo)`` on one side; across, the radiance of either is divided by its squared index."""
    wo, wi = pairs(case, 4096, torch.float64, torch.Generator().manual_seed(3))
    p = lanes(case.rows(torch.float64), wo.shape[1])
    there = case.model.eval(p, wo, wi) * wo[2].abs()
    back = case.model.eval(p, wi, wo) * wi[2].abs()
    if case.model.refracts:
        there = there * torch.where(wo[2] < 0, case.eta**-2, 1.0)
        back = back * torch.where(wi[2] < 0, case.eta**-2, 1.0)
    assert (there > 0).any() or case.smooth
    torch.testing.assert_close(there, back, rtol=1e-5, atol=1e-9)


@each([case for case in CASES if not case.model.transmits], tables=True)
def test_opaque_models_are_black_from_behind(case):
    wo, wi = pairs(case, 512, torch.float32, torch.Generator().manual_seed(4))
    p = lanes(case.rows(), wo.shape[1])
    wi = torch.stack((wi[0], wi[1], -wi[2]))
    value, pdf = case.model.eval_pdf(p, wo, wi)
    assert not value.any() and not pdf.any()


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(m, marks=[pytest.mark.slow] if heavy(m) or str(m) == "roughplastic" else [], id=str(m))
        for m in MODELS
    ],
)
def test_rows_of_one_model_do_not_meet(model):
    """All its materials in one group of lanes give what each gives alone, whatever one has and another has not."""
    cases = [case for case in CASES if case.model is model]  # whose tables are there
    generator = torch.Generator().manual_seed(5)
    n = 128 * len(cases)
    u = torch.rand(3, n, generator=generator)
    wo = uniform_sphere(torch.rand(2, n, generator=generator))
    wi = uniform_sphere(torch.rand(2, n, generator=generator))
    if not model.transmits:
        wo = torch.stack((wo[0], wo[1], wo[2].abs()))
    row = torch.arange(n) % len(cases)
    together = _everything(model, bsdfs.gather(bsdfs.stacked([case.rows() for case in cases]), row), wo, wi, u)
    for i, case in enumerate(cases):
        alone = _everything(model, lanes(case.rows(), n), wo, wi, u)
        for x, y in zip(together, alone, strict=True):
            assert torch.equal(x[..., row == i], y[..., row == i]), f"{case} beside others"


def _everything(model: bsdfs.Bsdf, p: bsdfs.Parameters, wo: Tensor, wi: Tensor, u: Tensor) -> list[Tensor]:
    n = wo.shape[1]
    out = model.sample(p, wo, u[2] if model.lobed else None, u[:2])
    value, pdf = model.eval_pdf(p, wo, wi)
    parts = [out.wi, out.pdf, out.weight, value, model.albedo(p)]
    return [
        x.expand(3, n) if x.dim() == 2 else x.expand(n) for x in (*parts, pdf, *([] if out.eta is None else [out.eta]))
    ]


# --- Edges of the numbers


def edge_directions(both_sides: bool) -> Tensor:
    """Outgoing ``(3, n)``: along the normal, slanted, and ever closer to the horizon."""
    columns = [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (-0.48, 0.64, 0.6)]
    for z in (0.0, -0.0, 1e-7, 1e-4):
        for angle in (0.0, 2.2):
            r = math.sqrt(1 - z * z)
            columns.append((r * math.cos(angle), r * math.sin(angle), z))
    up = torch.tensor(columns).T
    return torch.cat((up, up * torch.tensor([1.0, 1.0, -1.0])[:, None]), 1) if both_sides else up


_EDGE_U = torch.cartesian_prod(*(torch.tensor([0.0, 2**-24, 0.5, 1 - 2**-24]),) * 3).T


def edge_lanes(case: Case) -> tuple[Tensor, Tensor, Tensor]:
    """All combinations of outgoing directions, degenerate and random incoming ones, and numbers at their ends."""
    wo = edge_directions(case.model.transmits)
    k, m = wo.shape[1], _EDGE_U.shape[1]
    u = _EDGE_U.repeat(1, k)
    wo = wo.repeat_interleave(m, 1)
    generator = torch.Generator().manual_seed(8)
    wi = uniform_sphere(torch.rand(2, k * m, generator=generator))
    kind = torch.arange(k * m) % m
    flat = torch.stack((torch.cos(kind * 1.0), torch.sin(kind * 1.0), torch.zeros(k * m)))
    for i, special in enumerate(
        (wo, -wo, mirrored(wo), -mirrored(wo), flat, edge_directions(True).repeat(1, m)[:, : k * m])
    ):
        wi = torch.where((kind >= 4 * i) & (kind < 4 * i + 4), special, wi)
    return wo, wi, u


@each(EDGES, later=[str(model) for model in MODELS if heavy(model) and model.anisotropic])
def test_edge_numbers_stay_finite(case):
    model = case.model
    wo, wi, u = edge_lanes(case)
    p = lanes(case.rows(), wo.shape[1])
    out = model.sample(p, wo, u[2] if model.lobed else None, u[:2])

    def lane(bad: Tensor) -> str:
        i = int(bad.reshape(-1, bad.shape[-1]).any(0).nonzero()[0])
        return (
            f"wo {wo[:, i].tolist()} u {u[:, i].tolist()} sampled {out.wi[:, i].tolist()} pdf {float(out.pdf[i])} "
            f"weight {out.weight.expand(3, wo.shape[1])[:, i].tolist()}; given wi {wi[:, i].tolist()}"
        )

    def no(bad: Tensor, what: str) -> None:
        assert not bad.any(), f"{what}: {lane(bad)}"

    no(~torch.isfinite(out.wi), "wi is not finite")
    no(~torch.isfinite(out.weight.expand(3, wo.shape[1])), "weight is not finite")
    no(torch.isnan(out.pdf) | (out.pdf < 0), "pdf of the draw")
    no(torch.isinf(out.pdf) & torch.tensor(not model.delta), "a delta of a model that says it has none")
    no(out.weight.expand(3, wo.shape[1]) < 0, "weight below 0")
    live = out.pdf > 0
    no(live & (((out.wi.double() ** 2).sum(0) - 1).abs() > 4e-6), "wi is no unit vector")
    if out.eta is not None:
        no(~torch.isfinite(out.eta) | (out.eta <= 0), "eta")
    if not model.transmits:
        no(live & (out.wi[2] < 0), "an opaque model draws from below")
    for other in (wi, out.wi):
        value, pdf = model.eval_pdf(p, wo, other)
        no(~torch.isfinite(value) | (value < 0), "eval")
        no(~torch.isfinite(pdf) | (pdf < 0), "pdf")
    albedo = model.albedo(p)
    assert torch.isfinite(albedo).all() and (albedo >= 0).all()


@each([case for case in EDGES if leaves(case.values)], tables=True)
def test_gradients_stay_finite_at_the_edges(case):
    """Through ``prepare``: of eval, and of the weights of all draws, deltas and failed ones too."""
    wo, wi, u = edge_lanes(case)
    values = tensors(case.values, torch.float32)
    inputs = [t.requires_grad_() for t in leaves(values)]
    p = lanes(bsdfs.stacked([case.model.prepare(values)]), wo.shape[1])
    # Of directions as well: they depend on vertices.
    wo, wi = wo.clone().requires_grad_(), wi.clone().requires_grad_()
    out = case.model.sample(p, wo, u[2] if case.model.lobed else None, u[:2])
    results = {"eval": case.model.eval(p, wo, wi), "weight": out.weight}
    for name, result in results.items():
        if not result.requires_grad:
            continue
        grads = torch.autograd.grad(result.sum(), [*inputs, wo, wi], retain_graph=True, allow_unused=True)
        for gradient, x in zip(grads, [*inputs, wo, wi], strict=True):
            if gradient is None:
                continue
            bad = ~torch.isfinite(gradient)
            where = ""
            if bad.any() and gradient.shape[-1] == wo.shape[1]:
                i = int(bad.any(0).nonzero()[0])
                where = f"wo {wo[:, i].tolist()} wi {wi[:, i].tolist()} u {u[:, i].tolist()}"
            assert not bad.any(), (
                f"gradient of {name} in a tensor {tuple(x.shape)}: {gradient[bad][:3].tolist()} {where}"
            )


# --- Gradients


def inside(values: bsdfs.Parameters) -> bsdfs.Parameters:
    """Moved off the ends of [0, 1], where a clamp has no derivative."""
    out: bsdfs.Parameters = {}
    for key, value in values.items():
        if isinstance(value, dict):
            out[key] = inside(value)
        else:
            out[key] = torch.where(value == 0, 0.03, torch.where(value == 1, 0.97, value))
    return out


@each([case for case in CASES if case.differentiable and not case.smooth and not case.model.tabulated])
def test_gradients_of_eval(case):
    """Finite differences in every number that a material is given, at directions within its lobes.

    Those of tables are tested by longer steps, see ``test_derivatives.py``.
    """
    values = inside(tensors(case.values, torch.float64))
    flat = [t.requires_grad_() for t in leaves(values)]
    wo, wi = pairs(case, 12, torch.float64, torch.Generator().manual_seed(11))

    def refill(like: bsdfs.Parameters, new: list[Tensor]) -> bsdfs.Parameters:
        return {key: refill(v, new) if isinstance(v, dict) else new.pop(0) for key, v in like.items()}

    def value(*inputs: Tensor) -> Tensor:
        p = lanes(bsdfs.stacked([case.model.prepare(refill(values, list(inputs)))]), wo.shape[1])
        return case.model.eval(p, wo, wi)

    assert value(*flat).requires_grad
    assert torch.autograd.gradcheck(value, flat, eps=1e-7, atol=1e-5, rtol=1e-3, fast_mode=True)
