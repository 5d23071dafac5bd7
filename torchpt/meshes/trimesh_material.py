"""Materials of trimesh objects: by the rules of glTF (``PBRMaterial``) and MTL (``SimpleMaterial``), which they come from."""

from __future__ import annotations

import hashlib
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.errors import AssetError
from torchpt.images import EncodedImage
from torchpt.images.decode import MAX_PIXELS
from torchpt.meshes.gltf_document import Document
from torchpt.meshes.gltf_material import Materials
from torchpt.meshes.mesh_part import FileMaterial
from torchpt.meshes.mtl_material import Map, Statements, material_of

__all__ = ["Looks"]

_FACTORS = ("metallicFactor", "roughnessFactor")
_PICTURES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")
#: Keys of a glTF material that stand in its block ``pbrMetallicRoughness``.
_INNER = (*_FACTORS, "baseColorFactor", "baseColorTexture", "metallicRoughnessTexture")
#: Pillow's modes that a PNG file holds.
_MODES = ("1", "L", "LA", "RGB", "RGBA", "I;16", "I")
#: What trimesh says where a file says nothing: of ``SimpleMaterial``, the grey of its colours and its exponent.
_UNSAID, _UNSAID_EXPONENT = (102, 102, 102, 255), 1.0


class Looks:
    """The materials of trimesh objects, each made once, and their pictures.

    Args:
        label: what errors call their owner.
        wanted: whether there are to be any.
    """

    def __init__(self, label: str, wanted: bool = True) -> None:
        self.label, self.wanted = label, wanted
        # What an id belongs to is kept, so that it stays its own.
        self._materials: dict[tuple[int, bool], tuple[Any, FileMaterial | None, NDArray[np.float64] | None]] = {}
        self._pictures: dict[int, tuple[Any, EncodedImage]] = {}

    def of(
        self, material: Any, colors: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """A material, and the colours ``(V, 3)`` of the vertices with its own multiplied in where they stand for it.

        Raises:
            AssetError: a picture that cannot be used, numbers that no material has.
        """
        if not self.wanted:
            return None, colors
        key = id(material), colors is not None
        if key not in self._materials:
            one = None if colors is None else np.ones((1, 3))
            made, tint = self._simple(material) if hasattr(material, "glossiness") else self._physical(material, one)
            self._materials[key] = material, made, tint
        _, made, tint = self._materials[key]
        return made, colors if colors is None or tint is None else colors * tint

    def _physical(
        self, material: Any, one: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """A ``PBRMaterial``, or None: the block that a glTF file would have for it."""
        block: dict[str, Any] = {}
        images: dict[int, str | EncodedImage] = {}
        if material is not None:
            block = {"name": str(material.name or "material")}
            for key in (*_FACTORS, "alphaMode", "alphaCutoff"):
                if getattr(material, key) is not None:
                    block[key] = getattr(material, key)
            if material.baseColorFactor is not None:
                block["baseColorFactor"] = (np.asarray(material.baseColorFactor, np.float64) / 255.0).tolist()
            if material.emissiveFactor is not None:
                block["emissiveFactor"] = np.asarray(material.emissiveFactor, np.float64).tolist()
            for key in _PICTURES:
                picture = getattr(material, key)
                if picture is not None:
                    block[key] = {"index": len(images)}
                    images[len(images)] = self.picture(picture, key)
            block["pbrMetallicRoughness"] = {key: block.pop(key) for key in _INNER if key in block}
        count = len(images)
        text = {"materials": [block], "textures": [{"source": n} for n in range(count)], "images": [{}] * count}
        rules = Materials(Document(Path(self.label), json.dumps(text).encode()))
        rules.images = images
        return rules.of(None if material is None else 0, one)

    def _simple(self, material: Any) -> tuple[FileMaterial, None]:
        """A ``SimpleMaterial``: the statements that an MTL file would have for it.

        Trimesh fills in a grey for colours that a file does not give, which cannot be told from the same grey given.
        """
        statements = Statements()
        files: dict[str, Any] = {}
        for key, value in (("kd", material.diffuse), ("ks", material.specular)):
            if tuple(np.asarray(value).tolist()) != _UNSAID:
                red, green, blue = (float(level) / 255.0 for level in value[:3])
                statements.colors[key] = red, green, blue
        if material.diffuse[3] < 255:
            statements.numbers["d"] = float(material.diffuse[3]) / 255.0
        if material.glossiness != _UNSAID_EXPONENT:
            statements.numbers["ns"] = float(material.glossiness)
        if material.image is not None:
            statements.maps["map_kd"] = Map("map_Kd", "", 0)
            files["map_kd"] = self.picture(material.image, "image")
        made, ignored = material_of(statements, files)
        extra = [str(key)[:80] for key in material.kwargs if key not in ("kd", "ka", "ks", "ns")]
        name = str(material.name or "material")[:80]
        return FileMaterial(name, made, tuple(dict.fromkeys([*ignored, *extra]))), None

    def picture(self, image: Any, what: str) -> EncodedImage:
        """A picture of Pillow's (or an array) as a PNG file in memory. It is called after its content: equal ones are one.

        Raises:
            AssetError: too large, broken, or of colours that are not read.
        """
        if id(image) not in self._pictures:
            self._pictures[id(image)] = image, self._encoded(image, what)
        return self._pictures[id(image)][1]

    def _encoded(self, image: Any, what: str) -> EncodedImage:
        from PIL import Image

        try:
            pillow = image if hasattr(image, "save") else Image.fromarray(np.asarray(image))
            width, height = pillow.size
            if width * height > MAX_PIXELS:
                limit = f"more than {MAX_PIXELS / 2**20:g} Mpixel are not read"
                raise AssetError(self.label, f"{what}: {width} x {height} pixels: {limit}")
            if pillow.mode in ("P", "PA"):
                pillow = pillow.convert("RGBA" if pillow.mode == "PA" or "transparency" in pillow.info else "RGB")
            if pillow.mode not in _MODES:
                expected = "expected grey or RGB"
                raise AssetError(self.label, f"{what}: colours stored as {pillow.mode} are not read; {expected}")
            data = BytesIO()
            pillow.save(data, "PNG", compress_level=1)
        except AssetError:
            raise
        except Exception as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
            raise AssetError(self.label, f"{what} cannot be read ({reason})") from None
        digest = hashlib.blake2b(data.getvalue(), digest_size=6).hexdigest()
        return EncodedImage(f"{what} {digest}", data.getvalue(), "png")
