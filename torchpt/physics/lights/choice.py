"""Light samplers: the choice of a light uniformly, by power, or by the light tree, and the bounds for the tree."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace

import torch
from torch import Tensor

from torchpt.core.threads import sum_all
from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import take
from torchpt.physics.lights import tree
from torchpt.physics.lights.base import COLUMNS
from torchpt.physics.lights.records import Lights
from torchpt.physics.lights.surface import emitter
from torchpt.physics.lights.tree import LightTree

__all__ = [
    "LIGHT_SAMPLERS",
    "MANY",
    "Bounds",
    "TreeSampler",
    "bounds_of",
    "depends_on_point",
    "draw",
    "environment",
    "light_sampler",
    "probability",
    "without_last",
]


# ---- Bounds of lights for the light tree


@dataclass(frozen=True)
class Bounds:
    """Bounds of K lights, arguments of :func:`torchpt.physics.lights.tree.build`; float64, detached."""

    low: Tensor  # (3, K)
    high: Tensor  # (3, K)
    axis: Tensor  # (3, K)
    cos_o: Tensor  # (K,)
    cos_e: Tensor  # (K,)
    intensity: Tensor  # (K,)


def bounds_of(lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor]) -> Bounds:
    """Return the bounds of all local lights, which are the first rows.

    Args:
        lights: the table.
        power: power of all rows ``(K,)``.
        boxes: lower and upper corners ``(3, E)`` of the boxes of the E emissive primitives, which are the first rows.
    """
    near = [kind for kind in map(emitter, lights.kinds) if not kind.distant]
    number = torch.zeros_like(lights.area, dtype=torch.int64) if lights.kind is None else lights.kind
    count = int((number < len(near)).sum())
    number = number[:count]
    columns = {name: getattr(lights, name)[..., :count].detach().double() for name in COLUMNS}
    place, surfaces = columns["p0"], boxes[0].shape[1]
    low, high = (torch.cat((box.double(), place[:, surfaces:]), 1) for box in boxes)
    cos_o, cos_e = torch.empty_like(place[0]), torch.empty_like(place[0])
    intensity = power[:count].detach().double() / math.pi
    for k, kind in enumerate(near):
        rows = (number == k).nonzero().squeeze(1)
        at = replace(lights, **{name: column.index_select(-1, rows) for name, column in columns.items()})
        cone = kind.bounds(at, intensity[rows])
        cos_o[rows], cos_e[rows], intensity[rows] = cone.cos_o, cone.cos_e, cone.intensity
    return Bounds(low, high, columns["normal"], cos_o, cos_e, intensity)


# ---- Choice of a light
#
# :func:`draw` returns rows and their probabilities, :func:`probability` the probability of a row whose light a ray hit.


#: Values of `light_choice`; auto is `power` below MANY local lights, else `tree`.
LIGHT_SAMPLERS = ("auto", "uniform", "power", "tree")
MANY = 3
#: Probability of a uniform choice instead of the tree: at most EVEN, EACH / K among K lights, 0 beyond FEW lights. The tree
#: ignores the BSDF and may nearly always choose the wrong light for a glossy surface. At 64 samples a pixel the uniform share
#: halves the error of four plates under five lights; among many lights it would not help, and cost where one outshines all.
EVEN, EACH, FEW = 0.25, 2.0, 64


@dataclass(frozen=True)
class TreeSampler:
    """Light sampler of a light tree over local lights, and a choice by power between it and each distant light."""

    tree: LightTree
    beside: Distribution1D | None  # over the tree (0) and the distant rows; None without distant lights
    even: Distribution1D | None  # uniform over the rows of the tree; None if it is never used
    share: Tensor  # () float64 probability of `even` among choices of local lights


def light_sampler(
    lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor], way: str
) -> Distribution1D | TreeSampler | None:
    """Return the light sampler of a table, None for a single light.

    Args:
        lights: the table; its field ``choice`` is not read.
        power: power of the rows ``(K,)``, float64.
        boxes: lower and upper corners ``(3, E)`` of the boxes of the E emissive primitives, which are the first rows.
        way: one of :data:`LIGHT_SAMPLERS`.
    """
    dtype = lights.area.dtype
    if len(power) == 1:
        return None
    if way in ("uniform", "power") or (way == "auto" and len(power) < MANY):
        return Distribution1D.of((power > 0).double() if way == "uniform" else power, dtype)
    bounds = bounds_of(lights, power, boxes)
    count = len(bounds.intensity)
    if not count or (way == "auto" and count < MANY):
        return Distribution1D.of(power, dtype)
    beside = None
    if count < len(power):
        beside = Distribution1D.of(torch.cat((sum_all(power[:count]).reshape(1), power[count:])), dtype)
    shining = (power[:count] > 0).double()
    few = count <= FEW
    share = min(EVEN, EACH / max(float(shining.sum()), 1.0)) if few else 0.0
    part = torch.tensor(share, dtype=torch.float64, device=power.device)
    return TreeSampler(tree.build(*astuple(bounds)), beside, Distribution1D.of(shining, dtype) if few else None, part)


def depends_on_point(lights: Lights | None) -> bool:
    """Return True if the choice depends on the reference point, which paths then have to keep for MIS."""
    return lights is not None and isinstance(lights.choice, TreeSampler)


def draw(choice: Distribution1D | TreeSampler, u: Tensor, x: Tensor, n: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Choose lights; return rows ``(N,)``, probabilities ``(N,)``, and remapped numbers ``(N,)`` float64 in [0, 1].

    The remapped ``u`` is uniform given the choice. Reusing it keeps light and point stratified together.

    Args:
        choice: the light sampler.
        u: ``(N,)`` float64 in [0, 1) of 48 bits, see :func:`torchpt.physics.lights.tree.from_digits`.
        x: reference points ``(3, N)``.
        n: normals ``(3, N)``, or None, as for :func:`torchpt.physics.lights.tree.sample`.
    """
    if isinstance(choice, Distribution1D):
        row, rest = choice.draw(u)
        return row, take(choice.pmf, row), rest
    if choice.beside is None:
        return _near(choice, u, x, n)
    beside, first = choice.beside, choice.tree.count
    outcome, left = beside.draw(u)
    row, p, rest = _near(choice, left, x, n)
    near = outcome == 0
    rest = torch.where(near, rest, left)
    p = torch.where(near, p, 1.0) * take(beside.pmf, outcome)
    return torch.where(near, row, outcome + (first - 1)), p, rest


def _near(choice: TreeSampler, u: Tensor, x: Tensor, n: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Choose among local lights; see :func:`draw`."""
    if choice.even is None:
        return tree.sample(choice.tree, x, n, u)
    share = choice.share
    apart = u < share
    row, _, rest = tree.sample(choice.tree, x, n, ((u - share) / (1.0 - share)).clamp_min(0.0))
    other, left = choice.even.draw((u / share).clamp_max(1.0 - 2.0**-53))
    row, rest = torch.where(apart, other, row), torch.where(apart, left, rest)
    return row, _chance(choice, row, x, n), rest


def _chance(choice: TreeSampler, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """Return the probability among local lights; see :func:`probability`."""
    p = tree.probability(choice.tree, row, x, n)
    if choice.even is None:
        return p
    share = choice.share.to(p.dtype)
    return p * (1.0 - share) + take(choice.even.pmf, row) * share


def probability(choice: Distribution1D | TreeSampler, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """Return the probability ``(N,)`` with which :func:`draw` chooses ``row (N,)`` at ``x`` and ``n``."""
    if isinstance(choice, Distribution1D):
        return take(choice.pmf, row)
    if choice.beside is None:
        return _chance(choice, row, x, n)
    first = choice.tree.count
    p = _chance(choice, torch.minimum(row, first - 1), x, n)
    return torch.where(row < first, p, 1.0) * take(choice.beside.pmf, (row - (first - 1)).clamp_min(0))


def environment(choice: Distribution1D | TreeSampler | None) -> Tensor | float:
    """Return the probability of the last row, the environment's if the scene has one."""
    if choice is None:
        return 1.0
    chosen = choice if isinstance(choice, Distribution1D) else choice.beside
    assert chosen is not None
    return chosen.pmf[-1]


def without_last(choice: Distribution1D | TreeSampler) -> Distribution1D | TreeSampler:
    """Return the light sampler without the last row, a distant light; at least one row has to be left."""
    if isinstance(choice, TreeSampler):
        beside = choice.beside
        assert beside is not None  # distant lights are not in the tree
        return replace(choice, beside=None if len(beside.pmf) == 2 else _fewer(beside))
    return _fewer(choice)


def _fewer(choice: Distribution1D) -> Distribution1D:
    return Distribution1D.of(choice.pmf[:-1], choice.pmf.dtype)
