"""Replaying paths: bits, depth, memory, and what a colour of 0 has for a derivative."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from few import few
from gradient_rooms import gradient_of, room

import torchpt
from torchpt.engines.kernels import backward, engine
from torchpt.gradients import replay
from torchpt.gradients.tape import clamped_samples, sample_cotangents
from torchpt.scene.formats.description import settings

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

PLATE = {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4]}
NAME = "materials.plate.reflectance"


@pytest.mark.slow
def test_bits_do_not_depend_on_memory_by_tensor_operations():
    scene = torchpt.load(room(PLATE), "cpu")
    first, other = (gradient_of(scene, NAME, compile="off", max_memory=memory) for memory in (None, "3GB"))
    assert torch.equal(first, other)


@pytest.mark.parametrize("mode", ["auto", "off"])
def test_paths_of_more_vertices_than_are_kept(monkeypatch, mode):
    scene = torchpt.load(room(PLATE), "cpu")
    wish = {"compile": mode, "integrator": {"type": "path", "max_depth": 14, "rr_depth": 100}}
    whole = gradient_of(scene, NAME, **wish)
    for module in (replay, backward):
        monkeypatch.setattr(module, "KEPT", 2)
    monkeypatch.setattr(replay, "MARKS", 3)
    parts = gradient_of(scene, NAME, **wish)
    assert torch.equal(whole, parts)


@pytest.mark.parametrize("adjoint", ["replay", "autograd"])
def test_a_colour_of_zero_has_its_whole_derivative(adjoint):
    # Linear in a colour near 0, but for paths that meet it twice.
    found = []
    for value in (0.0, 1e-3):
        scene = torchpt.load(room({"type": "diffuse", "reflectance": [value] * 3}), "cpu")
        wish = {"integrator": {"type": "path", "max_depth": 5, "rr_depth": 2}}
        found.append(gradient_of(scene, NAME, adjoint=adjoint, spp=64, **wish))
    assert torch.allclose(found[0], found[1], rtol=0.02)


def test_an_unlit_lamp_has_its_derivative_behind_what_hides_it():
    described = room(PLATE)
    described["shapes"]["lamp"]["emission"] = [0.0, 0.0, 0.0]
    dark = gradient_of(torchpt.load(described, "cpu"), "shapes.lamp.emission", spp=256)
    lit = gradient_of(torchpt.load(room(PLATE), "cpu"), "shapes.lamp.emission", spp=256)
    assert torch.allclose(dark, lit, rtol=0.15)  # another estimator: a lamp without power is not chosen


def test_no_gradient_as_large_as_the_table_for_each_look_up():
    from torch.utils._python_dispatch import TorchDispatchMode

    class Sizes(TorchDispatchMode):
        large = 0

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            out = func(*args, **(kwargs or {}))
            if isinstance(out, torch.Tensor) and out.numel() >= size and "zeros" in str(func):
                Sizes.large += 1
            return out

    steps = 40
    grid = [
        [-1 + 2 * x / steps, -1 + 2 * y / steps, 0.01 * ((x * y) % 3)]
        for y in range(steps + 1)
        for x in range(steps + 1)
    ]
    faces = [
        [a, a + 1, a + steps + 2, a + steps + 1]
        for y in range(steps)
        for x in range(steps)
        for a in [y * (steps + 1) + x]
    ]
    size = 3 * len(faces)
    mesh = {"type": "mesh", "vertices": grid, "faces": faces, "material": "plate", "face_normals": True}
    scene = torchpt.load(room(PLATE, shapes={"plate": mesh}), "cpu")
    with Sizes():
        gradient_of(scene, "shapes.plate.vertices", compile="off", spp=1, edges=False)
    assert Sizes.large < 30  # of the assembly, and one sum for each of its tables


@pytest.mark.parametrize("name", [NAME, "shapes.plate.to_world"])
def test_stages_of_which_no_kernel_can_be_made(monkeypatch, name, capfd):
    from torchpt.compiler.graph import Unsupported
    from torchpt.core.errors import warn_once
    from torchpt.engines.kernels.backward import VjpKernels

    scene = torchpt.load(room(PLATE, lights={"sky": {"type": "constant", "radiance": [0.2, 0.3, 0.4]}}), "cpu")
    whole, made = gradient_of(scene, name), VjpKernels._get

    def get(self: Any, listed: bool, build: Any, *arguments: Any) -> Any:
        if build.__name__.endswith("_vjp"):
            raise Unsupported("an operator of the test's own")
        return made(self, listed, build, *arguments)

    warn_once.cache_clear()
    monkeypatch.setattr(VjpKernels, "_get", get)
    eager = gradient_of(scene, name)
    assert float((whole - eager).norm()) < 1e-4 * float(whole.norm())
    assert "is differentiated by tensor operations, as no kernel can be made of an operator" in capfd.readouterr().err


@pytest.mark.parametrize("threads", few([1, 2], 1))
def test_memory_that_runs_out_between_kernels(monkeypatch, threads):
    scene = torchpt.load(room(PLATE), "cpu")
    whole, run, calls = gradient_of(scene, NAME, spp=16), replay.Chunk.run, []

    def failing(*args: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise MemoryError
        return run(*args)

    monkeypatch.setattr(replay, "LANES_OF_KERNELS", engine.LANES // 64)
    monkeypatch.setattr(replay.Chunk, "run", failing)
    found = gradient_of(scene, NAME, spp=16, threads=threads)
    assert len(calls) >= 3
    assert torch.allclose(found, whole, rtol=1e-4)


def test_gradcheck_of_texels(tmp_path):
    path = tmp_path / "texels.png"
    torchpt.write_image(path, 0.2 + 0.6 * torch.rand(2, 2, 3, generator=torch.Generator().manual_seed(0)))
    scene = torchpt.load(room({"type": "diffuse", "reflectance": {"type": "image", "path": str(path)}}), "cpu")
    leaf = scene.params[NAME].double().requires_grad_()

    def picture(texels: torch.Tensor) -> torch.Tensor:
        wish = {"film": {"width": 4, "height": 4}, "integrator": {"type": "path", "max_depth": 4, "rr_depth": 100}}
        return torchpt.render(scene, params={NAME: texels}, spp=2, seed=3, seed_grad=3, dtype=torch.float64, **wish)

    assert torch.autograd.gradcheck(picture, (leaf,), eps=1e-5, atol=1e-6, fast_mode=True)


def test_cotangents_of_samples_are_those_of_how_pixels_count_them():
    """Samples below and above the clamp, of either sign, and one that is not finite: against autograd."""
    samples = torch.randn(3, 8, 5, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    samples[1, 2, 3] = float("nan")
    pixels = torch.randn(3, 5, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    scene = torchpt.load(room(PLATE), "cpu")
    for clamp in (None, 0.7):
        wishes = settings(scene.description, {"integrator": {"type": "path", "clamp": clamp}, "render": {"spp": 8}})
        leaf = samples.clone().requires_grad_()
        (clamped_samples(wishes, leaf).mean(1) * pixels).sum().backward()
        assert leaf.grad is not None
        torch.testing.assert_close(sample_cotangents(wishes, samples, pixels), leaf.grad)
