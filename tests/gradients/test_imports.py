"""What a gradient loads: libraries that stay in memory, and that it does not need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchpt.core.autograd import gradients_of

_GRADIENT = """
import sys
import torchpt
scene = torchpt.load("cornell_box")
name = "{name}"
leaf = scene.params[name].clone().requires_grad_()
picture = torchpt.render(scene, params={{name: leaf}}, film=(8, 8), spp=1, compile="{compile}", edges=False)
picture.mean().backward()
assert leaf.grad is not None and bool(leaf.grad.abs().sum() > 0)
print(*[name for name in ("sympy", "torch._dynamo") if name in sys.modules])
"""


@pytest.mark.parametrize("compiled", ["auto", "off"])
def test_a_gradient_imports_neither_sympy_nor_dynamo(compiled):
    # Both take tens of MB, and torch imports SymPy where autograd is given cotangents.
    code = _GRADIENT.format(name="materials.red.reflectance", compile=compiled)
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, cwd=root)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []


def test_cotangents_are_pulled_back_as_by_torch():
    x, y, unused = (torch.randn(5, requires_grad=True, dtype=torch.float64) for _ in range(3))
    outputs = [x * y, (x.sin() + y)[:3], x, y.detach()]
    cotangents = [torch.randn_like(output) for output in outputs]
    with torch.no_grad():  # as in a backward pass
        found = gradients_of(outputs, [x, y, unused], cotangents)
    outputs = [x * y, (x.sin() + y)[:3], x]
    expected = torch.autograd.grad(outputs, [x, y, unused], cotangents[:3], allow_unused=True)
    assert found[2] is None and expected[2] is None
    assert all(torch.equal(a, b) for a, b in zip(found[:2], expected[:2], strict=True) if a is not None)
