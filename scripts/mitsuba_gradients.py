"""Render torchpt's scenes by Mitsuba 3, differentiable in poses: for benchmarks of gradients by geometry."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mitsuba_scene import convert, load_mitsuba
from torch import Tensor

from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

__all__ = ["PoseRenderer", "pose_renderer"]

#: Renders a picture ``(H, W, 3)`` of poses by name, samples a pixel and a seed.
PoseRenderer = Callable[[Mapping[str, Tensor], int, int], Tensor]


def pose_renderer(scene: Scene, integrator: str, threads: int = 1) -> PoseRenderer:
    """Return a renderer of a scene of torchpt by Mitsuba (``llvm_ad_rgb``), differentiable in poses.

    It takes ``shapes.NAME.to_world`` and ``camera.to_world``, ``(4, 4)``; the poses of others stay.

    Args:
        scene: without instances.
        integrator: type of Mitsuba's integrator, such as ``prb_projective``; it gets the scene's depths.
        threads: of Mitsuba.
    """
    mi = load_mitsuba("llvm_ad_rgb")
    dr: Any = importlib.import_module("drjit")
    dr.set_thread_count(threads)
    given = settings(scene.description, {})
    with tempfile.TemporaryDirectory() as folder:
        described = convert(mi, scene, given, Path(folder))
        described["integrator"]["type"] = integrator
        theirs = mi.load_dict(described, optimize=False)  # meshes keep names of their own
    params = mi.traverse(theirs)
    first = {key: _numbers(params[key]) for key in params.keys() if key.endswith(("to_world", "vertex_positions"))}

    def keys_of(name: str) -> list[str]:
        """Return the names of what a pose of ours moves."""
        if name == "camera.to_world":
            return ["sensor.to_world"]
        shape = name.removesuffix(".to_world")
        parts = [f"part{k}." for k, part in enumerate(scene.built.parts) if part.name == shape or part.shape == shape]
        found = [key for key in first for part in parts if key.startswith(part)]
        if not found:
            raise SystemExit(f"no shape of Mitsuba's scene for {name}")
        return found

    class Render(torch.autograd.Function):
        """A picture by Mitsuba, and the gradient of poses."""

        @staticmethod
        def forward(ctx: Any, names: list[str], spp: int, seed: int, *poses: Tensor) -> Tensor:
            ctx.moved = []
            for number, (name, pose) in enumerate(zip(names, poses, strict=True)):
                # From the pose in which the scene was converted to this one.
                back = scene.params[name].double().inverse().numpy()
                for key in keys_of(name):
                    flat = key.endswith("vertex_positions")
                    points = np.c_[first[key].reshape(-1, 3), np.ones(first[key].size // 3)].T if flat else first[key]
                    own = back @ points
                    now = pose.detach().double().numpy() @ own
                    value = mi.Float(now[:3].T.ravel()) if flat else mi.Matrix4f(now.tolist())
                    dr.make_opaque(value)  # a literal would be compiled anew with each pose
                    dr.enable_grad(value)
                    params[key] = value if flat else type(params[key])(value)
                    ctx.moved.append((number, own, value, flat))
            params.update()
            ctx.picture = mi.render(theirs, params, spp=spp, seed=seed)
            return torch.from_numpy(np.array(ctx.picture))

        @staticmethod
        def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
            dr.set_grad(ctx.picture, mi.TensorXf(cotangents[0].contiguous().numpy()))
            dr.enqueue(dr.ADMode.Backward, ctx.picture)
            dr.traverse(dr.ADMode.Backward)
            grads = [torch.zeros(4, 4) for _ in range(1 + max(number for number, *_ in ctx.moved))]
            for number, own, value, flat in ctx.moved:
                found = _numbers(dr.grad(value))
                found = np.r_[found.reshape(-1, 3).T, np.zeros((1, found.size // 3))] if flat else found
                grads[number] += torch.from_numpy(found @ own.T).float()
            return None, None, None, *grads

    def render(poses: Mapping[str, Tensor], spp: int, seed: int) -> Tensor:
        picture = Render.apply(list(poses), spp, seed, *poses.values())
        assert isinstance(picture, Tensor)
        return picture

    return render


def _numbers(value: Any) -> np.ndarray:
    """Return Mitsuba's numbers as an array: ``(4, 4)`` of a transform or matrix, else flat."""
    matrix = getattr(value, "matrix", value)
    numbers = np.array(matrix, np.float64)
    return numbers.reshape(4, 4) if type(matrix).__name__.startswith("Matrix") else numbers.reshape(-1)
