"""Textures opened: images become parameters, slots become nodes that read them. Every file is read once."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchpt.errors import AssetError, SceneError
from torchpt.format.textures import CHANNELS, Checkerboard, Image, Named, Texture, TextureInput, VertexColor
from torchpt.images import EncodedImage, Texels, read_texels
from torchpt.images.colour import srgb_to_linear
from torchpt.images.decode import MAX_PIXELS
from torchpt.math.transforms import uv_matrix
from torchpt.textures import Node, Reading, VertexColors, atlas_of, look_up

__all__ = ["Opener", "images_of"]

_ONE = (1.0, 1.0, 1.0)
#: What a checkerboard's two colours are called among the parameters, after its own name.
_COLORS = ("color0", "color1")


class Opener:
    """Opens the textures of one scene.

    Args:
        textures: the named ones.
        resolve: from a path as written and its dotted key to a file.
        parameters: where texels go, by dotted name: ``textures.NAME`` or the slot's own name, ``(H, W, C)`` float32.
        file: scene file for errors.
    """

    def __init__(
        self,
        textures: Mapping[str, Texture],
        resolve: Callable[[tuple[str, ...], str], Path],
        parameters: dict[str, np.ndarray],
        file: str | None,
    ) -> None:
        self._textures, self._resolve, self._parameters, self.file = textures, resolve, parameters, file
        self.files: dict[str, Texels] = {}
        self._nodes: dict[str, Reading] = {}  # of materials, which many shapes may share
        #: What the texels of a parameter mean; a number slot and a colour slot may read the same image differently.
        self._decoded: dict[str, bool] = {}
        self._shared: dict[str, dict[str, str]] = {}

    def __call__(self, slot: TextureInput, key: str) -> Reading:
        """The node of the slot ``key``.

        Raises:
            SceneError: a channel that is not there, a value that the slot does not accept.
            AssetError: an image that is missing or malformed.
        """
        if key not in self._nodes:
            self._nodes[key] = self._found(slot, key)
        return self._nodes[key]

    def _found(self, slot: TextureInput, key: str) -> Reading:
        texture = slot.texture
        if isinstance(texture, Named):
            return self._opened(
                slot, self._textures[texture.texture], f"textures.{texture.texture}", texture.channel, key
            )
        return self._opened(slot, texture, key, None, key)

    def _opened(
        self, slot: TextureInput, texture: Texture | Named, name: str, channel: str | None, key: str
    ) -> Reading:
        """The node of a slot whose texels are called ``name``."""
        if isinstance(texture, Image):
            return self._image(slot, texture, name, channel or texture.channel or "luminance", key)
        channel = channel or "luminance"
        if isinstance(texture, VertexColor):
            if channel == "a":
                raise SceneError(
                    f"{key}.channel", channel, "one of luminance, r, g, b (vertices have no alpha)", self.file
                )
            return VertexColors(None if slot.coloured else CHANNELS.index(channel) - 1)
        assert isinstance(texture, Checkerboard)
        return self._checkerboard(slot, texture, name, channel, key)

    def sharing(self, prefix: str) -> Callable[[TextureInput, str], Reading]:
        """The same for the materials of a mesh file, whose images are named after themselves and shared.

        Args:
            prefix: dotted name before theirs.
        """

        def opened(slot: TextureInput, key: str) -> Reading:
            texture, name = slot.texture, key
            if isinstance(texture, Image):
                path = texture.path
                label = path.label if isinstance(path, EncodedImage) else path[0]
                known = self._shared.setdefault(prefix, {})
                stem = re.sub(r"\W+", "_", Path(label).stem) or "image"
                if label not in known:
                    known[label] = stem if stem not in known.values() else f"{stem}_{len(known)}"
                name = f"{prefix}.{known[label]}"
            return self._opened(slot, texture, name, None, key)

        return opened

    def values(self, slot: TextureInput, key: str) -> Callable[[np.ndarray], np.ndarray]:
        """A number texture as a function from texture coordinates ``(V, 2)`` to values ``(V,)``, float64."""
        before = dict(self._parameters)
        node = self._found(slot, key)
        if not isinstance(node, Node):
            raise SceneError(key, "vertex_color", "an image or a checkerboard", self.file)
        node = replace(node, filtered=False)
        images = images_of([node], {name: torch.from_numpy(value) for name, value in self._parameters.items()})
        # What shapes the mesh is spent with it: no parameter.
        for name in set(self._parameters) - set(before):
            del self._parameters[name]
            self._decoded.pop(name, None)
        atlas = atlas_of([node], images, torch.float64, torch.device("cpu"))

        def textures(uvs: np.ndarray) -> np.ndarray:
            lanes = torch.zeros(len(uvs), dtype=torch.int64)
            return look_up(atlas, lanes, torch.from_numpy(np.ascontiguousarray(uvs.T)), False).numpy()

        return textures

    def _checkerboard(self, slot: TextureInput, texture: Checkerboard, name: str, channel: str, key: str) -> Node:
        if channel == "a":
            raise SceneError(f"{key}.channel", channel, "one of luminance, r, g, b (squares have no alpha)", self.file)
        for which in _COLORS:
            color = getattr(texture, which)
            self._check(np.asarray(color), slot, f"{name}.{which}", "")
            self._parameters[f"{name}.{which}"] = np.asarray(color, np.float64)
        uv = texture.uv_transform
        matrix = uv_matrix(uv.scale, uv.rotate, uv.translate, texture.scale)
        filtered = texture.filter == "trilinear"
        return Node(
            name, None if slot.coloured else CHANNELS.index(channel) - 1, "repeat", True, matrix, _ONE, filtered
        )

    def _image(self, slot: TextureInput, texture: Image, name: str, channel: str, key: str) -> Node:
        if isinstance(texture.path, EncodedImage):
            label, source = texture.path.label, texture.path
        else:
            source = self._resolve(texture.path, f"{name}.path")
            label = str(source)
        most = MAX_PIXELS if texture.max_pixels is None else texture.max_pixels
        found = self.files.get(label)
        if found is None or found.values.shape[0] * found.values.shape[1] > most:
            found = self.files[label] = read_texels(source, most)
        alpha = not slot.coloured and channel == "a"  # which is never encoded
        colour = texture.colorspace == "srgb" or (texture.colorspace == "auto" and (alpha or not slot.linear))
        decode = found.eight_bit and colour
        channels = found.values.shape[2]
        if alpha and channels in (1, 3):
            raise AssetError(label, f"has no alpha channel, asked for by {key}")
        if not slot.coloured and len(set(texture.scale)) > 1:
            raise SceneError(f"{name}.scale", list(texture.scale), f"one number, as {key} is one", self.file)
        name = self._declare(name, found, decode, alpha)
        self._check(self._parameters[name], slot, key, label, texture.scale)
        index = None
        if not slot.coloured:
            grey = channels < 3
            index = {
                "luminance": 0 if grey else -1,
                "r": 0,
                "g": 0 if grey else 1,
                "b": 0 if grey else 2,
                "a": channels - 1,
            }[channel]
        uv = texture.uv_transform
        matrix = uv_matrix(uv.scale, uv.rotate, uv.translate, (1.0, 1.0))
        nearest, filtered = texture.filter == "nearest", texture.filter == "trilinear"
        return Node(name, index, texture.wrap, nearest, matrix, texture.scale, filtered)

    def _declare(self, name: str, found: Texels, decode: bool, alpha: bool) -> str:
        """The parameter that holds an image's texels, decoded or as stored (of alpha either will do)."""
        known = self._decoded.get(name)
        if known is not None and known != decode and not alpha:
            # One image for colours and for numbers: two sets of texels.
            name += ".decoded" if decode else ".stored"
        if name not in self._parameters:
            values = found.values
            if decode:
                colours = values.shape[2] - (1 if values.shape[2] in (2, 4) else 0)
                values = values.copy()
                values[..., :colours] = srgb_to_linear(torch.from_numpy(values[..., :colours])).numpy()
            self._parameters[name] = values
            self._decoded[name] = decode
        return name

    def _check(
        self, values: np.ndarray, slot: TextureInput, key: str, label: str, scale: tuple[float, float, float] = _ONE
    ) -> None:
        """Refuse texels that the slot does not accept."""
        ends = [float(end) * factor for end in (values.min(), values.max()) for factor in scale]
        low, high = min(ends), max(ends)
        if low >= slot.low - 1e-6 and high <= slot.high * (1 + 1e-6):
            return
        where = f" in the texels of {label}" if label else ""
        expected = f"numbers in {slot.low:g}..{slot.high:g}" if slot.high < 1e30 else f"numbers >= {slot.low:g}"
        raise SceneError(key, [low, high], f"{expected}{where}", self.file)


def images_of(nodes: list[Node], parameters: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The images ``(H, W, C)`` that nodes read; a checkerboard's two colours are one of 2 x 2."""
    images: dict[str, torch.Tensor] = {}
    for node in nodes:
        name = node.texels
        if name in images:
            continue
        if name in parameters:
            images[name] = parameters[name]
        else:
            a, b = (parameters[f"{name}.{which}"] for which in _COLORS)
            images[name] = torch.stack((torch.stack((a, b)), torch.stack((b, a))))
    return images
