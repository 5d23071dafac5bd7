"""Convert the materials of MTL files; ``docs/reference/assets.md`` has the rules.

The format was made for Phong's model (Alias Wavefront, *Object Files*, appendix B: MTL 3.0); ``Pr Pm Ps Pc Pcr aniso
anisor norm`` are the extension of Clara.io's and Blender's exporters, whose meaning is Burley's principled model: roughness,
metallic, sheen, clearcoat, its roughness, anisotropy, its rotation, normal map. Of the old format: ``Kd Ks Ke`` diffuse,
specular and emitted colour, ``Tf`` colour of transmitted light, ``Ns`` Phong's exponent, ``Ni`` index of refraction, ``d``
opacity, ``Tr`` 1 - d, ``illum`` the number of an illumination model: 0 and 1 without highlights, 2 with them, 3, 5 and 8
mirrors, 4, 6, 7 and 9 glass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any

from torchpt.images import has_alpha
from torchpt.scene.meshes.file_texture import image_texture, number_if_grey

__all__ = ["COLORS", "MAPS", "NUMBERS", "Map", "Statements", "coat_gloss", "material_of"]

Rgb = tuple[float, float, float]

#: Keys of statements, lower case: colours, single numbers, images.
COLORS = ("kd", "ks", "ke", "tf")
NUMBERS = ("ns", "ni", "d", "tr", "illum", "pr", "pm", "ps", "pc", "pcr", "aniso", "anisor")
MAPS = ("map_kd", "map_ks", "map_ke", "map_pr", "map_pm", "map_ps", "map_d", "bump", "norm")

#: Statements of the extension: a material with any of them is a principled one.
_PBR = {"pr", "pm", "ps", "pc", "pcr", "aniso", "map_pr", "map_pm", "map_ps"}
#: Keys as the format writes them, for messages.
_NAMES = {"pr": "Pr", "pm": "Pm", "ps": "Ps", "pc": "Pc", "pcr": "Pcr", "ks": "Ks", "kd": "Kd"}
_GREY = (0.5, 0.5, 0.5)
_WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Map:
    """A map statement.

    Attributes:
        key: the statement's key as written.
        name: the image file's name as written.
        line: line number.
        bump: ``-bm``, the factor of a bump map.
        offset: ``-o``, added to texture coordinates that ``scale`` has multiplied.
        scale: ``-s``.
        clamp: ``-clamp on``, which does not repeat the image.
        channel: channel of ``-imfchan`` from which a number is read, or None.
        ignored: unsupported options.
    """

    key: str
    name: str
    line: int
    bump: float = 1.0
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    clamp: bool = False
    channel: str | None = None
    ignored: tuple[str, ...] = ()


@dataclass
class Statements:
    """The statements of one material by lower-case key; the last one of a key holds."""

    colors: dict[str, Rgb] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    maps: dict[str, Map] = field(default_factory=dict)
    ignored: list[str] = field(default_factory=list)


def coat_gloss(roughness: float) -> float:
    """Return the ``clearcoat_gloss`` of a roughness.

    The coat's alpha is roughness² here, and 0.1 at gloss 0 to 0.001 at gloss 1 in Burley's model (2012).
    """
    return min(max((0.1 - roughness * roughness) / 0.099, 0.0), 1.0)


def material_of(statements: Statements, files: dict[str, str]) -> tuple[dict[str, Any], list[str]]:
    """Return a material as a block of a scene file, and the names of unsupported statements.

    Args:
        statements: the statements of one material.
        files: absolute path of each map.
    """
    converter = _Converter(statements, files)
    material = converter.surface()
    converter.set_opacity(material)
    converter.set_normals(material)
    converter.set_emission(material)
    return material, converter.ignored


class _Converter:
    """Converter of one material; ``ignored`` has the names of unsupported statements."""

    def __init__(self, statements: Statements, files: dict[str, str]) -> None:
        self.colors, self.numbers, self.maps = statements.colors, statements.numbers, statements.maps
        self.files = files
        self.ignored = [name for found in self.maps.values() for name in found.ignored]
        # The format's models are 0 to 10; a number far from them counts as the default.
        illum = self.numbers.get("illum", 2.0)
        self.illum = int(illum) if abs(illum) < 100 else 2
        self.opacity = self._opacity()

    def surface(self) -> dict[str, Any]:
        """Return the type and its parameters, without opacity, normals and emission."""
        if self._is_glass():
            return self._glass()
        if _PBR & (self.numbers.keys() | self.maps.keys()):
            return self._principled()
        ks = self.colors.get("ks", (0.0, 0.0, 0.0))
        has_highlight = max(ks) > 0 or "map_ks" in self.maps
        if (
            self.illum in (3, 5, 8)
            and has_highlight
            and "map_kd" not in self.maps
            and max(self.colors.get("kd", _GREY)) == 0
        ):
            return {"type": "conductor", "reflectance": self._color("ks", _WHITE, "map_ks")}
        if not has_highlight or self.illum in (0, 1):
            self._ignore_specular()
            return {"type": "diffuse", "reflectance": self._color("kd", _GREY, "map_kd")}
        return {
            "type": "principled",
            "base_color": self._color("kd", _GREY, "map_kd"),
            "specular": self._specular(ks),
            "roughness": self._phong_roughness(),
        }

    def _ignore_specular(self) -> None:
        """Report the specular colour and its map, which the material does not use."""
        if max(self.colors.get("ks", (0.0,))) > 0:
            self.ignored.append("Ks")
        if "map_ks" in self.maps:
            self.ignored.append("map_Ks")

    def _opacity(self) -> float:
        """Return `d`, else 1 - `Tr`; a `Tr` of 1 counts as opaque, since some exporters write `d` under that name."""
        if "d" in self.numbers:
            return self._bounded(self.numbers["d"], "d")
        through = self._bounded(self.numbers.get("tr", 0.0), "Tr")
        if through == 1.0:
            self.ignored.append("Tr 1 (taken for d 1)")
            return 1.0
        return 1.0 - through

    def _is_glass(self) -> bool:
        """Return True for the illumination models of refraction; 6 and 9 also stand for plain transparency by `d`."""
        index = self.numbers.get("ni", 1.0)
        is_opaque = self.opacity == 1.0 and "map_d" not in self.maps
        return index != 1.0 and (self.illum in (4, 7) or (self.illum in (6, 9) and (is_opaque or "tf" in self.colors)))

    def _glass(self) -> dict[str, Any]:
        """Return a dielectric, rough where `Pr` is above 0; indices of refraction are clamped to what it accepts."""
        index = self.numbers["ni"]
        material: dict[str, Any] = {"type": "dielectric", "int_ior": min(max(index, 1e-3), 1e3), "ext_ior": 1.0}
        if material["int_ior"] != index:
            self.ignored.append("Ni out of range")
        roughness = self._bounded(self.numbers.get("pr", 0.0), "Pr")
        if roughness > 0:
            material |= {"type": "roughdielectric", "roughness": roughness}
        tint = self._unit("tf", _WHITE)
        if tint != _WHITE:
            material["specular_transmittance"] = list(tint)
        self._ignore_specular()
        self.ignored += [_NAMES[key] for key in ("pm", "ps", "pc") if self.numbers.get(key, 0.0) > 0.0]
        self.ignored += [
            found.key for kind, found in self.maps.items() if kind in ("map_kd", "map_pr", "map_pm", "map_ps")
        ]
        self.opacity = 1.0  # the dielectric has its own transmission
        return material

    def _principled(self) -> dict[str, Any]:
        """Return Burley's model for the statements of the extension."""
        numbers = self.numbers
        if "pr" in numbers:
            roughness = self._bounded(numbers["pr"], "Pr")
        elif "map_pr" in self.maps:
            roughness = 1.0  # the factor of the map
        else:
            roughness = self._phong_roughness()
        material: dict[str, Any] = {
            "type": "principled",
            "base_color": self._color("kd", _GREY, "map_kd"),
            "roughness": self._number(roughness, "map_pr"),
        }
        features = {
            "metallic": self._number(self._amount("pm", "map_pm"), "map_pm"),
            "sheen": self._number(self._amount("ps", "map_ps"), "map_ps"),
            "clearcoat": self._bounded(numbers.get("pc", 0.0), "Pc"),
            "anisotropic": self._bounded(abs(numbers.get("aniso", 0.0)), "aniso"),
        }
        material |= {name: value for name, value in features.items() if value != 0.0}
        if "clearcoat" in material:
            material["clearcoat_gloss"] = coat_gloss(self._bounded(numbers.get("pcr", 0.0), "Pcr"))
        index = numbers.get("ni", 1.0)
        if 1.0 < index <= 1e3:
            material["eta"] = index
        self._ignore_specular()
        if numbers.get("anisor", 0.0) != 0.0:
            self.ignored.append("anisor")
        return material

    def _amount(self, key: str, kind: str) -> float:
        """Return a feature's number; beside a map 0 counts as absent."""
        value = self._bounded(self.numbers.get(key, 0.0), _NAMES[key])
        return 1.0 if kind in self.maps and value == 0.0 else value

    def _specular(self, ks: Rgb) -> Any:
        """Return the specular strength of a dielectric: the mean of `Ks`."""
        if max(ks) == 0:
            ks = _WHITE  # beside its map
        if min(ks) != max(ks):
            self.ignored.append("Ks (its hue)")
        return self._number(self._bounded(sum(ks) / 3.0, "Ks"), "map_ks")

    def _phong_roughness(self) -> float:
        """Return the roughness whose highlight is about as wide as that of the Phong exponent `Ns`.

        alpha = sqrt(2 / (Ns + 2)) (Walter et al., *Microfacet Models for Refraction through Rough Surfaces*, 2007,
        section 5.2, for Beckmann's distribution), and roughness = sqrt(alpha).
        """
        if "ns" not in self.numbers:
            return 0.5  # the default of the principled model
        return math.sqrt(math.sqrt(2.0 / (max(self.numbers["ns"], 0.0) + 2.0)))

    def set_opacity(self, material: dict[str, Any]) -> None:
        """Set the opacity: `d`, `Tr`, `map_d`."""
        found = self.maps.get("map_d")
        if found is not None:
            channel = found.channel
            # The image of the colour again: its alpha is meant, where it has one.
            if channel is None and self.files["map_d"] == self.files.get("map_kd") and has_alpha(self.files["map_d"]):
                channel = "a"
            opacity = self.opacity if self.opacity > 0 else 1.0  # beside a map exporters write 0 for absent
            material["opacity"] = self._image("map_d", opacity, channel=channel or "luminance")
        elif self.opacity != 1.0:
            material["opacity"] = self.opacity
        glass = material["type"] in ("dielectric", "roughdielectric")
        if not glass and self._unit("tf", _WHITE) != _WHITE and self.illum not in (0, 1, 2):
            self.ignored.append("Tf")

    def set_normals(self, material: dict[str, Any]) -> None:
        """Set the normal or bump map: `norm`, `bump`; a `bump` whose file name says normal map is one."""
        kind = "norm" if "norm" in self.maps else "bump"
        if kind not in self.maps:
            return
        if kind == "norm" and "bump" in self.maps:
            self.ignored.append(self.maps["bump"].key)
        found = self.maps[kind]
        stem = PurePath(self.files[kind]).stem.lower()
        # Exporters that know no `norm` write normal maps as `bump`, with one of these names.
        if kind == "norm" or "normal" in stem or stem.endswith(("_n", "_nrm", "_nor", "_norm")):
            material["normal_map"] = self._image(kind, 1.0, channel=None)
            if found.bump < 0.0:
                self.ignored.append(f"{found.key} -bm")
            elif found.bump != 1.0:
                material["normal_strength"] = found.bump
        else:
            material["bump_map"] = self._image(kind, found.bump, channel=found.channel or "luminance")

    def set_emission(self, material: dict[str, Any]) -> None:
        """Set the emission: `Ke` times `map_Ke`."""
        emitted = self.colors.get("ke", (0.0, 0.0, 0.0))
        if "map_ke" in self.maps:
            material["emission"] = self._image(
                "map_ke", number_if_grey(emitted if max(emitted) > 0 else _WHITE), channel=None
            )
        elif max(emitted) > 0:
            material["emission"] = list(emitted)

    def _color(self, key: str, default: Rgb, kind: str) -> Any:
        """Return a colour clamped to 1, times its map. Beside a map black counts as white: exporters write it for absent."""
        color = self._unit(key, _WHITE if kind in self.maps else default)
        if kind not in self.maps:
            return list(color)
        return self._image(kind, number_if_grey(color if max(color) > 0 else _WHITE), channel=None)

    def _number(self, value: float, kind: str) -> Any:
        """Return a number times its map."""
        if kind not in self.maps:
            return value
        return self._image(kind, value, channel=self.maps[kind].channel or "luminance")

    def _image(self, kind: str, scale: float | list[float], *, channel: str | None) -> dict[str, Any]:
        """Return the texture of a map; ``channel``: None for a colour."""
        found = self.maps[kind]
        transform: dict[str, Any] = {}
        if found.scale != (1.0, 1.0):
            transform["scale"] = list(found.scale)
        # The format counts v from the bottom: with v = 1 - v', s v + o becomes s v' + (1 - s - o).
        (offset_u, offset_v), (_, scale_v) = found.offset, found.scale
        translation = (offset_u, 1.0 - scale_v - offset_v)
        if translation != (0.0, 0.0):
            transform["translate"] = list(translation)
        return image_texture(
            self.files[kind],
            scale=scale,
            channel=channel,
            wrap="clamp" if found.clamp else "repeat",
            uv_transform=transform,
        )

    def _unit(self, key: str, default: Rgb) -> Rgb:
        """Return a colour clamped to 1; the parser has refused negative ones."""
        color = self.colors.get(key, default)
        if max(color) > 1:
            self.ignored.append(f"{key.capitalize()} above 1")
            return min(color[0], 1.0), min(color[1], 1.0), min(color[2], 1.0)
        return color

    def _bounded(self, value: float, name: str) -> float:
        """Return a number clamped to 0..1."""
        inside = min(max(value, 0.0), 1.0)
        if inside != value and f"{name} outside 0..1" not in self.ignored:
            self.ignored.append(f"{name} outside 0..1")
        return inside
