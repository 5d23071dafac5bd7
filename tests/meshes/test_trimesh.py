"""Objects of trimesh: its meshes as ours, and its scenes."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import torchpt
from torchpt.core.errors import AssetError, SceneError
from torchpt.images import EncodedImage, read_texels
from torchpt.scene.from_trimesh import description_of

trimesh: Any = import_module("trimesh")  # hardly typed
PBRMaterial = trimesh.visual.material.PBRMaterial
SimpleMaterial = trimesh.visual.material.SimpleMaterial
TextureVisuals = trimesh.visual.TextureVisuals
Lighting = trimesh.scene.lighting

BALL = trimesh.creation.icosphere(subdivisions=1)
SMALL = {"width": 24, "height": 18}


def picture(mode: str = "RGB", seed: int = 3) -> Image.Image:
    rows = np.random.default_rng(seed).integers(0, 256, (6, 5, 3), dtype=np.uint8)
    return Image.fromarray(rows).convert(mode)


def square(material: Any = None, **visual: Any) -> Any:
    """The unit square in the xy plane; its texture upright."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False, **visual)
    if material is not None:
        mesh.visual = TextureVisuals(uv=corners[:, :2], material=material)
    return mesh


def parts_of(source: Any, **keys: Any) -> Any:
    """The mesh of a scene that has the object."""
    described = {
        "camera": {"origin": [0, 0, 9], "target": [0, 0, 0]},
        "shapes": {"thing": {"type": "mesh", "mesh": source, **keys}},
    }
    return torchpt.load(described, "cpu").built.parts


# --- objects


def test_a_mesh_object_is_a_mesh() -> None:
    before = copy.deepcopy((BALL.vertices, BALL.faces))
    (part,) = parts_of(BALL, face_normals=True)
    assert np.array_equal(part.vertices, BALL.vertices) and np.array_equal(part.faces, BALL.faces)
    assert np.array_equal(before[0], BALL.vertices) and np.array_equal(before[1], BALL.faces)
    (part,) = parts_of(trimesh.creation.box((1, 2, 3)))  # a primitive too
    assert part.faces is not None and len(part.faces) == 12


def test_normals_are_those_that_the_mesh_was_given() -> None:
    (part,) = parts_of(square())
    assert part.normals is None
    (part,) = parts_of(square(vertex_normals=[[0, 3, 4]] * 4))
    assert np.allclose(part.normals, [[0, 0.6, 0.8]] * 4)


def test_colours_of_vertices_and_faces() -> None:
    levels = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [51, 102, 153, 255]], np.uint8)
    (part,) = parts_of(square(vertex_colors=levels))
    assert np.allclose(part.colors, levels[:, :3] / 255)
    (part,) = parts_of(square(face_colors=levels[:2]))
    assert len(part.vertices) == 6 and np.allclose(part.colors, np.repeat(levels[:2, :3], 3, axis=0) / 255)
    assert np.allclose(part.normals, [[0, 0, 1]] * 6)
    (part,) = parts_of(square(vertex_colors=levels), material={"type": "conductor"})
    assert part.material.model.name == "conductor"


def look_of(material: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
    from torchpt.scene.meshes.trimesh_objects import mesh_parts_of

    (part,) = mesh_parts_of(square(material))
    assert part.material is not None
    parts_of(square(material))  # a scene takes it
    return part.material.material, part.material.ignored


def test_physical_materials_follow_the_rules_of_gltf() -> None:
    look, _ = look_of(PBRMaterial(baseColorFactor=[255, 51, 0, 255], metallicFactor=0.25, roughnessFactor=0.5))
    assert look == {"type": "principled", "base_color": [1.0, 0.2, 0.0], "metallic": 0.25, "roughness": 0.5}
    cut = {"alphaMode": "MASK", "alphaCutoff": 0.3, "baseColorTexture": picture("RGBA"), "emissiveFactor": [0, 2, 4]}
    look, ignored = look_of(PBRMaterial(**cut, occlusionTexture=picture("L"), normalTexture=picture()))
    assert look["alpha_cutoff"] == 0.3 and look["opacity"]["channel"] == "a" and look["emission"] == [0, 2, 4]
    assert look["base_color"]["path"] is look["opacity"]["path"] and "normal_map" in look
    assert ignored == ("occlusionTexture",)


def test_simple_materials_follow_the_rules_of_mtl() -> None:
    look, _ = look_of(SimpleMaterial(diffuse=[51, 102, 153, 255]))
    assert look == {"type": "diffuse", "reflectance": pytest.approx([0.2, 0.4, 0.6])}
    look, _ = look_of(SimpleMaterial(image=picture()))  # trimesh's own grey is no colour that was given
    assert look["type"] == "diffuse" and "scale" not in look["reflectance"]
    look, ignored = look_of(
        SimpleMaterial(specular=[255, 255, 255, 255], glossiness=30, diffuse=[0, 0, 0, 51], illum=["2"])
    )
    assert look["type"] == "principled" and look["roughness"] == pytest.approx((2 / 32) ** 0.25)
    assert look["opacity"] == pytest.approx(0.2) and ignored == ("illum",)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "I;16"])
def test_pictures_keep_their_values(mode: str) -> None:
    image = Image.fromarray(np.arange(30, dtype=np.uint16).reshape(6, 5) * 2000) if mode == "I;16" else picture(mode)
    look, _ = look_of(PBRMaterial(baseColorTexture=image))
    values = read_texels(look["base_color"]["path"]).values
    plain = image.convert("RGB") if mode == "P" else image
    white = {"1": 1, "I;16": 65535}.get(mode, 255)
    assert np.allclose(values.squeeze(), np.asarray(plain, np.float64) / white)


def test_equal_pictures_are_one_and_others_are_not() -> None:
    scene = trimesh.Scene()
    for number, seed in enumerate((1, 1, 2)):
        scene.add_geometry(square(PBRMaterial(name="same name", baseColorTexture=picture(seed=seed))), f"s{number}")
    built = torchpt.from_trimesh(scene, device="cpu").params
    textures = {name: value for name, value in built.items() if "texture" in name.lower()}
    assert len({value.numpy().tobytes() for value in textures.values()}) == 2


def test_several_materials_are_several_parts() -> None:
    mesh = square(trimesh.visual.material.MultiMaterial([PBRMaterial(metallicFactor=0.0), SimpleMaterial()]))
    mesh.visual.face_materials = [1, 0]
    first, second = parts_of(mesh)
    assert len(first.faces) == len(second.faces) == 1
    assert (first.material.model.name, second.material.model.name) == ("principled", "diffuse")


def broken() -> Image.Image:
    picture().save(data := io.BytesIO(), "PNG")
    return Image.open(io.BytesIO(data.getvalue()[:60]))


OBJECT_ERRORS: dict[str, tuple[Callable[[], Any], str]] = {
    "no face": (lambda: trimesh.Trimesh(), "trimesh: the mesh is empty"),
    "an empty scene": (lambda: trimesh.Scene(), "trimesh: the mesh is empty"),
    "not finite": (lambda: trimesh.Trimesh([[0, 0, np.nan]] * 3, [[0, 1, 2]], process=False), "vertex 0 is not finite"),
    "an index": (lambda: trimesh.Trimesh(np.eye(3), [[0, 1, 7]], process=False), "outside 0..2"),
    "colours": (lambda: square(PBRMaterial(baseColorTexture=picture("CMYK"))), "stored as CMYK are not read"),
    "a broken picture": (lambda: square(PBRMaterial(baseColorTexture=broken())), "baseColorTexture cannot be read"),
    "points": (lambda: trimesh.PointCloud(np.eye(3)), "expected a trimesh.Trimesh or trimesh.Scene, got PointCloud"),
}


@pytest.mark.parametrize("name", OBJECT_ERRORS)
def test_what_is_wrong_with_an_object(name: str) -> None:
    make, said = OBJECT_ERRORS[name]
    with pytest.raises(AssetError) as caught:
        parts_of(make())
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"mesh": "bunny"}, r"shapes.a.mesh: expected a trimesh.Trimesh or trimesh.Scene \(an object of Python"),
        ({"mesh": BALL, "path": "a.off"}, "either path or mesh"),
        ({"mesh": BALL, "vertices": [[0, 0, 0]]}, "either mesh or an inline mesh"),
    ],
)
def test_the_parameter_mesh(keys: dict[str, Any], said: str) -> None:
    with pytest.raises(SceneError, match=said):
        torchpt.load({"camera": {"origin": [0, 0, 1], "target": [0, 0, 0]}, "shapes": {"a": {"type": "mesh", **keys}}})


# --- scenes


def world() -> Any:
    """A floor with a picture, three balls of one geometry (one mirrored and stretched), a box of coloured corners, a lamp."""
    scene = trimesh.Scene()
    floor = square(PBRMaterial(name="floor", baseColorTexture=picture(), roughnessFactor=0.6, metallicFactor=0.0))
    turn = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    scene.add_geometry(floor, "floor", transform=np.diag([4, 4, 4, 1]) @ turn @ _moved(-0.5, -0.5, 0))
    ball = BALL.copy()
    ball.vertex_normals = ball.vertices
    gold = PBRMaterial(name="gold", baseColorFactor=[255, 190, 80, 255], roughnessFactor=0.5, metallicFactor=1.0)
    ball.visual = TextureVisuals(uv=ball.vertices[:, :2], material=gold)
    scene.add_geometry(ball, "ball0", geom_name="ball", transform=_moved(-1, 0.5, 0) @ np.diag([0.5, 0.5, 0.5, 1]))
    scene.graph.update("ball1", geometry="ball", matrix=_moved(0, 0.4, 0.8) @ np.diag([0.4, 0.4, 0.4, 1]))
    scene.graph.update("ball2", geometry="ball", matrix=_moved(1, 0.6, 0) @ np.diag([-0.3, 0.6, 0.3, 1]))
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    box.visual.vertex_colors = np.random.default_rng(0).integers(0, 256, (8, 4), dtype=np.uint8)
    scene.add_geometry(box, "box", transform=_moved(0, 0.25, -0.8))
    scene.lights = [Lighting.PointLight(name="lamp", color=[255, 255, 128, 255], intensity=60.0)]
    scene.graph["lamp"] = _moved(1, 4, 3)
    scene.camera = trimesh.scene.Camera(name="eye", resolution=(24, 18), fov=(50, 38))
    scene.graph["eye"] = trimesh.transformations.rotation_matrix(-0.5, [1, 0, 0], [0, 0, 0]) @ _moved(0, 0, 4.5)
    return scene


def _moved(x: float, y: float, z: float) -> np.ndarray:
    return trimesh.transformations.translation_matrix([x, y, z])


def test_a_scene_and_its_gltf_file_are_one_picture(tmp_path: Path) -> None:
    described = description_of(world())
    kinds = {name: (shape["type"], shape.get("of")) for name, shape in described["shapes"].items()}
    mesh = ("mesh", None)
    assert kinds == {
        "floor": mesh,
        "ball0": mesh,
        "ball1": ("instance", "ball0"),
        "ball2": ("instance", "ball0"),
        "box": mesh,
    }
    assert described["lights"] == {
        "lamp": {"type": "point", "position": [1.0, 4.0, 3.0], "intensity": (60.0, 60.0, pytest.approx(60 * 128 / 255))}
    }
    image = torchpt.render(torchpt.from_trimesh(world(), device="cpu"), spp=4, integrator="direct", compile="off")
    assert image.shape == (18, 24, 3) and 0.02 < image.mean() < 2
    (tmp_path / "a.glb").write_bytes(world().export(file_type="glb", include_normals=True))
    file = torchpt.load({**described, "shapes": {"all": {"type": "mesh", "path": str(tmp_path / "a.glb")}}}, "cpu")
    other = torchpt.render(file, spp=4, integrator="direct", compile="off")
    # Corners are float32 in the file: paths at edges may go another way.
    assert (image - other).abs().mean() < 2e-3 * image.mean()
    assert ((image - other).abs() > 1e-3 * image.mean()).float().mean() < 0.02


def test_rays_hit_what_they_hit_in_trimesh() -> None:
    pytest.importorskip("embreex", reason="trimesh traces rays by embreex (extra `bench`)")
    source = world()
    scene = torchpt.from_trimesh(source, device="cpu")
    rng = np.random.default_rng(1)
    origins = rng.normal(size=(4000, 3)) * 3
    aims = rng.uniform((-2, 0, -2), (2, 1, 2), (4000, 3)) - origins
    aims /= np.linalg.norm(aims, axis=1, keepdims=True)
    places, rays, _ = source.to_mesh().ray.intersects_location(origins, aims, multiple_hits=False)
    expected = np.full(4000, np.inf)
    expected[rays] = np.linalg.norm(places - origins[rays], axis=1)
    o, d = (torch.from_numpy(np.ascontiguousarray(rows.T, np.float32)) for rows in (origins, aims))
    t = scene.accel("auto", None).intersect(o, d, torch.full((4000,), torch.inf))[0].numpy()
    assert 0.3 < np.isfinite(expected).mean() < 1
    agree = np.isclose(t, expected, rtol=1e-4) | (np.isinf(t) & np.isinf(expected))
    assert agree.mean() > 0.999  # but for edges


def test_the_camera_shows_where_trimeshs_rays_go() -> None:
    source = world()
    scene = torchpt.from_trimesh(source, device="cpu")
    origins, directions, pixels = source.camera_rays()
    pose = scene.params["camera.to_world"].double().numpy()
    assert np.allclose(pose[:3, 3], origins[0], atol=1e-6)
    assert np.allclose(pose[:3, 2], -source.camera_transform[:3, 2], atol=1e-6)
    assert np.allclose(pose[:3, 0], -source.camera_transform[:3, 0], atol=1e-6)
    # Pixels that are no squares, as trimesh has them: its rays through their middles are OpenCV's.
    ahead = directions @ source.camera_transform[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    places = (ahead / ahead[:, 2:]) @ scene.pinhole(dtype=torch.float64).K.numpy().T
    rows = 17 - pixels[:, 1]  # it counts them from the bottom
    assert np.allclose(places[:, :2], np.stack((pixels[:, 0], rows), axis=1) + 0.5, atol=1e-4)


def test_spots_and_suns() -> None:
    source = trimesh.Scene(BALL)
    source.lights = [
        Lighting.SpotLight(name="spot", color=[255, 0, 0, 255], intensity=2, innerConeAngle=0.2, outerConeAngle=0.5),
        Lighting.DirectionalLight(name="sun", color=[255, 255, 255, 255], intensity=3, radius=2.0),
    ]
    source.graph["spot"] = _moved(0, 0, 5)
    source.graph["sun"] = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    lights = description_of(source)["lights"]
    assert lights["spot"]["target"] == pytest.approx([0, 0, 0]) and lights["spot"]["intensity"] == (2, 0, 0)
    assert lights["spot"]["cutoff_angle"] == pytest.approx(np.degrees(0.5))
    assert lights["sun"]["direction"] == pytest.approx([0, -1, 0], abs=1e-12) and lights["sun"]["irradiance"] == (
        3,
        3,
        3,
    )
    assert len(torchpt.from_trimesh(source, device="cpu").built.sources) == 2
    # As the mesh of a shape the lights come with it, as those of a glTF file.
    made = {"camera": {"origin": [0, 0, 9], "target": [0, 0, 0]}, "shapes": {"all": {"type": "mesh", "mesh": source}}}
    built = torchpt.load(made, "cpu").built
    assert [each.name for each in built.sources] == ["shapes.all.lights.spot", "shapes.all.lights.sun"]
    assert "KHR_lights_punctual.range" in built.parts[0].ignored


def test_a_light_without_a_place() -> None:
    source = trimesh.Scene(BALL)
    source.lights = [Lighting.PointLight(name="lamp")]
    with pytest.raises(AssetError, match="the light 'lamp' has no place"):
        torchpt.from_trimesh(source)


def test_where_nothing_shines_the_sky_does() -> None:
    scene = torchpt.from_trimesh(BALL, film=SMALL, device="cpu")
    image = torchpt.render(scene, spp=4, compile="off")
    assert image[0, 0, 0] == 1.0 and image[9, 12, 0] == pytest.approx(0.5, abs=0.1)
    assert (image[:, [0, -1]] == 1).all() and (image[[0, -1]] == 1).all()  # all of it is seen
    glowing = square(PBRMaterial(emissiveFactor=[1, 2, 3], baseColorFactor=[0, 0, 0, 255]))
    assert "lights" not in description_of(glowing)


def test_blocks_stand_in_place_of_the_objects_own() -> None:
    camera = {"type": "orthographic", "origin": [0, 0, 9], "target": [0, 0, 0], "width": 3}
    lights = {"sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": 1}}
    scene = torchpt.from_trimesh(
        world(),
        camera=camera,
        lights=lights,
        film=SMALL,
        integrator={"type": "direct"},
        render={"spp": 1},
        device="cpu",
    )
    assert "camera.width" in scene.params and "lights.sun.irradiance" in scene.params and len(scene.built.sources) == 1
    assert torchpt.render(scene, compile="off").shape == (18, 24, 3)
    assert torchpt.from_trimesh(world(), film={"width": 8}, device="cpu").description.film == {"width": 8, "height": 6}


def test_what_cannot_be_an_instance_is_a_mesh_again() -> None:
    source = trimesh.Scene()
    source.add_geometry(square(PBRMaterial(emissiveFactor=[1, 1, 1])), "a.b", geom_name="tile")
    source.graph.update("c", geometry="tile", matrix=_moved(2, 0, 0))
    shapes = description_of(source)["shapes"]
    assert {name: shape["type"] for name, shape in shapes.items()} == {"a_b": "mesh", "c": "mesh"}
    assert len(torchpt.from_trimesh(source, device="cpu").built.parts) == 2


def test_points_and_paths_are_left_out_and_named() -> None:
    source = trimesh.Scene([BALL, trimesh.PointCloud(np.eye(3))])
    assert len(description_of(source)["shapes"]) == 1
    (part,) = parts_of(source)
    assert any("PointCloud" in name for name in part.ignored)
    with pytest.raises(AssetError, match="the scene is empty"):
        torchpt.from_trimesh(trimesh.Scene(trimesh.PointCloud(np.eye(3))))
    with pytest.raises(AssetError, match="got int"):
        torchpt.from_trimesh(3)


def test_pictures_have_a_label_and_a_kind() -> None:
    look, _ = look_of(PBRMaterial(baseColorTexture=picture()))
    assert isinstance(look["base_color"]["path"], EncodedImage) and look["base_color"]["path"].kind == "png"
