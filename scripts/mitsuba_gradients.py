"""Render torchpt's scenes by Mitsuba 3, differentiable in where shapes are: for benchmarks of gradients by geometry."""

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

__all__ = ["ShapeRenderer", "shape_renderer"]

#: Renders a picture ``(H, W, 3)`` of parameters by name, samples a pixel and a seed.
ShapeRenderer = Callable[[Mapping[str, Tensor], int, int], Tensor]


def shape_renderer(scene: Scene, integrator: str, threads: int = 1) -> ShapeRenderer:
    """Return a renderer of a scene of torchpt by Mitsuba (``llvm_ad_rgb``), differentiable in where its shapes are.

    It takes ``shapes.NAME.to_world``, ``shapes.NAME.vertices`` and ``camera.to_world``; all else stays.

    Args:
        scene: without instances.
        integrator: type of Mitsuba's integrator, such as ``prb_projective``; it gets the scene's depths.
        threads: of Mitsuba.
    """
    mi = load_mitsuba("llvm_ad_rgb")
    dr: Any = importlib.import_module("drjit")
    dr.set_thread_count(threads)
    with tempfile.TemporaryDirectory() as folder:
        described = convert(mi, scene, settings(scene.description, {}), Path(folder))
        described["integrator"]["type"] = integrator
        theirs = mi.load_dict(described, optimize=False)  # meshes keep names of their own
    params = mi.traverse(theirs)
    # As converted: transforms (4, 4), vertices (N, 3).
    first = {key: _numbers(params[key]) for key in params.keys() if key.endswith(("to_world", "vertex_positions"))}

    def moved(name: str, value: Tensor) -> dict[str, Tensor]:
        """Return what a parameter of ours makes of Mitsuba's, by name there."""
        shape = name.rpartition(".")[0]
        prefixes = [f"part{k}." for k, part in enumerate(scene.built.parts) if shape in (part.name, part.shape)]
        keys = ["sensor.to_world"] if shape == "camera" else [key for key in first if key.startswith(tuple(prefixes))]
        found = {}
        for key in keys if prefixes or shape == "camera" else ():
            if name.endswith(".vertices"):
                pose = scene.params[f"{shape}.to_world"].double()
                places = value.double() @ pose[:3, :3].T + pose[:3, 3]
                # There they come in another order, some of them twice.
                found[key] = places[torch.cdist(first[key], places.detach()).argmin(1)]
                continue
            turned = value.double() @ scene.params[name].double().inverse()  # from the pose as converted
            at = first[key]
            found[key] = at @ turned[:3, :3].T + turned[:3, 3] if at.shape[1] == 3 else turned @ at
        if not found:
            raise SystemExit(f"nothing in Mitsuba's scene is moved by {name}")
        return found

    class Render(torch.autograd.Function):
        """A picture by Mitsuba of its own parameters."""

        @staticmethod
        def forward(ctx: Any, keys: list[str], spp: int, seed: int, *values: Tensor) -> Tensor:
            ctx.values = []
            for key, given in zip(keys, values, strict=True):
                flat = given.shape[1] == 3
                value = mi.Float(given.numpy().ravel()) if flat else mi.Matrix4f(given.tolist())
                dr.make_opaque(value)  # a literal would be compiled anew with each pose
                dr.enable_grad(value)
                params[key] = value if flat else type(params[key])(value)
                ctx.values.append(value)
            params.update()
            ctx.picture = mi.render(theirs, params, spp=spp, seed=seed)
            return torch.from_numpy(np.array(ctx.picture))

        @staticmethod
        def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
            dr.set_grad(ctx.picture, mi.TensorXf(cotangents[0].contiguous().numpy()))
            dr.enqueue(dr.ADMode.Backward, ctx.picture)
            dr.traverse(dr.ADMode.Backward)
            return None, None, None, *(_numbers(dr.grad(value)) for value in ctx.values)

    def render(values: Mapping[str, Tensor], spp: int, seed: int) -> Tensor:
        given: dict[str, Tensor] = {}
        for name, value in values.items():
            given |= moved(name, value)
        picture = Render.apply(list(given), spp, seed, *given.values())
        assert isinstance(picture, Tensor)
        return picture

    return render


def _numbers(value: Any) -> Tensor:
    """Return Mitsuba's numbers, float64: ``(4, 4)`` of a transform or matrix, ``(N, 3)`` of vertices."""
    matrix = getattr(value, "matrix", value)
    numbers = torch.from_numpy(np.array(matrix, np.float64))
    return numbers.reshape(4, 4) if type(matrix).__name__.startswith("Matrix") else numbers.reshape(-1, 3)
