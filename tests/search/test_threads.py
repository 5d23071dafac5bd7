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
    code = PREAMBLE.format(tests=str(Path(__file__).parent)) + textwrap.dedent(body)
    settings = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", **env}
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
def test_import_loads_no_numba():
    out = _run("print('numba' in sys.modules); build(soup(0), 'torch'); print('numba' in sys.modules)")
    assert out == ["False", "False"]


@pytest.mark.parametrize("layer", ["default", "workqueue"])
@pytest.mark.slow
def test_two_python_threads(layer, expected):
    body = """
    out = []
    both = [threading.Thread(target=lambda: out.extend(work() for _ in range(3))) for _ in range(2)]
    [t.start() for t in both]; [t.join() for t in both]
    print(*out)
    """
    assert _run(body, NUMBA_THREADING_LAYER=layer) == [expected] * 6


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.slow
def test_worker_processes_after_the_parent_worked(method, expected, tmp_path):
    script = tmp_path / "workers.py"
    script.write_text(
        PREAMBLE.format(tests=str(Path(__file__).parent))
        + textwrap.dedent(
            f"""
            if __name__ == "__main__":
                print(work())
                with multiprocessing.get_context({method!r}).Pool({2 if method == "fork" else 1}) as pool:
                    print(*pool.map(work, range(3)))
            """
        )
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, str(script)], env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == [expected] * 4


CACHE = """
from numba.core import event

class Compiled(event.Listener):
    names = []
    def on_start(self, event): pass
    def on_end(self, event): self.names.append(str(event.data["dispatcher"]))

event.register("numba:compile", Compiled())
work()
o, d, t_max = (x.numpy() for x in rays(7, 64))
t, prim, out = t_max.copy(), t_max.astype("int32"), t_max.astype("int32")
accel = build(soup(3), "numba", 1)
accel.nearest(o, d, t_max, 64, t, prim, t.copy(), t.copy()), accel.blocked(o, d, t_max, 64, out)
print(sum("torchpt" in name or "CPUDispatcher" in name for name in Compiled.names))
"""


@pytest.mark.slow  # compiles everything anew
def test_a_second_process_compiles_nothing_and_says_nothing(tmp_path):
    env = {"TORCHPT_CACHE": str(tmp_path / "cache")}
    first, said = _run(CACHE, errors=True, **env)
    assert int(first[0]) > 20 and said.count("compiling the search kernels") == 1
    second, said = _run(CACHE, errors=True, **env)
    assert second == ["0"] and "compiling" not in said
