"""The compiled loop made for older machines, run here: the picture of this machine's own code, up to rounding."""

from __future__ import annotations

import platform

import pytest
import torch
from few import few

import torchpt
from torchpt.compiler import cache
from torchpt.compiler import cpu as engine
from torchpt.compiler.target import Target
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

pytestmark = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="these are x86 machines")


def picture(name: str, spp: int) -> torch.Tensor:
    scene = torchpt.load(name, "cpu")
    wish = {"film": {"width": 40, "height": 40, "filter": "box"}, "render": {"spp": spp, "compile": "on"}}
    return render_scene(scene, settings(scene.description, wish)).image


@pytest.mark.parametrize("cpu", few(["haswell", "nehalem"], 1))  # AVX2, and SSE 4.2 without fused multiply-add
@pytest.mark.parametrize(
    "name", ["cornell_box", *(pytest.param(n, marks=pytest.mark.slow) for n in ("veach_mis", "studio", "env_teapot"))]
)
def test_older_machines_show_the_same_picture(monkeypatch, name, cpu):
    own = picture(name, 4)
    made = engine.counts()
    monkeypatch.setitem(engine._state, "host", Target(cpu, ""))
    monkeypatch.setattr(cache, "_programs", {})
    other = picture(name, 4)
    assert engine.counts() != made  # code of its own, made now or read from disk
    # Sums are rounded otherwise, and a decision may fall the other way for it: a few paths differ.
    assert torch.isclose(own, other, rtol=1e-3, atol=1e-5).all(-1).float().mean() > 0.98
    assert float(other.mean()) == pytest.approx(float(own.mean()), rel=2e-3)
