"""The vector search gives the bits of a scalar one, whatever rays it is given and however they are grouped."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from accel_reference import sphere_mesh, triangles
from few import few
from ray_sets import KINDS, make_rays
from scalar_search import scalar_search

from torchpt.search.tree import WideBvh


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
