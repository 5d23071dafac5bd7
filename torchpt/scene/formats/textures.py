"""The grammar of textures in a scene file: what stands where a number or a colour could.

A texture is read when its slot is: a *colour* slot takes three channels, a *number* slot one of them. No file is opened here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchpt.core.errors import SceneError
from torchpt.physics.textures import CHANNELS, KINDS, Named, TextureInput
from torchpt.spec import Moves, Refused, Spec, parameters_of
from torchpt.spec.reading import as_refused
from torchpt.spec.schema import ParsedParams, check_keys, dotted, read_typed

__all__ = ["Named", "TextureInput", "check_texture", "read_texture", "texture_of"]


def read_texture(raw: Any, key: str, file: str | None) -> ParsedParams | Named:
    """The texture of a mapping: ``{texture: NAME}``, or one written out.

    Raises:
        SceneError: what is wrong with it.
    """
    if isinstance(raw, Mapping) and "texture" in raw and "type" not in raw:
        check_keys(raw, ("texture", "channel"), key, "a reference to a texture", file)
        name, channel = raw["texture"], raw.get("channel")
        if not isinstance(name, str) or not name:
            raise SceneError(dotted(key, "texture"), name, "the name of a texture", file)
        if channel is not None and channel not in CHANNELS:
            raise SceneError(dotted(key, "channel"), channel, f"one of {', '.join(CHANNELS)}", file)
        return Named(name, channel)
    return read_typed("texture", KINDS, raw, key, file)


def texture_of(raw: Mapping[str, Any], spec: Spec) -> TextureInput:
    """What stands in place of a number or a colour; :func:`torchpt.spec.schema.read_typed` takes it as ``texture``.

    Args:
        raw: the mapping as written.
        spec: of the slot.

    Raises:
        Refused: what is wrong with it.
    """
    low, high = getattr(spec, "bounds")  # noqa: B009  (of numbers and colours)
    return _input(raw, spec.coloured, low, high, getattr(spec, "linear", True), spec.moves)


def _input(raw: Any, coloured: bool, low: float, high: float, linear: bool, moves: Moves) -> TextureInput:
    try:
        texture = read_texture(raw, "", None)
    except SceneError as error:
        raise as_refused(error) from None
    channel = texture.channel if isinstance(texture, Named) else texture.values.get("channel")
    if coloured and channel is not None:
        raise Refused("no channel where a colour is wanted", channel, ("channel",))
    if isinstance(texture, ParsedParams):
        texture.kind.check_slot(texture.values, coloured)
    return TextureInput(texture, coloured, linear, low, high, moves)


def check_texture(
    slot: TextureInput,
    key: str,
    textures: Mapping[str, ParsedParams],
    file: str | None,
    *,
    coordinates: bool = False,
    points: bool = False,
) -> None:
    """What can be said of a slot's texture only once all are known.

    Args:
        slot: what was read.
        key: its dotted key.
        textures: the named ones.
        file: scene file for errors.
        coordinates: whether it must be read by texture coordinates, as maps and what is read at points are.
        points: whether the slot is read at points: then a texture of its own must not filter (a named one does not, here).

    Raises:
        SceneError: a texture that does not exist, or that the slot cannot read.
    """
    texture = slot.texture
    if isinstance(texture, Named):
        if texture.texture not in textures:
            known = ", ".join(textures) or "none is defined"
            where = key if key.endswith(".texture") else f"{key}.texture"
            raise SceneError(where, texture.texture, f"the name of a texture ({known})", file)
        texture = textures[texture.texture]
    if coordinates and texture.kind.reads != "uv":
        raise SceneError(key, texture.name, "an image, or another texture that is read by coordinates", file)
    if points and texture is slot.texture and texture.values.get("filter") in texture.kind.filters:
        words = getattr(parameters_of(texture.kind)["filter"], "names", ())
        accepted = [word for word in words if word not in texture.kind.filters]
        expected = f"{' or '.join(accepted)}, as {key.removesuffix('.texture').rpartition('.')[2]} is read at points"
        raise SceneError(f"{key}.filter", texture["filter"], expected, file)
