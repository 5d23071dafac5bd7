"""Renders from threads, forked and spawned workers, and without a writable cache: each runs in an interpreter of its own, and
must give the picture that a plain render gives."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

import torchpt

PREFACE = """
import hashlib, multiprocessing, os, threading
import torch, torchpt

def digest(spp=4):
    scene = torchpt.load(NAME, "cpu")
    image = torchpt.render(scene, spp=spp, film={"width": 40, "height": 40, "filter": "box"}, compile="off")
    return hashlib.sha256(image.numpy().tobytes()).hexdigest()

def work(queue):
    queue.put(digest())

def worker(method):
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=work, args=(queue,))
    process.start()
    print(queue.get(timeout=100))
    process.join()
"""
SCRIPTS = {
    "threads, then a fork": """
found = []
threads = [threading.Thread(target=lambda: found.append(digest())) for _ in range(2)]
[t.start() for t in threads]; [t.join() for t in threads]
print(*found, sep="\\n")
worker('fork')
""",
    "threads": """
found = []
threads = [threading.Thread(target=lambda: found.append(digest())) for _ in range(2)]
[t.start() for t in threads]; [t.join() for t in threads]
print(*found, sep="\\n")
""",
    "fork": "print(digest())\nworker('fork')",
    "spawn": "print(digest())\nworker('spawn')",
}


def expected(name: str) -> str:
    scene = torchpt.load(name, "cpu")
    image = torchpt.render(scene, spp=4, film={"width": 40, "height": 40, "filter": "box"}, compile="off")
    return hashlib.sha256(image.numpy().tobytes()).hexdigest()


def run(tmp_path: Path, body: str, name: str, environment: dict[str, str]) -> list[str]:
    script = tmp_path / "script.py"
    indented = "\n".join("    " + line for line in body.strip().splitlines())
    script.write_text(
        f"NAME = {name!r}\n{PREFACE}\nif __name__ == '__main__':\n    torch.set_num_threads(2)\n{indented}\n"
    )
    root = str(Path(torchpt.__file__).parents[1])
    found = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PYTHONPATH": root, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert found.returncode == 0, found.stderr[-2000:]
    return found.stdout.split()


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Python's, of a fork beside threads
def test_threads_then_a_fork_give_the_same_picture():
    """By the process of the tests; the scripts have interpreters of their own."""
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(expected("cornell_box"))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=lambda: queue.put(expected("cornell_box")))
    process.start()
    found.append(queue.get(timeout=100))
    process.join()
    assert len(found) == 3 and set(found) == {expected("cornell_box")}


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_torch_has_one_thread_in_a_forked_child():
    """Its pool's threads are the parent's: a child that loads a mesh would wait for them forever."""
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        process = context.Process(target=lambda: queue.put(torch.get_num_threads()))
        process.start()
        assert queue.get(timeout=100) == 1
        process.join()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# Both CPU searches: packets and the wide tree.
@pytest.mark.parametrize("name", ["cornell_box", pytest.param("cornell_bunny", marks=pytest.mark.slow)])
@pytest.mark.slow
@pytest.mark.parametrize("way", SCRIPTS)
def test_threads_and_workers_give_the_same_picture(tmp_path, way, name):
    assert set(run(tmp_path, SCRIPTS[way], name, {})) == {expected(name)}


@pytest.mark.slow
def test_without_a_writable_cache_folder(tmp_path):
    # A copy of the package beside which nothing can be written, and no home to fall back to.
    blocked = tmp_path / "file"
    blocked.write_text("")
    found = run(tmp_path, "print(digest())", "cornell_box", {"TORCHPT_CACHE": str(blocked / "cache")})
    assert set(found) == {expected("cornell_box")}


@pytest.mark.slow
def test_fresh_processes_give_one_picture(tmp_path):
    """MKL's first call in two threads at once made one of four differ, see torchpt.core.threads.warm_up."""
    found = [run(tmp_path, "print(digest())", "cornell_bunny", {}) for _ in range(24)]
    assert len({tuple(lines) for lines in found}) == 1
