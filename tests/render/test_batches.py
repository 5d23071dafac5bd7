"""Batches: each picture is the one that ``render`` makes alone, nothing is made twice, and errors say where they belong."""

from __future__ import annotations

import gc
import threading
import weakref
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from torch import Tensor

import torchpt
from torchpt import gradients, search
from torchpt.core.errors import RenderError, SceneError, TorchptError
from torchpt.engines import tensors
from torchpt.engines.engine import TASKS
from torchpt.engines.kernels import engine, programs
from torchpt.engines.kernels import programs as loop_kernels
from torchpt.paths.integrators import base
from torchpt.rendering import Run
from torchpt.rendering.batches import Picture, request_of, task_counts
from torchpt.scene import scene as scenes_room

SIZE = {"width": 24, "height": 16, "filter": "box"}


def room(x: float = 0.0, colour: float = 0.5, ball: bool = True, **more):
    shapes = {
        "floor": {"type": "rectangle", "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]},
        "wall": {"type": "rectangle", "material": "grey", "transform": [{"scale": 3}, {"translate": [0, 0, -2]}]},
        "lamp": {
            "type": "rectangle",
            "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 2.5, 0]}],
            "emission": [5, 5, 5],
        },
    }
    if ball:
        shapes["ball"] = {"type": "sphere", "center": [x, 0.5, 0], "radius": 0.5, "material": "grey"}
    return torchpt.load(
        {
            "camera": {"type": "perspective", "origin": [0, 1, 4], "target": [0, 0.7, 0], "fov": 50},
            "film": SIZE,
            "integrator": {"max_depth": 4},
            "render": {"spp": 3, "threads": 1, "device": "cpu"},
            "materials": {"grey": {"type": "diffuse", "reflectance": [colour, 0.5, 0.4]}},
            "shapes": shapes,
            **more,
        }
    )


def tetrahedron(height: float = 1.0):
    """A scene of another kind: triangles, a mirror, two light sources."""
    return torchpt.load(
        {
            "camera": {
                "type": "thinlens",
                "origin": [0, 1, 3],
                "target": [0, 0.3, 0],
                "aperture_radius": 0.05,
                "focus_distance": 3,
            },
            "film": SIZE,
            "render": {"spp": 3, "threads": 1, "device": "cpu"},
            "shapes": {
                "tip": {
                    "type": "mesh",
                    "vertices": [[-1, 0, 1], [1, 0, 1], [0, 0, -1], [0, height, 0]],
                    "faces": [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
                    "material": {"type": "conductor", "material": "Au"},
                }
            },
            "lights": {
                "sky": {"type": "constant", "radiance": [0.3, 0.4, 0.5]},
                "sun": {"type": "directional", "direction": [0, -1, -0.5], "irradiance": [1, 1, 1]},
            },
        }
    )


def poses(scene, count):
    found = scene.params["camera.to_world"].repeat(count, 1, 1)
    found[:, 0, 3] += 0.1 * torch.arange(count)
    return found


BLOCKS = [
    {"type": "perspective", "origin": [1, 1, 4], "target": [0, 0.5, 0], "fov": 40},
    {"type": "orthographic", "origin": [0, 2, 3], "target": [0, 0.5, 0], "width": 4},
    {"K": [[30, 0, 12], [0, 30, 8], [0, 0, 1]], "R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "t": [0, 1, 4]},
]


# -- the same bits


@pytest.mark.parametrize("threads", few((2, 1, 3), 1))
def test_scenes_of_different_kinds(threads):
    scenes = [room(0.2), tetrahedron(), room(-0.3, 0.8), room(ball=False), tetrahedron(0.5)]
    batch = torchpt.render_batch(scenes, threads=threads, seed=5)
    assert batch.shape == (5, 1, 16, 24, 3)
    for scene, picture in zip(scenes, batch, strict=True):
        assert torch.equal(picture[0], torchpt.render(scene, seed=5))


def test_cameras_as_blocks():
    scenes = [room(0.2), tetrahedron()]
    batch = torchpt.render_batch(scenes, BLOCKS)
    assert batch.shape == (2, 3, 16, 24, 3)
    for s, scene in enumerate(scenes):
        for c, block in enumerate(BLOCKS):
            assert torch.equal(batch[s, c], torchpt.render(scene.seen_by(block)))
    written = room(0.2, camera=BLOCKS[2])
    assert torch.equal(batch[0, 2], torchpt.render(written))


def test_cameras_as_poses():
    scenes = [room(0.2), tetrahedron()]
    given = poses(scenes[0], 3)
    batch = torchpt.render_batch(scenes, given)
    for s, scene in enumerate(scenes):
        for c, pose in enumerate(given):
            assert torch.equal(batch[s, c], torchpt.render(scene, params={"camera.to_world": pose}))
    assert torch.equal(torchpt.render_batch(scenes, list(given)), batch)


def test_a_film_of_the_call_is_that_of_matrices_in_pixels():
    film = {"width": 12, "height": 8}
    alone = torchpt.render(room(camera=BLOCKS[2], film=SIZE | film))
    assert torch.equal(torchpt.render_batch(room(), BLOCKS[2:], film=film)[0, 0], alone)


def test_parameters_of_each_scene():
    scene = room()
    rgb = torch.tensor([[0.2, 0.3, 0.4], [0.8, 0.1, 0.1]])
    batch = torchpt.render_batch(scene, params={"materials.grey.reflectance": rgb})
    as_list = [{"materials.grey.reflectance": row} for row in rgb]
    assert batch.shape == (2, 1, 16, 24, 3)
    assert torch.equal(torchpt.render_batch(scene, params=as_list), batch)
    for own, picture in zip(as_list, batch, strict=True):
        assert torch.equal(picture[0], torchpt.render(scene, params=own))
    scenes = [scene, room(0.4)]
    both = torchpt.render_batch(scenes, poses(scene, 2), as_list)
    pose = poses(scene, 2)[1]
    alone = torchpt.render(scenes[1], params={**as_list[1], "camera.to_world": pose})
    assert torch.equal(both[1, 1], alone)


def test_meshes_that_move():
    scene = tetrahedron()
    tips = scene.params["shapes.tip.vertices"].repeat(3, 1, 1)
    tips[:, 3, 1] = torch.tensor([0.4, 0.8, 1.2])
    batch = torchpt.render_batch(scene, params={"shapes.tip.vertices": tips})
    for height, picture in zip((0.4, 0.8, 1.2), batch, strict=True):
        assert torch.equal(picture[0], torchpt.render(tetrahedron(height)))


def test_seeds():
    scenes, given = [room(), tetrahedron()], poses(room(), 2)
    each = torchpt.render_batch(scenes, given, seed=[3, 4])
    grid = torchpt.render_batch(scenes, given, seed=[[3, 7], [4, 4]])
    assert (
        torch.equal(each[0, 0], grid[0, 0])
        and torch.equal(each[1], grid[1])
        and not torch.equal(each[0, 1], grid[0, 1])
    )
    assert torch.equal(grid[0, 1], torchpt.render(scenes[0], seed=7, params={"camera.to_world": given[1]}))


def test_samples_of_each_scene_and_camera():
    scenes, given = [room(), tetrahedron()], poses(room(), 2)
    each = torchpt.render_batch(scenes, given, spp=[2, 5], full=True)
    grid = torchpt.render_batch(iter(scenes), given, spp=torch.tensor([[2, 4], [1, 5]]))
    for picture, s, c, spp in (
        (each.image[0, 1], 0, 1, 2),
        (each.image[1, 1], 1, 1, 5),
        (grid[0, 1], 0, 1, 4),
        (grid[1, 0], 1, 0, 1),
    ):
        assert torch.equal(picture, torchpt.render(scenes[s], spp=spp, params={"camera.to_world": given[c]}))
    assert [each[s, 0].spp for s in range(2)] == [2, 5]
    same = torchpt.render_batch(scenes, given, spp=np.array([[2, 2], [5, 5]]))
    assert torch.equal(same, each.image)


def test_a_picture_of_many_samples_is_more_tasks():
    scene, counts = room(), task_counts(4, 16.0)
    few_samples, many = (counts(Picture(0, 0, "", request_of(scene, False, spp=spp))) for spp in (1, 61))
    assert few_samples == 1 and many > 0.9 * TASKS * torch.get_num_threads()


def test_cameras_of_each_scene():
    scenes = [room(0.2), tetrahedron()]
    given = torch.stack([poses(scene, 3) for scene in scenes])
    batch = torchpt.render_batch(scenes, given)
    assert batch.shape == (2, 3, 16, 24, 3)
    for s, scene in enumerate(scenes):
        for c in range(3):
            assert torch.equal(batch[s, c], torchpt.render(scene, params={"camera.to_world": given[s, c]}))
    for nested in (given.numpy(), given.tolist(), list(given), [list(row) for row in given]):
        assert torch.equal(torchpt.render_batch(scenes, nested), batch)
    assert torch.equal(torchpt.render_batch(iter(scenes), given), batch)
    mixed = torchpt.render_batch(scenes, [BLOCKS[:1], [given[1, 2]]])
    assert torch.equal(mixed[0, 0], torchpt.render(scenes[0].seen_by(BLOCKS[0])))
    assert torch.equal(mixed[1], batch[1, 2:])


def test_scenes_from_an_iterator():
    told = []
    batch = torchpt.render_batch((room(0.1 * k) for k in range(3)), on_progress=lambda *done: told.append(done))
    assert torch.equal(batch[2, 0], torchpt.render(room(0.1 * 2)))
    assert told == [(1, None), (2, None), (3, None)]


@pytest.mark.parametrize(
    "wishes",
    (
        {"compile": "off"},
        {"max_memory": "2GB"},
        {"target_error": 0.5},
        {"sampler": {"type": "sobol", "adaptive": True}, "spp": 24},
        {"pilots": True, "spp": 4},
        {"integrator": {"type": "path", "max_depth": 3, "clamp": 0.4}},
        {"dtype": torch.float64},
        {"spp": 70},
        {"integrator": "aov", "film": {"aovs": ["normal"]}},
    ),
    ids=str,
)
def test_every_way_to_render(wishes):
    scenes = [room(0.2), room(0.3)]
    batch = torchpt.render_batch(scenes, **wishes)
    for scene, picture in zip(scenes, batch, strict=True):
        assert torch.equal(picture[0], torchpt.render(scene, **wishes))


def test_layers():
    scenes, film = [room(0.2), tetrahedron()], {"aovs": ["depth", "albedo", "variance"]}
    batch = torchpt.render_batch(scenes, poses(scenes[0], 2), film=film, full=True)
    assert {name: tuple(value.shape) for name, value in batch.layers.items()} == {
        "depth": (2, 2, 16, 24, 1),
        "albedo": (2, 2, 16, 24, 3),
        "variance": (2, 2, 16, 24, 3),
    }
    alone = torchpt.render(scenes[1], film=film, full=True, params={"camera.to_world": poses(scenes[0], 2)[1]})
    assert torch.equal(batch.image[1, 1], alone.image) and batch[1, 1].rays == alone.rays
    for name, layer in batch.layers.items():
        assert torch.equal(layer[1, 1], alone.layers[name])
    assert batch.denoised is None and batch[0, 1].paths == 16 * 24 * 3
    assert repr(batch) == "Renderings(2 x 2 x 16 x 24 x 3; layers: depth, albedo, variance)"


# -- by tensor operations: one picture after another

FACTS = ("rays", "paths", "spp", "truncated_paths", "nonfinite_samples", "clamped", "stopped_by", "complete")
#: The last one looks past everything.
VIEWS = [*BLOCKS, {"type": "perspective", "origin": [0, 1, 4], "target": [0, 1, 9]}]


@pytest.mark.parametrize(
    "wishes",
    (
        {},
        {"film": {"aovs": ["depth", "albedo", "variance"], "filter": "mitchell", "crop": [4, 2, 14, 10]}},
        {"integrator": {"type": "path", "light_choice": "tree", "clamp": 0.4}, "dtype": torch.float64},
        pytest.param({"integrator": "ibl"}, marks=pytest.mark.slow),
        {"integrator": "aov", "film": {"aovs": ["normal", "object_id"]}},
    ),
    ids=str,
)
@pytest.mark.filterwarnings("ignore::torchpt.NoLightWarning")
def test_pictures_by_tensor_operations(wishes):
    scenes, wishes = [room(0.2), tetrahedron()], {"compile": "off", "full": True, **wishes}
    seeds = [[3, 1, 4, 1], [5, 9, 2, 6]]
    batch = torchpt.render_batch(scenes, VIEWS, seed=seeds, **wishes)
    for s, scene in enumerate(scenes):
        for c, block in enumerate(VIEWS):
            alone, own = torchpt.render(scene.seen_by(block), seed=seeds[s][c], **wishes), batch[s, c]
            assert torch.equal(own.image, alone.image) and own.layers.keys() == alone.layers.keys()
            assert all(torch.equal(own.layers[name], alone.layers[name]) for name in own.layers)
            assert [getattr(own, fact) for fact in FACTS] == [getattr(alone, fact) for fact in FACTS]
            assert own.rays > 0


def test_views_and_parameters_of_the_camera():
    scene, angles = room(), torch.tensor([30.0, 40.0])
    for compiled in ("off", "on"):
        views = torchpt.render_batch([scene.seen_by(block) for block in BLOCKS], compile=compiled)
        for block, picture in zip(BLOCKS, views, strict=True):
            assert torch.equal(picture[0], torchpt.render(scene.seen_by(block), compile=compiled))
        zoomed = torchpt.render_batch(scene, params={"camera.fov": angles}, compile=compiled)
        for angle, picture in zip(angles, zoomed, strict=True):
            assert torch.equal(picture[0], torchpt.render(scene, params={"camera.fov": angle}, compile=compiled))


def test_textures_that_average_over_the_footprints_of_each_camera():
    floor = {"type": "image", "data": torch.rand(8, 8, 3), "filter": "trilinear"}
    scene = room(materials={"grey": {"type": "diffuse", "reflectance": floor}})
    cameras = [BLOCKS[0], {**BLOCKS[0], "fov": 4}]
    batch = torchpt.render_batch(scene, cameras, compile="off")
    for picture, block in zip(batch[0], cameras, strict=True):
        assert torch.equal(picture, torchpt.render(scene.seen_by(block), compile="off"))


def test_pictures_with_and_without_kernels():
    scenes = [room(0.1 * k, render={"spp": 3, "threads": 1, "compile": way}) for k, way in enumerate(("on", "off") * 2)]
    for scene, picture in zip(scenes, torchpt.render_batch(scenes), strict=True):
        assert torch.equal(picture[0], torchpt.render(scene))


def test_paths_that_are_cut_are_counted_by_picture(monkeypatch):
    monkeypatch.setattr(base, "ENDLESS", 4)
    scene, wishes = room(), {"integrator": {"type": "path", "max_depth": -1, "rr_depth": 99}, "compile": "off"}
    batch = torchpt.render_batch(scene, VIEWS, full=True, **wishes)
    found = [batch[0, c].truncated_paths for c in range(4)]
    alone = [torchpt.render(scene.seen_by(block), full=True, **wishes).truncated_paths for block in VIEWS]
    assert found == alone and len(set(found)) > 2


def test_scenes_by_tensor_operations_are_rendered_before_the_next_is_loaded():
    told = []

    def scenes():
        for k in range(3):
            told.append(f"load {k}")
            yield room(0.1 * k)

    torchpt.render_batch(scenes(), BLOCKS[:2], compile="off", on_progress=lambda done, total: told.append(done))
    assert told == ["load 0", 1, 2, "load 1", 3, 4, "load 2", 5, 6]


def test_memory_that_runs_out_by_tensor_operations(monkeypatch):
    scenes = [room(0.2), room(0.3)]
    expected = torchpt.render_batch(scenes, compile="off")
    plain, taken = tensors.weighted_radiance, []

    def limited(wave, state, *args, **rest):
        if len(state.lane) > 500:
            raise MemoryError
        taken.append(state)
        return plain(wave, state, *args, **rest)

    monkeypatch.setattr(tensors, "weighted_radiance", limited)
    assert torch.equal(torchpt.render_batch(scenes, compile="off"), expected) and len(taken) > 4


def test_samples_that_are_not_finite_are_those_of_their_picture():
    scenes = [tetrahedron(), tetrahedron(0.5), tetrahedron(0.7)]
    scenes[1].params["lights.sky.radiance"].fill_(float("nan"))
    scenes[1].check_own = lambda: None  # which refuses that
    for compiled in ("off", "on"):
        batch = torchpt.render_batch(scenes, compile=compiled, full=True)
        assert [batch[s, 0].nonfinite_samples > 0 for s in range(3)] == [False, True, False]


# -- gradients


def test_gradients_are_those_of_single_renders():
    scenes = [room(0.2), room(0.4)]
    rgb = torch.tensor([[0.2, 0.3, 0.4], [0.8, 0.1, 0.1]], requires_grad=True)
    batch = torchpt.render_batch(scenes, params={"materials.grey.reflectance": rgb}, seed=[1, 2])
    weights = torch.rand(batch.shape, generator=torch.Generator().manual_seed(0))
    (found,) = torch.autograd.grad((batch * weights).sum(), rgb)
    for s, scene in enumerate(scenes):
        own = rgb[s].detach().clone().requires_grad_()
        alone = torchpt.render(scene, params={"materials.grey.reflectance": own}, seed=1 + s)
        assert torch.equal(batch[s, 0], alone)
        (expected,) = torch.autograd.grad((alone * weights[s, 0]).sum(), own)
        assert torch.equal(found[s], expected) and bool(expected.any())


def test_gradients_of_poses():
    scene = room(0.2)
    given = poses(scene, 2).requires_grad_()
    batch = torchpt.render_batch(scene, given, edges=True)
    (found,) = torch.autograd.grad(batch[0, 1].sum(), given)
    own = given[1].detach().clone().requires_grad_()
    (expected,) = torch.autograd.grad(torchpt.render(scene, params={"camera.to_world": own}).sum(), own)
    assert torch.equal(found[1], expected) and bool(expected.any()) and not bool(found[0].any())


def test_gradients_of_poses_of_each_scene():
    """One camera a scene, as training takes them: gradients and layers are those of single renders."""
    scenes = [room(0.2), tetrahedron()]
    given = torch.stack([poses(scene, 2)[1:] for scene in scenes]).requires_grad_()
    options: dict[str, Any] = {"film": {"aovs": ["depth"]}, "edges": False, "full": True}
    with pytest.warns(torchpt.EdgeWarning):
        batch = torchpt.render_batch(scenes, given, spp=[2, 3], seed=[4, 9], **options)
    weights = torch.rand(batch.image.shape, generator=torch.Generator().manual_seed(0))
    (found,) = torch.autograd.grad((batch.image * weights).sum(), given)
    for s, scene in enumerate(scenes):
        own = given[s, 0].detach().clone().requires_grad_()
        with pytest.warns(torchpt.EdgeWarning):
            alone = torchpt.render(scene, params={"camera.to_world": own}, seed=(4, 9)[s], spp=2 + s, **options)
        assert torch.equal(batch.image[s, 0], alone.image)
        assert torch.equal(batch.layers["depth"][s, 0], alone.layers["depth"])
        (expected,) = torch.autograd.grad((alone.image * weights[s, 0]).sum(), own)
        assert torch.equal(found[s, 0], expected) and bool(expected.any())


GREY = "materials.grey.reflectance"


@pytest.fixture
def passes(monkeypatch):
    """Record the threads of backward passes, by name."""
    seen: list[str] = []
    plain = gradients.gradients

    def recorded(*args, **given):
        seen.append(threading.current_thread().name)
        return plain(*args, **given)

    monkeypatch.setattr(gradients, "gradients", recorded)
    return seen


def colours(count: int) -> torch.Tensor:
    return torch.linspace(0.1, 0.9, 3 * count).reshape(count, 3).requires_grad_()


def expected_gradients(scene, rgb, pose=None):
    """Gradients of the mean square of each picture, alone."""
    found = []
    for row in rgb.detach():
        leaf = row.clone().requires_grad_()
        params = {GREY: leaf} | ({} if pose is None else {"camera.to_world": pose})
        found.append(torch.autograd.grad(torchpt.render(scene, params=params).square().mean(), leaf)[0])
    return torch.stack(found)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_backward_passes_of_small_pictures_run_on_threads(passes, threads):
    scene, rgb = room(), colours(5)
    expected = expected_gradients(scene, rgb)
    passes.clear()
    for _ in range(3):  # pieces, tables and buffers of passes before are used again
        images = torchpt.render_batch(scene, params={GREY: rgb}, threads=threads)
        (found,) = torch.autograd.grad(images.square().mean((1, 2, 3, 4)).sum(), rgb)
        assert torch.equal(found, expected)
    assert len(passes) == 15 and all(name.startswith("torchpt_") for name in passes)


def test_backward_passes_of_cameras_of_one_scene(passes):
    scene, given = room(), poses(room(), 4)
    rgb = colours(1)
    for _ in range(3):
        images = torchpt.render_batch(scene, given, {GREY: rgb}, threads=2)
        (found,) = torch.autograd.grad(images.square().mean((2, 3, 4)).sum(), rgb)
        alone = sum(expected_gradients(scene, rgb, pose) for pose in given)
        torch.testing.assert_close(found, alone, rtol=1e-6, atol=0)
    assert len(passes) == 3 * 8


def test_passes_of_pictures_that_a_loss_leaves_out_are_not_taken(passes):
    scene, rgb = room(), colours(3)
    expected = expected_gradients(scene, rgb)
    passes.clear()
    images = torchpt.render_batch(scene, params={GREY: rgb})
    (found,) = torch.autograd.grad(images[1:].square().mean((1, 2, 3, 4)).sum(), rgb, retain_graph=True)
    assert torch.equal(found[1:], expected[1:]) and not found[0].any() and len(passes) == 3
    for s, row in enumerate(images):  # one by one
        (found,) = torch.autograd.grad(row.square().mean(), rgb, retain_graph=True)
        assert torch.equal(found[s], expected[s])


def test_passes_of_inputs_that_nobody_asks_for_are_not_taken(passes):
    scene, rows = room(), [row.detach().requires_grad_() for row in colours(4)]
    images = torchpt.render_batch(scene, params=[{GREY: row} for row in rows])
    found = torch.autograd.grad(images.sum(), rows[1:3])
    assert len(passes) == 2 and all(bool(gradient.any()) for gradient in found)


def test_a_loss_of_pictures_and_of_the_stacked_ones():
    scene, rgb = room(), colours(2)
    batch = torchpt.render_batch(scene, params={GREY: rgb}, full=True)
    (once,) = torch.autograd.grad(batch.image.sum(), rgb, retain_graph=True)
    (found,) = torch.autograd.grad(batch.image.sum() + batch[1, 0].image.sum(), rgb)
    assert torch.equal(found[0], once[0])
    torch.testing.assert_close(found[1], 2 * once[1])


def test_an_error_in_a_backward_pass_is_raised():
    scene, rgb = room(), colours(3)
    images = torchpt.render_batch(scene, params={GREY: rgb})
    scene.params["shapes.lamp.emission"].fill_(7.0)
    with pytest.raises(RenderError, match="changed"):
        images.sum().backward()
    with pytest.raises(TorchptError, match="render takes batches of cotangents by torch.func.jacrev alone"):
        images = torchpt.render_batch(scene, params={GREY: rgb})
        torch.autograd.grad(images, rgb, torch.ones(2, *images.shape), is_grads_batched=True)


@pytest.mark.parametrize("layer", ["depth", "object_id"])
def test_gradients_of_layers_are_those_of_single_renders(layer):
    scene, film = room(0.2), {"aovs": [layer]}
    given = scene.params["shapes.ball.to_world"].repeat(2, 1, 1)
    given[1, 0, 3] += 0.3
    given.requires_grad_()
    batch = torchpt.render_batch(scene, params={"shapes.ball.to_world": given}, film=film, full=True)
    assert batch.layers[layer].requires_grad == (layer == "depth")
    if layer == "depth":
        (found,) = torch.autograd.grad(batch.layers[layer].sum(), given)
        for s in range(2):
            own = given[s].detach().clone().requires_grad_()
            alone = torchpt.render(scene, params={"shapes.ball.to_world": own}, film=film, full=True)
            (expected,) = torch.autograd.grad(alone.layers[layer].sum(), own)
            assert torch.equal(found[s], expected) and bool(expected.any())


def test_parameters_of_scenes_that_require_gradients():
    scenes = [room(0.2), room(0.4)]
    for scene in scenes:
        scene.params["materials.grey.reflectance"].requires_grad_()
    batch = torchpt.render_batch(scenes)
    batch[1].sum().backward()
    unused, used = (scene.params["materials.grey.reflectance"].grad for scene in scenes)
    assert used is not None and bool(used.any())
    assert unused is None or not bool(unused.any())
    with torch.no_grad():
        assert not torchpt.render_batch(scenes).requires_grad


# -- what is made


@pytest.fixture
def counted(monkeypatch):
    """Count how often worlds, search structures, tables of kernels and programs are made."""
    made = {"worlds": 0, "trees": 0, "tables": [], "programs": 0}

    def counting(room, name, key):
        plain = getattr(room, name)

        def call(*args, **given):
            made[key] += 1
            return plain(*args, **given)

        monkeypatch.setattr(room, name, call)

    counting(scenes_room, "assemble", "worlds")
    counting(search, "build", "trees")
    counting(programs, "trace_stage", "programs")
    plain = loop_kernels.Kernels._make

    def make(self, key, *rest):
        known = self.kernel_cache._entries.get(key)
        kernel = plain(self, key, *rest)
        if known is None or kernel is not known.kernel:
            made["tables"].append(key[0])
        return kernel

    monkeypatch.setattr(loop_kernels.Kernels, "_make", make)
    return made


@pytest.mark.parametrize("params", (False, True), ids=("own", "given"))
def test_cameras_build_nothing(counted, params):
    scene = tetrahedron()
    given = {"shapes.tip.vertices": scene.params["shapes.tip.vertices"][None] * 1.5} if params else None

    def made(cameras):
        counted.update(worlds=0, trees=0, tables=[], programs=0)
        torchpt.render_batch(scene, poses(scene, cameras), given)
        return dict(counted)

    first, one, five = made(1), made(1), made(5)
    assert first["worlds"] and first["trees"] and len(set(first["tables"])) > 2
    assert (five["worlds"], five["trees"], five["programs"]) == (int(params), int(params), 0)
    # Of a camera's own there is only what its rays are made of.
    assert sorted(five["tables"]) == sorted([*one["tables"], *["generate"] * 4])
    assert params or one["tables"] == ["generate"]


def test_blocks_of_cameras_build_nothing(counted):
    scene = room()
    torchpt.render(scene)
    counted.update(worlds=0, trees=0, tables=[], programs=0)
    fovs = [{**BLOCKS[0], "fov": 40 + k} for k in range(4)]
    torchpt.render_batch(scene, fovs)
    assert counted["worlds"] == counted["trees"] == counted["programs"] == 0
    assert set(counted["tables"]) <= {"generate"}


def test_views_follow_their_scene():
    scene = room()
    view = scene.seen_by(BLOCKS[0])
    before = torchpt.render(view)
    scene.params["materials.grey.reflectance"].fill_(0.9)
    after = torchpt.render(view)
    assert not torch.equal(before, after)
    assert torch.equal(after, torchpt.render(scene.seen_by(BLOCKS[0])))
    scene.params["shapes.ball.to_world"][0, 3] += 0.2
    assert torch.equal(torchpt.render(view), torchpt.render(scene.seen_by(BLOCKS[0])))
    assert torch.equal(torchpt.render(scene), torchpt.render(scene))


def test_poses_as_nested_lists():
    scene = room()
    given = poses(scene, 2)
    assert torch.equal(torchpt.render_batch(scene, given.tolist()), torchpt.render_batch(scene, given))


# -- errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    (
        ({"cameras": []}, "cameras: "),
        ({"cameras": BLOCKS[0]}, "cameras: "),
        ({"cameras": [BLOCKS[0], 3]}, r"cameras\[1\]: "),
        ({"cameras": [BLOCKS[0], {**BLOCKS[0], "fov": -1}]}, r"^cameras\[1\]\.fov: "),
        ({"cameras": torch.eye(4)}, r"cameras: .*\(C, 4, 4\)"),
        ({"cameras": torch.eye(4)[None].to_sparse()}, r"^cameras: .* dense tensor \(C, 4, 4\).*sparse_coo tensor"),
        ({"cameras": [torch.eye(4).to_sparse()]}, r"^cameras\[0\]: .*dense.*sparse_coo tensor"),
        ({"cameras": [[["a"] * 4] * 4]}, r"^cameras\[0\]: expected a pose \(4, 4\)"),
        ({"cameras": [[1.0, 2.0]]}, r"^cameras\[0\]: .*shape \(4, 4\)"),
        ({"cameras": np.array([["a"]])}, "^cameras: expected a sequence"),
        ({"params": {"camera.to_world": torch.eye(4).expand(2, 4, 4).to_sparse()}}, "^params.camera.to_world: .*dense"),
        ({"cameras": torch.eye(3)[None]}, r"^cameras\[0\]: .*shape \(4, 4\)"),
        ({"cameras": torch.eye(4)[None], "params": {"camera.to_world": torch.eye(4)[None].repeat(2, 1, 1)}}, "poses"),
        (
            {"params": {"materials.grey.reflectance": torch.ones(3, 3)}},
            "^params: expected as many as there are scenes, 2",
        ),
        ({"params": [{}]}, "^params: expected as many"),
        ({"params": [{}, {}, {}]}, "^params: expected as many"),
        ({"on_progress": 3}, "^on_progress: expected a function"),
        ({"cameras": [BLOCKS[0]], "film": "x"}, r"film: expected \(width, height\), or a mapping"),
        ({"params": [{}, {"materials.gray.reflectance": torch.ones(3)}]}, r"^scenes\[1\]\.params\.materials\.gray"),
        ({"params": {"a": torch.ones(2), "b": torch.ones(3)}}, "^params.b: .*first dimension of 2"),
        ({"params": {"a": 1.0}}, "^params.a: "),
        ({"params": 3}, "^params: "),
        ({"seed": [1, 2, 3]}, "^seed: "),
        ({"seed": [[1], [1, 2]]}, "^seed: "),
        ({"seed": [1, -2]}, r"render\.seed: "),
        ({"spp": [1, 2, 3]}, "^spp: expected a whole number, a sequence of 2, or of sequences of 1"),
        ({"spp": [[1], [1, 2]]}, "^spp: "),
        ({"spp": [1, 0]}, r"^scenes\[1\]\.render\.spp: "),
        ({"spp": [1, "a"]}, "^spp: "),
        ({"spp": 2.5}, "^spp: expected a whole number"),
        ({"spp": torch.tensor([1.0, 2.0])}, r"^spp: expected a whole number.*, got \(\(2,\), torch.float32\)"),
        ({"spp": torch.tensor(2.0)}, r"^spp: expected a whole number.*, got \(\(\), torch.float32\)"),
        ({"spp": torch.tensor([True, True])}, "^spp: expected a whole number.*torch.bool"),
        ({"spp": np.array([1.0, 2.0])}, "^spp: expected a whole number.*dtype.'float64'"),
        ({"seed": torch.tensor([1.0, 2.0])}, "^seed: expected a whole number.*torch.float32"),
        ({"cameras": torch.eye(4).expand(3, 1, 4, 4)}, "^cameras: expected as many as there are scenes, 2, got 3"),
        ({"cameras": torch.eye(4).expand(2, 0, 4, 4)}, r"^cameras: .*\(S, C, 4, 4\)"),
        (
            {"cameras": [BLOCKS[:1], BLOCKS[:2]]},
            r"^cameras\[1\]: expected as many cameras as of the first scene, 1, got 2",
        ),
        ({"cameras": [BLOCKS[:1], [{**BLOCKS[0], "fov": -1}]]}, r"^cameras\[1\]\[0\]\.fov: "),
        ({"cameras": [BLOCKS[:1], BLOCKS[0]]}, r"^cameras\[1\]: "),
        ({"cameras": [BLOCKS[:1], []]}, r"^cameras\[1\]: "),
        ({"cameras": [BLOCKS[:1], [3]]}, r"^cameras\[1\]\[0\]: "),
        ({"spp": 0}, r"render\.spp: "),
        ({"checkpoint": "a.ckpt"}, "^render.checkpoint: "),
        (
            {"max_memory": "1kB"},
            "^render.max_memory: .*pictures alone take, as bytes or with a unit such as 4GB, got '1000 b",
        ),
        ({"film": {"aovs": ["depth"]}}, r"film\.aovs: .*full=True"),
    ),
    ids=str,
)
def test_what_is_refused(arguments, message):
    with pytest.raises(SceneError, match=message):
        torchpt.render_batch([room(), room(0.1)], **arguments)


def test_no_scenes_and_films_of_other_sizes():
    with pytest.raises(SceneError, match="^scenes: expected one scene at least"):
        torchpt.render_batch([])
    with pytest.raises(SceneError, match=r"^scenes\[1\]\.film\.width: expected \[24, 16\], as of the first"):
        torchpt.render_batch([room(), room(film={"width": 8, "height": 8})])


@pytest.mark.parametrize(("threads", "compiled"), ((1, "auto"), (2, "auto"), (1, "off")))
def test_an_error_names_its_scene(threads, compiled):
    bad = room()
    bad.params["shapes.lamp.emission"].fill_(float("nan"))
    bad.check_own = lambda: None  # which refuses that
    scenes = [room(), room(0.1), bad, room(0.2)]
    wish = {"integrator": {"type": "path", "strict": True}, "threads": threads, "compile": compiled}
    with pytest.raises(RenderError, match=r"^scenes\[2\]: integrator\.strict: sample"):
        torchpt.render_batch(scenes, **wish)
    moved = room()
    moved.params["shapes.ball.to_world"][0, 3] = float("inf")
    with pytest.raises(SceneError, match=r"^scenes\[1\]\.params\.shapes\.ball\.to_world: expected numbers finite"):
        torchpt.render_batch([room(), moved], threads=threads, compile=compiled)


@pytest.mark.parametrize("compiled", ("auto", "off"))
def test_an_error_names_its_parameters(monkeypatch, compiled):
    scene, task_finished = room(), Run.task_finished

    def failing(self, share):
        if float(self.wave.camera.to_world[0, 3]) > 1.5:
            raise RenderError("broken")
        return task_finished(self, share)

    monkeypatch.setattr(Run, "task_finished", failing)
    given = poses(scene, 3)
    given[2, 0, 3] = 2.0
    with pytest.raises(RenderError, match=r"^params\[2\]: broken"):
        torchpt.render_batch(scene, params={"camera.to_world": given}, compile=compiled)


@pytest.mark.parametrize(("key", "value"), [("aovs", ["depth"]), ("denoise", True)])
def test_scenes_whose_files_ask_for_other_layers(key, value):
    scenes = [room(), room(film={**SIZE, key: value})]
    torchpt.render_batch(scenes)  # of pictures alone that is no matter
    for pair in (scenes, scenes[::-1]):
        with pytest.raises(SceneError, match=rf"^scenes\[1\]\.film\.{key}: expected .* as of the first picture"):
            torchpt.render_batch(pair, full=True)


@pytest.mark.parametrize("make", [list, np.array, torch.tensor])
@pytest.mark.parametrize("key", ["seed", "spp"])
def test_more_values_than_an_iterator_gives_scenes(make, key):
    with pytest.raises(SceneError, match=f"^{key}: expected as many as there are scenes, 2, got 3"):
        torchpt.render_batch((room(0.1 * k) for k in range(2)), **{key: make([1, 2, 3])})


@pytest.mark.parametrize("count", [1, 3])
def test_cameras_of_more_or_fewer_scenes_than_an_iterator_gives(count):
    given = poses(room(), 2).expand(count, 2, 4, 4)
    with pytest.raises(SceneError, match=f"^cameras: expected as many as there are scenes(, 2)?, got {count}"):
        torchpt.render_batch((room(0.1 * k) for k in range(2)), given)


def test_a_picture_that_renders_alone_is_not_blamed_for_one_before(monkeypatch):
    bad, alone = room(render={"spp": 512, "threads": 1}), room(render={"time_limit": 5.0, "threads": 1})
    task_finished = Run.task_finished

    def failing(self, share):
        if share is not None and self.scene is bad:
            raise RenderError("broken")
        return task_finished(self, share)

    monkeypatch.setattr(Run, "task_finished", failing)
    with pytest.raises(RenderError, match=r"^scenes\[0\]: broken"):
        torchpt.render_batch([bad, alone])


@pytest.mark.slow
def test_nothing_piles_up():
    """Workers go from scene to scene, and scenes without gradients go once they are rendered."""
    made, alive, seen = [], weakref.WeakSet(), []
    plain = engine.KernelsEngine.__init__

    def counting(self, *args):
        made.append(True)
        plain(self, *args)

    def scenes():
        for k in range(12):
            scene = room(0.05 * k)
            alive.add(scene)
            yield scene

    def watch(done, total):
        gc.collect()
        seen.append(len(alive))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine.KernelsEngine, "__init__", counting)
        torchpt.render_batch(scenes(), threads=2, on_progress=watch)
    assert len(made) <= 4 and max(seen) <= 8


def test_what_watches_may_raise():
    class StopRules(Exception):
        pass

    def stop(done: int, total: int | None) -> None:
        if done == 2:
            raise StopRules

    with pytest.raises(StopRules):
        torchpt.render_batch([room(0.1 * k) for k in range(4)], on_progress=stop, threads=2)


@pytest.mark.parametrize("fails", [False, True])
def test_torch_has_the_threads_that_it_had(fails):
    """While others trace, what is next is made ready by a single thread of torch."""
    before, seen = torch.get_num_threads(), []

    def scenes():
        for k in range(6):
            seen.append(torch.get_num_threads())
            if fails and k == 4:
                raise ZeroDivisionError
            yield room(0.1 * k)

    with pytest.raises(ZeroDivisionError) if fails else nullcontext():
        torchpt.render_batch(scenes(), threads=2, spp=64)
    assert torch.get_num_threads() == before
    assert 1 in seen[1:]


def test_memory_that_runs_out_in_a_thread(monkeypatch):
    scenes = [room(0.2), room(0.3)]
    expected = torchpt.render_batch(scenes)
    plain, failed = loop_kernels.Kernels.generate, []

    def once(self, **form):
        if not failed:
            failed.append(True)
            raise MemoryError
        return plain(self, **form)

    monkeypatch.setattr(loop_kernels.Kernels, "generate", once)
    assert torch.equal(torchpt.render_batch(scenes, threads=2), expected) and failed


def test_cameras_of_tensors_and_views_of_their_own():
    """A view's camera may be of tensors with gradients; what compiled graphs and texels after loading keep is each view's."""
    scene = room()
    fov = torch.tensor(40.0, requires_grad=True)
    camera = {"origin": [0, 0.2, 3], "target": [0, 0, 0]}
    view = scene.seen_by({**camera, "fov": fov})
    assert view.number != scene.number and view.textured is not scene.textured
    torchpt.render(view, spp=4).sum().backward()
    alone = scene.seen_by({**camera, "fov": 40.0})
    leaf = alone.params["camera.fov"].clone().requires_grad_()
    torchpt.render(alone, params={"camera.fov": leaf}, spp=4).sum().backward()
    assert fov.grad is not None and leaf.grad is not None and torch.equal(fov.grad, leaf.grad)
    found = torch.func.grad(lambda x: torchpt.render(view, params={"camera.fov": x}, spp=4).sum())(torch.tensor(40.0))
    assert torch.equal(found, leaf.grad)
    given = fov.detach()
    found = torch.func.grad(lambda x: torchpt.render_batch(alone, params=[{"camera.fov": x}], spp=4).sum())(given)
    assert torch.equal(found, leaf.grad)
    with pytest.raises(SceneError, match=r"cameras\[0\].fov: expected plain numbers"):
        torch.func.grad(lambda x: torchpt.render_batch(scene, [{**camera, "fov": x}], spp=1).sum())(given)


def pictures_of(scene: torchpt.Scene, colours: Tensor, cameras: Tensor, **more: Any) -> Any:
    film = {"width": 8, "height": 8}
    return torchpt.render_batch(scene, cameras, {"materials.grey.reflectance": colours}, spp=2, film=film, **more)


def test_transforms_of_torch_func_give_the_bits_of_plain_calls():
    scene = room()
    cameras, colours = poses(scene, 2), torch.tensor([[0.2, 0.3, 0.4], [0.5, 0.6, 0.7]])
    weights = torch.linspace(0.0, 1.0, 2 * 2 * 8 * 8 * 3).reshape(2, 2, 8, 8, 3)

    def loss(colours: Tensor, cameras: Tensor) -> Tensor:
        return (pictures_of(scene, colours, cameras) * weights).sum()

    leaves = [x.clone().requires_grad_() for x in (colours, cameras)]
    plain = pictures_of(scene, colours, cameras)
    loss(*leaves).backward()
    found = torch.func.grad(loss, argnums=(0, 1))(colours, cameras)
    assert all(b.grad is not None and torch.equal(a, b.grad) for a, b in zip(found, leaves, strict=True))
    of_cameras = torch.func.grad(lambda cameras: loss(colours, cameras))(cameras)
    leaf = cameras.clone().requires_grad_()
    loss(colours, leaf).backward()
    assert leaf.grad is not None and torch.equal(of_cameras, leaf.grad)
    both = torch.func.vmap(lambda colours: pictures_of(scene, colours, cameras))(torch.stack((colours, colours / 2)))
    assert torch.equal(both[0], plain) and not torch.equal(both[1], plain)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is:DeprecationWarning")  # of torch's own jvp, at its first call
def test_forward_mode_of_a_batch():
    scene = room()
    cameras, colours = poses(scene, 2), torch.tensor([[0.2, 0.3, 0.4], [0.5, 0.6, 0.7]])
    plain, tangents = pictures_of(scene, colours, cameras), torch.ones_like(colours)
    picture, change = torch.func.jvp(lambda x: pictures_of(scene, x, cameras), (colours,), (tangents,))[:2]
    assert torch.equal(picture, plain) and float(change.mean()) > 0.0
    forward_ad = torch.autograd.forward_ad
    for value in (colours, colours.clone().requires_grad_()):
        with forward_ad.dual_level():
            found = forward_ad.unpack_dual(pictures_of(scene, forward_ad.make_dual(value, tangents), cameras))
            assert torch.equal(found.primal, plain)
            assert found.tangent is not None and torch.equal(found.tangent, change)


def test_a_refused_colour_is_named_under_a_transform():
    scene = room()
    with pytest.raises(SceneError, match=r"^params\[1\].params.materials.grey.reflectance: expected"):
        torch.func.grad(lambda x: pictures_of(scene, torch.stack((x, x - 5)), poses(scene, 1)).sum())(torch.ones(3))
