"""The sky and the sun of Hosek and Wilkie, in linear sRGB.

Sources: Hosek and Wilkie, *An Analytic Model for Full Spectral Sky-Dome Radiance*, 2012 (equations 8 and 9), and *Adding a
Solar Radiance Function to the Hosek-Wilkie Skylight Model*, 2013. The numbers stand in ``hosek_wilkie.npz``, written by
``scripts/make_sky_data.py``. Units are Mitsuba's: W / (m^2 sr nm), weighted by the CIE's matching functions. The functions
are differentiable in turbidity and albedo.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

__all__ = ["SUN_RADIUS", "sky_model", "sky_radiance", "sun_profile", "sun_radiance"]

#: Angular radius of the sun in radians, for which its radiance was fitted.
SUN_RADIUS = math.radians(0.5358 / 2.0)
#: One over the integral of the CIE's y over wavelengths, 106.75 nm; the sky's numbers are spectral radiance times y.
_SKY_UNIT = 1.0 / 106.7502593994140625
#: The same for the sum over the 11 wavelengths of the sun's numbers.
_SUN_UNIT = 467.069280386 * _SKY_UNIT
#: Degree of the polynomial in height that stands for the fall of the sun's radiance to the horizon.
_DEGREE = 3


@cache
def _numbers() -> dict[str, Tensor]:
    with np.load(Path(__file__).with_suffix(".npz"), allow_pickle=False) as file:
        return {name: torch.from_numpy(file[name].astype(np.float64)) for name in file.files}


def _at_turbidity(name: str, turbidity: Tensor) -> Tensor:
    """Return numbers interpolated in turbidity, their first axis."""
    numbers = _numbers()[name].to(turbidity.device)
    low = turbidity.detach().floor().clamp(1.0, 9.0)
    share, row = turbidity - low, low.long()
    return numbers[row - 1] * (1.0 - share) + numbers[row] * share


def sky_model(turbidity: Tensor, albedo: Tensor, elevation: float) -> tuple[Tensor, Tensor]:
    """Return the nine parameters ``(9, 3)`` of the sky's formula and its mean radiance ``(3,)``.

    Args:
        turbidity: ``()`` float64 in 1..10.
        albedo: ``(3,)`` of the ground.
        elevation: of the sun above the horizon, in radians, >= 0.
    """
    t = (elevation / (0.5 * math.pi)) ** (1.0 / 3.0)
    found = []
    for name in ("sky_parameters", "sky_radiance"):
        numbers = _at_turbidity(name, turbidity).movedim(2, -1)  # (2 albedos, 6, [9,] 3)
        numbers = numbers[0] * (1.0 - albedo) + numbers[1] * albedo
        # A Bezier curve of degree 5 in the cube root of the elevation.
        found.append(sum(math.comb(5, k) * t**k * (1.0 - t) ** (5 - k) * numbers[k] for k in range(6)))
    return found[0], found[1] * _SKY_UNIT


def sky_radiance(model: tuple[Tensor, Tensor], cos_zenith: Tensor, cos_gamma: Tensor, gamma: Tensor) -> Tensor:
    """Return the radiance ``(3, N)`` of the sky; what the formula makes negative is 0.

    Args:
        model: from :func:`sky_model`.
        cos_zenith: cosines ``(N,)`` of the angles of directions from the zenith, > 0.
        cos_gamma: cosines of their angles from the sun.
        gamma: these angles.
    """
    parameters, mean = model
    a, b, c, d, e, f, g, h, i = (parameters[k][:, None] for k in range(9))
    square = cos_gamma * cos_gamma
    across = 1.0 + i * i - 2.0 * i * cos_gamma
    chi = (1.0 + square) / (across * across.sqrt())
    gradation = 1.0 + a * torch.exp(b / (cos_zenith + 0.01))
    indicatrix = c + d * torch.exp(e * gamma) + f * square + g * chi + h * cos_zenith.sqrt()
    return (gradation * indicatrix * mean[:, None]).clamp_min(0.0)


def sun_radiance(turbidity: Tensor, elevation: Tensor) -> Tensor:
    """Return the spectral radiance ``(11, N)`` of the middle of the sun's disc, at elevations ``(N,)`` in radians, >= 0."""
    numbers = _at_turbidity("sun_radiance", turbidity)  # (45, 11, 4)
    count = numbers.shape[0]
    # Pieces whose ends are equal steps of the elevation's cube root.
    piece = ((elevation * (2.0 / math.pi)).pow(1.0 / 3.0) * count).long().clamp(0, count - 1)
    x = elevation - (piece.double() / count) ** 3 * (0.5 * math.pi)
    a, b, c, d = numbers[piece].unbind(-1)
    x = x[:, None]
    return (a + x * (b + x * (c + x * d))).T


def sun_profile(turbidity: Tensor, elevation: float) -> Tensor:
    """Return coefficients ``(6, 4, 3)`` of the radiance of the sun's disc.

    Take a point of the disc at the height ``v``, -1 at its lower rim and 1 at its upper one, where ``m`` is the cosine of the
    angle between ray and normal of the sun's surface. Its radiance is the sum over j and k of ``c[j, k] m^j v^k``: the fall to
    the limb, times that of the air toward the horizon.

    Args:
        turbidity: ``()`` float64 in 1..10.
        elevation: of the sun's middle above the horizon, in radians, >= 0.
    """
    numbers = _numbers()
    limb, to_rgb = (numbers[name].to(turbidity.device) for name in ("sun_limb", "sun_to_rgb"))
    v = torch.linspace(-1.0, 1.0, 65, dtype=torch.float64, device=turbidity.device)
    height = (elevation + SUN_RADIUS * v).clamp_max(0.5 * math.pi)
    v, height = v[height >= 0.0], height[height >= 0.0]
    powers = v[:, None] ** torch.arange(_DEGREE + 1, device=v.device)
    fitted = torch.linalg.pinv(powers) @ sun_radiance(turbidity, height).T  # (4, 11)
    return torch.einsum("kw,wj,wc->jkc", fitted, limb, to_rgb) * _SUN_UNIT
