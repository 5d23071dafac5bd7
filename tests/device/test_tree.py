"""The search of trees by kernels of a device: hits on the PTX machine and pictures have the bits of the CPU."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
import torch
from accel_reference import soup, sphere_mesh, triangles
from few import few
from gradient_rooms import room, sums_of
from ptx_machine import PtxMachine
from ray_kernels import searched_trees
from ray_sets import KINDS, make_rays
from search_scenes import copied, maps, with_instances, with_quadrics
from simulated_cuda import simulated_cuda
from tree_machine import search_on_machine

import torchpt
from torchpt.core.tree import moved
from torchpt.engines.kernels import device_forward as forward_module
from torchpt.engines.kernels import device_search
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings
from torchpt.search import build
from torchpt.search.instance_rays import InstanceSearch
from torchpt.search.tree import WideBvh
from torchpt.search.tree_instances import InstancedWideBvh


def tensors(rays: Any) -> Any:
    return tuple(map(torch.from_numpy, rays))


@pytest.mark.parametrize(("kind", "any_hit"), few(product(KINDS, (False, True)), 4))
def test_hits_of_a_mesh(kind, any_hit):
    g = triangles(*sphere_mesh(10))
    accel = WideBvh(g, 1)
    found = search_on_machine(accel, tensors(make_rays(kind, g, 250, 1)), any_hit, per_thread=2)
    assert found.differing == 0
    assert found.machine.local_bytes == 8 * accel.depth


def test_hits_of_other_primitives():
    g = soup(5, (40, 20, 20, 20))
    rays = tensors(make_rays("aimed", g, 250, 2))
    assert search_on_machine(WideBvh(g, 1), rays, False).differing == 0


@pytest.mark.parametrize(("kind", "any_hit"), few(product(("aimed", "random", "axes"), (False, True)), 2))
def test_hits_of_instances(kind, any_hit):
    g, explicit = with_instances(40, 3)
    accel = InstancedWideBvh(g, 1)
    found = search_on_machine(accel, tensors(make_rays(kind, explicit, 120, 1)), any_hit, per_thread=2)
    assert found.differing == 0
    assert found.machine.local_bytes == 8 * max(accel.depth, accel.base.depth)


def test_the_search_of_a_device_is_that_of_the_host():
    """Quadrics and instances, searched by tensors on a device: kernels get the bits of the CPU's trees."""
    plain = with_quadrics()
    for g in (plain, copied(plain, [(0, 40)], maps(4, 6))):
        with simulated_cuda():
            accel = build(moved(g, torch.device("cuda:0")))
            assert accel.name == "torch"
            host = device_search._host_search(accel)
        assert isinstance(host, WideBvh if g is plain else InstancedWideBvh)
        of_device, of_host = (
            searched_trees(host),
            searched_trees(InstancedWideBvh(g) if g.copies is not None else WideBvh(g)),
        )
        assert of_device.functions == of_host.functions
        assert [x.tobytes() for x in of_device.tables] == [x.tobytes() for x in of_host.tables]


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
    plain = forward_module.search_on_device

    def noted(*given: Any) -> Any:
        found = plain(*given)
        copied.append(None if found is None else found.tree)
        return found

    monkeypatch.setattr(forward_module, "search_on_device", noted)
    return copied


def test_a_picture_by_ptx(device, trees):
    """A small picture of a mesh in a room: the whole wave is PTX on the machine, trees included."""
    scene = torchpt.load("cornell_bunny", device="cpu")
    of_cpu = rendered(scene, {"width": 4, "height": 4}, 1)
    device(1024, ptx=True)
    found = rendered(scene, {"width": 4, "height": 4}, 1)
    assert torch.equal(found.image, of_cpu.image) and found.rays == of_cpu.rays
    assert [tree.kinds for tree in trees] == [("triangle", "rectangle")]


def crowd(opacity: float = 1.0) -> Scene:
    """A ball of triangles in a room, and seven instances of it, of which every other one may let light pass."""
    vertices, faces = sphere_mesh(6)
    mesh = {"type": "mesh", "vertices": (0.3 * vertices).tolist(), "faces": faces.tolist(), "material": "plate"}
    described = room({"type": "diffuse", "reflectance": [0.3, 0.5, 0.7]}, {"mesh": mesh})
    described["materials"]["veil"] = {"type": "diffuse", "reflectance": [0.7, 0.4, 0.2], "opacity": opacity}
    for k in range(7):
        placed = [{"scale": [0.5, 0.8, 0.4 + 0.1 * k]}, {"translate": [0.25 * k - 0.7, 0.4 * (k % 3) - 0.3, 0.4]}]
        material = "veil" if k % 2 else "grey"
        described["shapes"][f"copy{k}"] = {"type": "instance", "of": "mesh", "material": material, "transform": placed}
    return torchpt.load(described, device="cpu")


@pytest.mark.parametrize(("opacity", "accel"), few([(0.5, "torch"), (0.5, "auto"), (1.0, "torch"), (1.0, "auto")], 1))
def test_pictures_with_instances(opacity, accel, device, trees):
    """Opaque, and with surfaces that may let light pass; a device's own search by tensors is replaced by kernels."""
    scene, film = crowd(opacity), {"width": 16, "height": 12}
    of_cpu = rendered(scene, film, 2, accel=accel)
    device(1024, 0)
    found = rendered(scene, film, 2, accel=accel)
    assert torch.equal(found.image, of_cpu.image) and found.rays == of_cpu.rays
    assert [type(tree) for tree in trees] == [InstanceSearch]


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [1.0, 0.5])
def test_pictures_with_instances_by_ptx(opacity, device):
    scene, film = crowd(opacity), {"width": 8, "height": 6}
    of_cpu = rendered(scene, film, 2)
    device(1024, ptx=True)
    found = rendered(scene, film, 2)
    assert torch.equal(found.image, of_cpu.image) and found.rays == of_cpu.rays


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_gradients_with_instances(device):
    scene, names = crowd(), ("shapes.copy2.to_world", "shapes.mesh.vertices", "materials.veil.reflectance")
    of_cpu = sums_of(scene, *names)
    cuda = device(1024, 0)
    assert torch.equal(sums_of(scene, *names), of_cpu) and cuda.fallback == ""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_bunny", "env_teapot", "shapes_and_maps", "instances", "clutter", "noise"])
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
