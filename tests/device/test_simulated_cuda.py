"""The simulated CUDA device: what it refuses, and what it counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from simulated_cuda import Log, SimulatedTensor, simulated_cuda
from torch import Tensor

CUDA = torch.device("cuda:0")


@pytest.fixture
def log() -> Iterator[Log]:
    with simulated_cuda() as log:
        yield log


def test_tensors_are_made_on_the_device(log: Log):
    made = [torch.zeros(3, device="cuda"), torch.arange(3, device=CUDA), torch.tensor([1.0, 2.0], device="cuda")]
    made += [torch.ones(2).to("cuda"), torch.ones(2).cuda(), torch.as_tensor([1], device="cuda")]
    made += [torch.ones(2).new_zeros(3, device="cuda")]
    made += [torch.zeros_like(made[0]), made[0].new_tensor([1.0]), made[0][1:], made[0].to(torch.float64), made[0] + 1]
    assert all(isinstance(x, SimulatedTensor) and x.is_cuda and x.device == CUDA for x in made)
    assert not torch.zeros(3).is_cuda and made[0].cpu().device.type == "cpu" and made[0].to("cuda:0") is made[0]


REFUSED: dict[str, Callable[[Tensor, Tensor], object]] = {
    "sum": lambda here, there: here + there,
    "other way": lambda here, there: there * here,
    "where": lambda here, there: torch.where(here > 0, here, there),
    "cat": lambda here, there: torch.cat((here, there)),
    "number on the host": lambda here, there: torch.stack((here[0], there[0])),
    "gather": lambda here, there: here.gather(0, there.long()),
    "in place": lambda here, there: here.add_(there),
    "host table": lambda here, there: there[here.long()],
    "product": lambda here, there: here[None] @ there[:, None],
}


@pytest.mark.parametrize("name", REFUSED)
def test_operators_of_two_devices_are_refused(log: Log, name: str):
    with pytest.raises(
        RuntimeError, match="all tensors to be on the same device, but found at least two devices, cuda:0 and cpu"
    ):
        REFUSED[name](torch.zeros(3, device="cuda"), torch.zeros(3))


def test_numbers_and_indices_of_the_host_are_taken(log: Log):
    x = torch.arange(3.0, device="cuda")
    assert (x * torch.tensor(2.0)).tolist() == [0.0, 2.0, 4.0] and x[torch.tensor([2, 0])].tolist() == [2.0, 0.0]
    assert torch.where(x > 0, torch.tensor(5.0), x).tolist() == [0.0, 5.0, 5.0]


def test_device_memory_is_closed_to_the_host(log: Log):
    x = torch.zeros(3, device="cuda")
    with pytest.raises(TypeError, match="can't convert cuda:0 device type tensor to numpy"):
        x.numpy()
    with pytest.raises(RuntimeError, match="address of a device tensor"):
        x.data_ptr()
    with pytest.raises(RuntimeError, match="invalid device ordinal"):
        torch.zeros(3, device="cuda:1")


#: Operators on ``x = (0, 1, 2)``: times that the host waits, of these transfers to the host, and bytes of these.
WAITS: dict[str, tuple[Callable[[Tensor], object], tuple[int, int, int]]] = {
    "arithmetic": (lambda x: (x * 2 + 1).clamp(min=0).sum(), (0, 0, 0)),
    "gather": (lambda x: x[x.long()].scatter(0, x.long(), x), (0, 0, 0)),
    "fill by a mask": (lambda x: x.clone().__setitem__(x > 0, 1.0), (0, 0, 0)),
    "fill": (lambda x: torch.full((3,), 2.0, device=x.device), (0, 0, 0)),
    "nonzero": (lambda x: x.nonzero(), (1, 0, 0)),
    "mask": (lambda x: x[x > 0], (1, 0, 0)),
    "write by a mask": (lambda x: x.clone().__setitem__(x > 0, torch.ones(2, device="cuda")), (1, 0, 0)),
    "unique": (lambda x: x.unique(), (1, 0, 0)),
    "repeat_interleave": (lambda x: x.repeat_interleave(x.long()), (1, 0, 0)),
    "repeat_interleave to a size": (lambda x: x.repeat_interleave(x.long(), output_size=3), (0, 0, 0)),
    "inverse": (lambda x: torch.linalg.inv(torch.eye(2, device="cuda")), (1, 0, 0)),
    "item": (lambda x: x[1].item(), (1, 1, 4)),
    "int": (lambda x: int(x[1]), (1, 1, 4)),
    "bool": (lambda x: bool((x > 0).any()), (1, 1, 1)),
    "tolist": (lambda x: x.tolist(), (1, 1, 12)),
    "cpu": (lambda x: x.cpu(), (1, 1, 12)),
    "copy to the host": (lambda x: torch.zeros(3).copy_(x), (1, 1, 12)),
    "upload": (lambda x: torch.zeros(3).to("cuda"), (1, 0, 0)),
    "upload of numbers": (lambda x: torch.tensor([1, 2], device="cuda"), (1, 0, 0)),
    "copy to the device": (lambda x: x.clone().copy_(torch.zeros(3)), (1, 0, 0)),
}


@pytest.mark.parametrize("name", WAITS)
def test_waits_are_counted(log: Log, name: str):
    call, expected = WAITS[name]
    x = torch.arange(3.0, device="cuda")
    log.clear()
    call(x)
    assert (sum(log.waits.values()), sum(log.transfers.values()), log.bytes) == expected


def test_derivatives_go_to_the_device_of_each_tensor(log: Log):
    host, x = torch.ones(3, requires_grad=True), torch.arange(3.0, device="cuda").requires_grad_()
    y = (host.to("cuda") * x).cpu()
    a, b = torch.autograd.grad((y * y).sum(), (host, x))
    assert a.device.type == "cpu" and a.tolist() == [0.0, 2.0, 8.0]
    assert b.device == CUDA and b.tolist() == [0.0, 2.0, 4.0]


def test_nothing_is_left_behind():
    before = torch.Tensor.to, torch.zeros, torch.cuda.is_available
    with simulated_cuda(cards=2, name="Two"):
        assert torch.cuda.device_count() == 2 and torch.cuda.get_device_name() == "Two"
        assert torch.zeros(2, device="cuda:1").device.index == 1
        with pytest.raises(RuntimeError, match="same device"):
            torch.zeros(2, device="cuda:1").add(torch.zeros(2, device="cuda:0"))
    assert (torch.Tensor.to, torch.zeros, torch.cuda.is_available) == before
