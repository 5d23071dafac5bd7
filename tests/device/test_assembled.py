"""Kernels of shipped scenes through NVIDIA's assembler: registers and spills are no more than ``kernels.json`` says.

``docs/cuda.md`` shows the same figures.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from ptx_assembler import ARCHITECTURES, assemble, find_ptxas
from ptx_calls import named_stages, ptx_of

import torchpt

#: By scene, pass and kernel: ``ptx``, instructions of the text; ``registers`` and ``spills`` (bytes) by architecture;
#: ``lanes`` that were run on the machine of the tests; ``instructions`` and ``issues`` a lane there.
TABLE: dict[str, dict[str, dict[str, Any]]] = json.loads((Path(__file__).parent / "kernels.json").read_text())
#: Registers by which versions of ``ptxas`` may differ.
SLACK = 8
FAST = "cornell_box forward"


def passes(scene: torchpt.Scene, gradient: bool) -> None:
    """Call the kernels of a picture, or of a gradient by all parameters."""
    wish: dict[str, Any] = {"film": {"width": 16, "height": 16}, "spp": 1, "threads": 1, "compile": "on"}
    if not gradient:
        torchpt.render(scene, **wish)
        return
    given = {name: value.clone().requires_grad_() for name, value in scene.params.items()}
    image = torchpt.render(scene, params=given, **wish)
    torch.autograd.grad(image.mean(), list(given.values()), allow_unused=True)


@pytest.mark.filterwarnings("ignore:the gradient leaves out")
@pytest.mark.parametrize(
    ("name", "every"), [(FAST, False), *(pytest.param(name, True, marks=pytest.mark.slow) for name in TABLE)]
)
def test_registers_and_spills(name, every):
    """Of every kernel for every architecture, or of the two shortest kernels for one."""
    ptxas = find_ptxas()
    if ptxas is None:
        pytest.skip("ptxas is not installed (extra `cuda-dev`)")
    scene, _, which = name.partition(" ")
    stages = named_stages(scene, lambda loaded: passes(loaded, which == "backward"))
    common = stages.keys() & TABLE[name].keys()
    assert len(common) >= len(TABLE[name]) // 2  # the others are called by few paths, or for layers
    for kernel in sorted(common, key=lambda kernel: TABLE[name][kernel]["ptx"])[: None if every else 2]:
        known, ptx = TABLE[name][kernel], ptx_of(stages[kernel])
        for architecture in ARCHITECTURES if every else ("sm_90",):
            figures = assemble(ptxas, ptx, architecture)
            what = f"{kernel} on {architecture}: {figures}"
            assert figures.registers <= known["registers"][architecture] + SLACK, what
            assert figures.spills <= known["spills"][architecture], what


def test_table():
    """Every kernel was assembled for all architectures, and run by some lanes."""
    assert FAST in TABLE
    for kernels in TABLE.values():
        for known in kernels.values():
            assert set(known["registers"]) == set(known["spills"]) == set(ARCHITECTURES)
            assert 16 <= min(known["registers"].values()) <= max(known["registers"].values()) <= 255
            assert 0 < known["instructions"] <= known["issues"] * 1.001 and known["lanes"] > 0
