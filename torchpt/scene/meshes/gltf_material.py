"""Convert the materials of glTF files; ``docs/reference/assets.md`` has the rules.

Khronos glTF 2.0 specification, 3.9 and appendix B, and the extensions ``KHR_materials_*``. The metallic-roughness model is
close to Burley's principled one (roughness^2 is alpha in both, F0 of 0.04 is ``specular: 0.5``), and is converted to it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.images import EncodedImage, has_alpha
from torchpt.scene.meshes.file_texture import image_texture, number_if_grey
from torchpt.scene.meshes.gltf_document import Document, NumberReader
from torchpt.scene.meshes.mesh import FileMaterial, Rgb
from torchpt.scene.meshes.mtl_material import coat_gloss

__all__ = ["MATERIAL_EXTENSIONS", "Materials"]

#: Extensions of materials that are read, at least in part; their unsupported keys are listed in ``FileMaterial.ignored``.
MATERIAL_EXTENSIONS = (
    "KHR_materials_emissive_strength", "KHR_materials_transmission", "KHR_materials_ior", "KHR_materials_clearcoat",
    "KHR_materials_sheen", "KHR_materials_specular", "KHR_materials_unlit",
)  # fmt: skip

#: Modes of OpenGL's samplers: how textures repeat, and look-ups without interpolation.
_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_REPEAT = 10497
_NEAREST = 9728
#: Kinds of embedded images.
_KINDS = {"image/png": "png", "image/jpeg": "jpg"}
_WHITE = (1.0, 1.0, 1.0)
#: F0, the reflectance at normal incidence, of Burley's `specular` 1.
_LARGEST_F0 = 0.08
#: Largest F0 that is converted to an index of refraction, about 1000, the largest that `eta` accepts.
_LARGEST_ETA_F0 = 0.996
#: Largest numbers that are accepted: of texture transforms and normal maps, and of emission.
_MAX_FACTOR, _MAX_EMISSION = 1e6, 1e30


class Materials:
    """Converter of one document's materials; each is converted once.

    Attributes:
        images: images by index: path, or bytes that are embedded.
        converted: by index of the material, and whether the vertices have colours: the material, and the colour by which vertex
            colours are multiplied where they take the base colour's place (else None).
    """

    def __init__(self, document: Document) -> None:
        self.document = document
        self.images: dict[int, str | EncodedImage] = {}
        self.converted: dict[tuple[int, bool], tuple[FileMaterial, Rgb | None]] = {}

    def convert(
        self, number: Any, colors: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """Return a material, and the vertex colours, multiplied by the base colour where they take its place.

        Args:
            number: index of the material; None where a primitive has none.
            colors: the primitive's ``COLOR_0``, ``(V, 3)``, or None.
        """
        if number is None:
            if colors is None:
                return None, None
            return FileMaterial("vertex colors", {"type": "diffuse", "reflectance": {"type": "vertex_color"}}), colors
        key = (number, colors is not None)
        block = self.document.item("materials", number)
        if key not in self.converted:  # the same object for every primitive that has it
            converter = _Converter(self, block, number)
            material = converter.material(has_colors=colors is not None)
            name = str(block.get("name") or f"material{number}")[:80]
            found = FileMaterial(name, material, tuple(dict.fromkeys(converter.ignored)))
            self.converted[key] = found, converter.base_color if converter.tints_colors else None
        found, tint = self.converted[key]
        return found, colors if colors is None or tint is None else colors * np.array(tint)

    def image(self, number: Any) -> str | EncodedImage:
        """Return an image of the document: its path, or its bytes where they are embedded."""
        image = self.document.item("images", number)
        if number not in self.images:
            label = f"{self.document.path}: images {number}"
            kind = _KINDS.get(str(image.get("mimeType")), "")
            if "bufferView" in image:
                found: str | EncodedImage = EncodedImage(label, bytes(self.document.view(image["bufferView"])[0]), kind)
            elif str(image.get("uri", "")).startswith("data:"):
                found = EncodedImage(label, self.document.resource(image["uri"], f"images {number}"), kind)
            elif isinstance(image.get("uri"), str):
                found = str(self.document.file(image["uri"], f"images {number}").resolve())
            else:
                raise AssetError(self.document.path, f"images {number} has neither a bufferView nor a uri")
            self.images[number] = found
        return self.images[number]


class _Converter(NumberReader):
    """Converter of one material; ``ignored`` has the names of unsupported features."""

    def __init__(self, materials: Materials, block: dict[str, Any], number: Any) -> None:
        super().__init__(materials.document, f"materials {number}")
        self.materials, self.block = materials, block
        self.extensions: dict[str, Any] = block.get("extensions", {})
        self.ignored = [str(name) for name in self.extensions if name not in MATERIAL_EXTENSIONS]
        self.base_color: Rgb = _WHITE
        self.tints_colors = False  # vertex colours take the place of the base colour, which multiplies them

    def material(self, *, has_colors: bool) -> dict[str, Any]:
        """Return the material as a block of a scene file; ``has_colors``: the vertices have colours."""
        pbr = self.block.get("pbrMetallicRoughness", {})
        factor = self.numbers(pbr, "baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        self.base_color = (factor[0], factor[1], factor[2])
        texture = self.texture(pbr, "baseColorTexture", number_if_grey(self.base_color), channel=None, encoded=True)
        if has_colors and texture is not None:
            self.ignored.append("COLOR_0 (beside baseColorTexture)")
        elif has_colors:
            self.tints_colors, texture = True, {"type": "vertex_color"}
        color = list(self.base_color) if texture is None else texture
        if "KHR_materials_unlit" in self.extensions:
            self.ignored.append("KHR_materials_unlit (rendered as diffuse)")
            material: dict[str, Any] = {"type": "diffuse", "reflectance": color}
        else:
            material = {"type": "principled", "base_color": color, **self.microfacets(pbr), **self.layers()}
        self.set_opacity(material, pbr, factor[3])
        self.set_normals(material)
        self.set_emission(material)
        if "occlusionTexture" in self.block:
            self.ignored.append("occlusionTexture")
        return material

    def microfacets(self, pbr: dict[str, Any]) -> dict[str, Any]:
        """Return roughness (channel G), metallic (B) and the specular strength or index of a dielectric."""
        roughness = self.number(pbr, "roughnessFactor", 1.0, high=1.0)
        metallic = self.number(pbr, "metallicFactor", 1.0, high=1.0)
        found: dict[str, Any] = {"roughness": self.scaled(pbr, "metallicRoughnessTexture", roughness, "g")}
        if metallic > 0:
            found["metallic"] = self.scaled(pbr, "metallicRoughnessTexture", metallic, "b")
        ior = self.extension("ior", ("ior",))
        index = self.number(ior, "ior", 1.5, high=1e3)
        if index == 0:
            self.ignored.append("KHR_materials_ior 0 (a surface that reflects everything)")
            index = 1.5
        specular = self.extension(
            "specular", ("specularFactor", "specularTexture", "specularColorFactor", "specularColorTexture")
        )
        if not specular:
            return found | ({"eta": index} if ior and index != 1.5 else {})
        color = self.numbers(specular, "specularColorFactor", _WHITE, high=1e3)
        if "specularColorTexture" in specular or min(color) != max(color):
            self.ignored.append("KHR_materials_specular (its hue)")
        root = (index - 1.0) / (index + 1.0)  # of Fresnel's reflectance at normal incidence
        f0 = self.number(specular, "specularFactor", 1.0, high=1.0) * min(root * root * max(color), 1.0)
        if f0 <= _LARGEST_F0:
            found["specular"] = self.scaled(specular, "specularTexture", f0 / _LARGEST_F0, "a")
        else:
            if "specularTexture" in specular:
                self.ignored.append("KHR_materials_specular.specularTexture")
            root = math.sqrt(min(f0, _LARGEST_ETA_F0))
            found["eta"] = (1.0 + root) / (1.0 - root)
        return found

    def layers(self) -> dict[str, Any]:
        """Return the parameters of transmission, clearcoat and sheen."""
        found: dict[str, Any] = {}
        block = self.extension("transmission", ("transmissionFactor", "transmissionTexture"))
        transmission = self.number(block, "transmissionFactor", 0.0, high=1.0)
        if transmission > 0:
            found["spec_trans"] = self.scaled(block, "transmissionTexture", transmission, "r")
        block = self.extension("clearcoat", ("clearcoatFactor", "clearcoatTexture", "clearcoatRoughnessFactor"))
        coat = self.number(block, "clearcoatFactor", 0.0, high=1.0)
        if coat > 0:
            found["clearcoat"] = self.scaled(block, "clearcoatTexture", coat, "r")
            found["clearcoat_gloss"] = coat_gloss(self.number(block, "clearcoatRoughnessFactor", 0.0, high=1.0))
        block = self.extension("sheen", ("sheenColorFactor",))
        color = self.numbers(block, "sheenColorFactor", (0.0, 0.0, 0.0))
        if max(color) > 0:
            found["sheen"] = max(color)
            if min(color) != max(color):
                found["sheen_tint"] = (max(color) - min(color)) / max(color)
                self.ignored.append("KHR_materials_sheen (its hue: that of the base colour)")
        return found

    def set_opacity(self, material: dict[str, Any], pbr: dict[str, Any], factor: float) -> None:
        """Set the opacity by alphaMode: the base colour's alpha, times ``factor``, with a cut-off for MASK."""
        mode = self.block.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise self.wrong(f"alphaMode {str(mode)[:40]!r}, expected OPAQUE, MASK or BLEND")
        if mode == "OPAQUE":
            return
        alpha: Any = self.texture(pbr, "baseColorTexture", factor, channel="a")
        if alpha is None or not has_alpha(alpha["path"]):
            alpha = factor
        if mode == "MASK":
            cutoff = self.number(self.block, "alphaCutoff", 0.5, high=math.inf)
            if cutoff > 1.0:  # above any alpha
                material["opacity"] = 0.0
            else:
                material["opacity"], material["alpha_cutoff"] = alpha, cutoff
        elif alpha != 1.0:
            material["opacity"] = alpha

    def set_normals(self, material: dict[str, Any]) -> None:
        """Set the normal map."""
        normals = self.texture(self.block, "normalTexture", 1.0, channel=None)
        if normals is None:
            return
        material["normal_map"] = normals
        strength = self.number(self.block["normalTexture"], "scale", 1.0, high=_MAX_FACTOR, low=-_MAX_FACTOR)
        if strength < 0.0:
            self.ignored.append("normalTexture.scale")
        elif strength != 1.0:
            material["normal_strength"] = strength

    def set_emission(self, material: dict[str, Any]) -> None:
        """Set the emission: emissiveFactor, its texture, KHR_materials_emissive_strength."""
        color = self.numbers(self.block, "emissiveFactor", (0.0, 0.0, 0.0), high=_MAX_EMISSION)
        block = self.extension("emissive_strength", ("emissiveStrength",))
        strength = self.number(block, "emissiveStrength", 1.0, high=_MAX_EMISSION)
        if max(color) * strength == 0:
            return
        picture = self.texture(
            self.block, "emissiveTexture", number_if_grey((color[0], color[1], color[2])), channel=None, encoded=True
        )
        material["emission"] = list(color) if picture is None else picture
        if strength != 1.0:
            material["emission_strength"] = strength
        if self.block.get("doubleSided"):
            self.ignored.append("doubleSided (light leaves the front alone)")

    def extension(self, name: str, read: tuple[str, ...]) -> dict[str, Any]:
        """Return the block of ``KHR_materials_NAME``; keys other than ``read`` are listed as ignored."""
        name = f"KHR_materials_{name}"
        block = self.extensions.get(name, {})
        self.ignored += [f"{name}.{str(key)[:40]}" for key in block if key not in (*read, "extras")]
        return block

    def scaled(self, block: dict[str, Any], key: str, factor: float, channel: str) -> Any:
        """Return ``factor``, or the texture ``key`` of ``block``, scaled by it, where the file has one."""
        found = self.texture(block, key, factor, channel=channel) if factor != 0 else None
        return factor if found is None else found

    def texture(
        self,
        block: dict[str, Any],
        key: str,
        scale: float | list[float],
        *,
        channel: str | None,
        encoded: bool = False,
    ) -> Any:
        """Return the texture that a textureInfo of the file refers to; None where it is missing or unsupported.

        Args:
            block: the object with the textureInfo.
            key: key of the textureInfo.
            scale: factor of the values.
            channel: channel that a number is read from; None for a colour.
            encoded: True for colours, which are sRGB of whatever number of bits.
        """
        info = block.get(key)
        if info is None:
            return None
        uv_transform = info.get("extensions", {}).get("KHR_texture_transform", {})
        if uv_transform.get("texCoord", info.get("texCoord", 0)) != 0:
            self.ignored.append(f"{key} (its texture coordinates are not TEXCOORD_0)")
            return None
        self.ignored += [
            f"{key}: {str(name)[:80]}" for name in info.get("extensions", {}) if name != "KHR_texture_transform"
        ]
        document = self.document
        texture = document.item("textures", info.get("index"))
        if "source" not in texture:
            kinds = ", ".join(str(name)[:80] for name in texture.get("extensions", {})) or "no source"
            self.ignored.append(f"{key} ({kinds})")
            return None
        sampler = document.item("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap_u, wrap_v = (_WRAPS.get(sampler.get(side, _REPEAT)) for side in ("wrapS", "wrapT"))
        if wrap_u is None or wrap_v is None:
            raise self.wrong(f"{key} has a sampler with an unknown wrap mode")
        if wrap_u != wrap_v:
            self.ignored.append(f"{key}: wrapT (both directions wrap as wrapS)")
        transform: dict[str, Any] = {}
        scaling = self.numbers(uv_transform, "scale", (1.0, 1.0), high=_MAX_FACTOR, low=-_MAX_FACTOR)
        turn = self.number(uv_transform, "rotation", 0.0, high=_MAX_FACTOR, low=-_MAX_FACTOR)
        offset = self.numbers(uv_transform, "offset", (0.0, 0.0), high=_MAX_FACTOR, low=-_MAX_FACTOR)
        if scaling != (1.0, 1.0):
            transform["scale"] = list(scaling)
        if turn != 0:
            transform["rotate"] = -math.degrees(turn)  # counter-clockwise as seen, and v points down
        if offset != (0.0, 0.0):
            transform["translate"] = list(offset)
        return image_texture(
            self.materials.image(texture["source"]),
            scale=scale,
            channel=channel,
            wrap=wrap_u,
            nearest=sampler.get("magFilter") == _NEAREST,
            uv_transform=transform,
            encoded=encoded,
        )
