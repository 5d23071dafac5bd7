"""Mitsuba 3 as the judge of a BSDF: its value and density for pairs of directions, and what counts as the same.

Mitsuba's ``wi`` points toward the previous vertex, so it is our ``wo``, and the other way round.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchpt.physics.bsdfs import Bsdf, Parameters, gather

__all__ = [
    "PAIRS",
    "assert_same",
    "both_sides",
    "mitsuba_bsdf",
    "mitsuba_eval_pdf",
    "ours_eval_pdf",
    "random_pairs",
    "rgb",
]

PAIRS = 10_000


def rgb(*values: float) -> dict[str, Any]:
    """A colour as Mitsuba's dicts spell it: `srgb` values are taken as they are in its RGB mode."""
    return {"type": "rgb", "value": list(values if len(values) == 3 else values * 3)}


def random_pairs(seed: int, n: int = PAIRS, near: float = 0.5, sharp: float = 0.1) -> tuple[Tensor, Tensor]:
    """Directions ``wo, wi (3, n)`` above the surface, float32.

    Both are uniform by solid angle but for a part ``near`` of the pairs, where ``wi`` is the mirror image of ``wo`` off by
    about ``sharp`` radians, so that narrow lobes are met too.
    """
    g = torch.Generator().manual_seed(seed)
    wo, wi = _uniform(n, g), _uniform(n, g)
    mirrored = torch.stack((-wo[0], -wo[1], wo[2])) + sharp * torch.randn(3, n, generator=g, dtype=torch.float64)
    mirrored[2] = mirrored[2].abs()
    take = torch.rand(n, generator=g, dtype=torch.float64) < near
    wi = torch.where(take, mirrored / mirrored.norm(dim=0), wi)
    return wo.float(), wi.float()


def both_sides(seed: int, eta: float, n: int = PAIRS, near: float = 0.5, sharp: float = 0.1) -> tuple[Tensor, Tensor]:
    """As :func:`random_pairs` on the whole sphere, from outside and inside; half the near ones are about the refracted ray.

    Args:
        seed: of the pairs.
        eta: index below the surface over that above it.
        n: how many.
        near: part of the pairs that are near the mirror image or the refracted ray.
        sharp: how near, in radians.
    """
    wo, wi = (w.double() for w in random_pairs(seed, n, near, sharp))
    g = torch.Generator().manual_seed(seed + 1)
    coin = torch.rand(3, n, generator=g, dtype=torch.float64) < 0.5
    flip = torch.tensor([[1.0], [1.0], [-1.0]], dtype=torch.float64)
    below = coin[0]
    ratio = torch.where(below, eta, 1 / eta)  # sine of the refracted ray over that of wo
    x, y = -wo[0] * ratio, -wo[1] * ratio
    height = 1 - x * x - y * y
    refracted = torch.stack((x, y, -height.clamp_min(0).sqrt()))
    refracted = refracted + sharp * torch.randn(3, n, generator=g, dtype=torch.float64)
    refracted = refracted / refracted.norm(dim=0)
    take = coin[1] & (height > 0) & (torch.rand(n, generator=g, dtype=torch.float64) < near)
    wi = torch.where(take, refracted, torch.where(coin[2], wi * flip, wi))
    return torch.where(below, wo * flip, wo).float(), torch.where(below, wi * flip, wi).float()


def mitsuba_bsdf(description: Mapping[str, Any]) -> Any:
    """A BSDF of Mitsuba's ``scalar_rgb`` variant from its dict."""
    mitsuba: Any = importlib.import_module("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba.load_dict(dict(description))


def mitsuba_eval_pdf(description: Mapping[str, Any], wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
    """Mitsuba's value ``f |cos(theta_i)| (3, N)`` and density ``(N,)``, float64 tensors of its float32 numbers.

    Args:
        description: the BSDF's dict.
        wo: ``(3, N)`` local, toward the previous vertex.
        wi: ``(3, N)`` local.
    """
    bsdf = mitsuba_bsdf(description)
    mitsuba: Any = importlib.import_module("mitsuba")
    context, point = mitsuba.BSDFContext(), mitsuba.SurfaceInteraction3f()
    values, densities = [], []
    for a, b in zip(wo.T.tolist(), wi.T.tolist(), strict=True):
        point.wi = a
        value, density = bsdf.eval_pdf(context, point, b)
        values.append((value[0], value[1], value[2]))
        densities.append(density)
    return torch.tensor(values, dtype=torch.float64).T.contiguous(), torch.tensor(densities, dtype=torch.float64)


def ours_eval_pdf(model: Bsdf, values: Mapping[str, Any], wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
    """Our value and density, in float32 from plain numbers and colours as a material is given them."""
    rows: Parameters = {}
    for name, value in values.items():
        colour = isinstance(value, tuple | list)
        rows[name] = torch.tensor([[x] for x in value] if colour else [value], dtype=torch.float32)
    lanes = gather(model.prepare(rows), torch.zeros(wo.shape[1], dtype=torch.int64))
    return model.eval_pdf(lanes, wo, wi)


def assert_same(
    ours: tuple[Tensor, Tensor],
    theirs: tuple[Tensor, Tensor],
    explain: Mapping[str, Tensor] | None = None,
    fraction: float = 0.999,
    relative: float = 1e-3,
    absolute: float = 1e-5,
) -> dict[str, int]:
    """``|a - b| <= relative |b| + absolute`` for a fraction of the pairs, and a named cause for each of the others.

    Args:
        ours: value ``(3, N)`` and density ``(N,)``.
        theirs: the same of Mitsuba's.
        explain: cause -> mask ``(N,)`` of the pairs that it can spoil; the first that holds is counted.
        fraction: how many have to agree.
        relative: tolerance.
        absolute: tolerance.

    Returns:
        How many outliers each cause has.
    """
    (value, density), (value_there, density_there) = ours, theirs
    a = torch.cat((value.detach().double(), density.detach().double()[None]))
    b = torch.cat((value_there.double(), density_there.double()[None]))
    assert a.shape == b.shape and torch.isfinite(a).all()
    off = ((a - b).abs() - relative * b.abs() - absolute > 0) | ~torch.isfinite(b)
    bad = off.any(0)
    same = 1 - float(bad.double().mean())
    left, counts = bad.clone(), {}
    for cause, mask in (explain or {}).items():
        counts[cause] = int((left & mask).sum())
        left &= ~mask
    worst = [f"{i}: ours {a[:, i].tolist()} theirs {b[:, i].tolist()}" for i in bad.nonzero()[:5, 0].tolist()]
    assert same >= fraction, f"only {same:.5f} of the pairs agree ({counts}): {worst}"
    unexplained = left.nonzero()[:5, 0].tolist()
    listed = [f"{i}: ours {a[:, i].tolist()} theirs {b[:, i].tolist()}" for i in unexplained]
    assert not left.any(), f"{int(left.sum())} outliers without a cause (beside {counts}): {listed}"
    return {cause: count for cause, count in counts.items() if count}


def _uniform(n: int, g: torch.Generator) -> Tensor:
    """Uniform on the upper hemisphere, float64 ``(3, n)``."""
    z, phi = torch.rand(n, generator=g, dtype=torch.float64), torch.rand(n, generator=g, dtype=torch.float64)
    r, phi = (1 - z * z).sqrt(), 2 * math.pi * phi
    return torch.stack((r * phi.cos(), r * phi.sin(), z))
