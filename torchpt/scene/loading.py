"""Load a :class:`Scene` from a file, a name, text or a dict.

The source is read to a *description* (checked names and numbers), whose parts and parameters :class:`Scene` builds. Tensors in
a dict are taken out first, and connected with the scene's parameters at the end, so that they get gradients.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch

from torchpt.core.memory import explain_out_of_memory
from torchpt.core.threads import outside_inference_mode
from torchpt.physics.bsdfs import Bsdf
from torchpt.scene.devices import device_of
from torchpt.scene.dict_tensors import params_from_tensors, vertex_attributes_in, with_all_intrinsics
from torchpt.scene.formats.description import Source, read_description, settings
from torchpt.scene.formats.tensors import DictTensors
from torchpt.scene.scene import Scene

__all__ = ["load"]


def load(
    source: Source,
    device: str | torch.device | None = None,
    bsdfs: Mapping[str, Bsdf] | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Scene:
    """Load a scene.

    Args:
        source: the name of a scene that ships, a path ending in ``.yaml`` (or in ``.xml``: docs/mitsuba.md), an open file,
            YAML text (of more than one line), or a dict of the same schema. Relative paths in it start at the file's folder,
            else at the current one. In a dict numbers, colours, poses, texels and vertices may be arrays, and tensors on any
            device: those that require gradients get them from every picture (docs/reference/scenes.md, *Tensors in dicts*).
        device: ``auto`` (CUDA where ``scripts/first_gpu.py`` has passed, else the CPU), ``cpu``, ``cuda`` or ``cuda:N``; by
            default the scene's own ``render.device``, which is ``auto`` where it does not say.
        bsdfs: models of your own by the ``type`` that materials name them by. Gradients flow to their weights too.
        overrides: values of the scene's keys by dotted key: ``{"camera.fov": 20, "+shapes.ball": {"type": "sphere"},
            "~lights.sky": None}`` sets one, adds a shape and removes a light (docs/reference/scenes.md, *Overrides*). They may
            be tensors as in a dict.

    Raises:
        SceneError: a wrong key or value; the message says where and what is accepted.
        AssetError: a missing or malformed file.
        RenderError: the device is not available.

    Warns:
        ImportedSceneWarning: a scene of Mitsuba has what this program lacks.
    """
    # No decorator, which would import torch's compiler together with this module.
    if torch.compiler.is_compiling():
        not_compiled: Any = torch.compiler.disable(_load)
        return not_compiled(source, device, bsdfs, overrides)
    return _load(source, device, bsdfs, overrides)


def _load(
    source: Source,
    device: str | torch.device | None,
    bsdfs: Mapping[str, Bsdf] | None,
    overrides: Mapping[str, Any] | None,
) -> Scene:
    start = time.perf_counter()
    tensors = DictTensors()  # collects the tensors of the dict and of the overrides; the description gets plain numbers
    with explain_out_of_memory("the scene file"):
        may_hold_tensors = bool(overrides) or isinstance(source, Mapping)
        description = read_description(source, bsdfs, tensors.extract if may_hold_tensors else None, overrides)
    chosen_device = device_of(settings(description).render.device if device is None else device)
    with outside_inference_mode():
        scene = Scene(
            with_all_intrinsics(description, tensors),  # a tensor `K` makes each of its numbers a parameter
            chosen_device,
            own_models=tuple((bsdfs or {}).values()),
            vertex_params=vertex_attributes_in(tensors),
        )
    # So that gradients reach the caller's tensors, and not only the numbers read from them.
    scene.replace_params(params_from_tensors(tensors, scene.description, scene.built, scene.raw_params))
    scene.load_seconds = time.perf_counter() - start
    return scene
