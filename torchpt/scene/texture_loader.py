"""Textures opened: their numbers become parameters, slots become nodes that read them. Every file is read once."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpt.physics.parts import Parameters
from torchpt.physics.textures import Named, Node, Opening, TextureInput, TexturePoint
from torchpt.spec.schema import ParsedParams

__all__ = ["TextureLoader"]


class TextureLoader:
    """Opens the textures of one scene.

    Args:
        textures: the named ones.
        resolve: from a path as written and its dotted key to a file.
        parameters: where their numbers go, by dotted name: ``textures.NAME`` or the slot's own name.
        file: scene file for errors.
    """

    def __init__(
        self,
        textures: Mapping[str, ParsedParams],
        resolve: Callable[[tuple[str, ...], str], Path],
        parameters: Parameters,
        file: str | None,
    ) -> None:
        self._textures, self._resolve, self._parameters, self.file = textures, resolve, parameters, file
        self._pictures: dict[Any, Any] = {}
        self._nodes: dict[str, Node] = {}  # of materials, which many shapes may share
        self._shared: dict[str, dict[str, str]] = {}

    def __call__(self, slot: TextureInput, key: str) -> Node:
        """The node of the slot ``key``.

        Raises:
            SceneError: a channel that is not there, a value that the slot does not accept.
            AssetError: an image that is missing or malformed.
        """
        if key not in self._nodes:
            self._nodes[key] = self._opened(slot, key, key, self._parameters)
        return self._nodes[key]

    def _opened(self, slot: TextureInput, key: str, name: str, parameters: Parameters) -> Node:
        """The node of a slot whose texture, where it is written there, is called ``name``."""
        texture, channel = slot.texture, None
        if isinstance(texture, Named):
            name, channel, texture = f"textures.{texture.texture}", texture.channel, self._textures[texture.texture]
        opening = Opening(slot, key, name, channel, parameters, self._resolve, self.file, self._pictures)
        return texture.kind.open(texture.values, opening)

    def sharing(self, prefix: str) -> Callable[[TextureInput, str], Node]:
        """The same for the materials of a mesh file, whose images are named after themselves and shared.

        Args:
            prefix: dotted name before theirs.
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
        """A number texture as a function from texture coordinates ``(V, 2)`` to values ``(V,)``, float64."""
        own = Parameters()  # what shapes the mesh is spent with it: no parameter of the scene
        node = self._opened(slot, key, key, own).at_points()
        given = {name: torch.from_numpy(value) for name, value in own.items()}
        table = node.table([node], given, torch.float64, torch.device("cpu"))

        def look_up(uvs: np.ndarray) -> np.ndarray:
            lanes = torch.zeros(len(uvs), dtype=torch.int64)
            point = TexturePoint(torch.from_numpy(np.ascontiguousarray(uvs.T)))
            return table.look_up(lanes, point, False).numpy()

        return look_up
