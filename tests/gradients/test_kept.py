"""Gradients that reuse tables, machine code and memory of earlier passes have the bits of a first pass."""

from __future__ import annotations

import gc
import weakref

import pytest
from torch import Tensor

import torchpt
from torchpt.engines.kernels import programs
from torchpt.scene.prepare import scene_cache

SHAPE = {"width": 12, "height": 10}


def gradients(scene: torchpt.Scene, values: dict[str, Tensor], seed: int = 3) -> list[Tensor]:
    """Return the picture of a scene, and the gradients of its sum of squares."""
    params = {name: value.clone().requires_grad_() for name, value in values.items()}
    picture = torchpt.render(scene, params=params, film=SHAPE, spp=2, seed=seed, edges=False)
    picture.square().sum().backward()
    grads = [value.grad for value in params.values()]
    return [picture.detach(), *(grad for grad in grads if grad is not None)]


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_passes_of_other_values_and_parameters_have_the_bits_of_the_first() -> None:
    """Colours, poses, lights and the camera in turn, on one scene, against a new scene each."""
    kept = torchpt.load("cornell_box", "cpu")
    names = list(kept.params)
    colours = [name for name in names if name.endswith("reflectance")][:2]
    pose = next(name for name in names if name.startswith("shapes.") and name.endswith(".to_world"))
    light = next(name for name in names if name.endswith("emission"))
    for chosen, scale in (
        (colours[:1], 1.0),
        (colours[:1], 0.9),
        (colours, 0.8),
        ([pose], 1.0),
        ([light, colours[0]], 1.1),
        (["camera.to_world"], 1.0),
        (colours[:1], 1.0),
    ):
        values = {name: kept.params[name] * scale for name in chosen}
        ours, theirs = gradients(kept, values), gradients(torchpt.load("cornell_box", "cpu"), values)
        assert len(ours) == 1 + len(chosen)
        for a, b in zip(ours, theirs, strict=True):
            assert a.equal(b) and a.any(), chosen


def test_a_second_pass_binds_what_has_changed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = torchpt.load("cornell_box", "cpu")
    name = next(name for name in scene.params if name.endswith("reflectance"))
    bound: list[list[bool]] = []
    bind = programs.bind_tables

    def counted(*args, kept=(), **options):
        bound.append([table is None for table in kept])
        return bind(*args, kept=kept, **options)

    monkeypatch.setattr(programs, "bind_tables", counted)
    for scale in (1.0, 0.9):
        bound.clear()
        gradients(scene, {name: scene.params[name] * scale})
    assert bound and all(tables for tables in bound)
    assert max(sum(tables) for tables in bound) < min(len(tables) for tables in bound)


def test_tables_of_differentiated_tensors_are_given_back() -> None:
    """Those of a pass, which no other can use."""
    scene = torchpt.load("cornell_box", "cpu")
    name = next(name for name in scene.params if name.endswith("reflectance"))
    seen: list[weakref.ref[Tensor]] = []
    forget = programs.KernelCache.forget

    def noted(cache: programs.KernelCache, paths):
        seen.extend(
            weakref.ref(tensor)
            for entry in cache._entries.values()
            for path, (tensor, _) in entry.states.items()
            if path in paths
        )
        forget(cache, paths)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs.KernelCache, "forget", noted)
        gradients(scene, {name: scene.params[name]})
    gc.collect()
    assert seen and not any(tensor() is not None for tensor in seen)
    assert scene_cache(scene).kernels is not None


def test_scenes_by_other_cameras_share_tables() -> None:
    """The tensors of one kind of camera are no tensors of another."""
    flat = {"type": "orthographic", "origin": [0, 1, 6], "target": [0, 1, 0], "width": 2.5}
    scene = torchpt.load("cornell_box", "cpu")
    name = next(name for name in scene.params if name.endswith("reflectance"))
    values = {name: scene.params[name]}
    for camera in (None, flat, None):
        kept, fresh = (
            loaded if camera is None else loaded.seen_by(camera)
            for loaded in (scene, torchpt.load("cornell_box", "cpu"))
        )
        for a, b in zip(gradients(kept, values), gradients(fresh, values), strict=True):
            assert a.equal(b)
