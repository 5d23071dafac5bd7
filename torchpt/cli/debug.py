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
from torchpt.cli.notices import printed_scene_warnings
from torchpt.cli.render import Job, scene_and_settings
from torchpt.cli.streams import flushed_stdout

if TYPE_CHECKING:
    from torchpt.rendering.one_path import (
        BsdfSampleRecord,
        ConnectionRecord,
        EmissionRecord,
        LightSampleRecord,
        Path,
        Vertex,
    )

__all__ = ["PathRequest", "debug", "lines"]

# [x,y] or x,y: two whole numbers of at most nine digits.
_PIXEL = re.compile(r"\[?\s*(\d{1,9})\s*,\s*(\d{1,9})\s*\]?\Z")
# A whole number that int64 holds.
_SAMPLE = re.compile(r"\d{1,18}\Z")
#: Digits by which any two numbers of float32 differ.
_EXACT_DIGITS = 9


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


def debug(job: Job, request: PathRequest, interrupt: Interrupt, *, as_json: bool = False) -> int:
    """Load the scene, trace the path, print it and return the exit code.

    Raises:
        TorchptError: bad input.
        Interrupted: a signal arrived.
    """
    from torchpt.rendering.one_path import one_path
    from torchpt.scene.devices import device_of
    from torchpt.scene.scene import Scene

    gc_pause.resume()  # the imports are done: collect garbage again
    with printed_scene_warnings():
        description, settings = scene_and_settings(job)
        scene = Scene(description, device_of(settings.render.device))
        path = one_path(scene, settings, request.pixel, request.sample)
    interrupt.check()
    with flushed_stdout():
        print(json.dumps(_json_value(asdict(path)), allow_nan=False) if as_json else "\n".join(lines(path)))
    return 0


def _json_value(value: Any) -> Any:
    """Convert a value for JSON, which has no NaN and no infinity: they become text."""
    if isinstance(value, dict):
        return {key: _json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def lines(path: Path) -> Iterator[str]:
    """Yield the lines that describe a path."""
    x, y = path.pixel
    yield f"scene {path.scene}, pixel ({x}, {y}), sample {path.sample}, seed {path.seed}"
    yield f"camera at {_triple_text(path.origin)}, looking along {_triple_text(path.direction)}"
    for vertex in path.vertices:
        yield from _vertex_lines(vertex)
    yield f"ended: {path.ended}"
    yield f"radiance {_triple_text(path.radiance, digits=_EXACT_DIGITS)}"
    if path.value != path.radiance:  # weighted by the filter, clamped, or 0 as it is not finite
        yield f"in the picture {_triple_text(path.value, digits=_EXACT_DIGITS)}"


def _vertex_lines(vertex: Vertex) -> Iterator[str]:
    """Yield the lines of one vertex."""
    if vertex.position is None:
        yield f"{vertex.depth}  escaped"
    else:
        assert vertex.normal is not None and vertex.geometric_normal is not None
        where = f"{vertex.shape}, {vertex.kind} {vertex.primitive}"
        yield f"{vertex.depth}  {where}, material {vertex.material} ({vertex.model})"
        yield _labelled_line("position", _triple_text(vertex.position))
        yield _labelled_line(
            "normal", f"{_triple_text(vertex.normal)}, geometric {_triple_text(vertex.geometric_normal)}"
        )
        yield _labelled_line("wo", _triple_text(vertex.wo))
    if vertex.emission is not None:
        yield _labelled_line("emission" if vertex.position else "environment", _emission_text(vertex.emission))
    if vertex.light is not None:
        yield _labelled_line("light", _light_sample_text(vertex.light))
    if vertex.connection is not None:
        yield _labelled_line("connection", _connection_text(vertex.connection))
    if vertex.scattered is not None:
        yield from _bsdf_sample_lines(vertex.scattered)
    yield _labelled_line("radiance", _triple_text(vertex.radiance))


def _emission_text(record: EmissionRecord) -> str:
    radiance, pdf = _triple_text(record.radiance), _number_text(record.pdf)
    parts = f"radiance {radiance}, pdf {pdf}, MIS weight {_number_text(record.mis_weight)}"
    return f"{record.light}: {parts}, contribution {_triple_text(record.contribution)}"


def _light_sample_text(light: LightSampleRecord) -> str:
    visible = "not asked" if light.visible is None else _number_text(light.visible)
    return (
        f"{light.light}: wi {_triple_text(light.wi)}, {_pdf_text(light.pdf)}, radiance/pdf {_triple_text(light.arriving)}, "
        f"bsdf {_triple_text(light.bsdf)}, MIS weight {_number_text(light.mis_weight)}, visible {visible}, "
        f"contribution {_triple_text(light.contribution)}"
    )


def _connection_text(record: ConnectionRecord) -> str:
    return (
        f"to {_triple_text(record.position)}, radiance {_triple_text(record.arriving)}, "
        f"visible {_number_text(record.visible)}, contribution {_triple_text(record.contribution)}"
    )


def _bsdf_sample_lines(record: BsdfSampleRecord) -> Iterator[str]:
    """Yield the lines of a BSDF sample."""
    eta = "" if record.eta is None else f", eta {_number_text(record.eta)}"
    yield _labelled_line(
        "scattered", f"wi {_triple_text(record.wi)}, {_pdf_text(record.pdf)}, weight {_triple_text(record.weight)}{eta}"
    )
    if record.survival is not None:
        yield _labelled_line("roulette", f"survives with {_number_text(record.survival)}")
    yield _labelled_line("throughput", _triple_text(record.throughput))


def _labelled_line(name: str, text: str) -> str:
    return f"   {name:11} {text}"


def _pdf_text(pdf: float) -> str:
    return "pdf inf (a delta)" if pdf == math.inf else f"pdf {_number_text(pdf)}"


def _number_text(value: float, digits: int = 6) -> str:
    return f"{value + 0.0:.{digits}g}"  # -0.0 + 0.0 is 0.0: prints no minus sign


def _triple_text(values: Sequence[float], digits: int = 6) -> str:
    return f"({', '.join(_number_text(value, digits=digits) for value in values)})"
