"""Vectors in kernels against numpy, bit for bit, on ordinary and on special values."""

import operator

import numba
import numpy as np
import pytest
from kernel_sources import simd


def jit(**options):
    return numba.njit(error_model="numpy", **options)


LANES = (pytest.param(4, marks=pytest.mark.slow), 8, pytest.param(16, marks=pytest.mark.slow))
SPECIAL = np.array(
    [0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e-45, -1e-45, 1.1754942e-38, 3.4028235e38, -3.4028235e38],
    np.float32,
)


def floats(seed=0, rows=600):
    """Pairs ``(rows * 16,)``: random bits, ordinary numbers and each special value beside each."""
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, 2**32, (2, rows * 16), dtype=np.uint32).view(np.float32)
    a[::2], b[::2] = rng.normal(size=(2, rows * 8)).astype(np.float32)
    pairs = np.stack(np.meshgrid(SPECIAL, SPECIAL)).reshape(2, -1)
    a[: pairs.shape[1]], b[: pairs.shape[1]] = pairs
    a[-16:] = b[-16:]
    return a, b


def ints(seed=0, rows=600):
    rng = np.random.default_rng(seed)
    a, b = rng.integers(-(2**31), 2**31, (2, rows * 16)).astype(np.int32)
    a[:5], b[:5] = [0, -1, 2**31 - 1, -(2**31), 7], [-1, -1, 1, -1, 7]
    a[-16:] = b[-16:]
    return a, b


def same(a, b):
    """Equal bits, but that one NaN is as good as another: which one an operation gives is the machine's choice."""
    if a.dtype == np.float32:
        assert np.array_equal(np.isnan(a), np.isnan(b))
        a, b = (np.where(np.isnan(x), np.float32(0), x).view(np.int32) for x in (a, b))
    assert np.array_equal(a, b)


def over(lanes, body):
    """A kernel that gives vectors of two arrays to ``body(a, b)`` and stores what comes back."""
    load, store = simd.load, simd.store
    inner = jit(forceinline=True)(body)

    @jit()
    def kernel(a, b, out):
        for i in range(0, len(a), lanes):
            store(out, i, inner(load(a, i, lanes), load(b, i, lanes)))

    return kernel


def run(lanes, body, a, b, dtype=None):
    out = np.zeros(len(a), dtype or a.dtype)
    over(lanes, body)(a, b, out)
    return out


def arithmetic(symbol):
    return lambda a, b: symbol(a, b)


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("name", ["add", "sub", "mul", "truediv"])
def test_arithmetic_of_floats(lanes, name):
    symbol, (a, b) = getattr(operator, name), floats()
    with np.errstate(all="ignore"):
        same(run(lanes, arithmetic(symbol), a, b), symbol(a, b))


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("name", ["add", "sub", "mul", "and_", "or_", "xor"])
def test_arithmetic_of_ints(lanes, name):
    symbol, (a, b) = getattr(operator, name), ints()
    same(run(lanes, arithmetic(symbol), a, b), symbol(a, b))


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("make", [floats, ints])
@pytest.mark.parametrize("name", ["lt", "le", "gt", "ge", "eq", "ne"])
def test_comparisons_and_masks(lanes, make, name):
    symbol, (a, b) = getattr(operator, name), make()
    bits, load = simd.bits, simd.load

    @jit()
    def kernel(a, b, out):
        for i in range(0, len(a), lanes):
            out[i // lanes] = bits(symbol(load(a, i, lanes), load(b, i, lanes)))

    out = np.zeros(len(a) // lanes, np.int64)
    kernel(a, b, out)
    expected = symbol(a, b).reshape(-1, lanes)
    assert 0 < expected.sum() < expected.size
    assert np.array_equal(out, (expected << np.arange(lanes)).sum(1))


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("make", [floats, ints])
def test_select_minimum_maximum(lanes, make):
    a, b = make()
    low, high, select = simd.minimum, simd.maximum, simd.select
    same(run(lanes, lambda x, y: low(x, y), a, b), np.where(a < b, a, b))
    same(run(lanes, lambda x, y: high(x, y), a, b), np.where(a > b, a, b))
    same(run(lanes, lambda x, y: select((x <= y) & ~(x == y), x, y), a, b), np.where((a <= b) & (a != b), a, b))
    same(run(lanes, lambda x, y: select((x < y) | (x == y), y, x), a, b), np.where((a < b) | (a == b), b, a))
    same(run(lanes, lambda x, y: select((x < y) ^ (y < x), x, y), a, b), np.where(a != b, a, b) if make is ints else
         np.where((a < b) ^ (b < a), a, b))  # fmt: skip


@pytest.mark.parametrize("lanes", LANES)
def test_bits_of_floats(lanes):
    a, b = floats()
    as_int, as_float, absolute = simd.as_int, simd.as_float, simd.absolute
    assert np.array_equal(run(lanes, lambda x, y: as_int(x), a, b, np.int32), a.view(np.int32))
    same(run(lanes, lambda x, y: as_float(as_int(x)), a, b), a)
    assert np.array_equal(run(lanes, lambda x, y: as_int(absolute(x)), a, b, np.int32), a.view(np.int32) & 0x7FFFFFFF)
    assert np.array_equal(run(lanes, lambda x, y: as_int(-x), a, b, np.int32), a.view(np.int32) ^ np.int32(-(2**31)))
    k, j = ints()
    assert np.array_equal(run(lanes, lambda x, y: ~x, k, j), ~k)


@pytest.mark.parametrize("lanes", LANES)
def test_float64_between_float32(lanes):
    """What comes and goes as float32 is computed in float64, and rounded once."""
    a, b = floats()
    with np.errstate(all="ignore"):
        x, y = a.astype(np.float64), b.astype(np.float64)
    widen, narrow, root, absolute, splat = simd.widen, simd.narrow, simd.square_root, simd.absolute, simd.splat
    low, high, select = simd.minimum, simd.maximum, simd.select
    with np.errstate(all="ignore"):
        same(run(lanes, lambda p, q: narrow(widen(p)), a, b), a)
        same(run(lanes, lambda p, q: narrow(root(widen(p) * widen(p) + widen(q) * widen(q))), a, b),
             np.sqrt(x * x + y * y).astype(np.float32))  # fmt: skip
        same(run(lanes, lambda p, q: root(p), a, b), np.sqrt(a))
        same(run(lanes, lambda p, q: narrow(-absolute(widen(p) - widen(q)) / splat(3.0, lanes)), a, b),
             (-np.abs(x - y) / 3.0).astype(np.float32))  # fmt: skip
        same(run(lanes, lambda p, q: narrow(low(widen(p), widen(q))), a, b), np.where(x < y, x, y).astype(np.float32))
        same(run(lanes, lambda p, q: narrow(high(widen(p), widen(q))), a, b), np.where(x > y, x, y).astype(np.float32))
        body = lambda p, q: select((widen(p) + widen(q)) * splat(0.5, lanes) > widen(p), p, q)  # noqa: E731
        same(run(lanes, body, a, b), np.where((x + y) * 0.5 > x, a, b))


def test_bits_of_scalars():
    @jit()
    def kernel(x, k):
        return simd.as_int(x), simd.as_float(k)

    assert kernel(np.float32(-0.0), np.int32(0x3F800000)) == (-(2**31), 1.0)


@pytest.mark.parametrize("lanes", LANES)
def test_splat_and_lane_numbers(lanes):
    a, b = ints()
    splat, numbers = simd.splat, simd.lane_numbers
    body = lambda x, y: numbers(lanes) * splat(np.int32(3), lanes)  # noqa: E731
    assert np.array_equal(run(lanes, body, a, b), np.tile(np.arange(lanes) * 3, len(a) // lanes))
    x, y = floats()
    same(run(lanes, lambda x, y: splat(np.float32(-0.0), lanes), x, y), np.full_like(x, -0.0))
    same(run(lanes, lambda x, y: simd.select(splat(True, lanes), x, y), x, y), x)


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_extremes(lanes, dtype):
    a = np.nan_to_num(floats()[0], nan=1.0, posinf=np.inf, neginf=-np.inf) if dtype == np.float32 else ints()[0]

    @jit()
    def kernel(a, low, high):
        for i in range(0, len(a), lanes):
            x = simd.load(a, i, lanes)
            low[i // lanes], high[i // lanes] = simd.lowest(x), simd.highest(x)

    low, high = np.zeros((2, len(a) // lanes), dtype)
    kernel(a, low, high)
    assert np.array_equal(low, a.reshape(-1, lanes).min(1)) and np.array_equal(high, a.reshape(-1, lanes).max(1))


@pytest.mark.parametrize("lanes", LANES)
def test_sorting(lanes):
    a, b = ints()
    a[16:4000] %= 3  # many equal
    sort = simd.sort_descending
    expected = -np.sort(-a.astype(np.int64).reshape(-1, lanes), axis=1)
    assert np.array_equal(run(lanes, lambda x, y: sort(x), a, b), expected.reshape(-1))


def test_counting_bits():
    @jit()
    def kernel(x):
        return simd.trailing_zeros(x), simd.popcount(x)

    for x in (1, 2, 0x8000, 0b1011000, 2**62, -1):
        bits = f"{x & (2**64 - 1):064b}"
        assert kernel(x) == (len(bits) - len(bits.rstrip("0")), bits.count("1"))


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_masked_memory_touches_nothing_else(lanes, dtype):
    @jit()
    def kernel(a, out, which):
        m = simd.mask(which, lanes)
        x = simd.load_masked(a, 3, m, simd.load(a, 0, lanes))
        simd.store_masked(out, 5, m, x)
        simd.store(out, 40, x)

    a = np.arange(64).astype(dtype)
    for which in (0, 1, 0b1010, 2**lanes - 1, 2 ** (lanes - 1)):
        chosen = (which >> np.arange(lanes)) & 1 == 1
        out = np.full(64, 99, dtype)
        kernel(a, out, which)
        assert np.array_equal(out[5 : 5 + lanes], np.where(chosen, a[3 : 3 + lanes], 99))
        assert np.array_equal(out[40 : 40 + lanes], np.where(chosen, a[3 : 3 + lanes], a[:lanes]))
        assert (out[:5] == 99).all() and (out[5 + lanes : 40] == 99).all()


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_gather_and_places_that_are_not_read(lanes, dtype):
    @jit()
    def kernel(a, places, which, out):
        index, other = simd.load(places, 0, lanes), simd.load(a, 0, lanes)
        simd.store(out, 0, simd.gather(a, index, simd.mask(which, lanes), other))

    a = np.arange(100).astype(dtype) * 3
    places = np.random.default_rng(1).integers(0, 100, lanes).astype(np.int32)
    places[1] = -(2**31)  # masked out: reading there would crash
    which = (2**lanes - 1) & ~2
    out = np.zeros(lanes, dtype)
    kernel(a, places, which, out)
    chosen = (which >> np.arange(lanes)) & 1 == 1
    assert np.array_equal(out, np.where(chosen, a[np.where(chosen, places, 0)], a[:lanes]))


def test_single_elements_and_prefetch():
    @jit()
    def kernel(a, k):
        simd.prefetch(a, 10**9)  # any address will do
        simd.put(k, 2, simd.item(a, 7))
        return simd.item(k, 1)

    a, k = np.arange(12, dtype=np.float32).reshape(3, 4), np.array([5, 6, 0], np.int64)
    assert kernel(a, k) == 6 and k.tolist() == [5, 6, 7]


def test_the_number_of_lanes_is_a_constant():
    from numba.core.errors import NumbaError

    @jit()
    def kernel(a, n):
        return simd.bits(simd.load(a, 0, n) == simd.load(a, 0, n))

    with pytest.raises(NumbaError, match="constant"):
        kernel(np.zeros(16, np.float32), 8)
