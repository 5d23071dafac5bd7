"""The vector search gives the bits of a scalar one, whatever rays it is given and however they are grouped."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from accel_reference import sphere_mesh, triangles
from few import few
from scalar_search import scalar_search

from torchpt.search.tree import WideBvh

KINDS = ("random", "aimed", "axes")


def make_rays(kind, g, n, seed=0, sort=False):
    """Random rays; aimed at vertices and edges; parallel to axes, with ±0, NaN, infinity and ends. ``o, d, t_max``."""
    rng = np.random.default_rng(seed)
    corners = np.concatenate([p.numpy() for p in (g.p0, g.p1, g.p2)], 1)
    low, high = corners.min(1), corners.max(1)
    size, t_max = (high - low).max(), np.full(n, np.inf, np.float32)
    d = rng.normal(size=(3, n)).astype(np.float32)
    o = (low[:, None] + rng.random((3, n)) * (high - low)[:, None]).astype(np.float32)
    if kind == "aimed":
        k, w = rng.integers(g.size, size=n), np.where(np.arange(n) % 2, rng.random(n), 0.0)
        target = g.p0.numpy()[:, k] * (1 - w) + g.p1.numpy()[:, k] * w
        o = (target + rng.normal(size=(3, n)) * 0.3 * size).astype(np.float32)
        d = (target - o).astype(np.float32)
    if kind == "axes":
        lanes, axis, what = np.arange(n), rng.integers(3, size=n), np.arange(n) % 4
        d[axis, lanes] = np.select([what == 0, what == 1], [0.0, -0.0], d[axis, lanes])
        d[(axis + 1) % 3, lanes] *= np.select([what == 2, what == 3], [0.0, 1e-30], 1.0).astype(np.float32)
        starts = corners[:, rng.integers(corners.shape[1], size=n)]  # rays in planes through vertices
        o = np.where(what < 2, o, starts + rng.choice([-0.2, 0.2], (3, n)) * size * (what == 2)).astype(np.float32)
        d[0, ::1000], d[1, 1::1000], o[2, 2::1000] = np.nan, np.inf, -np.inf
        t_max[::7] = rng.random(len(t_max[::7])).astype(np.float32) * size
        t_max[::97], t_max[1::97], t_max[2::97] = 0, -1, np.nan
    if sort:  # sixteen rays that go together: one octant, one longest axis
        order = np.lexsort((*(np.signbit(d[c]) for c in range(3)), np.abs(np.nan_to_num(d)).argmax(0)))
        o, d, t_max = o[:, order], d[:, order], t_max[order]
    return np.ascontiguousarray(o), np.ascontiguousarray(d), np.ascontiguousarray(t_max)


def found(accel, o, d, t_max):
    n = len(t_max)
    t, u, v = np.full((3, n), 7, np.float32)
    prim, out = np.full((2, n), 7, np.int32)
    accel.nearest(o, d, t_max, n, t, prim, u, v)
    accel.blocked(o, d, t_max, n, out)
    assert np.array_equal(out, (prim >= 0).astype(np.int32))
    return t, prim, u, v


def equal_bits(a, b):
    return all(np.array_equal(x.view(np.int32), y.view(np.int32)) for x, y in zip(a, b, strict=True))


def check(g, accel, kind, n, seed, sort):
    rays = make_rays(kind, g, n, seed, sort)
    hits = found(accel, *rays)
    share = (hits[1] >= 0).mean()
    assert 0.05 < share < 1.0 or kind == "random"
    assert equal_bits(hits, scalar_search(g, *rays))


@pytest.mark.parametrize("sort", few([False, True], 1))
@pytest.mark.parametrize("kind", KINDS)
def test_bits_are_those_of_the_scalar_search(kind, sort):
    g = triangles(*sphere_mesh(40))
    check(g, WideBvh(g, 1), kind, 20_000, 1, sort)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 300.0])
def test_bits_of_many_rays(shift):
    vertices, faces = sphere_mesh(200)
    g = triangles(vertices + np.float32(shift), faces)
    accel = WideBvh(g, 1)
    for seed in range(10):
        for kind in KINDS:
            check(g, accel, kind, 350_000, seed, seed % 2 == 0)


def test_bits_do_not_depend_on_the_rays_beside():
    g = triangles(*sphere_mesh(40))
    accel = WideBvh(g, 1)
    for kind in KINDS:
        o, d, t_max = make_rays(kind, g, 40_000, 2, sort=True)
        order = np.random.default_rng(3).permutation(len(t_max))
        together = found(accel, o, d, t_max)
        mixed = found(accel, o[:, order].copy(), d[:, order].copy(), t_max[order].copy())
        assert equal_bits([x[order] for x in together], mixed)


SCRIPT = """
import sys
from torchpt.native import kernels, machine
machine.host = lambda: tuple(sys.argv[1:])
from test_bits import KINDS, WideBvh, check, sphere_mesh, triangles
g = triangles(*sphere_mesh(12))
accel = WideBvh(g, 1)
for kind in KINDS:
    for sort in (False, True):
        check(g, accel, kind, 20_000, 5, sort)
made = machine.new_machine()
code = made.emit_assembly(machine.parse(kernels.read_module("tree_nearest"), made))
print(*(name in code for name in ("zmm", "ymm", "xmm")))
"""


@pytest.mark.slow  # compiles everything anew
@pytest.mark.skipif(sys.platform != "linux" or os.uname().machine != "x86_64", reason="names of x86 processors")
@pytest.mark.parametrize(
    ("cpu", "features", "registers"),
    [("haswell", "+avx2", ["False", "True", "True"]), ("nehalem", "", ["False", "False", "True"])],
)
def test_shorter_vectors_give_the_same_bits(cpu, features, registers, tmp_path):
    root = Path(__file__).resolve().parents[2]
    path = os.pathsep.join([str(root), *sys.path])  # with the helpers beside tests
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, cpu, features],
        env={**os.environ, "PYTHONPATH": path, "TORCHPT_CACHE": str(tmp_path)}, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == registers
