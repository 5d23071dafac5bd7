"""Names of EXR channels for layers, and layers from the channels of a file.

``image`` is the picture itself (``R G B``); channels of other layers have the name of the layer as a prefix (``albedo.R``). A
layer of ``film.aovs`` defines its channel names; those of any other follow from its number of components.
"""

from __future__ import annotations

from importlib import import_module

__all__ = ["channel_names", "group_channels"]

#: Names of components by their number.
_SUFFIXES = {2: "XY", 3: "RGB", 4: "RGBA"}
#: What some programs call the channels of the picture itself, in any case.
_SPELLINGS = (("r", "g", "b", "a"), ("red", "green", "blue", "alpha"))
#: Names of the channels of the picture itself.
_PICTURE = ("R", "G", "B", "A", "Y")
#: Order of the components of a layer.
_ORDER = "RGBXYZUVA"


def channel_names(layer: str, components: int) -> tuple[str, ...]:
    """Return the names of the EXR channels of a layer with ``components`` components."""
    if layer == "image":
        usual = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}
        return usual.get(components) or tuple(f"image.{i}" for i in range(components))
    # Imported by name, and only when a layer is written: package `paths` imports this one.
    aov = import_module("torchpt.paths.layers").LAYERS.get(layer)
    if aov is not None and len(aov.channels) == components:
        return aov.channels
    if components == 1:
        return (layer,)
    suffixes = _SUFFIXES.get(components) or [str(i) for i in range(components)]
    return tuple(f"{layer}.{s}" for s in suffixes)


def _usual(channels: tuple[str, ...] | list[str]) -> list[str]:
    """Return names of channels, those of the picture itself as they usually are where a program spells them in another way."""
    if not any(name in _PICTURE for name in channels):
        for spelling in _SPELLINGS:
            if set(spelling[:3]) <= {name.lower() for name in channels}:
                usual = dict(zip(spelling, "RGBA", strict=True))
                return [usual.get(name.lower(), name) for name in channels]
    return list(channels)


def _component_order(channel: str) -> tuple[int, int, str]:
    """Return the sort key of a channel among the components of its layer: numbers first, then letters by _ORDER."""
    _, _, last = channel.rpartition(".")
    if last.isdecimal() and last.isascii():
        return 0, int(last), last
    return 1, _ORDER.find(last) if len(last) == 1 else -1, last


def group_channels(channels: tuple[str, ...] | list[str]) -> dict[str, list[int]]:
    """Return the channel indices of each layer, components in order: the inverse of `channel_names`."""
    channels = _usual(channels)
    groups: dict[str, list[int]] = {}
    for index, channel in enumerate(channels):
        prefix, _, last = channel.rpartition(".")
        if not prefix and last == "Z":  # the usual name of depth
            prefix = "depth"
        elif not prefix:
            prefix = "image" if last in _PICTURE else last
        groups.setdefault(prefix, []).append(index)
    return {name: sorted(indices, key=lambda i: _component_order(channels[i])) for name, indices in groups.items()}
