"""The engines that the package chooses for tensors on CUDA: kernels of the simulated driver on a simulated device.

Device and host tensors do not mix there, so this holds what the other tests of the engine cannot, as their device memory is
that of CPU tensors: tables, counters and films are on the device, and stages are traced with copies on the host.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
import torch._ops
from few import few
from simulated_cuda import SimulatedTensor, simulated_cuda
from simulated_driver import SimulatedCuda, SimulatedDriver, simulated_target
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.engines.kernels import device_backward as backward_module
from torchpt.engines.kernels import device_forward as forward_module
from torchpt.engines.kernels import driver as driver_module
from torchpt.native import device_checks
from torchpt.native.device_checks import CheckResult
from torchpt.search.tree import WideBvh

FILM = {"width": 8, "height": 6}
NAMES = ("materials.white.reflectance", "shapes.lamp.emission", "shapes.short_box.vertices", "camera.to_world")


class _Card(SimulatedCuda):
    """A device of the simulated driver, whose memory is that of tensors on a simulated CUDA device."""

    def __init__(self) -> None:
        super().__init__()
        self.device = torch.device("cuda:0")

    def to_device(self, values: Tensor) -> Tensor:
        return values.to(self.device)

    def to_host(self, values: Tensor) -> Any:
        return super().to_host(values.cpu())


@pytest.fixture
def card(monkeypatch) -> Iterator[_Card]:
    """The device that ``cuda`` is."""
    card = _Card()
    call = torch._ops.OpOverload.__call__

    def called(self: Any, *args: Any, **kwargs: Any) -> Any:
        """Tables are filled by operators as such, of which the simulated device knows only those with tensors."""
        where = kwargs.get("device")
        if where is None or where.type != "cuda" or any(isinstance(x, SimulatedTensor) for x in args):
            return call(self, *args, **kwargs)
        return call(self, *args, **{**kwargs, "device": torch.device("cpu")}).to(where)

    monkeypatch.setattr(torch._ops.OpOverload, "__call__", called)
    monkeypatch.setattr(SimulatedTensor, "data_ptr", lambda self: self.inner.data_ptr())
    monkeypatch.setattr(driver_module, "library", SimulatedDriver)
    for module in (forward_module, backward_module):
        monkeypatch.setattr(module, "cuda_of", lambda device: card)
    monkeypatch.setattr(forward_module.device_forward, "__defaults__", (None, None, simulated_target, 2048))
    monkeypatch.setattr(backward_module.device_backward, "__defaults__", (None, None, simulated_target))
    with simulated_cuda(rounds=True):  # numbers of pictures may come from no operator that CUDA may round differently
        yield card


def picture(name: str, where: str, **keys: Any) -> Tensor:
    options: dict[str, Any] = {"spp": 2, "film": FILM, **keys}
    return torchpt.render(torchpt.load(name, where), seed=1, **options).cpu()


def gradients(where: str) -> list[Tensor]:
    scene = torchpt.load("cornell_box", where)
    values = {name: scene.params[name].clone().requires_grad_() for name in NAMES}
    image = torchpt.render(scene, params=values, spp=2, seed=1, film=FILM, compile="on", edges=False)
    weights = (torch.arange(image.numel()).view(image.shape) / image.numel()).to(image.device)
    return [x.cpu() for x in torch.autograd.grad(image, list(values.values()), weights)]


@pytest.mark.parametrize("name", few(["cornell_box", "cornell_bunny", "veach_mis", "env_teapot", "shapes_and_maps"], 1))
def test_pictures_have_the_bits_of_the_cpu(name, card):
    assert torch.equal(picture(name, "cuda", compile="on"), picture(name, "cpu"))
    assert card.driver.launches


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_gradients_have_the_bits_of_the_cpu(card):
    found, launches = gradients("cuda"), card.driver.launches.total()
    assert all(map(torch.equal, found, gradients("cpu"))) and launches > 100


@pytest.mark.parametrize("passed", few([True, False, None], 2))
def test_auto_takes_kernels_where_they_have_passed_their_check(card, monkeypatch, passed):
    result = None if passed is None else CheckResult("Simulated GPU", "550", passed)
    monkeypatch.setattr(device_checks, "last_check", lambda device=None: result)
    picture("cornell_box", "cuda", spp=1, film={"width": 4, "height": 3}, integrator={"max_depth": 2})
    assert bool(card.driver.launches.total()) == (passed is True)


def test_on_is_refused_with_an_old_driver(card, monkeypatch):
    monkeypatch.setattr(driver_module, "library", lambda: SimulatedDriver(version=10020))
    with pytest.raises(SceneError, match=r"render.compile: .*the CUDA driver is too old: 10.2, and 11.0 is needed"):
        picture("cornell_box", "cuda", compile="on")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_a_mesh_that_moves_refits_the_tree(card, monkeypatch):
    built: list[int] = []
    made = WideBvh.__init__
    monkeypatch.setattr(WideBvh, "__init__", lambda self, *given: (built.append(1), made(self, *given))[1])

    def steps(where: str) -> list[Tensor]:
        """Pictures and gradients of a mesh that moves."""
        scene = torchpt.load("cornell_bunny", where)
        vertices, found = scene.params["shapes.bunny.vertices"], []
        for step in range(3):
            options: dict[str, Any] = {"film": {"width": 8, "height": 8}, "integrator": {"max_depth": 2}}
            moved = (vertices + 0.02 * step).requires_grad_()
            image = torchpt.render(
                scene, params={"shapes.bunny.vertices": moved}, spp=1, compile="on", edges=False, **options
            )
            found += [image.detach().cpu(), torch.autograd.grad(image.sum(), moved)[0].cpu()]
        return found

    found = steps("cuda")
    assert len(built) == 1 and all(map(torch.equal, found, steps("cpu")))
    assert not torch.equal(found[0], found[4])
