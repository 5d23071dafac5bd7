"""Which light: by power where there are few, by the light tree where there are many.

Made with the table (:func:`choice_of`); :func:`draw` gives rows and their probabilities, and :func:`probability` tells the same
to rays that meet a light by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import torch
from torch import Tensor

from torchpt.lights import tree
from torchpt.lights.bounds import bounds_of
from torchpt.lights.tree import LightTree
from torchpt.math.distributions import Discrete
from torchpt.math.threads import sum_all
from torchpt.math.vectors import take
from torchpt.records import Lights

__all__ = [
    "MANY",
    "WAYS",
    "ByTree",
    "choice_of",
    "draw",
    "environment",
    "joined",
    "local",
    "probability",
    "without_last",
]

#: Ways to choose: all lights alike, by power, by the tree, or by power below MANY lights that lie somewhere, by the tree from
#: there on.
WAYS = ("auto", "uniform", "power", "tree")
MANY = 3
#: Share of the draws near by that is even among the lights, at most; among K of them EACH / K, and none beyond FEW. The tree
#: knows of no lobe, and of a glossy surface may draw the wrong light nearly always. At 64 samples a pixel it halves the error
#: of four plates under five lights; among many it would help none of them, and cost where one outshines the others.
EVEN, EACH, FEW = 0.25, 2.0, 64


@dataclass(frozen=True)
class ByTree:
    """A tree over the rows that lie somewhere; beside it those infinitely far, by power."""

    tree: LightTree
    beside: Discrete | None  # over the tree and the rows after its own; None where there are none
    even: Discrete | None  # over the rows of the tree; None where all draws are the tree's own
    share: Tensor  # () float64, of the draws of a row of the tree that are taken from `even`; of several choices (S,)


def choice_of(lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor], way: str) -> Discrete | ByTree | None:
    """How to choose among the rows of a table.

    Args:
        lights: the table; its own choice is not read.
        power: of its rows ``(K,)``, float64.
        boxes: lower and upper corners ``(3, E)`` of boxes about the E primitives that emit, which come first.
        way: from :data:`WAYS`.
    """
    dtype = lights.area.dtype
    if len(power) == 1:
        return None
    if way in ("uniform", "power") or (way == "auto" and len(power) < MANY):
        return Discrete.of((power > 0).double() if way == "uniform" else power, dtype)
    bounds = bounds_of(lights, power, boxes)
    count = len(bounds.intensity)
    if not count or (way == "auto" and count < MANY):
        return Discrete.of(power, dtype)
    beside = None
    if count < len(power):
        beside = Discrete.of(torch.cat((sum_all(power[:count]).reshape(1), power[count:])), dtype)
    shining = (power[:count] > 0).double()
    few = count <= FEW
    share = min(EVEN, EACH / max(float(shining.sum()), 1.0)) if few else 0.0
    part = torch.tensor(share, dtype=torch.float64, device=power.device)
    return ByTree(tree.build(*astuple(bounds)), beside, Discrete.of(shining, dtype) if few else None, part)


def local(lights: Lights | None) -> bool:
    """Whether the choice asks where it is made, so that paths must keep that."""
    return lights is not None and isinstance(lights.choice, ByTree)


def joined(choices: Sequence[Discrete | ByTree | None]) -> Discrete | ByTree | None:
    """The choices of several tables, all of one form (:func:`torchpt.union.form_of`), of which each lane has its own."""
    plain, trees = [c for c in choices if isinstance(c, Discrete)], [c for c in choices if isinstance(c, ByTree)]
    if not trees:
        return Discrete.joined(plain) if plain else None
    beside = [c.beside for c in trees if c.beside is not None]
    even = [c.even for c in trees if c.even is not None]
    return ByTree(
        tree.joined([c.tree for c in trees]),
        Discrete.joined(beside) if beside else None,
        Discrete.joined(even) if even else None,
        torch.stack([c.share for c in trees]),
    )


def draw(
    choice: Discrete | ByTree, u: Tensor, x: Tensor, n: Tensor | None, of: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows ``(N,)``, their probabilities ``(N,)``, and what the choice leaves of ``u``: ``(N,)`` float64 in [0, 1].

    The rest is uniform whatever was chosen. Who goes on with it keeps the stratification of light and place together.

    Args:
        choice: the choice.
        u: ``(N,)`` float64 in [0, 1) of 48 bits, see :func:`torchpt.lights.tree.fine`.
        x: reference points ``(3, N)``.
        n: normals ``(3, N)`` as :func:`torchpt.lights.tree.sample` takes them, or None.
        of: here and below, which of several :func:`joined` choices each lane has ``(N,)``; rows are those of its own table.
    """
    if isinstance(choice, Discrete):
        row, rest = choice.draw(u, of)
        return row, choice.chance(row, of), rest
    if choice.beside is None:
        return _near(choice, u, x, n, of)
    beside, first = choice.beside, _lanes(choice.tree.count, of)
    outcome, left = beside.draw(u, of)
    row, p, rest = _near(choice, left, x, n, of)
    near = outcome == 0
    rest = torch.where(near, rest, left)
    p = torch.where(near, p, 1.0) * beside.chance(outcome, of)
    return torch.where(near, row, outcome + (first - 1)), p, rest


def _near(choice: ByTree, u: Tensor, x: Tensor, n: Tensor | None, of: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`draw` among the rows of the tree."""
    if choice.even is None:
        return tree.sample(choice.tree, x, n, u, of)
    share = _lanes(choice.share, of)
    apart = u < share
    row, _, rest = tree.sample(choice.tree, x, n, ((u - share) / (1.0 - share)).clamp_min(0.0), of)
    other, left = choice.even.draw((u / share).clamp_max(1.0 - 2.0**-53), of)
    row, rest = torch.where(apart, other, row), torch.where(apart, left, rest)
    return row, _chance(choice, row, x, n, of), rest


def _chance(choice: ByTree, row: Tensor, x: Tensor, n: Tensor | None, of: Tensor | None) -> Tensor:
    """:func:`probability` among the rows of the tree."""
    p = tree.probability(choice.tree, row, x, n, of)
    if choice.even is None:
        return p
    share = _lanes(choice.share.to(p.dtype), of)
    return p * (1.0 - share) + choice.even.chance(row, of) * share


def _lanes(value: Tensor, of: Tensor | None) -> Tensor:
    """A number ``()`` of the only choice; of several ``(S,)`` those of the lanes."""
    return value if of is None else take(value, of)


def probability(
    choice: Discrete | ByTree, row: Tensor, x: Tensor, n: Tensor | None, of: Tensor | None = None
) -> Tensor:
    """``(N,)`` with which :func:`draw` gives ``row (N,)`` at ``x, n``."""
    if isinstance(choice, Discrete):
        return choice.chance(row, of)
    if choice.beside is None:
        return _chance(choice, row, x, n, of)
    first = _lanes(choice.tree.count, of)
    p = _chance(choice, torch.minimum(row, first - 1), x, n, of)
    return torch.where(row < first, p, 1.0) * choice.beside.chance((row - (first - 1)).clamp_min(0), of)


def environment(choice: Discrete | ByTree | None, of: Tensor | None = None) -> Tensor | float:
    """The probability of the last row, which is the environment's where there is one."""
    if choice is None:
        return 1.0
    chosen = choice if isinstance(choice, Discrete) else choice.beside
    assert chosen is not None
    return chosen.chance_of_last(of)


def without_last(choice: Discrete | ByTree) -> Discrete | ByTree:
    """The choice among all rows but the last, which is infinitely far and not the only one left."""
    if isinstance(choice, ByTree):
        beside = choice.beside
        assert beside is not None  # what is infinitely far is not of the tree
        return replace(choice, beside=None if len(beside.pmf) == 2 else _fewer(beside))
    return _fewer(choice)


def _fewer(choice: Discrete) -> Discrete:
    return Discrete.of(choice.pmf[:-1], choice.pmf.dtype)
