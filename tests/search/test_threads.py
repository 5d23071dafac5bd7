"""Threads, processes, caches: results do not depend on any of them."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from accel_reference import rays, soup

from torchpt.search import build

ROOT = Path(__file__).resolve().parents[2]
REFERENCES = ROOT / "tests" / "references"
PREAMBLE = """
import multiprocessing, sys, threading
import torch
sys.path.insert(0, {tests!r})
from accel_reference import rays, soup
from torchpt.search import build

def work(seed=0, kind="numba"):
    o, d, t_max = rays(7, 50000)
    accel = build(soup(3), kind, 2)
    return float(accel.intersect(o, d, t_max)[1].double().sum() + accel.occluded(o, d, t_max).sum())
"""


def _run(body, errors=False, **env):
    """Runs a script in its own process and returns the words it prints, and where asked what it prints to stderr."""
    code = PREAMBLE.format(tests=str(REFERENCES)) + textwrap.dedent(body)
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2", **env}
    done = subprocess.run([sys.executable, "-c", code], env=settings, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    return (done.stdout.split(), done.stderr) if errors else done.stdout.split()


@pytest.fixture(scope="module")
def expected():
    o, d, t_max = rays(7, 50000)
    accel = build(soup(3), "numba", 1)
    return str(float(accel.intersect(o, d, t_max)[1].double().sum() + accel.occluded(o, d, t_max).sum()))


@pytest.mark.parametrize("kind", ["brute", "numba"])
def test_threads_and_slices_do_not_change_a_bit(kind):
    g = soup(3)
    o, d, t_max = rays(7, 20011)
    one, two, five = (build(g, kind, k) for k in (1, 2, 5))
    hits, dark = one.intersect(o, d, t_max), one.occluded(o, d, t_max)
    for other in (two, five):
        assert all(torch.equal(a, b) for a, b in zip(hits, other.intersect(o, d, t_max), strict=True))
        assert torch.equal(dark, other.occluded(o, d, t_max))
    for a, b in ((0, 1), (1, 64), (64, 131), (7, 6007), (20000, 20011)):
        part = two.intersect(o[:, a:b], d[:, a:b], t_max[a:b])
        assert all(torch.equal(x[a:b], y) for x, y in zip(hits, part, strict=True))
        assert torch.equal(dark[a:b], two.occluded(o[:, a:b], d[:, a:b], t_max[a:b]))


@pytest.mark.slow
def test_a_search_loads_no_numba():
    assert _run("work(); print('numba' in sys.modules)") == ["False"]


@pytest.mark.slow
def test_two_python_threads(expected):
    body = """
    out = []
    both = [threading.Thread(target=lambda: out.extend(work() for _ in range(3))) for _ in range(2)]
    [t.start() for t in both]; [t.join() for t in both]
    print(*out)
    """
    assert _run(body) == [expected] * 6


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.slow
def test_worker_processes_after_the_parent_worked(method, expected, tmp_path):
    script = tmp_path / "workers.py"
    script.write_text(
        PREAMBLE.format(tests=str(REFERENCES))
        + textwrap.dedent(
            f"""
            if __name__ == "__main__":
                print(work())
                with multiprocessing.get_context({method!r}).Pool({2 if method == "fork" else 1}) as pool:
                    print(*pool.map(work, range(3)))
            """
        )
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, str(script)], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == [expected] * 4


CACHE = """
from torchpt.native import machine
made, original = [], machine.object_code
machine.object_code = lambda ir: made.append(ir) or original(ir)
work()
o, d, t_max = (x.numpy() for x in rays(7, 64))
t, prim, out = t_max.copy(), (0 * d[0]).astype("int32"), (0 * d[0]).astype("int32")
accel = build(soup(3), "numba", 1)
accel.nearest(o, d, t_max, 64, t, prim, t.copy(), t.copy()), accel.blocked(o, d, t_max, 64, out)
print(len(made))
"""


@pytest.mark.slow  # compiles everything anew
def test_a_second_process_compiles_nothing(tmp_path):
    env = {"TORCHPT_CACHE": str(tmp_path / "cache")}
    (first, *_), said = _run(CACHE, errors=True, **env)
    assert int(first) == 3 and not said  # build, nearest, occluded
    second, said = _run(CACHE, errors=True, **env)
    assert second == ["0"] and not said
