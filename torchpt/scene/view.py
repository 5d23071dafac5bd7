"""A scene through another camera: all but that is shared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.physics.parts import Parameters
from torchpt.scene.build import SceneBuild
from torchpt.scene.formats.cameras import read_camera
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.tensors import DictTensors
from torchpt.scene.formats.yaml import plain
from torchpt.scene.params_from_tensors import params_from_tensors, with_all_intrinsics

__all__ = ["view_attributes"]


def view_attributes(
    description: Description,
    built: SceneBuild,
    params: Mapping[str, Tensor],
    camera: Mapping[str, Any],
    film: Mapping[str, Any],
) -> dict[str, Any]:
    """What of a scene another camera changes, by attribute: its description, what that came to, its parameters.

    Args:
        description: of the scene.
        built: what it came to.
        params: its tensors.
        camera: the block of the other camera, as written.
        film: film settings in place of the scene's own.

    Raises:
        SceneError: what is wrong with the camera, or with the film.
    """
    if not isinstance(film, Mapping):
        raise SceneError("film", film, "a mapping")
    size = description.film | {name: value for name, value in film.items() if value is not None}
    tensors = DictTensors()
    chosen = read_camera(tensors.extract(plain({"camera": camera}))["camera"], size, None)
    description = with_all_intrinsics(replace(description, camera=chosen), tensors)
    chosen, parameters = description.camera, Parameters()
    for name, value in built.parameters.items():
        if not name.startswith("camera."):
            parameters.declare(name, value, built.parameters.specs[name])
    parameters.declare_all("camera", chosen.kind, chosen.values)
    device = next(iter(params.values())).device
    far = bool(built.centre.any())
    own = {
        name: torch.tensor(
            value, device=device, dtype=torch.float64 if far and parameters.specs[name].place else torch.float32
        )
        for name, value in parameters.items()
        if name.startswith("camera.")
    }
    built = replace(built, parameters=parameters)
    every = {name: value for name, value in params.items() if not name.startswith("camera.")} | own
    return {
        "description": description,
        "_built": built,
        "params": every | params_from_tensors(tensors, description, built, every),
    }
