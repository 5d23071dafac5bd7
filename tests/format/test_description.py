"""The schema: what a scene may say, and one line for each way to say it wrong."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchpt.core.errors import AssetError, NotBuiltError, SceneError
from torchpt.core.files import configs
from torchpt.scene.build import build_parts
from torchpt.scene.formats.cameras import read_camera
from torchpt.scene.formats.description import read_description, scene_names, settings
from torchpt.spec.schema import ParsedParams

CAMERA = {"origin": [0, 0, 5], "target": [0, 0, 0]}
TRIANGLE = {"type": "mesh", "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]]}


def scene(**blocks: Any) -> dict[str, Any]:
    return {"camera": dict(CAMERA), **blocks}


def shape(**keys: Any) -> dict[str, Any]:
    return scene(shapes={"s": keys})


def material(**keys: Any) -> dict[str, Any]:
    return scene(materials={"m": {"type": "diffuse", **keys}})


def camera(**keys: Any) -> dict[str, Any]:
    return {"camera": {**CAMERA, **keys}}


def thinlens(**keys: Any) -> dict[str, Any]:
    return camera(**{"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2, **keys})


def mesh(**keys: Any) -> dict[str, Any]:
    return shape(**{**deepcopy(TRIANGLE), **keys})


BAD: dict[str, tuple[dict[str, Any], str, str]] = {  # name -> scene, key, part of the message
    "no camera": ({}, "camera", "every scene needs one"),
    "unknown block": (scene(shape={}), "shape", "shapes"),
    "unknown key": (material(reflectence=1), "materials.m.reflectence", "did you mean reflectance?"),
    "unknown key names the known": (camera(fow=40), "camera.fow", "origin, target, up, to_world"),
    "unknown material type": (scene(materials={"m": {"type": "difuse"}}), "materials.m.type", "roughconductor"),
    "unknown shape type": (shape(type="torus"), "shapes.s.type", "mesh, sphere, rectangle, disk, cube"),
    "unknown light type": (scene(lights={"l": {"type": "sun"}}), "lights.l.type", "constant"),
    "no type": (shape(radius=1), "shapes.s.type", "mesh"),
    "unknown texture type": (material(reflectance={"type": "wood"}), "materials.m.reflectance.type", "checkerboard"),
    "block is no mapping": (scene(materials=[1]), "materials", "mapping"),
    "version": (scene(version=2), "version", "1"),
    "colour of two": (material(reflectance=[1, 2]), "materials.m.reflectance", "[r, g, b]"),
    "reflectance above 1": (material(reflectance=1.7), "materials.m.reflectance", "0..1"),
    "negative radiance": (scene(lights={"l": {"type": "constant", "radiance": -1}}), "lights.l.radiance", ">= 0"),
    "negative emission": (shape(type="disk", emission=[1, -1, 0]), "shapes.s.emission", ">= 0"),
    "boolean number": (shape(type="sphere", radius=True), "shapes.s.radius", "> 0"),
    "text number": (shape(type="sphere", radius="1"), "shapes.s.radius", "> 0"),
    "NaN number": (shape(type="sphere", radius=float("nan")), "shapes.s.radius", "> 0"),
    "huge integer": (shape(type="sphere", radius=10**400), "shapes.s.radius", "> 0"),
    "above float32": (shape(type="sphere", center=[1e39, 0, 0]), "shapes.s.center", "three finite"),
    "number flag": (shape(type="sphere", flip_normals=1), "shapes.s.flip_normals", "true or false"),
    "unknown material name": (shape(type="cube", material="m"), "shapes.s.material", "none is defined"),
    "inline material": (
        shape(type="cube", material={"type": "diffuse", "reflectance": 2}),
        "shapes.s.material.reflectance",
        "0..1",
    ),
    "NaN vertex": (mesh(vertices=[[0, 0, 0], [1, 0, 0], [0, float("nan"), 0]]), "shapes.s.vertices.2", "finite"),
    "ragged vertices": (mesh(vertices=[[0, 0, 0], [1, 0]]), "shapes.s.vertices.1", "[x, y, z]"),
    "text vertex": (mesh(vertices=[[0, 0, 0], ["1", 0, 0], [0, 1, 0]]), "shapes.s.vertices.1", "numbers"),
    "index out of range": (mesh(faces=[[0, 1, 2], [0, 1, 3]]), "shapes.s.faces.1", "0..2"),
    "negative index": (mesh(faces=[[0, 1, -1]]), "shapes.s.faces.0", "0..2"),
    "fractional index": (mesh(faces=[[0, 1, 1.5]]), "shapes.s.faces.0", "whole numbers"),
    "two-cornered face": (mesh(faces=[[0, 1]]), "shapes.s.faces.0", "three or more"),
    "no face": (mesh(faces=[]), "shapes.s.faces", "three or more"),
    "no vertices": (shape(type="mesh", faces=[[0, 1, 2]]), "shapes.s.vertices", "vertices and faces"),
    "empty mesh": (shape(type="mesh"), "shapes.s.path", "vertices and faces"),
    "path and vertices": (mesh(path="a.ply"), "shapes.s.vertices", "not both"),
    "normals of another size": (mesh(normals=[[0, 0, 1]]), "shapes.s.normals", "each of the 3 vertices"),
    "useless normals": (mesh(normals=[[0, 0, 1]] * 3, face_normals=True), "shapes.s.normals", "face_normals"),
    "bad path": (shape(type="mesh", path=3), "shapes.s.path", "file path"),
    "zero scale": (shape(type="cube", transform=[{"scale": [1, 0, 1]}]), "shapes.s.transform.0.scale", "non-zero"),
    "singular matrix": (
        shape(type="cube", transform=[{"matrix": [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]),
        "shapes.s.transform.0.matrix",
        "inverse",
    ),
    "projective matrix": (
        shape(type="cube", transform=[{"matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]}]),
        "shapes.s.transform.0.matrix",
        "[0, 0, 0, 1]",
    ),
    "unknown operation": (shape(type="cube", transform=[{"shear": 1}]), "shapes.s.transform.0.shear", "translate"),
    "zero axis": (
        shape(type="cube", transform=[{"scale": 1}, {"rotate": {"axis": [0, 0, 0], "angle": 1}}]),
        "shapes.s.transform.1.rotate.axis",
        "non-zero",
    ),
    "cylinder without radius": (shape(type="cylinder", radius=0), "shapes.s.radius", "> 0"),
    "cylinder without height": (shape(type="cylinder", height=0), "shapes.s.height", "> 0"),
    "cylinder upside down": (shape(type="cylinder", height=-1), "shapes.s.height", "> 0"),
    "cone without height": (shape(type="cone", height=0), "shapes.s.height", "other than 0"),
    "cone without slope": (shape(type="cone", slope=0), "shapes.s.slope", "> 0"),
    "cone of NaN": (shape(type="cone", height=float("nan")), "shapes.s.height", "other than 0"),
    "origin is target": (camera(target=[0, 0, 5]), "camera.target", "other than the origin"),
    "up along the view": (camera(up=[0, 0, 2]), "camera.up", "parallel"),
    "no target": ({"camera": {"origin": [0, 0, 1]}}, "camera.target", "to_world"),
    "two poses": (camera(to_world=np.eye(4).tolist()), "camera.origin", "not both"),
    "scaled pose": ({"camera": {"to_world": np.diag([2, 2, 2, 1]).tolist()}}, "camera.to_world", "scale"),
    "fov": (camera(fov=180), "camera.fov", "> 0 and < 180"),
    "fov axis": (camera(fov_axis="z"), "camera.fov_axis", "smaller"),
    "thin lens without a focus": (camera(type="thinlens", aperture_radius=0.1), "camera.focus_distance", "required"),
    "thin lens without a size": (camera(type="thinlens", focus_distance=1), "camera.aperture_radius", "required"),
    "focus in the lens": (thinlens(focus_distance=0), "camera.focus_distance", "> 0"),
    "focus below float32": (thinlens(focus_distance=1e-50), "camera.focus_distance", "> 0"),
    "negative aperture": (thinlens(aperture_radius=-0.1), "camera.aperture_radius", ">= 0"),
    "two blades": (thinlens(blades=2), "camera.blades", "3..64 or 0"),
    "half a blade": (thinlens(blades=6.5), "camera.blades", "3..64 or 0"),
    "a pinhole's aperture": (camera(aperture_radius=0), "camera.aperture_radius", "belongs to thinlens"),
    "a pinhole's width": (camera(width=1), "camera.width", "belongs to orthographic"),
    "parallel rays at an angle": (
        camera(type="orthographic", fov=40),
        "camera.fov",
        "belongs to perspective, thinlens",
    ),
    "orthographic without width": (camera(type="orthographic", width=0), "camera.width", "> 0"),
    "orthographic sized by its pose": (
        {"camera": {"type": "orthographic", "to_world": np.diag([2, 2, 2, 1]).tolist()}},
        "camera.to_world",
        "sized by width",
    ),
    "camera type": (camera(type="fisheye"), "camera.type", "perspective, thinlens, orthographic"),
    "_target_ at the top": (scene(_target_="os.system"), "_target_", "Python objects"),
    "_target_ inside": (shape(type="cube", transform=[{"_target_": 1}]), "shapes.s.transform.0._target_", "Python"),
    "odd name": (scene(materials={"a\nb": {"type": "diffuse"}}), "materials", "printable"),
    "spp": (scene(render={"spp": 0}), "render.spp", "1.."),
    "film": (scene(film={"width": 1.5}), "film.width", "whole number"),
    "crop": (scene(film={"crop": [500, 0, 100, 1]}), "film.crop", "inside the film"),
    "filter": (scene(film={"filter": {"type": "box", "radius": 1}}), "film.filter.radius", "box"),
    "aov": (scene(film={"aovs": ["depth", "colour"]}), "film.aovs.1", "object_id"),
    "another integrator's key": (
        scene(integrator={"type": "direct", "max_depth": 3}),
        "integrator.max_depth",
        "belongs to path",
    ),
    "endless": (scene(integrator={"max_depth": -1, "rr_prob": 1}), "integrator.rr_prob", "below 1"),
    "device": (scene(render={"device": "tpu"}), "render.device", "cuda:N"),
    "memory": (scene(render={"max_memory": "much"}), "render.max_memory", "4GB"),
    "memory beyond float64": (scene(render={"max_memory": "9" * 400}), "render.max_memory", "4GB"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line_that_names_the_key(name: str) -> None:
    source, key, part = BAD[name]
    with pytest.raises(SceneError) as caught:
        build_parts(read_description(source))
    assert not isinstance(caught.value, NotBuiltError)
    assert caught.value.key == key
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "suggested"),
    [
        ("{}/rom.yaml", "{}/room.yaml"),
        ("{}/room.yml", "{}/room.yaml"),
        ("{}/cornel_box.yaml", "cornell_box"),
        ("{}/away/cornel_box.yaml", "cornell_box"),
        ("cornel_box", "cornell_box"),
        ("room", "room.yaml"),
    ],
)
def test_a_misspelt_scene_gets_a_suggestion(
    name: str, suggested: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "room.yaml").write_text("{}")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError) as caught:
        read_description(name.format(tmp_path))
    assert f"(did you mean {suggested.format(tmp_path)}?)" in str(caught.value)


def test_values_that_ask_for_nothing_are_no_error() -> None:
    nothing = {"adaptive": False}, {"resume": False, "time_limit": None}
    found = read_description(
        material(opacity=1, emission=0, normal_map=None, bump_map=None) | {"sampler": nothing[0], "render": nothing[1]}
    )
    assert len(found.materials) == 1


def test_a_whole_scene() -> None:
    found = read_description(
        scene(
            version=1,
            materials={"red": {"type": "diffuse", "reflectance": [0.6, 0.1, 0.1], "two_sided": False}},
            shapes={
                "tri": {**TRIANGLE, "material": "red"},
                "ball": {"type": "sphere", "center": [1, 2, 3], "radius": 2, "material": {"type": "diffuse"}},
                "lamp": {"type": "rectangle", "emission": 3, "transform": [{"translate": [0, 5, 0]}]},
            },
            lights={"sky": {"type": "constant", "radiance": [1, 2, 3]}},
        )
    )
    assert found.version == 1 and found.file is None
    assert list(found.shapes) == ["tri", "ball", "lamp"]
    ball, tri = found.shapes["ball"], found.shapes["tri"]
    assert ball.name == "sphere" and ball["radius"] == 2 and isinstance(ball["material"], ParsedParams)
    assert ball["material"].name == "diffuse"
    assert tri.name == "mesh" and tri["faces"].dtype == np.int64 and tri["material"] == "red"
    lamp = found.shapes["lamp"]
    assert lamp["emission"] == (3, 3, 3)
    assert lamp.kind.to_world(lamp.values)[1, 3] == 5
    assert not found.materials["red"]["two_sided"]
    assert found.lights["sky"].values == {"radiance": (1, 2, 3)}


def test_polygons_become_fans() -> None:
    square = read_description(mesh(vertices=[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], faces=[[0, 1, 2, 3]]))
    part = square.shapes["s"]
    assert part["faces"].tolist() == [[0, 1, 2], [0, 2, 3]]


def test_arrays_are_accepted() -> None:
    part = read_description(mesh(vertices=np.eye(3, dtype=np.float32), faces=np.array([[0, 1, 2]]))).shapes["s"]
    assert part["vertices"].dtype == np.float64


@pytest.mark.mitsuba
def test_pose_is_mitsubas_look_at() -> None:
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    pose = read_camera({"origin": [1, 2, 3], "target": [4, 5, 7]}, {}, None)["to_world"]
    oracle = mi.ScalarTransform4f().look_at(origin=[1, 2, 3], target=[4, 5, 7], up=[0, 1, 0])
    np.testing.assert_allclose(pose, np.array(oracle.matrix), atol=1e-6)


@pytest.mark.parametrize("name", scene_names())
def test_shipped_scenes_need_no_assets(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCHPT_ASSETS", raising=False)
    found = read_description(name)
    settings(found)
    for key, part in found.shapes.items():
        if part.values.get("path") is not None:
            assert found.resolve(part["path"], f"shapes.{key}.path").is_file()
    first = (configs() / "scene" / f"{name}.yaml").read_text().splitlines()[0]
    assert first.startswith(f"# torchpt render scene={name} ")


def test_shipped_scenes_are_there() -> None:
    wanted = "cornell_box cornell_bunny cornell_spheres games101 games101_bunny games101_spheres"
    assert set(wanted.split()) <= set(scene_names())


def test_unknown_scene_names_the_known() -> None:
    with pytest.raises(SceneError, match=r"cornell_box.*\.yaml or \.xml, got 'cornel_box'"):
        read_description("cornel_box")


def test_missing_scene_file(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="No such file") as caught:
        read_description(tmp_path / "a.yaml")
    assert "\n" not in str(caught.value)


def test_resolve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my scene.yaml").write_text("camera: {origin: [0, 0, 1], target: [0, 0, 0]}\n")
    (tmp_path / "a b.ply").write_text("")
    assets = tmp_path / "assets"
    assets.mkdir()
    (assets / "c.ply").write_text("")
    found = read_description(str(tmp_path / "my scene.yaml"))
    monkeypatch.delenv("TORCHPT_ASSETS", raising=False)
    assert found.resolve("a b.ply", "k").samefile(tmp_path / "a b.ply")
    assert found.resolve(("$TORCHPT_ASSETS/c.ply", "a b.ply"), "k").name == "a b.ply"
    with pytest.raises(SceneError, match=r"TORCHPT_ASSETS is not set") as unset:
        found.resolve("$TORCHPT_ASSETS/c.ply", "shapes.s.path")
    assert unset.value.key == "shapes.s.path"
    monkeypatch.setenv("TORCHPT_ASSETS", str(assets))
    assert found.resolve(("$TORCHPT_ASSETS/c.ply", "a b.ply"), "k").name == "c.ply"
    with pytest.raises(AssetError, match=r"no such file, named by shapes\.s\.path"):
        found.resolve("d.ply", "shapes.s.path")
    with pytest.raises(AssetError, match="only .TORCHPT_ASSETS is expanded"):
        found.resolve("$HOME/d.ply", "shapes.s.path")
    with pytest.raises(AssetError, match="is a folder"):
        found.resolve("assets", "k")
