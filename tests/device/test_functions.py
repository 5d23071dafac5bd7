"""Operators and elementary functions of the lane compiler as PTX: the same bits as on one lane of the CPU at a time."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from few import few
from ptx_calls import LANES, differing_results
from torch import Tensor


def _module(name: str) -> ModuleType:
    """Import a file of the compiler's tests, whose cases are used here."""
    path = Path(__file__).parents[1] / "compiler" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"device_{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


OPERATORS, FUNCTIONS = _module("test_operators"), _module("test_functions")
CASES = OPERATORS.CASES


@pytest.mark.parametrize("number", few(range(len(CASES)), 8), ids=lambda k: CASES[k].operators.replace(" ", "+"))
def test_operators(number):
    case = CASES[number]

    def function(*arguments: Tensor) -> list[Tensor]:
        x = OPERATORS._namespace(arguments)
        found = [form(x) for form in case.forms]
        real = [y for y in found if y.dtype.is_floating_point and y.shape[-1] == x.f.shape[0]]
        return [*found, *(y * x.f + x.g for y in real)]  # products that are rounded with a sum

    with torch.inference_mode(case.inference), torch.no_grad():
        given = [x[..., :LANES] for x in OPERATORS.INPUTS.values()]
        numbers, wrong, _ = differing_results(function, given)
    assert numbers >= LANES and not wrong


@pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", few(FUNCTIONS.FUNCTIONS, 4))
def test_elementary_functions(name, dtype):
    """Of random arguments and of special ones."""
    given = [a[:: max(len(a) // LANES, 1)] for a in FUNCTIONS.arguments(name, dtype, 2_000)]
    ends = np.array(FUNCTIONS.SPECIAL, dtype)
    special = [ends] if len(given) == 1 else [a.reshape(-1) for a in np.meshgrid(ends, ends)]
    both = [torch.from_numpy(np.concatenate([a, b])) for a, b in zip(given, special, strict=True)]
    numbers, wrong, _ = differing_results(lambda *x: [FUNCTIONS.of_torch(name)(*x)], both)
    assert numbers >= LANES and not wrong


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_remainders(dtype):
    """GPUs have their own, by long division; CPUs the C library's. Of all sizes, subnormal ones too."""
    rng = torch.Generator().manual_seed(4)
    info = torch.finfo(dtype)
    low, high = math.log(info.smallest_normal * info.eps), math.log(info.max)
    size = torch.rand(2, 2000, generator=rng, dtype=torch.float64) * (high - low) + low
    size[1, ::2] = size[0, ::2] - torch.rand(1000, generator=rng, dtype=torch.float64) * 30.0
    x, y = (size.exp() * torch.where(torch.rand(size.shape, generator=rng) < 0.5, -1, 1)).to(dtype)
    ends = torch.tensor([0.0, -0.0, math.inf, -math.inf, math.nan, 1.0, -3.0, info.max, info.tiny * 0.3], dtype=dtype)
    x, y = (torch.cat([a, b]) for a, b in zip((x, y), torch.cartesian_prod(ends, ends).T, strict=True))
    numbers, wrong, _ = differing_results(lambda x, y: [torch.fmod(x, y), torch.remainder(x, y)], [x, y])
    assert numbers == 2 * len(x) and not wrong


def test_integers_of_floats_out_of_range():
    """The least integer where none is near, as x86 has it; PTX alone gives the nearest, and 0 for NaN."""
    x = torch.tensor([math.nan, math.inf, -math.inf, 3e9, -3e9, 2147483648.0, -2147483648.0, 2147483520.0, -0.7, 1e19])
    function = lambda x, d: [x.int(), d.int(), x.to(torch.uint8), (x * 2.0).long(), d.long() * d.int()]  # noqa: E731
    numbers, wrong, _ = differing_results(function, [x, x.double() - 0.5])
    assert numbers == 50 and not wrong
