"""The driver's interface: a device that cannot run kernels is one line."""

from __future__ import annotations

import ctypes

import pytest
import torch
from simulated_driver import SimulatedCuda, SimulatedDriver

from torchpt.core.errors import RenderError
from torchpt.engines.kernels import driver
from torchpt.engines.kernels.driver import Cuda, missing


def test_a_driver_may_be_missing(monkeypatch):
    monkeypatch.setattr(driver, "library", lambda: None)
    assert missing(0).startswith("there is no CUDA driver")
    with pytest.raises(RenderError, match=r"^kernels cannot run on cuda:1: there is no CUDA driver \([^\n]*\)$"):
        Cuda(torch.device("cuda:1"))


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({}, ""),
        ({"version": 10020}, "the CUDA driver is too old: 10.2, and 11.0 is needed"),
        ({"capability": (7, 0)}, "the GPU is too old: its compute capability is 7.0, and 7.5 is needed"),
        ({"present": 0}, "the CUDA driver says CUDA_ERROR_NO_DEVICE"),
    ],
)
def test_what_cannot_run_kernels_is_said_in_one_line(found, said):
    assert missing(0, SimulatedDriver(**found)) == said


def test_code_that_the_driver_refuses_is_one_line():
    cuda = SimulatedCuda()
    said = "^CUDA: the code of a kernel: CUDA_ERROR_INVALID_PTX: not an object file of this CPU$"
    with pytest.raises(RenderError, match=said):
        cuda.load(b"no code", "key")


def test_a_launch_may_fail():
    cuda = SimulatedCuda()
    function = driver.Function(ctypes.c_void_p(1), 1, 0, 0)
    words, lanes = (ctypes.c_int64 * 1)(), ctypes.c_int64(1)
    simulated: SimulatedDriver = cuda.driver
    for code, kind, name in ((2, MemoryError, "OUT_OF_MEMORY"), (700, RenderError, "UNKNOWN")):
        simulated.refused = code
        with pytest.raises(kind, match=f"^CUDA: the launch of a kernel: CUDA_ERROR_{name}$"):
            cuda.launch(function, words, ctypes.addressof(lanes), 1, 0)


def test_grids_fill_the_device_once():
    cuda = SimulatedCuda()
    grids = []
    cuda.driver.cuLaunchKernel = lambda function, grid, *rest: grids.append(grid) or 0
    function = driver.Function(ctypes.c_void_p(1), 40, 0, 0)
    words, lanes = (ctypes.c_int64 * 1)(), ctypes.c_int64(1)
    for most in (0, 1, 128, 129, 1 << 20):
        cuda.launch(function, words, ctypes.addressof(lanes), most, 0)
    assert grids == [1, 1, 1, 2, 40]
