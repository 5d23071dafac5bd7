"""Image textures from files or arrays. The texels become one parameter ``(H, W, C)``; a file is read once a scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch

from torchpt.core.errors import AssetError, SceneError
from torchpt.images import EncodedImage, Texels, read_texels
from torchpt.images.colour import srgb_to_linear
from torchpt.images.decode import MAX_PIXELS
from torchpt.images.texels import ACCEPTED_TEXELS, check_source, texels_from_array
from torchpt.physics.textures.atlas import WRAPS, ImageNode
from torchpt.physics.textures.base import CHANNELS, Mapped, Node, Opening
from torchpt.spec import Choice, Color, Custom, Integer, Path, Refused
from torchpt.spec import Texels as TexelsSpec

__all__ = ["MOST_PIXELS", "Image"]

#: Largest value of ``max_pixels``.
MOST_PIXELS = 2**30


def _source(value: Any) -> tuple[str, ...] | EncodedImage:
    return value if isinstance(value, EncodedImage) else Path().read(value)


class Image(Mapped):
    """An image of 1 to 4 channels (grey, grey and alpha, RGB, RGB and alpha)."""

    name = "image"
    parameters: ClassVar = {
        "path": Custom(
            None,
            reader=_source,
            words=Path().accepted,
            doc="PNG, JPEG, TGA, BMP, PPM, EXR or HDR; 8 or 16 bits, half or float",
        ),
        "data": Custom(
            None,
            reader=texels_from_array,
            words=ACCEPTED_TEXELS,
            doc="array, tensor or rows of numbers in place of a file, the top row first; linear, except uint8: `colorspace`",
        ),
        "wrap": Choice("repeat", names=WRAPS, doc="how the image continues beyond its edges"),
        "filter": Choice(
            "bilinear",
            names=("bilinear", "nearest", "trilinear"),
            doc="interpolation between texels; trilinear: with a mipmap, where a pixel covers several texels",
        ),
        "colorspace": Choice(
            "auto",
            names=("auto", "srgb", "linear"),
            doc="encoding of images of 8 bits a value; auto: sRGB for a colour, linear for a number",
        ),
        "scale": Color((1.0, 1.0, 1.0), low=None, doc="factor of the values"),
        "channel": Choice(None, names=CHANNELS, doc="channel for a number; luminance by default"),
        "max_pixels": Integer(
            None, low=1, high=MOST_PIXELS, also=(None,), doc="larger images are refused; null: 64 Mpixel"
        ),
    }
    filters = ("trilinear",)

    @classmethod
    def label(cls, values: Mapping[str, Any]) -> str | None:
        """See :meth:`Texture.label`."""
        path = values["path"]
        return path.label if isinstance(path, EncodedImage) else path[0] if path else None

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :meth:`Texture.check`; refuse other than one source of texels."""
        check_source(values)
        if values["data"] is not None and values["max_pixels"] is not None:
            raise Refused("no max_pixels beside data: it is of files", values["max_pixels"], ("max_pixels",))

    @classmethod
    def check_slot(cls, values: Mapping[str, Any], coloured: bool) -> None:
        """See :meth:`Texture.check_slot`."""
        if not coloured and len(set(values["scale"])) > 1:
            raise Refused("one number as scale where a number is wanted", list(values["scale"]), ("scale",))

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """See :meth:`Texture.open`."""
        slot, scale = opening.slot, values["scale"]
        label, picture = _picture(values, opening)
        channel = opening.channel or values["channel"] or "luminance"
        alpha = not slot.coloured and channel == "a"  # alpha is always linear
        space = values["colorspace"]
        decode = picture.eight_bit and (space == "srgb" or (space == "auto" and (alpha or not slot.linear)))
        channels = picture.values.shape[2]
        if alpha and channels in (1, 3):
            raise AssetError(label, f"has no alpha channel, asked for by {opening.key}")
        if not slot.coloured and len(set(scale)) > 1:
            expected = f"one number, as {opening.key} is one"
            raise SceneError(f"{opening.name}.scale", list(scale), expected, opening.file)
        name = _declared(opening, label, picture, decode, alpha, scale)
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
        matrix, filter = cls.matrix(values), values["filter"]
        return ImageNode(name, index, values["wrap"], filter == "nearest", matrix, scale, filter in cls.filters)


def _picture(values: Mapping[str, Any], opening: Opening) -> tuple[str, Texels]:
    """Return the name of an image for errors, and its values as stored."""
    if values["data"] is not None:
        return f"{opening.name}.data", values["data"]
    if isinstance(values["path"], EncodedImage):
        label, source = values["path"].label, values["path"]
    else:
        source = opening.resolve(values["path"], f"{opening.name}.path")
        label = str(source)
    most = MAX_PIXELS if values["max_pixels"] is None else values["max_pixels"]
    picture = opening.pictures.get(label)
    if picture is None or picture.values.shape[0] * picture.values.shape[1] > most:
        picture = opening.pictures[label] = read_texels(source, most)
    return label, picture


def _declared(
    opening: Opening, label: str, picture: Texels, decode: bool, alpha: bool, scale: tuple[float, float, float]
) -> str:
    """Declare an image's texels as a parameter, decoded or as stored, and return its name; alpha is the same in both."""
    texels = _decoded(opening, label, picture) if decode else picture.values
    name, others = opening.name, opening.parameters
    if name in others and others[name] is not texels and not alpha:
        name += ".decoded" if decode else ".stored"  # an image for both colours and numbers has two sets of texels
    if name in others:
        texels = others[name]
    opening.check(texels, opening.key, label, scale)
    spec = TexelsSpec(low=None, slack=1e-6, moves=opening.slot.moves, doc="texels `(H, W, C)`, linear")
    opening.declare(name, texels, opening.ranged(spec, scale))
    if label == f"{opening.name}.data":
        opening.parameters.stated.add(name)
    return name


def _decoded(opening: Opening, label: str, picture: Texels) -> np.ndarray:
    """Return the texels with colours decoded from sRGB."""
    key = (label, "decoded")
    if key not in opening.pictures:
        values = picture.values.copy()
        colours = values.shape[2] - (1 if values.shape[2] in (2, 4) else 0)
        values[..., :colours] = srgb_to_linear(torch.from_numpy(values[..., :colours])).numpy()
        opening.pictures[key] = values
    return opening.pictures[key]
