"""The textures of a scene file: what stands where a number or a colour could.

A texture is read when its slot is: a *colour* slot takes three channels, a *number* slot one of them. Images are not
opened here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from torchpt.errors import SceneError
from torchpt.images import EncodedImage
from torchpt.math.transforms import uv_matrix
from torchpt.spec.fields import Check, choice, color, file_paths, integer, number_field, pair, wrong
from torchpt.spec.validate import Model, check_keys, select
from torchpt.textures import WRAPS

__all__ = [
    "CHANNELS",
    "TEXTURES",
    "Checkerboard",
    "Image",
    "Named",
    "Texture",
    "TextureInput",
    "VertexColor",
    "read_texture",
    "texture_input",
]  # fmt: skip

CHANNELS = ("luminance", "r", "g", "b", "a")

Matrix = tuple[tuple[float, float, float], tuple[float, float, float]]
Rgb = tuple[float, float, float]


class Texture(Model):
    """What every texture has."""


class UvTransform(Model):
    """How texture coordinates are transformed: scaled, then turned by ``rotate`` degrees (u to v), then moved."""

    scale: Annotated[tuple[float, float], pair("a number or [u, v]", single=True)] = (1.0, 1.0)
    rotate: Annotated[float, number_field("an angle in degrees")] = 0.0
    translate: Annotated[tuple[float, float], pair("two numbers [u, v]")] = (0.0, 0.0)

    def matrix(self, repeats: tuple[float, float] = (1.0, 1.0)) -> Matrix:
        """Rows ``(2, 3)`` of the transform; with ``repeats`` as a scale after it."""
        return uv_matrix(self.scale, self.rotate, self.translate, repeats)


def _uv_transform(value: Any) -> UvTransform:
    if isinstance(value, UvTransform):
        return value
    if not isinstance(value, Mapping):
        raise wrong("a mapping with scale, rotate, translate")
    try:
        check_keys(value, UvTransform.model_fields, "", "uv_transform", None)
        return UvTransform.model_validate({key: item for key, item in value.items() if item is not None})
    except SceneError as error:
        raise wrong(error.expected, error.value, tuple(error.key.split("."))) from None


Uv = Annotated[UvTransform, Check(_uv_transform)]


def _source(value: Any) -> tuple[str, ...] | EncodedImage:
    if isinstance(value, EncodedImage):
        return value
    return file_paths(value)


class Image(Texture):
    """An image.

    Attributes:
        path: candidates, the first existing one is used; an image in memory where another file holds it.
        wrap: how it goes on beyond its edges.
        filter: how values between texels are found; ``trilinear``: and the image is read in smaller sizes where a pixel
            covers several texels.
        colorspace: of an image with 8 bits a value. ``auto``: sRGB where it gives a colour, linear where it gives a number.
        scale: factor of the values.
        channel: which of them a number takes.
        max_pixels: larger images are refused; None: 64 Mpixel.
        uv_transform: applied to texture coordinates.
    """

    type: Literal["image"] = "image"
    path: Annotated[tuple[str, ...] | EncodedImage, Check(_source)]
    wrap: Annotated[str, choice(*WRAPS)] = "repeat"
    filter: Annotated[str, choice("bilinear", "nearest", "trilinear")] = "bilinear"
    colorspace: Annotated[str, choice("auto", "srgb", "linear")] = "auto"
    scale: Annotated[Rgb, color(None)] = (1.0, 1.0, 1.0)
    channel: Annotated[str | None, choice(*CHANNELS)] = None
    max_pixels: Annotated[int | None, integer(1, 2**34, also=(None,))] = None
    uv_transform: Uv = UvTransform()


class Checkerboard(Texture):
    """Two colours in turn; a unit of u and v holds two squares each way, times ``scale``.

    ``filter: trilinear`` lets them go over into their mean where a pixel covers several squares.
    """

    type: Literal["checkerboard"] = "checkerboard"
    color0: Annotated[Rgb, color()] = (0.4, 0.4, 0.4)
    color1: Annotated[Rgb, color()] = (0.2, 0.2, 0.2)
    scale: Annotated[tuple[float, float], pair("a number or [u, v]", single=True)] = (1.0, 1.0)
    filter: Annotated[str, choice("nearest", "trilinear")] = "nearest"
    uv_transform: Uv = UvTransform()


class VertexColor(Texture):
    """The colours of a mesh's vertices, linear; 1 on surfaces without."""

    type: Literal["vertex_color"] = "vertex_color"


@dataclass(frozen=True)
class Named:
    """A texture of the block ``textures``; ``channel`` as of an image."""

    texture: str
    channel: str | None = None


TEXTURES: dict[str, type[Texture]] = {"image": Image, "checkerboard": Checkerboard, "vertex_color": VertexColor}


@dataclass(frozen=True)
class TextureInput:
    """A texture where a material wants a colour or a number.

    Attributes:
        texture: as written.
        coloured: whether three channels are wanted.
        linear: whether the numbers are no colours: then ``colorspace: auto`` leaves them as they are.
        low: least value that the slot accepts.
        high: greatest.
    """

    texture: Texture | Named
    coloured: bool
    linear: bool
    low: float
    high: float


def read_texture(raw: Any, key: str, file: str | None) -> Texture | Named:
    """The texture of a mapping.

    Raises:
        SceneError: what is wrong with it.
    """
    if isinstance(raw, Mapping) and "texture" in raw and "type" not in raw:
        check_keys(raw, ("texture", "channel"), key, "a reference to a texture", file)
        name, channel = raw["texture"], raw.get("channel")
        if not isinstance(name, str) or not name:
            raise SceneError(f"{key}.texture".lstrip("."), name, "the name of a texture", file)
        if channel is not None and channel not in CHANNELS:
            raise SceneError(f"{key}.channel".lstrip("."), channel, f"one of {', '.join(CHANNELS)}", file)
        return Named(name, channel)
    return select("texture", TEXTURES, raw, key, file)


def texture_input(raw: Any, coloured: bool, low: float, high: float, linear: bool | None = None) -> TextureInput:
    """The slot of a mapping that stands in a material; ``linear``: by default where it is a number.

    Raises:
        PydanticCustomError: what is wrong with it, for a field validator to pass on.
    """
    try:
        texture = read_texture(raw, "", None)
    except SceneError as error:
        raise wrong(error.expected, error.value, tuple(part for part in error.key.split(".") if part)) from None
    channel = texture.channel if isinstance(texture, Image | Named) else None
    if coloured and channel is not None:
        raise wrong("no channel where a colour is wanted", channel, ("channel",))
    if not coloured and isinstance(texture, Image) and len(set(texture.scale)) > 1:
        raise wrong("one number as scale where a number is wanted", list(texture.scale), ("scale",))
    return TextureInput(texture, coloured, not coloured if linear is None else linear, low, high)
