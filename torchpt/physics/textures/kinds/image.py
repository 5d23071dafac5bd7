"""Image textures from files or arrays. The texels become one parameter ``(H, W, C)``; a file is read once a scene.

A slot is the parameter of a material whose values the texture gives; opened for it, the texture becomes an ``ImageNode``, which
``atlas.py`` looks up.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path as FilePath
from typing import Any, ClassVar

import numpy as np

from torchpt.core.errors import AssetError, SceneError
from torchpt.core.threads import ReadAhead
from torchpt.images import ByteImage, EncodedImage, Texels, read_texels
from torchpt.images.decode import MAX_PIXELS
from torchpt.images.texels import ACCEPTED_TEXELS, check_source, texels_from_array
from torchpt.physics.textures.atlas import WRAPS, ImageNode
from torchpt.physics.textures.base import CHANNELS, Find, Mapped, Node, Opening, TextureInput
from torchpt.spec import Choice, Color, Custom, Flag, Integer, Path, Refused
from torchpt.spec import Texels as TexelsSpec

__all__ = ["MOST_PIXELS", "Image"]

#: Largest value of ``max_pixels``.
MOST_PIXELS = 2**30


def _read_source(value: Any) -> tuple[str, ...] | EncodedImage:
    """Return the value of ``path``: the parts of a path, or an image within a mesh file, still encoded."""
    return value if isinstance(value, EncodedImage) else Path().read(value)


class Image(Mapped):
    """An image of 1 to 4 channels (grey, grey and alpha, RGB, RGB and alpha)."""

    name = "image"
    parameters: ClassVar = {
        "path": Custom(
            None,
            reader=_read_source,
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
            doc="encoding of images of whole numbers; auto: sRGB for a colour of 8 bits a value, else linear",
        ),
        "scale": Color((1.0, 1.0, 1.0), low=None, doc="factor of the values"),
        "clamp": Flag(False, doc="whether values that are outside of 0..1 after `scale` become 0 or 1"),
        "channel": Choice(None, names=CHANNELS, doc="channel for a number; luminance by default"),
        "max_pixels": Integer(
            None, low=1, high=MOST_PIXELS, also=(None,), doc="larger images are refused; null: 64 Mpixel"
        ),
    }
    filters = ("trilinear",)

    @classmethod
    def label(cls, values: Mapping[str, Any]) -> str | None:
        """Return the image's file, or its label within a mesh file."""
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
        """Refuse three different factors where a number is wanted."""
        if not coloured and len(set(values["scale"])) > 1:
            raise Refused("one number as scale where a number is wanted", list(values["scale"]), ("scale",))

    @classmethod
    def read_ahead(
        cls, slot: TextureInput, values: Mapping[str, Any], find: Find, image_cache: dict[Any, Any], ahead: ReadAhead
    ) -> None:
        """See :meth:`Texture.read_ahead`."""
        if not isinstance(values["path"], tuple):
            return
        path = find(values["path"])
        max_pixels = MAX_PIXELS if values["max_pixels"] is None else values["max_pixels"]
        if path is not None and (key := (str(path), max_pixels)) not in image_cache:
            image_cache[key] = ahead.add(
                partial(_read_converted, path, max_pixels, values["colorspace"], linear=slot.linear)
            )

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """See :meth:`Texture.open`."""
        slot, scale = opening.slot, values["scale"]
        label, picture = _read_image(values, opening)
        channel = opening.channel or values["channel"] or "luminance"  # the slot's choice comes first
        alpha = not slot.coloured and channel == "a"  # alpha is always linear
        decode = _is_encoded(picture, values["colorspace"], linear=slot.linear and not alpha)
        channels = picture.stored.shape[2]
        if alpha and channels in (1, 3):
            raise AssetError(label, f"has no alpha channel, asked for by {opening.key}")
        if not slot.coloured and len(set(scale)) > 1:
            expected = f"one number, as {opening.key} is one"
            raise SceneError(f"{opening.name}.scale", list(scale), expected, opening.file)
        if values["clamp"]:
            picture, decode = _clamped(picture, label, scale, opening, decode=decode), False
        index = None
        if not slot.coloured:  # the channel's index among the texels; -1: luminance
            grey = channels < 3
            index = {
                "luminance": 0 if grey else -1,
                "r": 0,
                "g": 0 if grey else 1,
                "b": 0 if grey else 2,
                "a": channels - 1,
            }[channel]
        name, texels = _declare_texels(opening, label, picture, scale, decode=decode, alpha=alpha)
        filtered = values["filter"] in cls.filters  # the values that average over footprints
        node = ImageNode(
            texels=name,
            channel=index,
            wrap=values["wrap"],
            nearest=values["filter"] == "nearest",
            transform=cls.matrix(values),
            scale=scale,
            filtered=filtered,
            packed=isinstance(texels, ByteImage) and index != -1 and not filtered,
        )
        if isinstance(texels, ByteImage):
            texels.needs_floats |= not node.packed  # levels of mipmaps and luminances are no bytes
            texels.is_read_packed |= node.packed
        return node


def _read_image(values: Mapping[str, Any], opening: Opening) -> tuple[str, Texels]:
    """Return the name of an image for errors, and its values as stored."""
    if values["data"] is not None:
        return f"{opening.name}.data", values["data"]
    if isinstance(values["path"], EncodedImage):
        label, source = values["path"].label, values["path"]
    else:
        source = opening.resolve(values["path"], f"{opening.name}.path")
        label = str(source)
    max_pixels = MAX_PIXELS if values["max_pixels"] is None else values["max_pixels"]
    picture = opening.image_cache.get(label)
    # An image that another slot allowed to be larger is read again, which refuses it by name.
    if picture is None or picture.stored.shape[0] * picture.stored.shape[1] > max_pixels:
        begun = opening.image_cache.pop((label, max_pixels), None)  # see `Image.read_ahead`
        picture = opening.image_cache[label] = read_texels(source, max_pixels) if begun is None else begun()
    return label, picture


def _clamped(
    picture: Texels, label: str, scale: tuple[float, float, float], opening: Opening, *, decode: bool
) -> Texels:
    """Return an image whose values are in 0..1 after ``scale``; arguments as for :func:`_declare_texels`."""
    key = ("clamped", label, scale, decode)
    if key not in opening.image_cache:
        values = picture.decoded if decode else picture.values
        high = 1.0 / max(*map(abs, scale), 1e-30)
        opening.image_cache[key] = Texels(np.clip(values, 0.0, np.float32(high)), eight_bit=False)
    return opening.image_cache[key]


def _is_encoded(picture: Texels, colorspace: str, *, linear: bool) -> bool:
    """Return True if an image is to be decoded from sRGB.

    Args:
        picture: the image.
        colorspace: as the scene says; ``auto``: images of 8 bits a value are encoded, unless they give no colours.
        linear: True: the values of its slot are no colours.
    """
    return picture.is_encoded(colorspace) and not (linear and colorspace == "auto")


def _read_converted(path: FilePath, max_pixels: int, colorspace: str, *, linear: bool) -> Texels:
    """Read an image, and convert its values as a slot wants them; arguments as for :func:`_is_encoded`."""
    picture = read_texels(path, max_pixels)
    decode = _is_encoded(picture, colorspace, linear=linear)
    if picture.as_bytes(decode) is None:
        _ = picture.decoded if decode else picture.values
    return picture


def _declare_texels(
    opening: Opening, label: str, picture: Texels, scale: tuple[float, float, float], *, decode: bool, alpha: bool
) -> tuple[str, np.ndarray | ByteImage]:
    """Declare an image's texels as a parameter; return its name, and the texels.

    Args:
        opening: the slot.
        label: name of the image for errors.
        picture: the image as stored.
        scale: factors of the values, which count for the range that the slot accepts.
        decode: whether colours are decoded from sRGB.
        alpha: whether the slot reads the alpha channel: then either form will do, as alpha is the same in both.
    """
    texels: Any = picture.as_bytes(decode)
    if texels is None:
        texels = picture.decoded if decode else picture.values
    name, parameters = opening.name, opening.parameters

    def declared(name: str) -> Any:
        return parameters.images.get(name, parameters.get(name))

    if name in parameters and declared(name) is not texels and not alpha:
        name += ".decoded" if decode else ".stored"  # an image for both colours and numbers has two sets of texels
    if name in parameters:
        texels = declared(name)
    opening.check(texels, opening.key, label, scale)
    # The slack admits rounding at the bounds.
    spec = TexelsSpec(low=None, slack=1e-6, moves=opening.slot.moves, doc="texels `(H, W, C)`, linear")
    opening.declare(name, texels, opening.restricted(spec, scale))
    # Texels of `data` stand in the scene, not in a file: meshes that read them need texture coordinates.
    if label == f"{opening.name}.data":
        opening.parameters.texels_in_scene.add(name)
    return name, texels
