"""Kernels of shipped scenes as PTX: what calls of real renders leave in memory is the CPU's, bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from ptx_calls import LANES, WISH, Probe, call_backward, call_forward, probed

import torchpt
from torchpt.core.errors import TorchptError

SCENES = sorted(path.stem for path in (Path(__file__).parents[2] / "configs" / "scene").glob("*.yaml"))


def check(found: dict[str, Probe], kernels: set[str], record_property: Any) -> None:
    """Compare, and record kernels, numbers and lanes."""
    for name, probe in found.items():
        print(
            f"{name}: {probe.lanes} lanes, {probe.numbers} numbers, {probe.instructions:.0f} instructions and "
            f"{probe.issues:.0f} issues a lane"
        )
    wrong = {name: probe.wrong for name, probe in found.items() if probe.wrong}
    assert not wrong
    assert {name.partition("_")[0] for name in found} >= kernels
    record_property("kernels", len(found))
    record_property("numbers", sum(probe.numbers for probe in found.values()))
    print(
        f"{len(found)} kernels, of these {sum(x.lanes == LANES for x in found.values())} with {LANES} lanes, "
        f"{sum(x.numbers for x in found.values())} numbers"
    )


def _found(name: str, run: Any) -> dict[str, Probe]:
    try:
        return probed(name, run)
    except TorchptError as error:
        if "TORCHPT_ASSETS" in str(error) or "asset" in str(error):
            pytest.skip("a file of this scene is not there")
        raise


def test_cornell_box(record_property):
    """The picture's kernels of one scene; all scenes are slow."""

    def picture(scene: torchpt.Scene) -> None:
        torchpt.render(scene, film={"width": 32, "height": 24}, **WISH)

    check(_found("cornell_box", picture), {"generate", "emit", "bounce", "terminate"}, record_property)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_pictures(name, record_property):
    check(_found(name, call_forward), {"generate", "bounce", "layers"}, record_property)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_gradients(name, record_property):
    check(_found(name, call_backward), {"generate", "bounce", "store"}, record_property)
