"""Tries of damaged input, one after another, in a process of their own: ``python tries.py FAMILY FIRST COUNT FOLDER``.

Each prints a line of JSON before (its seed) and after (what came of it); a process that dies or hangs has told with which.
"""

from __future__ import annotations

import copy
import faulthandler
import json
import os
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

#: Seconds that a try may take, and bytes that it may need beside what the process has.
SECONDS, MOST_BYTES = 10.0, 2**30
#: One try in so many is compiled, which takes a second.
COMPILED = 16


def peak() -> int:
    """Most memory that the process has had since it was last asked, in bytes; 0 where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        found = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, StopIteration):
        return 0
    return found


def outcome(act: Callable[[], str]) -> dict[str, Any]:
    """What came of a try: ``said`` is a word, or the line of a refusal; ``wrong`` is set where it may not be so."""
    from torchpt.core.errors import EdgeWarning, EnergyWarning, TorchptError

    peak()
    before = peak()
    start = time.monotonic()
    found: dict[str, Any] = {}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for kind in (EnergyWarning, EdgeWarning):
                warnings.simplefilter("ignore", kind)
            found["said"] = act()
    except TorchptError as error:
        said = str(error)
        found["said"], found["refused"] = said, True
        if not said.isprintable() or not 0 < len(said) < 3000:
            found["wrong"] = f"no line to be read: {said[:300]!r}"
    except BaseException as error:
        rows = traceback.extract_tb(error.__traceback__)
        own = [f"{Path(row.filename).name}:{row.lineno} {row.name}" for row in rows if "torchpt" in row.filename]
        found["wrong"] = f"{type(error).__name__}: {str(error)[:200]} at {' < '.join(reversed(own[-3:]))}"
        found["trace"] = "".join(traceback.format_exception(error))[-3000:]
    found["seconds"] = time.monotonic() - start
    grown = max(peak() - before, 0)
    if grown > MOST_BYTES:
        found["wrong"] = found.get("wrong", f"{grown} bytes more")
    return found


def try_document(seed: int, folder: Path) -> str:
    """Load a damaged document, and render what loads."""
    from documents import damaged_document

    made = damaged_document(seed)
    if isinstance(made, bytes):
        file = folder / "scene.yaml"
        file.write_bytes(made)
        return load_and_render(str(file), seed)
    return load_and_render(made, seed)


def load_and_render(source: Any, seed: int = 0) -> str:
    """A tiny picture of a scene."""
    import torch

    import torchpt
    from torchpt.rendering.api import render_scene
    from torchpt.scene.formats.description import overridden

    scene = torchpt.load(source)
    compiled = "on" if seed % COMPILED == 0 else "off"
    film = {
        "width": 4,
        "height": 4,
        "crop": None,
        "denoise": False,
        "aovs": ["albedo", "normal", "depth"] if seed % 5 == 0 else None,
    }
    render = {
        "spp": 1, "max_memory": "1GB", "threads": 1, "compile": compiled, "checkpoint": None, "resume": None, "preview": None,
        "device": "cpu", "accel": "numba", "time_limit": None,
    }  # fmt: skip
    description, settings = overridden(scene.description, {"film": film, "render": render})
    scene.description = description
    if seed % 7 == 0:
        json.dumps(scene.info(settings))  # what `torchpt info` tells
    made = render_scene(scene, settings)
    assert made.image.shape == (4, 4, 3), made.image.shape
    if not bool(torch.isfinite(made.image).all()):
        raise AssertionError("a picture with values that are not finite")
    return "rendered"


def try_asset(seed: int, folder: Path) -> str:
    """Read damaged files as what they say they are, and render what can be read."""
    from assets import damaged_asset

    return damaged_asset(seed, folder)


FAMILIES = {"documents": try_document, "assets": try_asset}


def prepare(folder: Path) -> None:
    """Sound files beside the documents, and a first render, so that no try pays for it."""
    import resource

    import torch

    torch.set_num_threads(1)
    from assets import write_sound
    from documents import whole_documents

    write_sound(folder)
    os.chdir(folder)
    for document in whole_documents():  # kernels that nobody has compiled here before would take longer than a try may
        load_and_render(copy.deepcopy(document), 1)
    if sys.platform == "linux":
        size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (size + 6 * 2**30, resource.RLIM_INFINITY))


def main(family: str, first: str, count: str, where: str) -> None:
    """Run tries and tell of them."""
    folder = Path(where)
    out = os.fdopen(os.dup(1), "w", buffering=1)
    prepare(folder)
    noise = os.open(folder / "noise.txt", os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
    trace = open(folder / "trace.txt", "w")
    os.dup2(noise, 1)
    os.dup2(noise, 2)
    for seed in range(int(first), int(first) + int(count)):
        print(json.dumps({"begin": seed}), file=out, flush=True)
        trace.seek(0)
        faulthandler.dump_traceback_later(SECONDS, exit=True, file=trace)
        found = outcome(lambda seed=seed: FAMILIES[family](seed, folder))
        faulthandler.cancel_dump_traceback_later()
        if os.fstat(noise).st_size:
            os.lseek(noise, 0, os.SEEK_SET)
            text = os.read(noise, 2000).decode("utf-8", "replace")
            os.ftruncate(noise, 0)
            os.lseek(noise, 0, os.SEEK_SET)
            said = [line for line in text.splitlines() if line and not line.startswith("torchpt: ")]
            if said:
                found.setdefault("wrong", f"noise: {said[0][:300]}")
        print(json.dumps({"end": seed, **found}), file=out, flush=True)


if __name__ == "__main__":
    faulthandler.enable(open(Path(sys.argv[4]) / "crash.txt", "w"))
    main(*sys.argv[1:])
