"""Scenes of Mitsuba as people publish them: mirrored and flat poses, odd spots, files that Mitsuba opens and are not tidy."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mitsuba_corpus import scene
from mitsuba_values import agreements

import torchpt
from torchpt.core.errors import ImportedSceneWarning, SceneError
from torchpt.scene.formats.mitsuba import ImportOptions, read_mitsuba

_MESH = "v -1 0 -1\nv 1 0 -1\nv 1 0.5 1\nv -1 0.5 1\n{}"
#: Files of meshes: without normals, and with.
_FILES = {
    "plain.obj": _MESH.format("f 1 2 3\nf 1 3 4\n"),
    "smooth.obj": _MESH.format("vn 0 1 0.2\nvn 0.1 1 0\nf 1//1 2//2 3//1\nf 1//1 3//1 4//2\n"),
}
_LOOK = '<transform name="to_world"><lookat origin="{}" target="{}"{}/></transform>'
_AREA = '<emitter type="area"><rgb name="radiance" value="3 2 1"/></emitter>'


def write(folder: Path, text: str) -> Path:
    for name, mesh in _FILES.items():
        (folder / name).write_text(mesh)
    (folder / "scene.xml").write_text(text)
    return folder / "scene.xml"


def read(folder: Path, text: str) -> tuple[dict[str, Any], str]:
    """Return a scene and the warnings about it; it loads too."""
    file = write(folder, text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_mitsuba(file, "scene.xml", ImportOptions())
        torchpt.load(str(file), "cpu")
    assert all(warning.category is ImportedSceneWarning for warning in caught)
    return found, "\n".join(str(warning.message) for warning in caught)


def posed(type: str, pose: str, inside: str = "") -> str:
    return f'<shape type="{type}">{inside}<transform name="to_world">{pose}</transform></shape>'


def matrix(block: dict[str, Any]) -> np.ndarray:
    return np.array(block["transform"][0]["matrix"])


# ---- Mirrored poses

_OBJ = '<string name="filename" value="{}.obj"/>'
_SHAPES = {
    "sphere": ("sphere", '<float name="radius" value="0.7"/><point name="center" x="0.1" y="0.2" z="0"/>'),
    "rectangle": ("rectangle", ""),
    "disk": ("disk", ""),
    "cylinder": ("cylinder", ""),
    "cube": ("cube", ""),
    "plain mesh": ("obj", _OBJ.format("plain")),
    "smooth mesh": ("obj", _OBJ.format("smooth")),
    "faces": ("obj", _OBJ.format("smooth") + '<boolean name="face_normals" value="true"/>'),
}


@pytest.mark.mitsuba
@pytest.mark.parametrize("shape", _SHAPES)
@pytest.mark.parametrize("flipped", [False, True])
def test_mirrored_shapes_shine_where_mitsubas_do(tmp_path: Path, shape: str, flipped: bool) -> None:
    """Mitsuba turns mirrored spheres inside out, and meshes whose normals are those of their faces."""
    type, inside = _SHAPES[shape]
    inside += '<boolean name="flip_normals" value="true"/>' * flipped + _AREA
    pose = '<scale x="-1"/><rotate x="0.6" y="0.8" angle="-70"/><translate y="0.8"/>'
    found = agreements(write(tmp_path, scene(posed(type, pose, inside))), 300)
    assert found["emission"].count > 5 or shape in ("sphere", "cube", "cylinder")
    # Mitsuba decides by the interpolated normal which side of a smooth mesh shines.
    assert found["emission"].off <= (0.15 if shape == "smooth mesh" else 0.01), found


@pytest.mark.mitsuba
@pytest.mark.parametrize("shape", ["sphere", "plain mesh", "faces"])
@pytest.mark.parametrize("own", ["", '<scale z="-1"/>'])
@pytest.mark.parametrize("outer", ["", '<scale x="-1"/>'])
def test_mirrors_of_instances_leave_the_sides(tmp_path: Path, shape: str, own: str, outer: str) -> None:
    """Only the mirror of the shape itself turns normals round, not that of the instance."""
    type, inside = _SHAPES[shape]
    body = f'<bsdf type="diffuse"/><transform name="to_world">{own}<rotate x="1" angle="30"/></transform>'
    text = f'<shape type="shapegroup" id="g"><shape type="{type}">{inside}{body}</shape></shape>'
    for x in (-1, 1):
        text += posed("instance", f'{outer}<scale value="0.6"/><translate x="{x}" y="0.8"/>', '<ref id="g"/>')
    found = agreements(write(tmp_path, scene(text)), 300)
    assert found["value"].count > 5 or (shape == "sphere" and own)
    assert found["hit"].off <= 0.01 and found["value"].off <= 0.01, found


def test_mirrored_spheres_before_version_2_keep_their_sides(tmp_path: Path) -> None:
    """Mitsuba 0.6 took the length of the x axis alone."""
    body = '<shape type="sphere"><transform name="{}"><scale x="-1"/></transform></shape>'
    assert read(tmp_path, scene(body.format("to_world")))[0]["shapes"]["sphere_1"]["flip_normals"] is True
    assert "flip_normals" not in read(tmp_path, scene(body.format("toWorld"), "0.6.0"))[0]["shapes"]["sphere_1"]


def test_a_negative_radius_turns_a_sphere_inside_out(tmp_path: Path) -> None:
    found, said = read(tmp_path, scene('<shape type="sphere"><float name="radius" value="-2"/></shape>'))
    assert found["shapes"]["sphere_1"]["flip_normals"] is True and found["shapes"]["sphere_1"]["radius"] == 2.0
    assert not said


@pytest.mark.mitsuba
@pytest.mark.parametrize("size", ['x="0.5" y="1.4" z="0.9"', 'x="-0.5" y="1.4" z="0.9"'])
def test_stretched_spheres_stay_spheres_as_in_mitsuba(tmp_path: Path, size: str) -> None:
    pose = f'<rotate z="1" angle="20"/><scale {size}/><rotate x="1" angle="50"/><translate y="0.9"/>'
    body = posed("sphere", pose, '<float name="radius" value="1.1"/><point name="center" x="0.1" y="0" z="0.2"/>')
    assert "a stretched sphere stays one" in read(tmp_path, scene(body))[1]
    assert agreements(tmp_path / "scene.xml", 300)["hit"].off <= 0.01


# ---- Poses without an inverse, odd matrices


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (posed("sphere", '<scale value="0"/>'), "its to_world leaves it no area"),
        (posed("sphere", '<scale x="0"/>'), "its to_world leaves it no area"),
        (posed("rectangle", '<scale x="0"/>'), "its to_world leaves it no area"),
        (posed("obj", '<scale x="0" y="0"/>', _OBJ.format("plain")), "its to_world leaves it no area"),
        ('<shape type="sphere"><float name="radius" value="0"/></shape>', "its radius is not above 0"),
        ('<shape type="cylinder"><float name="radius" value="0"/></shape>', "its length or its radius is not above 0"),
        ('<emitter type="spot"><transform name="to_world"><scale value="0"/></transform></emitter>', "no direction"),
        ('<emitter type="directional"><vector name="direction" x="0" y="0" z="0"/></emitter>', "no direction"),
        ('<emitter type="spot"><float name="cutoff_angle" value="0"/></emitter>', "its cutoff_angle is not above 0"),
        (
            '<shape type="shapegroup" id="g"><shape type="cube"/></shape>'
            + posed("instance", '<scale x="0"/>', '<ref id="g"/>'),
            "its to_world cannot be inverted",
        ),
    ],
)
def test_what_has_no_extent_is_left_out(tmp_path: Path, body: str, words: str) -> None:
    found, said = read(tmp_path, scene(body))
    assert f"it is left out: {words}" in said or f"left out: it has {words}" in said
    assert not found.get("shapes") and not found.get("lights")


@pytest.mark.parametrize("type", ["cube", "obj"])
def test_flattened_solids_keep_a_little_thickness(tmp_path: Path, type: str) -> None:
    body = posed(type, '<scale x="2" y="2" z="0"/>', _OBJ.format("plain") * (type == "obj"))
    found, said = read(tmp_path, scene(body))
    assert "a little thickness" in said
    assert np.allclose(np.linalg.svd(matrix(found["shapes"][f"{type}_1"])[:3, :3])[1], [2.0, 2.0, 2e-5])


def test_flattened_copies_are_left_out(tmp_path: Path) -> None:
    mesh = posed("obj", '<scale z="0"/>', _OBJ.format("plain"))
    body = f'<shape type="shapegroup" id="g">{mesh}</shape>'
    body += '<shape type="instance"><ref id="g"/></shape>' * 2
    found, said = read(tmp_path, scene(body))
    assert "a flattened copy is left out" in said and len(found["shapes"]) == 1


@pytest.mark.parametrize(("version", "divisor"), [("3.0.0", 1.0), ("0.6.0", 2.0)])
def test_last_rows_of_matrices(tmp_path: Path, version: str, divisor: float) -> None:
    """Mitsuba 0.6 divided by the last number, later versions take no notice; perspective is left out."""
    name = "to_world" if version >= "2" else "toWorld"
    body = '<shape type="cube"><transform name="{}"><matrix value="4 0 0 2 0 4 0 0 0 0 4 0 {} 2"/></transform></shape>'
    found, said = read(tmp_path, scene(body.format(name, "0 0 0"), version))
    assert not said
    expected = np.diag([4.0, 4.0, 4.0, divisor]) / divisor
    expected[0, 3] = 2.0 / divisor
    assert np.array_equal(matrix(found["shapes"]["cube_1"]), expected)
    assert "perspective becomes affine" in read(tmp_path, scene(body.format(name, "0 0 0.1"), version))[1]


# ---- Sensors


def camera(folder: Path, pose: str, type: str = "perspective", version: str = "3.0.0") -> tuple[np.ndarray, str]:
    """Return the pose ``(4, 4)`` of a sensor and the warnings about it."""
    fov = '<float name="fov" value="40"/>' if type == "perspective" else ""
    text = f'<scene version="{version}"><sensor type="{type}">{fov}{pose}</sensor><shape type="sphere"/></scene>'
    found, said = read(folder, text)
    return np.array(found["camera"]["to_world"]), said


@pytest.mark.mitsuba
@pytest.mark.parametrize("up", ["", ' up="0, 0, 0"'])
@pytest.mark.parametrize("origin", ["1, 5, 2", "0, 5, 0", "-3, 1, -2", "4, 0, 0"])
def test_up_that_is_not_given_is_mitsubas(tmp_path: Path, up: str, origin: str) -> None:
    from mitsuba_scene import load_mitsuba

    pose, _ = camera(tmp_path, _LOOK.format(origin, "0, 0, 0", up))
    theirs = load_mitsuba("scalar_rgb").load_file(str(tmp_path / "scene.xml")).sensors()[0].world_transform()
    assert np.allclose(pose, np.array(theirs.matrix), atol=1e-6)


def test_up_that_was_not_given_before_version_2(tmp_path: Path) -> None:
    """Mitsuba 0.6 took another direction across the view: ``cross((0, z, -y), view)`` of one along -y is along x."""
    look = _LOOK.format("0, 5, 0", "0, 0, 0", "").replace("to_world", "toWorld")
    assert np.allclose(camera(tmp_path, look, version="0.6.0")[0][:3, 1], [1.0, 0.0, 0.0])


def test_the_shear_of_a_sensor_is_left_out(tmp_path: Path) -> None:
    rows = "-1 0.02 0 0  0 1 0 0  0 0.01 1 -5  0 0 0 1"
    pose, said = camera(tmp_path, f'<transform name="to_world"><matrix value="{rows}"/></transform>')
    assert "the shear of to_world is left out" in said
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) and np.linalg.det(pose[:3, :3]) < 0.0
    assert np.allclose(pose[:3, 2], [0.0, 0.0, 1.0])


def test_the_depth_scale_of_an_orthographic_sensor_has_no_meaning(tmp_path: Path) -> None:
    pose = '<transform name="to_world"><scale x="2" y="2" z="0"/><translate z="-5"/></transform>'
    assert np.allclose(camera(tmp_path, pose, "orthographic")[0][:3, :3], np.eye(3))


def test_a_scene_without_a_sensor_is_seen_whole(tmp_path: Path) -> None:
    body = posed("cube", '<scale y="2"/><translate x="5"/>') + posed(
        "obj", '<scale value="0.1"/>', _OBJ.format("plain")
    )
    found, said = read(tmp_path, f'<scene version="0.6.0">{body.replace("to_world", "toWorld")}</scene>')
    distance = 6.1 / (2.0 * math.tan(math.radians(22.5)))
    assert "there is no sensor" in said and found["camera"]["fov"] == 45.0
    assert np.allclose(np.array(found["camera"]["to_world"])[:3, 3], [2.95, 0.0, -1.0 - distance])


# ---- Spots


@pytest.mark.mitsuba
@pytest.mark.parametrize(("cutoff", "beam"), [(20, 30), (20, 0)])
def test_beams_of_spots_are_mitsubas(tmp_path: Path, cutoff: float, beam: float) -> None:
    angles = f'<float name="cutoff_angle" value="{cutoff}"/><float name="beam_width" value="{beam}"/>'
    look = '<transform name="to_world"><lookat origin="0, 4, 1" target="0, 0, 0" up="0, 0, 1"/></transform>'
    lamp = f'<emitter type="spot">{angles}{look}</emitter>'
    found = agreements(write(tmp_path, scene('<shape type="sphere"/><shape type="rectangle"/>' + lamp)), 300)
    assert found["light"].count > 10 and found["light"].off <= 0.01, found


def test_a_cutoff_beyond_all_directions_is_all(tmp_path: Path) -> None:
    found, said = read(tmp_path, scene('<emitter type="spot"><float name="cutoff_angle" value="270"/></emitter>'))
    assert found["lights"]["spot_1"]["cutoff_angle"] == 180.0 and "above 180 becomes 180" in said


# ---- Files that Mitsuba opens


def test_document_types_without_entities_are_read(tmp_path: Path) -> None:
    found, said = read(tmp_path, "<!DOCTYPE scene>" + scene('<shape type="sphere"/>'))
    assert [shape["type"] for shape in found["shapes"].values()] == ["sphere"] and not said


def test_blanks_before_the_declaration_keep_lines(tmp_path: Path) -> None:
    text = '\n <?xml version="1.0" encoding="utf-8"?>' + scene('<shape type="sphere"/>')
    read(tmp_path, text)
    with pytest.raises(SceneError, match="line 12, ref: "):
        read(tmp_path, text.replace("</scene>", '<ref id="none"/></scene>').replace("<shape", "\n\n<shape"))


@pytest.mark.parametrize("version", ["3.0.0-alpha", " 2.1.0 ", "3.0.0a1"])
def test_versions_with_a_suffix(tmp_path: Path, version: str) -> None:
    found, said = read(tmp_path, scene('<shape type="sphere"/>').replace("3.0.0", version))
    assert [shape["type"] for shape in found["shapes"].values()] == ["sphere"] and not said


def test_properties_of_the_scene_are_left_out(tmp_path: Path) -> None:
    _, said = read(tmp_path, scene('<integer name="budget" value="3"/><shape type="sphere"/>'))
    assert "the property budget of the scene is left out" in said


def test_properties_given_twice_before_version_2(tmp_path: Path) -> None:
    """Mitsuba 0.6 took the last one, with a warning; it is an error today."""
    body = '<shape type="sphere"><float name="radius" value="1"/><float name="radius" value="2"/></shape>'
    found, said = read(tmp_path, scene(body, "0.6.0"))
    assert found["shapes"]["sphere_1"]["radius"] == 2.0 and "the last one is taken" in said
    with pytest.raises(SceneError, match="a property only once"):
        read(tmp_path, scene(body))


def test_names_of_plugins_in_any_case(tmp_path: Path) -> None:
    body = '<shape type="shapeGroup" id="g"><shape type="Sphere"/></shape>'
    found, said = read(tmp_path, scene(body + '<shape type="instance"><ref id="g"/></shape>'))
    assert [shape["type"] for shape in found["shapes"].values()] == ["sphere"] and not said


def test_a_sample_count_of_0_becomes_1(tmp_path: Path) -> None:
    found, said = read(tmp_path, scene('<shape type="sphere"/>').replace('value="16"', 'value="0"'))
    assert found["render"]["spp"] == 1 and "a sample_count below 1 becomes 1" in said
