"""Light tree: chooses lights near a point, aimed at it and above its horizon most often.

    build(low, high, axis, cos_o, cos_e, intensity) -> LightTree
    sample(tree, x, n, u) -> row, probability
    probability(tree, row, x, n) -> probability

After Conty Estevez and Kulla, "Importance Sampling of Many Lights with Adaptive Tree Splitting" (2018), with the bounds of
Pharr, Jakob, Humphreys, *Physically Based Rendering*, 4th ed., section 12.6.3. A node has eight children rather than two: they
are weighted together as one vector, and a choice among finer groups has less variance.

Lights that cannot contribute (turned away, below the horizon) have probability 0. If that holds for a whole node, its
children are chosen uniformly, so that the probabilities of all rows sum to 1 at every point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.core.dispatch import dispatched

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["FIELDS", "WIDTH", "LightTree", "build", "from_digits", "probability", "sample"]

#: Children of a node: as many as a vector of AVX2 holds float32.
WIDTH = 8
#: Up to so many lights are the children of one node, whose fields are the same for all lanes: reading those of a lane's own
#: node takes longer than weighing two more rows of eight. A multiple of WIDTH.
MOST_FLAT = 24
#: Fields of each child of a node: bounding sphere, cone of the axes, angle of emission beyond the cone (angles as cosines), and
#: intensity relative to the brightest child.
FIELDS = ("x", "y", "z", "radius", "axis x", "axis y", "axis z", "cos o", "sin o", "cos e", "intensity")
#: Cosines are raised by this much, so that rounding does not give a contributing light probability 0.
SLACK = 2.0**-20
#: Squared distances are at least this fraction of the squared radius. With 1/4, and cosines as in `_weigh`, variance was 1.4
#: to 6 times lower than with 1 and with bounds alone, for 1,000 lights in four kinds of scenes.
NEAR = 0.25
#: Levels of a path through the tree that one 32-bit word holds, and bits of each; of the one level of a wider root.
STEPS, BITS, WIDE_BITS = 10, 3, 5
#: Least intensity of a light over the sum of all, so that it stays in the range of float32.
_DIMMEST = 1e-30


@dataclass(frozen=True)
class LightTree:
    """A tree over K lights."""

    nodes: Tensor  # (M, F, 8) float32: a field of FIELDS, for each child; a single node may have 16 or 24 in place of 8
    child: Tensor  # (M, 8) int32: index of a node, or ~row (negative) for the light of that row of the light table
    full: Tensor  # (M,) int32 number of children
    trail: Tensor  # (W, K) int32 path from the root: `bits` a level, ten levels a word, the first level lowest
    depth: Tensor  # (K,) int32 number of levels; 0 for lights without intensity, which are not in the tree
    count: Tensor  # () int64 K
    levels: int  # the largest of `depth`

    @property
    def bits(self) -> int:
        """Return the bits of a level in ``trail``."""
        return BITS if self.child.shape[1] == WIDTH else WIDE_BITS


def build(low: Tensor, high: Tensor, axis: Tensor, cos_o: Tensor, cos_e: Tensor, intensity: Tensor) -> LightTree:
    """Build the tree over lights, given by bounding boxes and cones of emission.

    Args:
        low: lower corners ``(3, K)``.
        high: upper corners ``(3, K)``.
        axis: axes of the cones, unit ``(3, K)``.
        cos_o: ``(K,)`` cosine of the half angle of the cone about ``axis`` that holds all normals; -1: all directions.
        cos_e: ``(K,)`` cosine of the largest angle between a normal and emitted light: 0 for the whole hemisphere.
        intensity: ``(K,)`` maximum radiant intensity, up to a common factor. Lights of intensity 0 are never chosen, unless
            all are 0: then all are chosen alike.
    """
    import numpy as np

    from torchpt.native.kernels import kernel

    def array(tensor: Tensor) -> np.ndarray:
        return tensor.detach().double().cpu().numpy()

    device, count = intensity.device, len(intensity)
    power = np.nan_to_num(array(intensity), nan=0.0, posinf=np.finfo(np.float64).max / max(count, 1)).clip(min=0.0)
    if not power.any():
        power = np.ones_like(power)
    power = power / power.max()
    shining = power > 0
    power = np.where(shining, np.maximum(power / power.sum(), _DIMMEST), 0.0)
    cone = array(cos_o)
    # Columns, which the builder adds and bounds over groups: low, high, axis weighted by power and by how narrow the cone is,
    # cos_e, power, number of lights.
    lights = np.empty((count, 12))
    lights[:, 0:3], lights[:, 3:6] = array(low).T, array(high).T
    lights[:, 6:9] = array(axis).T * (power * (0.5 + 0.5 * cone))[:, None]
    lights[:, 9], lights[:, 10], lights[:, 11] = array(cos_e), power, 1.0
    lights = np.nan_to_num(lights)
    ids = np.nonzero(shining)[0].astype(np.int32)
    if WIDTH < len(ids) <= MOST_FLAT:
        return _flat(lights, cone, ids, device)
    max_nodes = max(len(ids) - 1, 1)  # every node has at least two children
    nodes = np.zeros((max_nodes, len(FIELDS), WIDTH), np.float32)
    child = np.zeros((max_nodes, WIDTH), np.int32)
    full, trail, depth = np.zeros(max_nodes, np.int32), np.zeros(count, np.int64), np.zeros(count, np.int32)
    # Memory of the builder: for each node a span of `ids`, its level, and its path from the root.
    scratch = np.zeros((max_nodes, 2), np.int64), np.zeros(max_nodes, np.int64), np.zeros(max_nodes, np.int64)
    num_nodes = kernel("light_tree", "build")(lights, cone, ids, nodes, child, full, trail, depth, *scratch)
    levels = int(depth.max())
    # Three bits a level; a word of int32 holds those of STEPS levels.
    words = [trail >> BITS * first & (1 << BITS * STEPS) - 1 for first in range(0, max(levels, 1), STEPS)]
    tensors = (
        torch.from_numpy(a).to(device)
        for a in (
            nodes[:num_nodes].copy(),
            child[:num_nodes].copy(),
            full[:num_nodes].copy(),
            np.stack(words).astype(np.int32),
            depth,
        )
    )
    return LightTree(*tensors, count=torch.tensor(count, dtype=torch.int64, device=device), levels=levels)


def _flat(
    lights: NDArray[np.float64], cone: NDArray[np.float64], ids: NDArray[np.int32], device: torch.device
) -> LightTree:
    """Return the tree of one node, whose children are the lights ``ids``; see :func:`build` for ``lights`` and ``cone``."""
    import numpy as np

    some, width = lights[ids], -(-len(ids) // WIDTH) * WIDTH
    low, high, axis, power = some[:, 0:3], some[:, 3:6], some[:, 6:9], some[:, 10]
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    turned = length[:, 0] > 0  # else the light shines all around
    angle = np.where(turned, np.arccos(cone[ids].clip(-1.0, 1.0)), math.pi)
    # The radius is enlarged by the rounding of float32.
    radius = np.linalg.norm(0.5 * (high - low), axis=1) * (1.0 + 2.0**-20)
    radius += np.maximum(abs(low), abs(high)).max(1) * 2.0**-21
    columns = [
        *(0.5 * (low + high)).T,
        radius,
        *np.where(turned[:, None], axis / np.where(length > 0, length, 1.0), 0.0).T,
        np.cos(angle),
        np.sin(angle),
        some[:, 9],
        power / power.max(),
    ]
    nodes, child = np.zeros((1, len(FIELDS), width), np.float32), np.zeros((1, width), np.int32)
    nodes[0, :, : len(ids)], child[0, : len(ids)] = np.stack(columns), ~ids
    trail, depth = np.zeros((1, len(lights)), np.int32), np.zeros(len(lights), np.int32)
    trail[0, ids], depth[ids] = np.arange(len(ids)), 1
    full = np.array([len(ids)], np.int32)
    tensors = (torch.from_numpy(a).to(device) for a in (nodes, child, full, trail, depth))
    return LightTree(*tensors, count=torch.tensor(len(lights), dtype=torch.int64, device=device), levels=1)


def from_digits(high: Tensor, low: Tensor) -> Tensor:
    """Return two numbers ``(N,)`` in [0, 1) as one ``(N,)`` float64 of 48 bits: ``low`` continues the digits of ``high``.

    Numbers of samplers have 24 bits, too few for lights of lower probability.
    """
    return torch.add(high.double(), low.double(), alpha=2.0**-24)


@dispatched
@torch.no_grad()
def sample(
    tree: LightTree, x: Tensor, n: Tensor | None, u: Tensor, given: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Choose a light for each point.

    Args:
        tree: the lights.
        x: points to be lit ``(3, N)``.
        n: unit normals ``(3, N)`` of surfaces lit on their front only; zero where light counts from both sides. None: zero
            everywhere.
        u: ``(N,)`` in [0, 1), float64, see :func:`from_digits`.
        given: rows ``(N,)`` int64 that are chosen whatever ``u`` is, -1 where there is none. None: nowhere.

    Returns:
        Rows ``(N,)`` int64, their probabilities by ``u`` ``(N,)``, positive but for given rows, and the remapped ``u``:
        ``(N,)`` float64 in [0, 1], uniform given the choice, of no meaning for given rows.
    """
    row, p, remapped = _walk(tree, x, n, u=u, row=given)
    assert remapped is not None
    return row, p, remapped


@dispatched
@torch.no_grad()
def probability(tree: LightTree, row: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """Return the probability ``(N,)`` with which :func:`sample` chooses ``row (N,)`` at ``x`` and ``n``."""
    _, p, _ = _walk(tree, x, n, u=None, row=row)
    return p


def _weigh(nodes: Tensor, x: Tensor, n: Tensor | None) -> Tensor:
    """Return weights ``(N, 8)`` of the children of ``nodes (N, F, 8)``, in float32, zero only where no light contributes.

    Pharr et al., PBRT 4th ed., section 12.6.3: with theta_w the angle between a child's axis and the direction to p, and
    theta_b the angle that the child subtends, its lights emit toward p at least theta_w - theta_o - theta_b off their normals;
    likewise for p's own normal. Bounds alone would favour wide groups: each cosine is the mean of its bound and its value at
    the centre.

    In the names below, suffix ``w`` is theta_w, ``b`` theta_b, ``o`` theta_o, ``x`` theta_w - theta_o, and ``i`` the angle at
    p's normal; ``best`` is the bound of a cosine.
    """
    p, tiny = x.float(), torch.finfo(torch.float32).tiny
    cx, cy, cz, radius, ax, ay, az, cos_o, sin_o, cos_e, intensity = nodes.unbind(1)
    dx, dy, dz = p[0, :, None] - cx, p[1, :, None] - cy, p[2, :, None] - cz
    square = (dx * dx + dy * dy + dz * dz).clamp_min(tiny)
    inverse = 1.0 / square.sqrt()
    sin_b = radius * inverse
    within, cos_b = sin_b >= 1, _root(1.0 - sin_b * sin_b)
    cos_w = (ax * dx + ay * dy + az * dz) * inverse
    sin_w = _root(1.0 - cos_w * cos_w)
    covered = cos_w >= cos_o
    cos_x = torch.where(covered, 1.0, cos_w * cos_o + sin_w * sin_o)
    sin_x = torch.where(covered, 0.0, sin_w * cos_o - cos_w * sin_o)
    best = torch.where(within | (cos_x >= cos_b), 1.0, cos_x * cos_b + sin_x * sin_b) + SLACK
    cosine = torch.where(best > cos_e, best.clamp_min(SLACK) + cos_x.clamp_min(0.0), 0.0)
    if n is not None:
        normal = n.float()
        nx, ny, nz = normal[0, :, None], normal[1, :, None], normal[2, :, None]
        cos_i = -(nx * dx + ny * dy + nz * dz) * inverse
        sin_i = _root(1.0 - cos_i * cos_i)
        best = torch.where(within | (cos_i >= cos_b), 1.0, cos_i * cos_b + sin_i * sin_b) + SLACK
        below = torch.where(best > 0, best + cos_i.clamp_min(0.0), 0.0)
        turned = (nx != 0) | (ny != 0) | (nz != 0)
        cosine = cosine * torch.where(turned, below, 1.0)
    return intensity * cosine / torch.maximum(square, NEAR * radius * radius)


def _root(a: Tensor) -> Tensor:
    """Return the root ``(N, 8)``, of 0 where rounding has made ``a`` negative."""
    return a.clamp_min(0.0).sqrt()


def _walk(
    tree: LightTree, x: Tensor, n: Tensor | None, u: Tensor | None, row: Tensor | None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Descend the tree; return the rows reached, their probabilities, and the remapped ``u``.

    The way is that to ``row``, by ``u`` where that is negative. Either may be None.
    """
    node = torch.zeros(x.shape[1], dtype=torch.int64, device=x.device)
    p = torch.ones(x.shape[1], dtype=torch.float64, device=x.device)
    child_index = torch.arange(tree.child.shape[1], device=x.device)
    trail: Tensor | None = None  # (N,) children on the way down to `row`
    remapped = None if u is None else u.double()
    for level in range(tree.levels):
        if row is not None and level % STEPS == 0:
            trail = tree.trail[level // STEPS][row.clamp_min(0)]
        inner = node.clamp_min(0)  # lanes that have arrived at a light read the root; what they compute is dropped
        weight = _weigh(tree.nodes[inner], x, n).double()
        total = weight.sum(1, keepdim=True)
        weight = torch.where(total > 0, weight, (child_index < tree.full[inner, None]).double())
        ends = weight.cumsum(1)
        aim = None if remapped is None else remapped * ends[:, -1]
        chosen: Tensor | None = None
        if aim is not None:
            # The last child of positive weight whose interval starts at or before `aim`.
            chosen = torch.where((weight > 0) & (ends - weight <= aim[:, None]), child_index, 0).amax(1)
        if row is not None and trail is not None:
            next_child, trail = (trail & (1 << tree.bits) - 1).long(), trail >> tree.bits
            chosen = next_child if chosen is None else torch.where(row < 0, chosen, next_child)
        assert chosen is not None
        chosen_weight, end = (a.gather(1, chosen[:, None])[:, 0] for a in (weight, ends))
        deeper = node >= 0
        if aim is not None and remapped is not None:
            inside = ((aim - (end - chosen_weight)) / chosen_weight).clamp(0.0, 1.0)
            remapped = torch.where(deeper, inside, remapped)
        p = torch.where(deeper, p * chosen_weight / ends[:, -1], p)
        node = torch.where(deeper, tree.child[inner, chosen].long(), node)
    if row is not None:
        p = torch.where((row < 0) | (tree.depth[row.clamp_min(0)] > 0), p, 0.0)
    reached = ~node if row is None else torch.where(row < 0, ~node, row)  # a row may be that of no light of the tree
    return reached, p.to(x.dtype), remapped
