"""Open textures: declare their parameters, and make a texture node for each slot. Every file is read once.

A *slot* is a parameter that a texture stands in for; a *node* is one use of a texture, opened for a slot. To *declare* a
parameter is to add it to ``scene.params``. The builders of shapes and materials call a :class:`TextureLoader`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchpt.core.errors import AssetError, SceneError
from torchpt.core.threads import ReadAhead
from torchpt.physics.parts import Parameters
from torchpt.physics.textures import Node, Opening, TextureInput, TexturePoint, TextureReference
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
        self._pictures: dict[Any, Any] = {}  # images that were read; the kinds of textures choose the keys
        self._nodes: dict[str, Node] = {}  # by key: many shapes may share a material
        # Of mesh files, by prefix of their images' names: name of each image by its label (its path, or a hash).
        self._image_names: dict[str, dict[str, str]] = {}

    def read_ahead(self, ahead: ReadAhead) -> None:
        """Begin to read the images of all materials and shapes beside; errors come when slots open them."""
        description = self._description

        def find(path: tuple[str, ...]) -> Path | None:
            try:
                return description.resolve(path, "")
            except (SceneError, AssetError):
                return None

        for block in (*description.materials.values(), *description.shapes.values()):
            for slot in _slots(block):
                texture = slot.texture
                if isinstance(texture, TextureReference):
                    texture = self._textures.get(texture.texture)
                if texture is not None:
                    texture.kind.read_ahead(slot, texture.values, find, self._pictures, ahead)

    def __call__(self, slot: TextureInput, key: str) -> Node:
        """Return the texture node of the slot ``key``.

        Raises:
            SceneError: a missing channel, or a value that the slot does not accept.
            AssetError: a missing or malformed image.
        """
        if key not in self._nodes:
            self._nodes[key] = self._open(slot, key, key, self._parameters)
        return self._nodes[key]

    def _open(self, slot: TextureInput, key: str, name: str, parameters: Parameters) -> Node:
        """Open the texture of a slot and return its node.

        Args:
            slot: the texture, named or written in place, and what the slot accepts.
            key: dotted key of the slot, for errors.
            name: dotted prefix of the parameters of a texture that is written in place.
            parameters: gets the texture's parameters.
        """
        texture, channel = slot.texture, None
        if isinstance(texture, TextureReference):
            name, channel, texture = f"textures.{texture.texture}", texture.channel, self._textures[texture.texture]
        with self._description.reading_files() as resolve:
            opening = Opening(
                slot=slot,
                key=key,
                name=name,
                channel=channel,
                parameters=parameters,
                resolve=resolve,
                file=self.file,
                image_cache=self._pictures,
            )
            return texture.kind.open(texture.values, opening)

    def sharing(self, prefix: str) -> Callable[[TextureInput, str], Node]:
        """Return a function like this object for the materials of a mesh file, whose images are named after their files.

        Args:
            prefix: dotted prefix of the images' names.
        """

        def open_shared(slot: TextureInput, key: str) -> Node:
            texture, name = slot.texture, key
            label = None if isinstance(texture, TextureReference) else texture.kind.label(texture.values)
            if label is not None:
                names = self._image_names.setdefault(prefix, {})
                stem = re.sub(r"\W+", "_", Path(label).stem) or "image"  # letters, digits and underscores
                if label not in names:
                    names[label] = stem if stem not in names.values() else f"{stem}_{len(names)}"
                name = f"{prefix}.{names[label]}"
            return self._open(slot, key, name, self._parameters)

        return open_shared

    def values(self, slot: TextureInput, key: str) -> Callable[[np.ndarray], np.ndarray]:
        """Return a number texture as a function from texture coordinates ``(V, 2)`` to values ``(V,)``, float64."""
        own = Parameters()  # used once to displace the mesh: no parameters of the scene
        node = self._open(slot, key, key, own).unfiltered()
        tensors = {name: torch.from_numpy(own.decoded(name)) for name in own}
        table = node.table([node], tensors, torch.float64, torch.device("cpu"))  # the node is row 0

        def look_up(uvs: np.ndarray) -> np.ndarray:
            rows = torch.zeros(len(uvs), dtype=torch.int64)
            point = TexturePoint(torch.from_numpy(np.ascontiguousarray(uvs.T)))
            return table.look_up(rows, point, coloured=False).numpy()

        return look_up


def _slots(block: ParsedParams) -> Iterator[TextureInput]:
    """Yield the textures among the values of a block, and of the blocks in it."""
    for value in block.values.values():
        if isinstance(value, TextureInput):
            yield value
        elif isinstance(value, ParsedParams):
            yield from _slots(value)
