from __future__ import annotations

import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest

HEAVY = ("hydra", "omegaconf", "trimesh", "kornia", "matplotlib", "numba", "OpenImageIO", "imageio", "mitsuba")
PROBE = f"import sys; print([name for name in {HEAVY!r} if name in sys.modules])"


def loaded(code: str) -> tuple[str, float]:
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", f"{code}\n{PROBE}"], capture_output=True, text=True, check=True)
    return done.stdout.strip(), time.perf_counter() - start


SMALL = ("render", "scene=cornell_box", "render.spp=1", "film.width=64", "film.height=64")


def test_import_is_quick_and_light() -> None:
    found, seconds = loaded("import torchpt")
    assert found == "[]" and seconds < 2.0


@pytest.mark.slow
def test_the_public_names_load_on_use() -> None:
    found, _ = loaded(
        "import torchpt, torchpt.cli.main, torchpt.rendering.api\n"
        "for name in torchpt.__all__: getattr(torchpt, name)\n"
        "from torchpt import render; assert callable(torchpt.render) and torchpt.render is render"
    )
    assert found == "[]"


def test_unknown_names() -> None:
    import torchpt

    assert set(torchpt.__all__) <= set(dir(torchpt))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = torchpt.nonsense


def cpu_seconds(*words: str) -> float:
    """Of a process of its own."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.slow
def test_the_first_pixel_is_not_far_behind_torch(tmp_path: Path) -> None:
    words = ("-m", "torchpt", *SMALL, f"out={tmp_path}/a.png")
    cpu_seconds(*words)  # may compile
    assert cpu_seconds(*words) <= 1.5 * cpu_seconds("-c", "import torch") + 2.0


@pytest.mark.slow
def test_the_first_pixel_is_close_behind_torch(tmp_path: Path) -> None:
    words = ("-m", "torchpt", *SMALL, f"out={tmp_path}/a.png")
    cpu_seconds(*words)  # may compile
    torch, render = (min(cpu_seconds(*each) for _ in range(7)) for each in (("-c", "import torch"), words))
    assert render <= torch + 0.6


UNIX_ONLY = ("fcntl", "grp", "pwd", "resource", "termios")


@pytest.mark.slow
def test_nothing_of_unix_alone_is_needed() -> None:
    """Imported and rendered with what Windows lacks taken away; torch and numba, which bring their own ways, come first."""
    code = f"""
import sys, os, signal
import torch, numba, llvmlite.binding, multiprocessing, concurrent.futures.thread
for name in ("register_at_fork", "fork", "sched_getaffinity", "geteuid", "getuid", "getpgid", "killpg", "O_NOFOLLOW", "mkfifo",
             "uname", "statvfs", "sysconf", "chown", "getloadavg"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGALRM", "setitimer"):
    if hasattr(signal, name):
        delattr(signal, name)
for name in {UNIX_ONLY!r}:
    sys.modules[name] = None
import torchpt
film = {{"width": 8, "height": 8}}
scene = torchpt.load("cornell_box", device="cpu")
pictures = [torchpt.render(scene, spp=2, film=film, compile=mode) for mode in ("off", "on")]
assert all(float(picture.mean()) > 0 for picture in pictures)
from torchpt.cli.main import main
assert main(["--version"]) == 0
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
