"""Report non-finite samples: count them by cause and describe the first."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchpt.engines.engine import weighted_radiance
from torchpt.paths.nonfinite import NonFinite, SampleId
from torchpt.paths.state import PathState
from torchpt.paths.wave import Wave
from torchpt.scene.names import Names
from torchpt.scene.scene import Scene

if TYPE_CHECKING:  # what traces samples again is imported once there are such
    from torchpt.paths.explain import NonFiniteCause

__all__ = ["causes_of", "describe_sample"]


def causes_of(scene: Scene, wave: Wave, lost: NonFinite) -> tuple[dict[str, int], str]:
    """Return the number of non-finite samples by cause, largest first, and a sentence about the first; ``{}, ""`` if none.

    Only the first :data:`~torchpt.paths.nonfinite.KEPT` are traced again. Others count as ``nan, not traced`` and
    ``infinite, not traced``; all add up to ``lost.count``.

    Args:
        scene: what was rendered.
        wave: the wave of the render.
        lost: the non-finite samples.
    """
    if not lost.count:
        return {}, ""
    from torchpt.paths.explain import causes_of_samples

    faults = causes_of_samples(_trace, wave, lost.samples)
    causes = Counter(fault.name for fault in faults)
    nans = sum(place.nan for place in lost.samples)
    causes["nan, not traced"] = lost.nan - nans
    causes["infinite, not traced"] = lost.infinite - (len(lost.samples) - nans)
    first = f"{_named(wave, lost.samples[0])}: {_said(scene, wave, faults[0])}"
    return {name: count for name, count in causes.most_common() if count}, first


def describe_sample(scene: Scene, wave: Wave, place: SampleId) -> str:
    """Return a sentence about one non-finite sample and its cause."""
    from torchpt.paths.explain import causes_of_samples

    return f"{_named(wave, place)} is not finite: {_said(scene, wave, causes_of_samples(_trace, wave, [place])[0])}"


def _trace(wave: Wave, state: PathState, observer: Any) -> Tensor:
    return weighted_radiance(wave, state, observer=observer)


def _named(wave: Wave, place: SampleId) -> str:
    """Return the name of a sample: its index and pixel or ray, and whether it is a second value of an error probe."""
    if wave.start_rays is not None:
        return f"sample {place.sample} of ray {place.y * wave.crop[2] + place.x}"
    return str(place) + (" (its second value)" if place.first_randomization else "")


def _said(scene: Scene, wave: Wave, fault: NonFiniteCause) -> str:
    if fault.cause == "not repeated":
        return "traced again by tensor operations it is finite"
    depth = f" at depth {fault.depth}" if fault.depth else ""
    if fault.slot < 0:
        return fault.name + depth
    return f"{fault.name}{depth} ({Names(scene.built, wave.context.world).owner(fault.slot)})"
