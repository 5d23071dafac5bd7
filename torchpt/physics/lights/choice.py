"""Which of many lights is sampled: by power, by a light tree, or one; the bounds of lights that the tree is built of."""

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


# ---- Where lights lie and where they shine: what the light tree asks of the table's rows


@dataclass(frozen=True)
class Bounds:
    """Of K lights, see :func:`torchpt.physics.lights.tree.build`; float64, detached."""

    low: Tensor  # (3, K)
    high: Tensor  # (3, K)
    axis: Tensor  # (3, K)
    cos_o: Tensor  # (K,)
    cos_e: Tensor  # (K,)
    intensity: Tensor  # (K,)


def bounds_of(lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor]) -> Bounds:
    """The bounds of all rows that lie somewhere, which come before those infinitely far.

    Args:
        lights: the table.
        power: of all rows ``(K,)``.
        boxes: lower and upper corners ``(3, E)`` of boxes about the E primitives that emit, which come first.
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


# ---- Which light: by power where there are few, by the light tree where there are many
#
# Made with the table (:func:`light_sampler`); :func:`draw` gives rows and their probabilities, and :func:`probability` tells the
# same to rays that meet a light by chance.


#: Ways to choose: all lights alike, by power, by the tree, or by power below MANY lights that lie somewhere, by the tree from
#: there on.
LIGHT_SAMPLERS = ("auto", "uniform", "power", "tree")
MANY = 3
#: Share of the draws near by that is even among the lights, at most; among K of them EACH / K, and none beyond FEW. The tree
#: knows of no lobe, and of a glossy surface may draw the wrong light nearly always. At 64 samples a pixel it halves the error
#: of four plates under five lights; among many it would help none of them, and cost where one outshines the others.
EVEN, EACH, FEW = 0.25, 2.0, 64


@dataclass(frozen=True)
class TreeSampler:
    """A tree over the rows that lie somewhere; beside it those infinitely far, by power."""

    tree: LightTree
    beside: Distribution1D | None  # over the tree and the rows after its own; None where there are none
    even: Distribution1D | None  # over the rows of the tree; None where all draws are the tree's own
    share: Tensor  # () float64, of the draws of a row of the tree that are taken from `even`


def light_sampler(
    lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor], way: str
) -> Distribution1D | TreeSampler | None:
    """How to choose among the rows of a table.

    Args:
        lights: the table; its own choice is not read.
        power: of its rows ``(K,)``, float64.
        boxes: lower and upper corners ``(3, E)`` of boxes about the E primitives that emit, which come first.
        way: from :data:`LIGHT_SAMPLERS`.
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
    """Whether the choice asks where it is made, so that paths must keep that."""
    return lights is not None and isinstance(lights.choice, TreeSampler)


def draw(choice: Distribution1D | TreeSampler, u: Tensor, x: Tensor, n: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Rows ``(N,)``, their probabilities ``(N,)``, and what the choice leaves of ``u``: ``(N,)`` float64 in [0, 1].

    The rest is uniform whatever was chosen. Who goes on with it keeps the stratification of light and place together.

    Args:
        choice: the choice.
        u: ``(N,)`` float64 in [0, 1) of 48 bits, see :func:`torchpt.physics.lights.tree.from_digits`.
        x: reference points ``(3, N)``.
        n: normals ``(3, N)`` as :func:`torchpt.physics.lights.tree.sample` takes them, or None.
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
    """:func:`draw` among the rows of the tree."""
    if choice.even is None:
        return tree.sample(choice.tree, x, n, u)
    share = choice.share
    apart = u < share
    row, _, rest = tree.sample(choice.tree, x, n, ((u - share) / (1.0 - share)).clamp_min(0.0))
    other, left = choice.even.draw((u / share).clamp_max(1.0 - 2.0**-53))
    row, rest = torch.where(apart, other, row), torch.where(apart, left, rest)
    return row, _chance(choice, row, x, n), rest


def _chance(choice: TreeSampler, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """:func:`probability` among the rows of the tree."""
    p = tree.probability(choice.tree, row, x, n)
    if choice.even is None:
        return p
    share = choice.share.to(p.dtype)
    return p * (1.0 - share) + take(choice.even.pmf, row) * share


def probability(choice: Distribution1D | TreeSampler, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """``(N,)`` with which :func:`draw` gives ``row (N,)`` at ``x, n``."""
    if isinstance(choice, Distribution1D):
        return take(choice.pmf, row)
    if choice.beside is None:
        return _chance(choice, row, x, n)
    first = choice.tree.count
    p = _chance(choice, torch.minimum(row, first - 1), x, n)
    return torch.where(row < first, p, 1.0) * take(choice.beside.pmf, (row - (first - 1)).clamp_min(0))


def environment(choice: Distribution1D | TreeSampler | None) -> Tensor | float:
    """The probability of the last row, which is the environment's where there is one."""
    if choice is None:
        return 1.0
    chosen = choice if isinstance(choice, Distribution1D) else choice.beside
    assert chosen is not None
    return chosen.pmf[-1]


def without_last(choice: Distribution1D | TreeSampler) -> Distribution1D | TreeSampler:
    """The choice among all rows but the last, which is infinitely far and not the only one left."""
    if isinstance(choice, TreeSampler):
        beside = choice.beside
        assert beside is not None  # what is infinitely far is not of the tree
        return replace(choice, beside=None if len(beside.pmf) == 2 else _fewer(beside))
    return _fewer(choice)


def _fewer(choice: Distribution1D) -> Distribution1D:
    return Distribution1D.of(choice.pmf[:-1], choice.pmf.dtype)
