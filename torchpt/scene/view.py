"""Make the attributes of a view: a scene that differs from another in its camera alone (:meth:`Scene.seen_by`)."""

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
from torchpt.scene.settings import film_keys

__all__ = ["view_attributes"]


def view_attributes(
    description: Description,
    built: SceneBuild,
    params: Mapping[str, Tensor],
    camera: Mapping[str, Any],
    film: Any,
) -> dict[str, Any]:
    """Return the attributes of a scene that another camera changes: description, build and parameters.

    Args:
        description: the scene's.
        built: the scene's.
        params: the scene's parameters.
        camera: block of the other camera, as in a scene file.
        film: film settings that override the scene's, a mapping or ``(width, height)``.

    Raises:
        SceneError: a wrong camera block or film.
    """
    film = film_keys(film)
    if not isinstance(film, Mapping):
        raise SceneError("film", film, "(width, height), or a mapping of settings")
    merged_film = description.film | {name: value for name, value in film.items() if value is not None}
    tensors = DictTensors()  # tensors of the block that require gradients; readers get plain numbers
    new_camera = read_camera(tensors.extract(plain({"camera": camera}))["camera"], film=merged_film, file=None)
    description = with_all_intrinsics(replace(description, camera=new_camera), tensors)
    new_camera, parameters = description.camera, Parameters()
    for name, value in built.parameters.items():
        if not name.startswith("camera."):
            parameters.declare(name, value, built.parameters.specs[name])
    parameters.declare_all("camera", new_camera.kind, new_camera.values)
    device = next(iter(params.values())).device
    far = bool(built.centre.any())  # then positions are in float64, as in `Scene`
    camera_params = {
        name: torch.tensor(
            value,
            device=device,
            dtype=torch.float64 if far and parameters.specs[name].holds_positions else torch.float32,
        )
        for name, value in parameters.items()
        if name.startswith("camera.")
    }
    built = replace(built, parameters=parameters)
    view_params = {name: value for name, value in params.items() if not name.startswith("camera.")} | camera_params
    return {
        "description": description,
        "_built": built,
        "_tensors": view_params | params_from_tensors(tensors, description, built, view_params),
    }
