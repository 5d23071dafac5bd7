"""`torchpt render ... debug.pixel=[x,y] debug.sample=k`: print one path vertex by vertex, as text or as JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from torchpt.cli import gc_pause
from torchpt.cli.arguments import UsageError
from torchpt.cli.interrupt import Interrupt
from torchpt.cli.notices import notices
from torchpt.cli.render import Job, scene_and_settings
from torchpt.cli.streams import flushed_stdout

if TYPE_CHECKING:
    from torchpt.rendering.one_path import BsdfSampleRecord, EmissionRecord, LightSampleRecord, Path, Vertex

__all__ = ["PathRequest", "debug", "lines"]

_PIXEL = re.compile(r"\[?\s*(\d{1,9})\s*,\s*(\d{1,9})\s*\]?\Z")
_SAMPLE = re.compile(r"\d{1,18}\Z")


@dataclass(frozen=True)
class PathRequest:
    """The pixel and sample of the path to print.

    Attributes:
        pixel: ``(x, y)`` on the whole film, from the upper left.
        sample: index of the sample in the pixel.
    """

    pixel: tuple[int, int]
    sample: int = 0

    @staticmethod
    def read(words: Mapping[str, str]) -> PathRequest:
        """Parse the values of the keys in ``arguments.DEBUG_KEYS``.

        Raises:
            UsageError: an invalid pixel or sample.
        """
        pixel, sample = _PIXEL.match(words["debug.pixel"]), words.get("debug.sample", "0")
        if pixel is None:
            raise UsageError(f"debug.pixel: expected [x,y], two whole numbers from 0, got {words['debug.pixel']!r}")
        if not _SAMPLE.match(sample):
            raise UsageError(f"debug.sample: expected a whole number from 0, got {sample!r}")
        return PathRequest((int(pixel[1]), int(pixel[2])), int(sample))


def debug(job: Job, request: PathRequest, interrupt: Interrupt, as_json: bool = False) -> int:
    """Load the scene, trace the path, print it and return the exit code.

    Raises:
        TorchptError: bad input.
        Interrupted: a signal arrived.
    """
    from torchpt.rendering.one_path import one_path
    from torchpt.scene.devices import device_of
    from torchpt.scene.scene import Scene

    gc_pause.resume()
    with notices():
        description, settings = scene_and_settings(job)
        scene = Scene(description, device_of(settings.render.device))
        path = one_path(scene, settings, request.pixel, request.sample)
    interrupt.check()
    with flushed_stdout():
        print(json.dumps(_plain(asdict(path)), allow_nan=False) if as_json else "\n".join(lines(path)))
    return 0


def _plain(value: Any) -> Any:
    """Convert a value for JSON, which has no NaN and no infinity: they become text."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def lines(path: Path) -> Iterator[str]:
    """Yield the lines that describe a path."""
    x, y = path.pixel
    yield f"scene {path.scene}, pixel ({x}, {y}), sample {path.sample}, seed {path.seed}"
    yield f"camera at {_three(path.origin)}, looking along {_three(path.direction)}"
    for vertex in path.vertices:
        yield from _vertex(vertex)
    yield f"ended: {path.ended}"
    yield f"radiance {_three(path.radiance, 9)}"
    if path.value != path.radiance:
        yield f"in the picture {_three(path.value, 9)}"


def _vertex(vertex: Vertex) -> Iterator[str]:
    if vertex.position is None:
        yield f"{vertex.depth}  escaped"
    else:
        assert vertex.normal is not None and vertex.geometric_normal is not None
        where = f"{vertex.shape}, {vertex.kind} {vertex.primitive}"
        yield f"{vertex.depth}  {where}, material {vertex.material} ({vertex.model})"
        yield _row("position", _three(vertex.position))
        yield _row("normal", f"{_three(vertex.normal)}, geometric {_three(vertex.geometric_normal)}")
        yield _row("wo", _three(vertex.wo))
    if vertex.emission is not None:
        yield _row("emission" if vertex.position else "environment", _emission(vertex.emission))
    if vertex.light is not None:
        yield _row("light", _light(vertex.light))
    if vertex.scattered is not None:
        yield from _scattered(vertex.scattered)
    yield _row("radiance", _three(vertex.radiance))


def _emission(found: EmissionRecord) -> str:
    parts = f"radiance {_three(found.radiance)}, pdf {_number(found.pdf)}, MIS weight {_number(found.mis_weight)}"
    return f"{found.light}: {parts}, contribution {_three(found.contribution)}"


def _light(light: LightSampleRecord) -> str:
    seen = "not asked" if light.visible is None else _number(light.visible)
    return (
        f"{light.light}: wi {_three(light.wi)}, {_density(light.pdf)}, radiance/pdf {_three(light.arriving)}, "
        f"bsdf {_three(light.bsdf)}, MIS weight {_number(light.mis_weight)}, visible {seen}, "
        f"contribution {_three(light.contribution)}"
    )


def _scattered(found: BsdfSampleRecord) -> Iterator[str]:
    eta = "" if found.eta is None else f", eta {_number(found.eta)}"
    yield _row("scattered", f"wi {_three(found.wi)}, {_density(found.pdf)}, weight {_three(found.weight)}{eta}")
    if found.survival is not None:
        yield _row("roulette", f"survives with {_number(found.survival)}")
    yield _row("throughput", _three(found.throughput))


def _row(name: str, text: str) -> str:
    return f"   {name:11} {text}"


def _density(pdf: float) -> str:
    return "pdf inf (a delta)" if pdf == math.inf else f"pdf {_number(pdf)}"


def _number(value: float, digits: int = 6) -> str:
    return f"{value + 0.0:.{digits}g}"  # prints -0 as 0


def _three(values: Sequence[float], digits: int = 6) -> str:
    return f"({', '.join(_number(value, digits) for value in values)})"
