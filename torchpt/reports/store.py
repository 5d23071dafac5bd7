"""Finished runs on disk: a picture and its facts each, so that a study which was stopped resumes.

A run's name is a hash of all that it depends on: the scene and its files, every setting, seed and samples, the renderer's
own source and the machine. So a study that changed takes up what still holds of it and never a wrong run. The facts are
written after the picture and say that the run is whole.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchpt import __version__
from torchpt.core.tree import fingerprint
from torchpt.errors import OutputError
from torchpt.images import read_image, write_image
from torchpt.images.write import temporary_beside

__all__ = ["Run", "Store", "machine", "name_of", "write_whole"]

#: Rooms that no picture depends on.
_ABOVE = ("reports", "commands", "cli.py", "__main__.py", "share")


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        file: its picture, ``.exr``.
        facts: ``spp seed seconds set_up nonfinite_samples rays``, and what it was a run of.
    """

    file: Path
    facts: dict[str, Any]

    @property
    def seconds(self) -> float:
        """Of sampling alone."""
        return self.facts["seconds"]

    def image(self) -> Tensor:
        """The picture ``(H, W, 3)`` float64."""
        return read_image(self.file)[..., :3].double()


class Store:
    """The folder of a study's runs.

    Args:
        folder: made where it is not there; others may share it.

    Raises:
        OutputError: it cannot be made or written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe = temporary_beside(folder / "probe.json")
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise OutputError(folder, f"cannot be used for runs ({error.strerror or error})") from None

    def get(self, name: str) -> Run | None:
        """The run of this name, where it is there and whole."""
        try:
            facts = json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        picture = self.folder / f"{name}.exr"
        whole = isinstance(facts, dict) and {"seconds", "spp", "seed", "nonfinite_samples"} <= facts.keys()
        return Run(picture, facts) if whole and picture.is_file() else None

    def put(self, name: str, image: Tensor, facts: Mapping[str, Any]) -> Run:
        """Keep a run."""
        picture = self.folder / f"{name}.exr"
        write_image(picture, image)
        write_whole(self.folder / f"{name}.json", json.dumps(facts, indent=1).encode())
        return Run(picture, dict(facts))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside its place and move it there.

    Raises:
        OutputError: it cannot be written.
    """
    temporary = temporary_beside(path)
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(path, f"cannot be written ({error.strerror or error})") from None
    finally:
        with suppress(OSError):
            temporary.unlink()


def name_of(facts: Mapping[str, Any]) -> str:
    """The name of a run that depends on these facts, on this renderer and on this machine."""
    whole = {"facts": facts, "torchpt": __version__, "source": _source(), "torch": torch.__version__, **machine()}
    return fingerprint(json.dumps(whole, sort_keys=True)).hex()


@lru_cache(maxsize=1)
def machine() -> dict[str, Any]:
    """What times depend on: processor, cores, threads, GPU."""
    processor = platform.processor() or platform.machine()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), processor)
    facts: dict[str, Any] = {"processor": processor, "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    if torch.cuda.is_available():
        facts["gpu"] = torch.cuda.get_device_name()
    return facts


@lru_cache(maxsize=1)
def _source() -> str:
    """A hash of the package, but for what stands above rendering."""
    root = Path(__file__).parents[1]
    hashed = hashlib.blake2b(digest_size=12)
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in _ABOVE:
            hashed.update(str(name).encode() + path.read_bytes())
    return hashed.hexdigest()
