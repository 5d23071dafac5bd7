"""Which light: by power where there are few, by the light tree where there are many.

Made with the table (:func:`choice_of`); :func:`draw` gives rows and their probabilities, and :func:`probability` tells the same
to rays that meet a light by chance.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import torch
from torch import Tensor

from torchpt.lights import tree
from torchpt.lights.bounds import bounds_of
from torchpt.lights.tree import LightTree
from torchpt.math.distributions import Discrete
from torchpt.math.vectors import take
from torchpt.records import Lights

__all__ = ["MANY", "WAYS", "ByTree", "choice_of", "draw", "environment", "local", "probability"]

#: Ways to choose: all lights alike, by power, by the tree, or by power below MANY lights and by the tree from there on.
WAYS = ("auto", "uniform", "power", "tree")
MANY = 10


@dataclass(frozen=True)
class ByTree:
    """A tree over the rows that lie somewhere; beside it those infinitely far, by power."""

    tree: LightTree
    beside: Discrete | None  # over the tree and the rows after its own; None where there are none


def choice_of(lights: Lights, power: Tensor, way: str) -> Discrete | ByTree | None:
    """How to choose among the rows of a table.

    Args:
        lights: the table; its own choice is not read.
        power: of its rows ``(K,)``, float64.
        way: from :data:`WAYS`.
    """
    dtype = lights.area.dtype
    if len(power) == 1:
        return None
    if way in ("uniform", "power") or (way == "auto" and len(power) < MANY):
        return Discrete.of((power > 0).double() if way == "uniform" else power, dtype)
    bounds = bounds_of(lights, power)
    count = len(bounds.intensity)
    if not count:
        return Discrete.of(power, dtype)
    beside = None
    if count < len(power):
        beside = Discrete.of(torch.cat((power[:count].sum().reshape(1), power[count:])), dtype)
    return ByTree(tree.build(*astuple(bounds)), beside)


def local(lights: Lights | None) -> bool:
    """Whether the choice asks where it is made, so that paths must keep that."""
    return lights is not None and isinstance(lights.choice, ByTree)


def draw(choice: Discrete | ByTree, u: Tensor, x: Tensor, n: Tensor | None) -> tuple[Tensor, Tensor]:
    """Rows ``(N,)`` and their probabilities ``(N,)``.

    Args:
        choice: the choice.
        u: ``(N,)`` in [0, 1); of 48 bits for a tree, see :func:`torchpt.lights.tree.fine`.
        x: reference points ``(3, N)``.
        n: normals ``(3, N)`` as :func:`torchpt.lights.tree.sample` takes them, or None.
    """
    if isinstance(choice, Discrete):
        row = choice.sample(u)
        return row, take(choice.pmf, row)
    if choice.beside is None:
        return tree.sample(choice.tree, x, n, u)
    beside, first = choice.beside, len(choice.tree.depth)
    outcome = beside.sample(u)
    share = beside.cdf[0].clamp_min(torch.finfo(torch.float64).tiny)
    row, p = tree.sample(choice.tree, x, n, (u.double() / share).clamp_max(1.0))
    near = outcome == 0
    return torch.where(near, row, outcome + (first - 1)), torch.where(near, p, 1.0) * take(beside.pmf, outcome)


def probability(choice: Discrete | ByTree, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """``(N,)`` with which :func:`draw` gives ``row (N,)`` at ``x, n``."""
    if isinstance(choice, Discrete):
        return take(choice.pmf, row)
    if choice.beside is None:
        return tree.probability(choice.tree, row, x, n)
    first = len(choice.tree.depth)
    p = tree.probability(choice.tree, row.clamp_max(first - 1), x, n)
    return torch.where(row < first, p, 1.0) * take(choice.beside.pmf, (row - (first - 1)).clamp_min(0))


def environment(choice: Discrete | ByTree | None) -> Tensor | float:
    """The probability of the last row, which is the environment's where there is one."""
    if choice is None:
        return 1.0
    chosen = choice if isinstance(choice, Discrete) else choice.beside
    assert chosen is not None
    return chosen.pmf[-1]
