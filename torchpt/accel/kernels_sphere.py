"""The distance to a sphere (numba), shared by the packet and the tree kernels."""

from __future__ import annotations

import math

import numpy as np

from torchpt.native.jit import part

__all__ = ["sphere_distance"]


@part(forceinline=True)
def sphere_distance(ox, oy, oz, dx, dy, dz, cx, cy, cz, radius):
    """Nearest positive ``t`` at which ``o + t d`` meets the sphere, as float32; NaN where it does not.

    Haines et al., "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems, ch. 7: the discriminant comes
    from the perpendicular from the centre to the ray, the roots from ``q = b + sign(b) sqrt(a disc)``. In float64, so
    that rays that start on the sphere, offset by a few float32 ulps, know their side exactly.
    """
    fx, fy, fz = np.float64(ox) - cx, np.float64(oy) - cy, np.float64(oz) - cz
    ex, ey, ez = np.float64(dx), np.float64(dy), np.float64(dz)
    a = ex * ex + ey * ey + ez * ez
    b = -(fx * ex + fy * ey + fz * ez)
    s = b / a
    lx, ly, lz = fx + s * ex, fy + s * ey, fz + s * ez
    disc = radius * radius - (lx * lx + ly * ly + lz * lz)
    root = math.sqrt(a * disc)  # NaN for a miss: every comparison below is then false
    q = b + (root if b >= 0.0 else -root)
    near = (fx * fx + fy * fy + fz * fz - radius * radius) / q
    far = q / a
    low = near if near < far else far
    high = far if near < far else near
    return np.float32(low if low > 0.0 else high)
