"""A scene as a short name: two scenes that differ in anything that is rendered have two."""

from __future__ import annotations

import hashlib

from torchpt.scene.scene import Scene

__all__ = ["digest"]


def digest(scene: Scene) -> str:
    """Of all that the scene was made of, files included; the run settings are no part of it."""
    hashed = hashlib.blake2b(digest_size=12)
    told = scene.description
    hashed.update(repr((told.camera, told.textures, told.materials, told.shapes, told.lights)).encode())
    for name, value in scene.params.items():
        hashed.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    for part in scene.built.parts:
        for array in (part.faces, part.normals, part.uvs, part.colors):
            if array is not None:
                hashed.update(array.tobytes())
    return hashed.hexdigest()
