"""Open textures: declare their parameters, and make a texture node for each slot. Every file is read once."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpt.physics.parts import Parameters
from torchpt.physics.textures import Named, Node, Opening, TextureInput, TexturePoint
from torchpt.scene.formats.description import Description
from torchpt.spec.schema import ParsedParams

__all__ = ["TextureLoader"]


class TextureLoader:
    """Loader of one scene's textures.

    Args:
        textures: textures by name.
        description: finds the files that the scene names.
        parameters: gets the textures' parameters, as ``textures.NAME.*`` or under the slot's own name.
    """

    def __init__(self, textures: Mapping[str, ParsedParams], description: Description, parameters: Parameters) -> None:
        self._textures, self._description, self._parameters = textures, description, parameters
        self.file = description.file
        self._pictures: dict[Any, Any] = {}
        self._nodes: dict[str, Node] = {}  # by key: many shapes may share a material
        self._shared: dict[str, dict[str, str]] = {}

    def __call__(self, slot: TextureInput, key: str) -> Node:
        """Return the texture node of the slot ``key``.

        Raises:
            SceneError: a missing channel, or a value that the slot does not accept.
            AssetError: a missing or malformed image.
        """
        if key not in self._nodes:
            self._nodes[key] = self._opened(slot, key, key, self._parameters)
        return self._nodes[key]

    def _opened(self, slot: TextureInput, key: str, name: str, parameters: Parameters) -> Node:
        """Return the node of a slot; ``name``: dotted name of the parameters of a texture that is written in place."""
        texture, channel = slot.texture, None
        if isinstance(texture, Named):
            name, channel, texture = f"textures.{texture.texture}", texture.channel, self._textures[texture.texture]
        with self._description.reading_files() as resolve:
            opening = Opening(slot, key, name, channel, parameters, resolve, self.file, self._pictures)
            return texture.kind.open(texture.values, opening)

    def sharing(self, prefix: str) -> Callable[[TextureInput, str], Node]:
        """Return a function like this object for the materials of a mesh file, whose images are named after their files.

        Args:
            prefix: dotted prefix of the images' names.
        """

        def opened(slot: TextureInput, key: str) -> Node:
            texture, name = slot.texture, key
            label = None if isinstance(texture, Named) else texture.kind.label(texture.values)
            if label is not None:
                known = self._shared.setdefault(prefix, {})
                stem = re.sub(r"\W+", "_", Path(label).stem) or "image"
                if label not in known:
                    known[label] = stem if stem not in known.values() else f"{stem}_{len(known)}"
                name = f"{prefix}.{known[label]}"
            return self._opened(slot, key, name, self._parameters)

        return opened

    def values(self, slot: TextureInput, key: str) -> Callable[[np.ndarray], np.ndarray]:
        """Return a number texture as a function from texture coordinates ``(V, 2)`` to values ``(V,)``, float64."""
        own = Parameters()  # used once to displace the mesh: no parameters of the scene
        node = self._opened(slot, key, key, own).at_points()
        given = {name: torch.from_numpy(value) for name, value in own.items()}
        table = node.table([node], given, torch.float64, torch.device("cpu"))

        def look_up(uvs: np.ndarray) -> np.ndarray:
            lanes = torch.zeros(len(uvs), dtype=torch.int64)
            point = TexturePoint(torch.from_numpy(np.ascontiguousarray(uvs.T)))
            return table.look_up(lanes, point, False).numpy()

        return look_up
