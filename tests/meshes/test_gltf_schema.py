"""A damaged glTF document is refused by the name of the element that is wrong."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from small_files import glb, gltf_document

from torchpt.core.errors import AssetError
from torchpt.scene.meshes import load_mesh

#: Where something is put in, what, and what is said of it.
CASES: list[tuple[str, Any, str]] = [
    (
        "meshes.0.primitives.0.attributes.POSITION",
        "x",
        "meshes[0].primitives[0].attributes.POSITION: expected a whole number, got 'x'",
    ),
    (
        "meshes.0.primitives.0.attributes.NORMAL",
        0.5,
        "meshes[0].primitives[0].attributes.NORMAL: expected a whole number, got 0.5",
    ),
    ("meshes.0.primitives.0.attributes", [], "meshes[0].primitives[0].attributes: expected an object, got a list of 0"),
    ("meshes.0.primitives.0.attributes", {}, "meshes[0].primitives[0].attributes: POSITION is missing"),
    ("meshes.0.primitives.0.indices", None, "meshes[0].primitives[0].indices: expected a whole number, got null"),
    ("meshes.0.primitives.0.mode", "4", "meshes[0].primitives[0].mode: expected a whole number, got '4'"),
    ("meshes.0.primitives", 3, "meshes[0].primitives: expected a list, got 3"),
    ("nodes.0.children", "12", "nodes[0].children: expected a list, got '12'"),
    ("nodes.0.children", [[1]], "nodes[0].children[0]: expected a whole number, got a list of 1"),
    ("nodes.0.rotation", [0, 0, 1], "nodes[0].rotation: expected a list of 4 numbers, got a list of 3"),
    ("nodes.0.scale", [1, None, 1], "nodes[0].scale[1]: expected a number, got null"),
    (
        "nodes.1.translation",
        [10**400, 0, 0],
        "nodes[1].translation[0]: expected a number, got a number of very many digits",
    ),
    ("nodes.2.extensions.KHR_lights_punctual", 0, "nodes[2].extensions.KHR_lights_punctual: expected an object, got 0"),
    ("scenes.0.nodes", {}, "scenes[0].nodes: expected a list, got an object of 0"),
    ("accessors.1.componentType", {}, "accessors[1].componentType: expected a whole number, got an object of 0"),
    ("accessors.3.sparse.indices", {}, "accessors[3].sparse.indices: bufferView is missing"),
    ("materials.0.extensions", [], "materials[0].extensions: expected an object, got a list of 0"),
    ("materials.0.pbrMetallicRoughness", True, "materials[0].pbrMetallicRoughness: expected an object, got True"),
    (
        "materials.0.pbrMetallicRoughness.baseColorTexture.extensions.KHR_texture_transform",
        1,
        "materials[0].pbrMetallicRoughness.baseColorTexture.extensions.KHR_texture_transform: expected an object, got 1",
    ),
    ("samplers.0.wrapS", [], "samplers[0].wrapS: expected a whole number, got a list of 0"),
    ("textures", {}, "textures: expected a list, got an object of 0"),
    (
        "extensions.KHR_lights_punctual.lights.0",
        3,
        "extensions.KHR_lights_punctual.lights[0]: expected an object, got 3",
    ),
    ("extensionsRequired", "KHR_x", "extensionsRequired: expected a list, got 'KHR_x'"),
]


@pytest.mark.parametrize(
    ("place", "value", "said"), CASES, ids=[f"{place}={str(value)[:9]}" for place, value, _ in CASES]
)
def test_the_element_is_named(tmp_path: Path, place: str, value: Any, said: str) -> None:
    document, body = gltf_document()
    document = json.loads(json.dumps(document))
    node: Any = document
    *way, last = [int(part) if part.isdigit() else part for part in place.split(".")]
    for part in way:
        node = node[part]
    node[last] = value
    file = tmp_path / "a.glb"
    file.write_bytes(glb(document, body))
    with pytest.raises(AssetError) as caught:
        load_mesh(file)
    assert str(caught.value) == f"{file}: malformed glTF: {said}"


def test_what_is_not_read_may_be_anything(tmp_path: Path) -> None:
    document, body = gltf_document()
    document |= {"asset": 3, "animations": 5, "extras": [], "skins": "x", "nodes": [*document["nodes"], 7]}
    file = tmp_path / "a.glb"
    file.write_bytes(glb(document, body))
    (part,) = load_mesh(file)
    assert len(part.faces) == 2 and "animations" in part.ignored
