"""Light samplers: choose a light uniformly, by power, or by the light tree, and bound lights for the tree.

A light sampler chooses a row of the light table (:class:`Lights`). Rows of *local* lights, those at a finite distance, come
first; rows of *distant* ones (directional lights, environments) follow. A light tree holds the local lights only.
:func:`light_sampler` is called while a world is built; :func:`draw` and :func:`probability` are called on lanes.
"""

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
    """Bounds of K lights, in the order of arguments of :func:`torchpt.physics.lights.tree.build`; float64, detached."""

    low: Tensor  # (3, K) lower corner of the bounding box
    high: Tensor  # (3, K) upper corner
    axis: Tensor  # (3, K) unit axis of the cone of emission
    cos_o: Tensor  # (K,) as in torchpt.physics.lights.base.Cone
    cos_e: Tensor  # (K,)
    intensity: Tensor  # (K,)


def bounds_of(lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor]) -> Bounds:
    """Return the bounds of all local lights, which are the first rows.

    Args:
        lights: the table.
        power: power of all rows ``(K,)``.
        boxes: lower and upper corners ``(3, E)`` of the boxes of the E emissive primitives, which are the first rows.
    """
    local_kinds = [kind for kind in map(emitter, lights.kinds) if not kind.distant]
    kind_of_row = torch.zeros_like(lights.area, dtype=torch.int64) if lights.kind is None else lights.kind
    count = int((kind_of_row < len(local_kinds)).sum())
    kind_of_row = kind_of_row[:count]
    columns = {name: getattr(lights, name)[..., :count].detach().double() for name in COLUMNS}
    position, num_surfaces = columns["p0"], boxes[0].shape[1]
    # The box of a light without a surface is its position.
    low, high = (torch.cat((corner.double(), position[:, num_surfaces:]), 1) for corner in boxes)
    cos_o, cos_e = torch.empty_like(position[0]), torch.empty_like(position[0])
    intensity = power[:count].detach().double() / math.pi
    for k, kind in enumerate(local_kinds):
        rows = (kind_of_row == k).nonzero().squeeze(1)
        at = replace(lights, **{name: column.index_select(-1, rows) for name, column in columns.items()})
        cone = kind.bounds(at, intensity[rows])
        cos_o[rows], cos_e[rows], intensity[rows] = cone.cos_o, cone.cos_e, cone.intensity
    return Bounds(low=low, high=high, axis=columns["normal"], cos_o=cos_o, cos_e=cos_e, intensity=intensity)


# ---- Choice of a light
#
# :func:`draw` returns rows and their probabilities, :func:`probability` the probability of a row whose light a ray hit.


#: Values of the integrators' key `light_choice`; auto is `power` below :data:`MANY` local lights, else `tree`.
LIGHT_SAMPLERS = ("auto", "uniform", "power", "tree")
#: Number of local lights from which on `auto` takes the light tree.
MANY = 3
#: A tree of K lights is mixed with a uniform choice, of probability ``min(UNIFORM_MOST, UNIFORM_LIGHTS / K)``, and 0 beyond
#: UNIFORM_MAX_COUNT lights. The tree ignores the BSDF and may nearly always choose the wrong light for a glossy surface. At 64
#: samples a pixel the mixture halves the error of four plates under five lights; among many lights it would not help, and
#: cost where one outshines all.
UNIFORM_MOST, UNIFORM_LIGHTS, UNIFORM_MAX_COUNT = 0.25, 2.0, 64
#: The largest float64 below 1.
_BELOW_ONE = 1.0 - 2.0**-53


@dataclass(frozen=True)
class TreeSampler:
    """Light sampler of a light tree over local lights, and a choice by power between it and each distant light."""

    tree: LightTree
    tree_or_distant: Distribution1D | None  # outcome 0: the tree; 1 + k: distant light k; None without distant lights
    uniform: Distribution1D | None  # over the rows of the tree; None if it is never used
    uniform_probability: Tensor  # () float64 probability of `uniform` in place of the tree


def light_sampler(
    lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor], light_choice: str
) -> Distribution1D | TreeSampler | None:
    """Return the light sampler of a table, None for a single light.

    Args:
        lights: the table; its field ``choice`` is not read.
        power: power of the rows ``(K,)``, float64.
        boxes: lower and upper corners ``(3, E)`` of the boxes of the E emissive primitives, which are the first rows.
        light_choice: one of :data:`LIGHT_SAMPLERS`.
    """
    dtype = lights.area.dtype
    if len(power) == 1:
        return None
    if light_choice in ("uniform", "power") or (light_choice == "auto" and len(power) < MANY):
        return Distribution1D.of((power > 0).double() if light_choice == "uniform" else power, dtype)
    bounds = bounds_of(lights, power, boxes)
    count = len(bounds.intensity)
    if not count or (light_choice == "auto" and count < MANY):
        return Distribution1D.of(power, dtype)
    tree_or_distant = None
    if count < len(power):
        weights = torch.cat((sum_all(power[:count]).reshape(1), power[count:]))
        tree_or_distant = Distribution1D.of(weights, dtype)
    shining = (power[:count] > 0).double()  # 1 for lights of positive power, else 0
    mixed = count <= UNIFORM_MAX_COUNT
    uniform_probability = min(UNIFORM_MOST, UNIFORM_LIGHTS / max(float(shining.sum()), 1.0)) if mixed else 0.0
    return TreeSampler(
        tree=tree.build(*astuple(bounds)),  # its arguments are the fields, in their order
        tree_or_distant=tree_or_distant,
        uniform=Distribution1D.of(shining, dtype) if mixed else None,
        uniform_probability=torch.tensor(uniform_probability, dtype=torch.float64, device=power.device),
    )


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
        row, remapped = choice.draw(u)
        return row, take(choice.pmf, row), remapped
    if choice.tree_or_distant is None:
        return _draw_local(choice, u, x, n)
    tree_or_distant, first_distant = choice.tree_or_distant, choice.tree.count
    outcome, u = tree_or_distant.draw(u)
    row, p, remapped = _draw_local(choice, u, x, n)
    is_local = outcome == 0
    remapped = torch.where(is_local, remapped, u)
    p = torch.where(is_local, p, 1.0) * take(tree_or_distant.pmf, outcome)
    return torch.where(is_local, row, outcome + (first_distant - 1)), p, remapped


def _draw_local(choice: TreeSampler, u: Tensor, x: Tensor, n: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Choose among local lights; arguments and results as for :func:`draw`."""
    if choice.uniform is None:
        return tree.sample(choice.tree, x, n, u)
    p_uniform = choice.uniform_probability
    is_uniform = u < p_uniform
    uniform_row, uniform_remapped = choice.uniform.draw((u / p_uniform).clamp_max(_BELOW_ONE))
    given = torch.where(is_uniform, uniform_row, -1)
    # Either way may have chosen the row, so the probability is that of the mixture.
    row, p, remapped = tree.sample(choice.tree, x, n, ((u - p_uniform) / (1.0 - p_uniform)).clamp_min(0.0), given)
    return row, _mixed(choice, row, p), torch.where(is_uniform, uniform_remapped, remapped)


def _local_probability(choice: TreeSampler, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """Return the probability ``(N,)`` of ``row (N,)``, given that a local light is chosen."""
    return _mixed(choice, row, tree.probability(choice.tree, row, x, n))


def _mixed(choice: TreeSampler, row: Tensor, p: Tensor) -> Tensor:
    """Return the probability ``(N,)`` of rows of which the tree has the probabilities ``p (N,)``."""
    if choice.uniform is None:
        return p
    p_uniform = choice.uniform_probability.to(p.dtype)
    return p * (1.0 - p_uniform) + take(choice.uniform.pmf, row) * p_uniform


def probability(choice: Distribution1D | TreeSampler, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """Return the probability ``(N,)`` with which :func:`draw` chooses ``row (N,)`` at ``x`` and ``n``."""
    if isinstance(choice, Distribution1D):
        return take(choice.pmf, row)
    if choice.tree_or_distant is None:
        return _local_probability(choice, row, x, n)
    first_distant = choice.tree.count
    p = _local_probability(choice, torch.minimum(row, first_distant - 1), x, n)
    outcome = (row - (first_distant - 1)).clamp_min(0)
    return torch.where(row < first_distant, p, 1.0) * take(choice.tree_or_distant.pmf, outcome)


def environment(choice: Distribution1D | TreeSampler | None) -> Tensor | float:
    """Return the probability of the last row, the environment's if the scene has one."""
    if choice is None:
        return 1.0
    distribution = choice if isinstance(choice, Distribution1D) else choice.tree_or_distant
    assert distribution is not None
    return distribution.pmf[-1]


def without_last(choice: Distribution1D | TreeSampler) -> Distribution1D | TreeSampler:
    """Return the light sampler without the last row, a distant light; at least one row has to be left."""
    if isinstance(choice, TreeSampler):
        outcomes = choice.tree_or_distant
        assert outcomes is not None  # distant lights are not in the tree
        only_tree_left = len(outcomes.pmf) == 2
        return replace(choice, tree_or_distant=None if only_tree_left else _without_last_outcome(outcomes))
    return _without_last_outcome(choice)


def _without_last_outcome(distribution: Distribution1D) -> Distribution1D:
    """Return the distribution of the other outcomes than the last."""
    return Distribution1D.of(distribution.pmf[:-1], distribution.pmf.dtype)
