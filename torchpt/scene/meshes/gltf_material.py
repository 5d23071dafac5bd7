"""What the materials of a glTF file come to: the rules, which ``docs/reference/assets.md`` tells users.

Khronos glTF 2.0 specification, 3.9 and appendix B, and the extensions ``KHR_materials_*``. The metallic-roughness model is
close to Burley's principled one (roughness^2 is alpha in both, F0 of 0.04 is ``specular: 0.5``), so that is what it becomes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.images import EncodedImage, has_alpha
from torchpt.scene.meshes.file_texture import image_texture, plain_scale
from torchpt.scene.meshes.gltf_document import Document, NumberReader
from torchpt.scene.meshes.mesh import FileMaterial, Rgb
from torchpt.scene.meshes.mtl_material import coat_gloss

__all__ = ["MATERIAL_EXTENSIONS", "Materials"]

#: Extensions of materials that are read, at least in part; what of them is not is named.
MATERIAL_EXTENSIONS = (
    "KHR_materials_emissive_strength", "KHR_materials_transmission", "KHR_materials_ior", "KHR_materials_clearcoat",
    "KHR_materials_sheen", "KHR_materials_specular", "KHR_materials_unlit",
)  # fmt: skip

_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
_KINDS = {"image/png": "png", "image/jpeg": "jpg"}
_WHITE = (1.0, 1.0, 1.0)


class Materials:
    """The materials of one document, by number."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.images: dict[int, str | EncodedImage] = {}
        self.known: dict[tuple[int, bool], tuple[FileMaterial, Rgb | None]] = {}

    def of(
        self, number: Any, colors: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """A material, and the colours of the vertices with its base colour multiplied in where they stand for it.

        Args:
            number: of the material; None where a primitive has none.
            colors: the primitive's ``COLOR_0``, ``(V, 3)``, or None.
        """
        if number is None:
            if colors is None:
                return None, None
            return FileMaterial("vertex colors", {"type": "diffuse", "reflectance": {"type": "vertex_color"}}), colors
        key = (number, colors is not None)
        block = self.document.item("materials", number)
        if key not in self.known:  # the same object for every primitive that has it
            rules = _Rules(self, block, number)
            material = rules.material(colors is not None)
            name = str(block.get("name") or f"material{number}")[:80]
            found = FileMaterial(name, material, tuple(dict.fromkeys(rules.ignored)))
            self.known[key] = found, rules.base if rules.tinted else None
        found, tint = self.known[key]
        return found, colors if colors is None or tint is None else colors * np.array(tint)

    def image(self, number: Any) -> str | EncodedImage:
        """An image of the document: a path, or the bytes that lie in the document."""
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


class _Rules(NumberReader):
    """One material, and the names of what was left out."""

    def __init__(self, materials: Materials, block: dict[str, Any], number: Any) -> None:
        super().__init__(materials.document, f"materials {number}")
        self.materials, self.block = materials, block
        self.extensions: dict[str, Any] = block.get("extensions", {})
        self.ignored = [str(name) for name in self.extensions if name not in MATERIAL_EXTENSIONS]
        self.base: Rgb = _WHITE
        self.tinted = False

    def material(self, colored: bool) -> dict[str, Any]:
        """The material as a scene file would have it; ``colored``: the vertices have colours."""
        pbr = self.block.get("pbrMetallicRoughness", {})
        factor = self.numbers(pbr, "baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        self.base = (factor[0], factor[1], factor[2])
        base = self.texture(pbr, "baseColorTexture", plain_scale(self.base), None)
        if colored and base is not None:
            self.ignored.append("COLOR_0 (beside baseColorTexture)")
        elif colored:
            self.tinted, base = True, {"type": "vertex_color"}
        color = list(self.base) if base is None else base
        if "KHR_materials_unlit" in self.extensions:
            self.ignored.append("KHR_materials_unlit (rendered as diffuse)")
            material: dict[str, Any] = {"type": "diffuse", "reflectance": color}
        else:
            material = {"type": "principled", "base_color": color, **self.microfacets(pbr), **self.layers()}
        self.set_opacity(material, pbr, factor[3])
        self.set_normals(material)
        self.set_emission(material)
        self.ignored += ["occlusionTexture"] * ("occlusionTexture" in self.block)
        return material

    def microfacets(self, pbr: dict[str, Any]) -> dict[str, Any]:
        """Roughness (G) and metallic (B) of one picture, and the strength of a dielectric's highlight."""
        rough = self.number(pbr, "roughnessFactor", 1.0, 1.0)
        metal = self.number(pbr, "metallicFactor", 1.0, 1.0)
        found: dict[str, Any] = {"roughness": self.scaled(pbr, "metallicRoughnessTexture", rough, "g")}
        if metal > 0:
            found["metallic"] = self.scaled(pbr, "metallicRoughnessTexture", metal, "b")
        ior = self.extension("ior", ("ior",))
        index = self.number(ior, "ior", 1.5, 1e3)
        if index == 0:
            self.ignored.append("KHR_materials_ior 0 (a surface that reflects everything)")
            index = 1.5
        special = self.extension(
            "specular", ("specularFactor", "specularTexture", "specularColorFactor", "specularColorTexture")
        )
        if not special:
            return found | ({"eta": index} if ior and index != 1.5 else {})
        color = self.numbers(special, "specularColorFactor", _WHITE, 1e3)
        if "specularColorTexture" in special or min(color) != max(color):
            self.ignored.append("KHR_materials_specular (its hue)")
        root = (index - 1.0) / (index + 1.0)
        strength = self.number(special, "specularFactor", 1.0, 1.0) * min(root * root * max(color), 1.0)
        if strength <= 0.08:  # specular: 1 is an F0 of 0.08
            found["specular"] = self.scaled(special, "specularTexture", strength / 0.08, "a")
        else:
            self.ignored += ["KHR_materials_specular.specularTexture"] * ("specularTexture" in special)
            root = math.sqrt(min(strength, 0.996))  # eta = 1000, the largest
            found["eta"] = (1.0 + root) / (1.0 - root)
        return found

    def layers(self) -> dict[str, Any]:
        """Transmission, clearcoat and sheen."""
        found: dict[str, Any] = {}
        block = self.extension("transmission", ("transmissionFactor", "transmissionTexture"))
        through = self.number(block, "transmissionFactor", 0.0, 1.0)
        if through > 0:
            found["spec_trans"] = self.scaled(block, "transmissionTexture", through, "r")
        block = self.extension("clearcoat", ("clearcoatFactor", "clearcoatTexture", "clearcoatRoughnessFactor"))
        coat = self.number(block, "clearcoatFactor", 0.0, 1.0)
        if coat > 0:
            found["clearcoat"] = self.scaled(block, "clearcoatTexture", coat, "r")
            found["clearcoat_gloss"] = coat_gloss(self.number(block, "clearcoatRoughnessFactor", 0.0, 1.0))
        block = self.extension("sheen", ("sheenColorFactor",))
        color = self.numbers(block, "sheenColorFactor", (0.0, 0.0, 0.0))
        if max(color) > 0:
            found["sheen"] = max(color)
            if min(color) != max(color):
                found["sheen_tint"] = (max(color) - min(color)) / max(color)
                self.ignored.append("KHR_materials_sheen (its hue: that of the base colour)")
        return found

    def set_opacity(self, material: dict[str, Any], pbr: dict[str, Any], factor: float) -> None:
        """alphaMode: the base colour's alpha is the opacity, above a threshold or as it is."""
        mode = self.block.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise self.wrong(f"alphaMode {str(mode)[:40]!r}, expected OPAQUE, MASK or BLEND")
        if mode == "OPAQUE":
            return
        alpha: Any = self.texture(pbr, "baseColorTexture", factor, "a")
        if alpha is None or not has_alpha(alpha["path"]):
            alpha = factor
        if mode == "MASK":
            material["opacity"] = alpha
            material["alpha_cutoff"] = min(self.number(self.block, "alphaCutoff", 0.5, math.inf), 1.0)
        elif alpha != 1.0:
            material["opacity"] = alpha

    def set_normals(self, material: dict[str, Any]) -> None:
        """The normal map."""
        normals = self.texture(self.block, "normalTexture", 1.0, None)
        if normals is None:
            return
        material["normal_map"] = normals
        strength = self.number(self.block["normalTexture"], "scale", 1.0, 1e6, -1e6)
        if strength < 0.0:
            self.ignored.append("normalTexture.scale")
        elif strength != 1.0:
            material["normal_strength"] = strength

    def set_emission(self, material: dict[str, Any]) -> None:
        """EmissiveFactor times its picture times KHR_materials_emissive_strength."""
        color = self.numbers(self.block, "emissiveFactor", (0.0, 0.0, 0.0), 1e30)
        block = self.extension("emissive_strength", ("emissiveStrength",))
        strength = self.number(block, "emissiveStrength", 1.0, 1e30)
        if max(color) * strength == 0:
            return
        picture = self.texture(self.block, "emissiveTexture", plain_scale((color[0], color[1], color[2])), None)
        material["emission"] = list(color) if picture is None else picture
        if strength != 1.0:
            material["emission_strength"] = strength

    def extension(self, name: str, read: tuple[str, ...]) -> dict[str, Any]:
        """The block of ``KHR_materials_NAME``; keys beside those that are read are named."""
        name = f"KHR_materials_{name}"
        block = self.extensions.get(name, {})
        self.ignored += [f"{name}.{str(key)[:40]}" for key in block if key not in (*read, "extras")]
        return block

    def scaled(self, block: dict[str, Any], key: str, factor: float, channel: str) -> Any:
        """A number, times a channel of its picture where it has one."""
        found = self.texture(block, key, factor, channel) if factor != 0 else None
        return factor if found is None else found

    def texture(self, block: dict[str, Any], key: str, scale: float | list[float], channel: str | None) -> Any:
        """The picture that a textureInfo names; None where there is none, or none that is read."""
        info = block.get(key)
        if info is None:
            return None
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        if moved.get("texCoord", info.get("texCoord", 0)) != 0:
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
        wraps = [_WRAPS.get(sampler.get(side, 10497)) for side in ("wrapS", "wrapT")]
        if wraps[0] is None or wraps[1] is None:
            raise self.wrong(f"{key} has a sampler with an unknown wrap mode")
        if wraps[0] != wraps[1]:
            self.ignored.append(f"{key}: wrapT (both directions wrap as wrapS)")
        transform: dict[str, Any] = {}
        scaling = self.numbers(moved, "scale", (1.0, 1.0), 1e6, -1e6)
        turn = self.number(moved, "rotation", 0.0, 1e6, -1e6)
        offset = self.numbers(moved, "offset", (0.0, 0.0), 1e6, -1e6)
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
            wrap=wraps[0],
            nearest=sampler.get("magFilter") == _NEAREST,
            uv_transform=transform,
        )
