"""Report non-finite samples: count them by cause and describe the first.

A render notes the pixel and the index of its first NaN or infinite samples. These are traced again by tensor operations, with
an observer that tells which quantity stopped being finite.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchpt.engines.engine import weighted_radiance
from torchpt.paths.nonfinite import NonFinite, SampleId
from torchpt.paths.state import PathState
from torchpt.paths.store import VertexStore
from torchpt.paths.wave import Wave
from torchpt.scene.names import Names
from torchpt.scene.scene import Scene

if TYPE_CHECKING:  # what traces samples again is imported once there are such
    from torchpt.paths.explain import NonFiniteCause

__all__ = ["causes_of", "describe_sample"]


def causes_of(scene: Scene, wave: Wave, nonfinite: NonFinite) -> tuple[dict[str, int], str]:
    """Return the number of non-finite samples by cause, largest first, and a sentence about the first; ``{}, ""`` if none.

    Only the first :data:`~torchpt.paths.nonfinite.KEPT` are traced again. Others count as ``nan, not traced`` and
    ``infinite, not traced``; all add up to ``nonfinite.count``.

    Args:
        scene: what was rendered.
        wave: the wave of the render.
        nonfinite: the non-finite samples.
    """
    if not nonfinite.count:
        return {}, ""
    from torchpt.paths.explain import causes_of_samples

    causes = causes_of_samples(_trace, wave, nonfinite.samples)
    counts = Counter(cause.name for cause in causes)
    traced_nans = sum(sample_id.nan for sample_id in nonfinite.samples)
    counts["nan, not traced"] = nonfinite.nan - traced_nans
    counts["infinite, not traced"] = nonfinite.infinite - (len(nonfinite.samples) - traced_nans)
    first = f"{_sample_name(wave, nonfinite.samples[0])}: {_cause_phrase(scene, wave, causes[0])}"
    return {name: count for name, count in counts.most_common() if count}, first


def describe_sample(scene: Scene, wave: Wave, sample_id: SampleId) -> str:
    """Return a sentence about one non-finite sample and its cause."""
    from torchpt.paths.explain import causes_of_samples

    (cause,) = causes_of_samples(_trace, wave, [sample_id])
    return f"{_sample_name(wave, sample_id)} is not finite: {_cause_phrase(scene, wave, cause)}"


def _trace(wave: Wave, state: PathState, observer: Any, store: VertexStore | None) -> Tensor:
    """Return the samples ``(3, n)`` of paths, which an observer watches."""
    return weighted_radiance(wave, state, observer=observer, store=store)


def _sample_name(wave: Wave, sample_id: SampleId) -> str:
    """Return the name of a sample: its index and pixel or ray, and whether it is a second value of an error probe."""
    if wave.start_rays is not None:
        return f"sample {sample_id.sample} of ray {sample_id.y * wave.crop[2] + sample_id.x}"
    return str(sample_id) + (" (its second value)" if sample_id.first_randomization else "")


def _cause_phrase(scene: Scene, wave: Wave, cause: NonFiniteCause) -> str:
    """Return a cause with its depth, and the shape and material where it is one's."""
    if cause.cause == "merge":
        return "a photon of its light path, or the light of a merge"
    if cause.cause == "not repeated":
        return "traced again by tensor operations it is finite"
    depth = f" at depth {cause.depth}" if cause.depth else ""
    if cause.slot < 0:
        return cause.name + depth
    return f"{cause.name}{depth} ({Names(scene.built, wave.context.world).owner(cause.slot)})"
