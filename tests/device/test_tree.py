"""The search of a tree by kernels of a device: hits on the PTX machine and pictures have the bits of the CPU."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from accel_reference import soup, sphere_mesh, triangles
from ptx_machine import PtxMachine
from ray_sets import KINDS, make_rays
from tree_machine import search_on_machine

import torchpt
from torchpt.engines.kernels import device as device_module
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings
from torchpt.search.tree import WideBvh


def tensors(rays: Any) -> Any:
    return tuple(map(torch.from_numpy, rays))


@pytest.mark.parametrize("any_hit", [False, True])
def test_hits_of_a_mesh(any_hit):
    g = triangles(*sphere_mesh(10))
    accel = WideBvh(g, 1)
    for kind in KINDS:
        found = search_on_machine(accel, tensors(make_rays(kind, g, 250, 1)), any_hit, per_thread=2)
        assert found.differing == 0
        assert found.machine.local_bytes == 8 * accel.depth


def test_hits_of_other_primitives():
    g = soup(5, (40, 20, 20, 20))
    rays = tensors(make_rays("aimed", g, 250, 2))
    assert search_on_machine(WideBvh(g, 1), rays, False).differing == 0


def test_local_memory_has_bounds():
    head = (
        ".entry kernel(\n)\n{\n\t.local .align 8 .b8 \t__local_depot0[8];\n\t.reg .b64 \t%SPL;\n\t.reg .b32 \t%r<3>;\n"
    )
    head += "\tmov.b64 \t%SPL, __local_depot0;\n\tmov.b32 \t%r1, %tid.x;\n\tst.local.b32 \t[%SPL+4], %r1;\n"
    PtxMachine(head + "\tld.local.b32 \t%r2, [%SPL+4];\n\tret;\n}\n").launch(None, [], 1, 32)  # type: ignore[arg-type]
    for place in (8, -4, 2):
        machine = PtxMachine(head + f"\tld.local.b32 \t%r2, [%SPL+{place}];\n\tret;\n}}\n")
        with pytest.raises(IndexError, match="local memory"):
            machine.launch(None, [], 1, 32)  # type: ignore[arg-type]


def rendered(scene: Scene, film: dict[str, Any], depth: int, **render: Any) -> Rendering:
    wish = {"film": film, "integrator": {"type": "path", "max_depth": depth}, "render": {"spp": 1, **render}}
    return render_scene(scene, settings(scene.description, wish), None)


@pytest.fixture
def trees(monkeypatch) -> list[Any]:
    """The searches by kernels that renders copied to the device."""
    copied: list[Any] = []
    plain = device_module.search_on_device

    def noted(*given: Any) -> Any:
        found = plain(*given)
        copied.append(None if found is None else found.tree)
        return found

    monkeypatch.setattr(device_module, "search_on_device", noted)
    return copied


def test_a_picture_by_ptx(device, trees):
    """A small picture of a mesh in a room: the whole wave is PTX on the machine, trees included."""
    scene = torchpt.load("cornell_bunny", device="cpu")
    of_cpu = rendered(scene, {"width": 4, "height": 4}, 1)
    device(1024, ptx=True)
    found = rendered(scene, {"width": 4, "height": 4}, 1)
    assert torch.equal(found.image, of_cpu.image) and found.rays == of_cpu.rays
    assert [tree.kinds for tree in trees] == [("triangle", "rectangle")]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_bunny", "env_teapot", "shapes_and_maps"])
def test_pictures(name, device, trees):
    scene = torchpt.load(name, device="cpu")
    of_cpu = rendered(scene, {"width": 64, "height": 48}, 6, spp=4)
    device(4096, 0)
    found = rendered(scene, {"width": 64, "height": 48}, 6, spp=4)
    assert torch.equal(found.image, of_cpu.image) and found.rays == of_cpu.rays
    assert trees and None not in trees


@pytest.mark.slow
@pytest.mark.parametrize("any_hit", [False, True])
def test_share_of_threads_at_work(any_hit, monkeypatch):
    """Rays of the first bounce in a room with a mesh: two fifths of the threads are at work where each takes several rays."""
    calls: list[Any] = []
    plain = WideBvh.nearest

    def noted(self: WideBvh, o: Any, d: Any, t_max: Any, count: int, *hits: Any) -> None:
        calls.append([x[..., :count].copy() for x in (o, d, t_max)])
        plain(self, o, d, t_max, count, *hits)

    monkeypatch.setattr(WideBvh, "nearest", noted)
    scene = torchpt.load("cornell_bunny", device="cpu")
    torchpt.render(scene, film={"width": 64, "height": 48}, spp=1, threads=1, compile="on")
    _, bounced, *_ = calls
    accel = WideBvh(scene.world(torch.float32)[1], 1)
    found = search_on_machine(accel, tensors(bounced), any_hit, per_thread=8)
    assert found.differing == 0
    assert found.instructions > 0.4 * found.issues
