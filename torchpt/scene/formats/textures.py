"""Read textures in a scene file, which may stand in place of a number or a colour.

A texture is read for a *slot*, a parameter that it stands in for: a *colour* slot takes three channels, a *number* slot one. A
texture is written in place or named (a reference to the block ``textures``). No file is opened here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchpt.core.errors import SceneError, did_you_mean
from torchpt.physics.textures import CHANNELS, KINDS, TextureInput, TextureReference
from torchpt.spec import Refused, Spec, parameters_of
from torchpt.spec.reading import as_refused
from torchpt.spec.schema import ParsedParams, check_keys, dotted, read_typed

__all__ = ["TextureInput", "TextureReference", "check_texture", "read_texture", "texture_of"]


def read_texture(raw: Any, key: str, file: str | None) -> ParsedParams | TextureReference:
    """Read a reference ``{texture: NAME}``, or a texture written in place.

    Raises:
        SceneError: a wrong key or value.
    """
    if isinstance(raw, Mapping) and "texture" in raw and "type" not in raw:
        check_keys(raw, ("texture", "channel"), key=key, what="a reference to a texture", file=file)
        name, channel = raw["texture"], raw.get("channel")
        if not isinstance(name, str) or not name:
            raise SceneError(dotted(key, "texture"), name, "the name of a texture", file)
        if channel is not None and channel not in CHANNELS:
            raise SceneError(dotted(key, "channel"), channel, f"one of {', '.join(CHANNELS)}", file)
        return TextureReference(name, channel)
    return read_typed("texture", KINDS, raw, key=key, file=file)


def texture_of(raw: Mapping[str, Any], spec: Spec) -> TextureInput:
    """Read the texture of a slot; :func:`torchpt.spec.schema.read_typed` takes this function as ``texture``.

    Args:
        raw: the mapping as written.
        spec: spec of the slot.

    Raises:
        Refused: a wrong key or value.
    """
    low, high = getattr(spec, "bounds")  # noqa: B009  (specs of numbers and colours have them)
    coloured = spec.coloured
    try:
        texture = read_texture(raw, key="", file=None)
    except SceneError as error:
        raise as_refused(error) from None
    channel = texture.channel if isinstance(texture, TextureReference) else texture.values.get("channel")
    if coloured and channel is not None:
        raise Refused("no channel where a colour is wanted", channel, at=("channel",))
    if isinstance(texture, ParsedParams):
        texture.kind.check_slot(texture.values, coloured)
    # `linear`: values are not colours, so images are not decoded from sRGB. `moves`: the geometry that moves with the values.
    return TextureInput(
        texture=texture, coloured=coloured, linear=getattr(spec, "linear", True), low=low, high=high, moves=spec.moves
    )


def check_texture(
    slot: TextureInput,
    key: str,
    textures: Mapping[str, ParsedParams],
    file: str | None,
    *,
    coordinates: bool = False,
    points: bool = False,
) -> None:
    """Check the texture of a slot, once all textures are read.

    Args:
        slot: the slot's texture.
        key: its dotted key.
        textures: all textures by name.
        file: scene file, for errors.
        coordinates: True where the texture must be a function of texture coordinates.
        points: True where look-ups are not filtered; then a texture in place must not set a filter (that of a named one is
            ignored).

    Raises:
        SceneError: an unknown texture, or one that the slot cannot read.
    """
    texture = slot.texture
    if isinstance(texture, TextureReference):
        if texture.texture not in textures:
            known = ", ".join(textures) or "none is defined"
            where = key if key.endswith(".texture") else f"{key}.texture"
            hint = did_you_mean(texture.texture, textures)
            raise SceneError(where, texture.texture, f"the name of a texture ({known}){hint}", file)
        texture = textures[texture.texture]
    if coordinates and texture.kind.reads != "uv":
        raise SceneError(key, texture.name, "an image, or another texture that is read by coordinates", file)
    # `filters`: the words of the parameter `filter` for which the kind averages over footprints.
    if points and texture is slot.texture and texture.values.get("filter") in texture.kind.filters:
        words = getattr(parameters_of(texture.kind)["filter"], "names", ())
        accepted = [word for word in words if word not in texture.kind.filters]
        expected = f"{' or '.join(accepted)}, as {key.removesuffix('.texture').rpartition('.')[2]} is read at points"
        raise SceneError(f"{key}.filter", texture["filter"], expected, file)
