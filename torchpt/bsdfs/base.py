"""Conventions of every BSDF, stated once.

Directions are local: ``+z`` is the shading normal; ``wo`` points toward the previous vertex, ``wi`` is sampled. Both leave
the surface. ``eval`` includes ``|cos(theta_i)|``, ``pdf`` is in solid angle, ``weight = eval / pdf``, and ``pdf = 0`` says
that the sample failed. A model is a module with

    PARAMETERS: names of its stacked parameters
    sample(parameters, wo, lobe, u) -> BsdfSample   # lobe (N,), u (2, N)
    eval(parameters, wo, wi) -> (3, N)
    pdf(parameters, wo, wi) -> (N,)
    albedo(parameters) -> (3, N)                    # colour for the albedo layer

where each parameter is already a lane value, ``(3, N)`` or ``(N,)``, or ``None`` where the scene leaves it at what costs
nothing. The functions are pure.
"""

from __future__ import annotations

from torch import Tensor

__all__ = ["Parameters"]

Parameters = dict[str, Tensor | None]
