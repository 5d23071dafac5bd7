"""Shadow rays of splats and of connections, what these bring, and sums of splats.

:mod:`torchpt.engines.kernels.joins` and :mod:`torchpt.physics.film.splats` call these kernels. An arena is rows of ``stride``
words, a column a lane.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kernel_sources.jit import DOUBLES, FLOATS, INT, INTS, LONGS, inner, kernel
from kernel_sources.simd import item, put
from torchpt.engines.kernels.joins import RAY_ROWS
from torchpt.physics.film.splats import FRACTION_BITS

__all__ = ["add", "add_connections", "begin_rays", "end_splats"]

#: Unit of a limb in those of the next.
UNIT = 2.0**FRACTION_BITS


@kernel("splats", INTS, INT, INT, INT, INT, INT, INT, INT, INTS, INTS)
def begin_rays(
    words: Any, stride: int, count: int, row: int, mask: int, least: int, ray: int, shadow: int, lanes: Any, saved: Any
) -> Any:
    """List the lanes that have a ray, and copy these side by side to the rows of those to lights.

    Args:
        words: the arena.
        stride: of its rows.
        count: number of lanes.
        row: that tells which lanes have a ray: those with more than ``least`` in the bits ``mask`` of their word there.
        mask: see ``row``.
        least: likewise.
        ray: the first row of the rays.
        shadow: the first row of those to lights.
        lanes: the list, with room for ``count``.
        saved: ``(RAY_ROWS, count)`` what was in these.

    Returns:
        The number of rays.
    """
    n = np.int64(0)
    for k in range(count):  # without a branch
        put(lanes, n, np.int32(k))
        n += np.int64((np.int64(item(words, row * stride + k)) & mask) > least)
    for r in range(RAY_ROWS):
        for k in range(n):
            place = (shadow + r) * stride + k
            put(saved, r * n + k, item(words, place))
            put(words, place, item(words, (ray + r) * stride + np.int64(item(lanes, k))))
    return n


@inner(forceinline=True)
def _restore(words, stride, shadow, count, saved):
    """Write back what :func:`begin_rays` has saved."""
    for r in range(RAY_ROWS):
        for k in range(count):
            put(words, (shadow + r) * stride + k, item(saved, r * count + k))


@inner(forceinline=True)
def _passed(words, floats, place, partly):
    """Return the transmittance of a ray: a number in the arena where surfaces may let part of the light pass, else 0 or 1."""
    if partly:
        return item(floats, place)
    return np.float32(item(words, place) == 0)


@kernel(
    "splats", INTS, FLOATS, INT, INT, INT, INT, INT, INT, INT, INT, INT, INT, INTS, INTS, FLOATS, INTS, INTS, FLOATS, INTS
)  # fmt: skip
def end_splats(
    words: Any,
    floats: Any,
    stride: int,
    lane_count: int,
    count: int,
    shadow: int,
    result: int,
    partly: int,
    lane_row: int,
    pixel_row: int,
    radiance: int,
    transmittance: int,
    lanes: Any,
    saved: Any,
    largest: Any,
    samples: Any,
    pixels: Any,
    values: Any,
    lost: Any,
) -> Any:
    """Collect the splats that arrive, after the search of their rays.

    Args:
        words: the arena.
        floats: the same memory.
        stride: of its rows.
        lane_count: number of lanes.
        count: number of rays.
        shadow: see :func:`begin_rays`.
        result: row of the results of the search.
        partly: whether that is the transmittance.
        lane_row: row of the lanes' samples.
        pixel_row: of the splats' pixels.
        radiance: first row of the splats' radiance.
        transmittance: row to write the transmittance to, 0 in lanes without a splat.
        lanes: see :func:`begin_rays`.
        saved: likewise.
        largest: ``(1,)`` value from which on a splat counts as infinite.
        samples: ``(count,)`` the samples of the splats found.
        pixels: ``(count,)`` their pixels.
        values: ``(3, count)`` their radiance, each row from ``count`` times its number on.
        lost: ``(count + 1,)`` number of samples with a splat that is not finite, and these.

    Returns:
        The number of splats.
    """
    _restore(words, stride, shadow, count, saved)
    limit, found, bad = item(largest, 0), np.int64(0), np.int64(0)
    for k in range(lane_count):
        put(floats, transmittance * stride + k, np.float32(0.0))
    for k in range(count):
        lane = np.int64(item(lanes, k))
        passed = _passed(words, floats, result * stride + k, partly)
        if passed == 0.0:
            continue
        put(floats, transmittance * stride + lane, passed)
        place = radiance * stride + lane
        r, g, b = (
            item(floats, place) * passed,
            item(floats, place + stride) * passed,
            item(floats, place + 2 * stride) * passed,
        )
        sample = item(words, lane_row * stride + lane)
        if abs(r) < limit and abs(g) < limit and abs(b) < limit:
            put(samples, found, sample)
            put(pixels, found, item(words, pixel_row * stride + lane))
            put(values, found, r)
            put(values, count + found, g)
            put(values, 2 * count + found, b)
            found += 1
        else:
            bad += 1
            put(lost, bad, sample)
    put(lost, 0, np.int32(bad))
    return found


@kernel("splats", INTS, FLOATS, INT, INT, INT, INT, INT, INT, INT, INTS, INTS)
def add_connections(
    words: Any,
    floats: Any,
    stride: int,
    count: int,
    shadow: int,
    result: int,
    partly: int,
    light: int,
    radiance: int,
    lanes: Any,
    saved: Any,
) -> None:
    """Add what connections bring to the radiance of their lanes, after the search of their rays.

    ``light``, ``radiance``: first rows of what goes through the connection, and of the path's radiance. Others as for
    :func:`end_splats`.
    """
    _restore(words, stride, shadow, count, saved)
    for k in range(count):
        lane, passed = np.int64(item(lanes, k)), _passed(words, floats, result * stride + k, partly)
        for channel in range(3):
            place = (radiance + channel) * stride + lane
            put(floats, place, item(floats, place) + item(floats, (light + channel) * stride + lane) * passed)


@kernel("splats", LONGS, INT, LONGS, INT, DOUBLES)
def add(sums: Any, size: int, index: Any, count: int, values: Any) -> None:
    """Add splats ``values (3, count)`` at ``index (count,)`` to sums in fixed point ``(3, 3, size)``: by limb and channel."""
    for k in range(count):
        place = item(index, k)
        for channel in range(3):
            value = item(values, channel * count + k)
            for limb in range(3):
                whole = np.int64(value)
                at = (3 * limb + channel) * size + place
                put(sums, at, item(sums, at) + whole)
                value = (value - np.float64(whole)) * UNIT
