"""Views of a scene through another camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.physics.parts import Parameters
from torchpt.scene.build import SceneBuild
from torchpt.scene.dict_tensors import params_from_tensors, with_all_intrinsics
from torchpt.scene.formats.cameras import read_camera
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.tensors import DictTensors
from torchpt.scene.formats.yaml import plain

__all__ = ["view_attributes"]


def view_attributes(
    description: Description,
    built: SceneBuild,
    params: Mapping[str, Tensor],
    camera: Mapping[str, Any],
    film: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the attributes of a scene that another camera changes: description, build and parameters.

    Args:
        description: the scene's.
        built: the scene's.
        params: the scene's parameters.
        camera: block of the other camera, as in a scene file.
        film: film settings that override the scene's.

    Raises:
        SceneError: a wrong camera block or film.
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
