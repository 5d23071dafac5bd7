"""Scenes of Mitsuba: elements, names of versions, values, references, files, plugins, warnings, errors."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mitsuba_corpus import EXACT, NEAREST, OLD, scene, write_assets
from PIL import Image

import torchpt
from torchpt.core.errors import AssetError, ImportedSceneWarning, SceneError
from torchpt.scene.formats.description import read_description
from torchpt.scene.formats.mitsuba import ImportOptions, read_mitsuba
from torchpt.scene.formats.mitsuba.bsdfs import BSDFS
from torchpt.scene.formats.mitsuba.importer import PLUGINS
from torchpt.scene.formats.mitsuba.plugins import Twin
from torchpt.scene.formats.mitsuba.versions import property_name
from torchpt.scene.formats.write import write_scene


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assets")
    write_assets(folder)
    return folder


def read(folder: Path, text: str, **options: Any) -> dict[str, Any]:
    """Return a scene without warnings about it."""
    file = folder / "scene.xml"
    file.write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ImportedSceneWarning)
        return read_mitsuba(file, "scene.xml", ImportOptions(**options))


def material(folder: Path, bsdf: str, version: str = "3.0.0") -> dict[str, Any]:
    """Return what a BSDF becomes."""
    return read(folder, scene(f'<shape type="sphere">{bsdf}</shape>', version))["shapes"]["sphere_1"]["material"]


def rgb(folder: Path, value: str) -> list[float]:
    """Return the colour of an element that stands as a reflectance."""
    return material(folder, f'<bsdf type="diffuse">{value}</bsdf>')["reflectance"]


def error(folder: Path, text: str, **options: Any) -> str:
    with pytest.raises((SceneError, AssetError)) as caught:
        read(folder, text, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---- All of the corpus


@pytest.mark.parametrize("name", EXACT)
def test_what_is_exact_gives_no_warning(assets: Path, name: str) -> None:
    file = assets / f"{name}.xml"
    file.write_text(EXACT[name])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        described = read_description(str(file))
    assert described.film["width"] == 32 and described.render["spp"] == 16
    assert read_description(str(file), overrides={"import.strict": True}).shapes.keys() == described.shapes.keys()


@pytest.mark.parametrize("name", OLD)
def test_old_versions_are_read_as_todays(assets: Path, name: str) -> None:
    old, new = (read(assets, text) for text in OLD[name])
    for block in ("shapes", "lights", "film", "camera"):
        assert _near(old.get(block), new.get(block)), block


def _near(a: Any, b: Any) -> bool:
    """Return True for nested values that are equal but for rounding."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_near(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_near, a, b))
    return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-12) if isinstance(a, float) else a == b


@pytest.mark.parametrize("name", NEAREST)
def test_what_is_not_exact_warns_with_its_line_and_is_an_error_where_strict(assets: Path, name: str) -> None:
    text, becomes, words = NEAREST[name]
    file = assets / "scene.xml"
    file.write_text(text)
    with pytest.warns(ImportedSceneWarning, match=r"scene\.xml:\d+: ") as caught:
        raw = read_mitsuba(file, "scene.xml", ImportOptions())
    assert any(words in str(warning.message) for warning in caught)
    found = [shape["material"]["type"] for shape in raw["shapes"].values() if isinstance(shape["material"], dict)]
    assert not becomes or becomes in found
    line = next(str(warning.message).split(":")[1] for warning in caught if words in str(warning.message))
    assert (
        f'type="{"ward" if name == "ward_diffuse" else {"phong_facets": "roughconductor"}.get(name, name)}"'
        in (text.splitlines()[int(line) - 1])
    )
    strict = error(assets, text, strict=True)
    assert strict.startswith("scene.xml: line ") and "import.strict" in strict


def test_warnings_of_one_kind_are_counted(assets: Path) -> None:
    text = scene('<shape type="sphere"><bsdf type="coating"><bsdf type="diffuse"/></bsdf></shape>\n' * 3)
    (assets / "scene.xml").write_text(text)
    with pytest.warns(ImportedSceneWarning) as caught:
        read_mitsuba(assets / "scene.xml", "scene.xml", ImportOptions())
    assert len(caught) == 1 and str(caught[0].message).endswith("(3 times)")
    assert str(caught[0].message).startswith('scene.xml:9: bsdf "coating" becomes plastic: ')


def test_every_entry_that_is_not_exact_says_what_differs() -> None:
    entries = [(tag, name, plugin) for tag, table in PLUGINS.items() for name, plugin in table.items()]
    assert len(entries) > 100
    for tag, name, plugin in entries:
        assert plugin.twin is Twin.EXACT or plugin.note, (tag, name)
        assert (plugin.twin is Twin.LEFT_OUT) == (plugin.becomes == "nothing"), (tag, name)
    covered = "".join(EXACT.values())
    for name, plugin in BSDFS.items():  # those of old versions alone are not in the corpus, as Mitsuba cannot open them
        assert (
            plugin.twin is not Twin.EXACT
            or f'type="{name}"' in covered
            or name in ("mixturebsdf", "phong", "roughdiffuse")
        ), name


# ---- Values


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ('<rgb name="reflectance" value="0.1, 0.2,0.3"/>', [0.1, 0.2, 0.3]),
        ('<rgb name="reflectance" value="1e-008 .2 3E-1"/>', [1e-8, 0.2, 0.3]),
        ('<rgb name="reflectance" value="0.4"/>', [0.4] * 3),
        ('<float name="reflectance" value="0.4"/>', [0.4] * 3),
        ('<spectrum name="reflectance" value="0.4"/>', [0.4] * 3),
        ('<srgb name="reflectance" value="#ff8000"/>', [1.0, 0.21586050, 0.0]),
        ('<rgb name="reflectance" value="#ff8000"/>', [1.0, 0.21586050, 0.0]),
        ('<srgb name="reflectance" value="0.5, 0.5, 0.04"/>', [0.21404114, 0.21404114, 0.04 / 12.92]),
        ('<spectrum name="reflectance" value="360:1, 830:1"/>', [1.0] * 3),
    ],
)
def test_colours(assets: Path, value: str, expected: list[float]) -> None:
    assert rgb(assets, value) == pytest.approx(expected, abs=3e-4 if "360" in value else 1e-7)


def test_spectra_are_seen_as_by_mitsuba(assets: Path) -> None:
    # Of Mitsuba 3.9.1, scalar_rgb; its D65 makes a flat reflectance 0.99887.
    pairs = "400:0.1, 500:0.5, 600:.9, 700:.3"
    found = rgb(assets, f'<spectrum name="reflectance" value="{pairs}"/>')
    assert found == pytest.approx([0.8547973 / 0.99887, 0.6875398 / 0.99887, 0.2650152 / 0.99887], rel=4e-4)
    (assets / "curve.spd").write_text("# a comment\n400 0.1\n500 0.5 # more\n600 .9\n\n700 .3\n")
    assert rgb(assets, '<spectrum name="reflectance" filename="curve.spd"/>') == found
    light = '<emitter type="constant"><spectrum name="radiance" value="{}"/></emitter>'
    shine = lambda value: read(assets, scene(light.format(value)))["lights"]["constant_1"]["radiance"]  # noqa: E731
    assert shine(pairs) == pytest.approx([0.999234, 0.6597, 0.229444], rel=5e-4)
    assert shine("0.7") == pytest.approx([0.843356, 0.663804, 0.636241], rel=5e-4)


def test_a_black_body_has_its_luminance(assets: Path) -> None:
    text = '<emitter type="constant"><blackbody name="radiance" temperature="{}K"/></emitter>'
    cold, warm = (
        read(assets, scene(text.format(kelvin)))["lights"]["constant_1"]["radiance"] for kelvin in (3000, 6500)
    )
    assert cold[0] > cold[1] > cold[2] and warm[0] < 1.2 * warm[2]
    # Planck's law at 560 nm, 6500 K, in W / (m^2 sr nm): the luminance lies near.
    at_560 = 1.191042972e-16 / (560e-9) ** 5 / math.expm1(0.014387769 / (560e-9 * 6500)) * 1e-9
    assert 0.2126 * warm[0] + 0.7152 * warm[1] + 0.0722 * warm[2] == pytest.approx(at_560, rel=0.02)


def test_transforms_are_applied_in_order(assets: Path) -> None:
    text = (
        '<shape type="sphere"><transform name="to_world"><scale value="2"/><rotate z="1" angle="90"/><translate x="1"/>'
        '<matrix value="1 0 0 0  0 1 0 3  0 0 1 0  0 0 0 1"/><transform><translate value="0, 0, 5"/></transform>'
        "</transform></shape>"
    )
    rows = np.array(read(assets, scene(text))["shapes"]["sphere_1"]["transform"][0]["matrix"])
    assert rows == pytest.approx(np.array([[0, -2, 0, 1], [2, 0, 0, 3], [0, 0, 2, 5], [0, 0, 0, 1.0]]), abs=1e-12)
    camera = np.array(read(assets, scene(""))["camera"]["to_world"])
    assert camera[:3, 3] == pytest.approx([0, 3, 6]) and camera[:3, 2] == pytest.approx(
        np.array([0, -2.4, -6]) / math.hypot(2.4, 6)
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [("toWorld", "to_world"), ("intIOR", "int_ior"), ("maxDepth", "max_depth"), ("sunRadiusScale", "sun_radius_scale")],
)
def test_names_in_snake_case(name: str, expected: str) -> None:
    assert property_name("shape", "obj", name) == expected


def test_defaults_of_versions(assets: Path) -> None:
    assert material(assets, '<bsdf type="conductor"/>')["material"] == "none"
    assert material(assets, '<bsdf type="conductor"/>', "0.6.0")["material"] == "Cu"
    over = material(
        assets,
        '<bsdf type="conductor"><rgb name="eta" value="3"/><rgb name="k" value="6"/><float name="extEta" value="1.5"/></bsdf>',
        "0.6.0",
    )
    assert over["eta"] == pytest.approx([2.0] * 3) and over["k"] == pytest.approx([4.0] * 3)
    mix = material(
        assets,
        '<bsdf type="mixturebsdf"><string name="weights" value="0.2, 0.3 0.5"/><bsdf type="diffuse"/><bsdf type="plastic"/>'
        '<bsdf type="phong"/></bsdf>',
        "0.6.0",
    )
    assert mix["weight"] == pytest.approx(0.5) and mix["a"]["weight"] == pytest.approx(0.6)


def warned(folder: Path, text: str) -> tuple[dict[str, Any], str]:
    """Return a scene and the warnings of its import."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        (folder / "scene.xml").write_text(text)
        found = read_mitsuba(folder / "scene.xml", "scene.xml", ImportOptions())
    return found, "; ".join(str(each.message) for each in caught)


def test_files_before_version_2_mean_what_they_meant_then(assets: Path) -> None:
    light = '<emitter type="constant"><spectrum name="radiance" value="2"/></emitter>'
    assert (
        read(assets, scene(light, "0.6.0"))["lights"]["constant_1"]["radiance"] == [2.0] * 3
    )  # white, not equal energy
    assert read(assets, scene(light))["lights"]["constant_1"]["radiance"] == pytest.approx([2.41, 1.90, 1.82], abs=0.01)
    without = re.sub("<integrator.*</integrator>", "", scene(""), flags=re.DOTALL)
    assert read(assets, without.replace("3.0.0", "0.6.0"))["integrator"]["type"] == "direct"
    assert read(assets, without)["integrator"] == {"type": "path", "max_depth": -1, "dark_rims": True}
    checker = (
        '<bsdf type="diffuse"><texture type="checkerboard" name="reflectance"><float name="uscale" value="4"/>'
        '<float name="uoffset" value="0.25"/></texture></bsdf>'
    )
    moved = material(assets, checker, "0.6.0")["reflectance"]["uv_transform"]
    assert moved == {"scale": [4.0, 1.0], "translate": [0.25, 0.0]}
    fog = '<medium type="homogeneous" name="{}" id="fog"/>'
    lamp = f'<shape type="sphere"><emitter type="area"/>{fog.format("exterior")}</shape>'
    border = f'<shape type="sphere">{fog.format("interior")}</shape>'
    types = {
        (version, shape): warned(assets, scene(shape, version))[0]["shapes"]["sphere_1"]["material"]
        for version in ("0.6.0", "3.0.0")
        for shape in (lamp, border)
    }
    assert [found["type"] for found in types.values()] == ["diffuse", "null", "diffuse", "diffuse"]
    assert types["0.6.0", lamp]["reflectance"] == [0.0] * 3


def test_what_would_be_lost_is_said(assets: Path) -> None:
    two = '<shape type="sphere"><bsdf type="dielectric"/><bsdf type="diffuse"/></shape>'
    assert "only the last bsdf of several" in warned(assets, scene(two))[1]
    inner = '<float name="weight" value=".25"/><bsdf type="thindielectric"/><bsdf type="diffuse"/>'
    glass = f'<bsdf type="blendbsdf">{inner}</bsdf>'
    assert "seen from behind" in warned(assets, scene(f'<shape type="sphere">{glass}</shape>'))[1]


def test_a_blend_with_nothing_is_an_opacity(assets: Path) -> None:
    def blended(first: str, second: str) -> dict[str, Any]:
        inner = f'<bsdf type="{first}"/><bsdf type="{second}"/>'
        return material(assets, f'<bsdf type="blendbsdf"><float name="weight" value="0.25"/>{inner}</bsdf>')

    for found, opacity in ((blended("null", "diffuse"), 0.25), (blended("diffuse", "null"), 0.75)):
        assert found == {"type": "diffuse", "two_sided": False, "opacity": opacity}
    assert blended("null", "null")["type"] == "blend"


def test_shapes_of_a_merge_are_shapes_of_their_own(assets: Path) -> None:
    inner = '<shape type="sphere"><bsdf type="plastic"/></shape><shape type="cube"/>'
    found, said = warned(assets, scene(f'<shape type="merge">{inner}</shape>'))
    assert {shape["type"] for shape in found["shapes"].values()} == {"sphere", "cube"} and not said
    itself = f'<shape type="merge" id="m">{inner}<float name="wish" value="1"/><ref id="m"/></shape>'
    found, said = warned(assets, scene(itself))
    assert len(found["shapes"]) == 2 and "inside a merge is left out" in said and "wish is unknown" in said


def test_a_sky_and_its_sun_are_one_light(assets: Path) -> None:
    sun = '<vector name="sunDirection" x="0" y=".6" z=".8"/><float name="turbidity" value="4"/>'
    parts = [f'<emitter type="{part}">{sun}</emitter>' for part in ("sky", "sun", "sunsky")]
    found, _ = warned(assets, scene(parts[0] + parts[1], "0.6.0"))
    other, _ = warned(assets, scene(parts[1] + parts[0], "0.6.0"))
    both, _ = warned(assets, scene(parts[2], "0.6.0"))
    assert [*found["lights"].values()] == [*other["lights"].values()] == [*both["lights"].values()]
    other_sun = parts[1].replace('value="4"', 'value="3"')
    assert "an environment before it" in warned(assets, scene(parts[0] + other_sun, "0.6.0"))[1]


def test_bitmaps_of_16_bits_are_decoded_too(tmp_path: Path) -> None:
    Image.fromarray(np.full((2, 2), 32768, np.uint16)).save(tmp_path / "deep.png")
    image = '<texture type="bitmap" name="reflectance"><string name="filename" value="deep.png"/>{}</texture>'
    for more, value in (("", 0.21404), ('<boolean name="raw" value="true"/>', 0.5)):
        shape = f'<shape type="rectangle"><bsdf type="diffuse">{image.format(more)}</bsdf></shape>'
        (tmp_path / "scene.xml").write_text(scene(shape))
        opened = torchpt.load(str(tmp_path / "scene.xml"), "cpu")
        (texels,) = [texels for texels in opened.params.values() if texels.shape[:2] == (2, 2)]
        assert float(texels.max()) == pytest.approx(value, abs=1e-4)


# ---- Structure: parameters, files, references


def test_parameters_are_given_or_default(assets: Path) -> None:
    text = scene('<default name="w" value="1.5"/><shape type="sphere"><float name="radius" value="$w"/></shape>')
    assert read(assets, text)["shapes"]["sphere_1"]["radius"] == 1.5
    assert read(assets, text, parameters={"w": "2"})["shapes"]["sphere_1"]["radius"] == 2.0
    assert "scene_params.x: expected a parameter of the scene: one of w" in error(assets, text, parameters={"x": "2"})
    assert read(assets, text.replace("$w", "$w5"))["shapes"]["sphere_1"]["radius"] == 1.55  # as Mitsuba reads it
    missing = error(assets, text.replace("$w", "$nothing"))
    assert "got '$nothing'" in missing and "scene_params={nothing: ...}" in missing


def test_includes_stand_in_their_place_and_paths_start_at_their_folder(assets: Path) -> None:
    inner = assets / "parts"
    inner.mkdir(exist_ok=True)
    (inner / "ball.png").write_bytes((assets / "grey.png").read_bytes())
    (inner / "b.xml").write_text(
        '<scene version="0.6.0"><default name="r" value="3"/><bsdf type="diffuse" id="d"><texture type="bitmap" '
        'name="reflectance"><string name="filename" value="ball.png"/></texture></bsdf></scene>'
    )
    text = scene(
        '<include filename="parts\\b.xml"/><alias id="d" as="e"/><shape type="sphere" id="it"><ref id="e"/>'
        '<float name="radius" value="$r"/></shape>'
    )
    found = read(assets, text)
    assert found["shapes"]["it"] == {"type": "sphere", "radius": 3.0, "material": "d"}
    assert found["materials"]["d"]["reflectance"]["path"] == "parts/ball.png"
    (inner / "b.xml").write_text('<scene version="3.0.0"><include filename="b.xml"/></scene>')
    assert "a file that does not include itself" in error(assets, text)
    assert "the name of a file that is there" in error(assets, scene('<include filename="none.xml"/>'))


def test_a_missing_file_is_an_error_or_grey(assets: Path) -> None:
    text = scene(
        '<shape type="rectangle"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">\n'
        '<string name="filename" value="none.png"/></texture></bsdf></shape>\n'
        '<shape type="obj"><string name="filename" value="none.obj"/></shape>'
        '<emitter type="envmap"><string name="filename" value="none.exr"/></emitter>'
    )
    assert error(assets, text) == (
        "scene.xml: line 10, string filename: expected a file that is there (import.missing=warn goes on without it), "
        "got 'none.png'"
    )
    found = read(assets, text, missing=True)
    assert list(found["shapes"]) == ["rectangle_1"] and found["lights"]["constant_1"]["radiance"] == [0.5] * 3
    assert found["shapes"]["rectangle_1"]["material"]["reflectance"] == [0.5] * 3


def test_a_missing_include_is_an_error_or_left_out(assets: Path) -> None:
    text = scene('<include filename="none.xml"/><shape type="sphere"><ref id="red"/></shape><ref id="lamp"/>')
    assert error(assets, text).endswith("that is there (import.missing=warn goes on without it), got 'none.xml'")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = read_mitsuba(assets / "scene.xml", "scene.xml", ImportOptions(missing=True))
    assert len(said) == 3 and any("none.xml is not there, and left out" in str(warning.message) for warning in said)
    assert list(found["shapes"]) == ["sphere_1"]
    assert "expected the id of an element" in error(
        assets, text.replace('<include filename="none.xml"/>', ""), missing=True
    )


def test_a_mesh_without_area_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    meshes = "".join(f'<shape type="obj"><string name="filename" value="{n}.obj"/></shape>' for n in ("flat", "empty"))
    (tmp_path / "scene.xml").write_text(scene(meshes + '<shape type="sphere"/>'))
    with pytest.warns(ImportedSceneWarning, match=r"are left out: obj_1, obj_2 \(2 in all\)"):
        loaded = torchpt.load(str(tmp_path / "scene.xml"))
    assert {part.shape for part in loaded.built.parts} == {"sphere_3"}
    with pytest.raises(AssetError, match="without area"):
        torchpt.load(str(tmp_path / "scene.xml"), overrides={"import.strict": True})
    with pytest.raises(AssetError, match="without area"):
        camera = {"type": "perspective", "origin": [0, 0, 5], "target": [0, 0, 0]}
        torchpt.load({"camera": camera, "shapes": {"a": {"type": "mesh", "path": str(tmp_path / "flat.obj")}}})


def test_unknown_properties_warn(assets: Path) -> None:
    (assets / "scene.xml").write_text(
        scene('<shape type="sphere"><float name="radios" value="1"/><bsdf type="diffuse"/></shape>')
    )
    with pytest.warns(ImportedSceneWarning, match='shape "sphere": the property radios is unknown here and left out'):
        read_mitsuba(assets / "scene.xml", "scene.xml", ImportOptions())


#: Each blend refers twice to the one before: two to the thirtieth of them.
TWICE = '<bsdf type="diffuse" id="m0"/>' + "".join(
    f'<bsdf type="blendbsdf" id="m{k + 1}"><float name="weight" value=".5"/><ref id="m{k}"/><ref id="m{k}"/></bsdf>'
    for k in range(30)
)
MANY_PARAMETERS = f'<default name="a" value="{"x" * 1_000_000}"/>' + '<alias id="$a" as="b"/>' * 300


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "well-formed XML"),
        ("<scene", "well-formed XML"),
        ("<a/>", "<scene> as the outermost element"),
        ('<scene version="x"/>', "a version such as"),
        ('<scene version="3.0.0"/>', "a sensor"),
        ('<!DOCTYPE scene [<!ENTITY a "b">]><scene version="3.0.0">&a;</scene>', "without entities"),
        ('<!DOCTYPE scene SYSTEM "http://x/y.dtd"><scene version="3.0.0">&a;</scene>', "without entities"),
        (scene('<shape type="sphere"><ref id="none"/></shape>'), "the id of an element"),
        (scene('<shape type="sphere"><float name="radius" value="a"/></shape>'), "numbers between blanks"),
        (scene('<shape type="sphere"><float name="radius" value="nan"/></shape>'), "finite numbers"),
        (scene('<shape type="sphere"><float value="1"/></shape>'), "an attribute name"),
        (scene("<shape/>"), "an attribute type"),
        (scene("<wish/>"), "one of the elements"),
        (scene('<bsdf type="diffuse" id="a"/><bsdf type="diffuse" id="a"/>'), "an id of its own"),
        (scene('<shape type="sphere"><boolean name="flip_normals" value="1"/></shape>'), "true or false"),
        (
            scene('<shape type="sphere"><bsdf type="conductor"><string name="material" value="Xx"/></bsdf></shape>'),
            "metals",
        ),
        (scene('<shape type="sphere"><transform name="to_world"><turn/></transform></shape>'), "inside a transform"),
        (
            scene('<shape type="sphere"><ref id="a"/></shape><bsdf type="twosided" id="a"><ref id="a"/></bsdf>'),
            "deep inside each other",
        ),
        (scene("<a>" * 70 + "</a>" * 70), "nested at most"),
        (scene('<shape type="sphere"><float name="to_world" value="3"/></shape>'), "a transform as to_world"),
        (scene(f'<shape type="sphere"><ref id="m30"/></shape>{TWICE}'), "at most 8 blends inside each other"),
        (scene(f'<shape type="sphere"><float name="radius" value="${"a" * 200_000}"/></shape>'), "a <default>"),
        (scene(MANY_PARAMETERS), "256 times that in all"),
    ],
)
def test_errors_are_one_line_and_name_a_line(assets: Path, text: str, words: str) -> None:
    found = error(assets, text)
    assert words in found and found.startswith("scene.xml: line ")


def test_keys_of_the_import_are_checked(assets: Path) -> None:
    file = assets / "scene.xml"
    file.write_text(scene('<shape type="sphere"/>'))
    for key, value, words in (
        ("import.strict", 1, "true or false"),
        ("import.missing", "grey", "error or warn"),
        ("import.nothing", True, "import.strict, import.missing"),
        ("scene_params", 3, "a mapping"),
    ):
        with pytest.raises(SceneError, match=words):
            read_description(str(file), overrides={key: value})
    described = read_description(str(file), overrides={"camera.fov": 20, "import": {"strict": True}})
    assert described.camera["fov"] == 20.0
    with pytest.raises(SceneError, match="a key of a scene"):
        read_description("cornell_box", overrides={"import.strict": True})


# ---- Pictures


def test_a_scene_renders_and_reads_settings(assets: Path) -> None:
    (assets / "scene.xml").write_text(EXACT["crop"])
    image = torchpt.render(torchpt.load(str(assets / "scene.xml")), compile="off", spp=1)
    assert image.shape == (16, 16, 3) and bool(torch.isfinite(image).all())


def test_one_sided_surfaces_are_black_from_behind(assets: Path) -> None:
    found = {}
    for name in ("one_sided", "twosided"):
        (assets / "scene.xml").write_text(EXACT[name])
        found[name] = torchpt.render(torchpt.load(str(assets / "scene.xml")), compile="off", spp=4).mean()
    assert found["one_sided"] < 0.97 * found["twosided"]


# ---- Attributes of meshes


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("vertex_nothing",), "the attribute vertex_nothing is not in its file, white takes its place"),
        (
            ("face_shade", "vertex_gloss"),
            "a mesh carries one attribute, face_shade, which is taken for vertex_gloss as well",
        ),
    ],
)
def test_attributes_that_a_mesh_cannot_have_are_warnings(assets: Path, names: tuple[str, ...], words: str) -> None:
    slots = ("diffuse_reflectance", "specular_reflectance")
    textures = "".join(
        f'<texture type="mesh_attribute" name="{slot}"><string name="name" value="{name}"/></texture>'
        for slot, name in zip(slots, names, strict=False)
    )
    text = scene(
        '<shape type="ply"><string name="filename" value="meshes/attributes.ply"/><ref id="m"/></shape>'
        f'<bsdf type="plastic" id="m">{textures}</bsdf>'
    )
    (assets / "scene.xml").write_text(text)
    with pytest.warns(ImportedSceneWarning, match=words):
        read_mitsuba(assets / "scene.xml", "scene.xml", ImportOptions())


def test_a_flipped_mesh_keeps_its_attribute(assets: Path) -> None:
    plain, flipped = (
        read(
            assets,
            EXACT["vertex_attribute"].replace('<boolean name="face_normals"', f'{flag}<boolean name="face_normals"'),
        )
        for flag in ("", '<boolean name="flip_tex_coords" value="true"/>')
    )
    parts = [next(x["mesh"][0] for x in raw["shapes"].values() if "mesh" in x) for raw in (plain, flipped)]
    assert parts[0].colors is not None
    np.testing.assert_array_equal(parts[0].colors, parts[1].colors)


def test_attributes_survive_a_conversion_to_yaml(assets: Path, tmp_path: Path) -> None:
    for name in ("vertex_color", "vertex_attribute", "face_attribute"):
        raw = read(assets, EXACT[name])
        file = tmp_path / f"{name}.yaml"
        write_scene(raw, assets, file)
        options: dict[str, Any] = {"spp": 2, "compile": "off", "film": {"width": 16, "height": 12}}
        images = [torchpt.render(torchpt.load(str(path)), **options) for path in (assets / "scene.xml", file)]
        assert torch.equal(*images)


# ---- Skies


def sky(folder: Path, plugin: str, inner: str, version: str = "3.0.0") -> dict[str, Any]:
    """Return what a sky becomes."""
    (light,) = read(folder, scene(f'<emitter type="{plugin}">{inner}</emitter>', version))["lights"].values()
    return light


def test_scales_and_sizes_of_skies_are_those_of_their_version(assets: Path) -> None:
    both = '<float name="scale" value="3"/><float name="sunScale" value="2"/><float name="sunRadiusScale" value="4"/>'
    old = sky(assets, "sunsky", both, "0.6.0")
    assert (old["sky_scale"], old["sun_scale"], old["albedo"]) == (3.0, 2.0, [0.2] * 3)
    assert old["sun_aperture"] == pytest.approx(4 * 0.5358) and "transform" not in old
    assert sky(assets, "sun", both, "0.6.0")["sky_scale"] == 0.0 == sky(assets, "sky", both, "0.6.0")["sun_scale"]
    new = sky(assets, "sunsky", '<float name="sun_aperture" value="2"/><float name="turbidity" value="7"/>')
    assert (new["sun_aperture"], new["turbidity"], new["albedo"]) == (2.0, 7.0, [0.3] * 3)
    matrix = np.array(new["transform"][0]["matrix"])
    np.testing.assert_allclose(matrix @ [0, 1, 0, 0], [0, 0, 1, 0], atol=1e-12)  # up is z


def test_the_suns_of_a_time_stand_in_the_south_of_each_version(assets: Path) -> None:
    noon = '<float name="latitude" value="48"/><float name="longitude" value="15"/><float name="timezone" value="1"/>'
    noon += '<float name="hour" value="12"/>'
    old = np.array(sky(assets, "sunsky", noon, "0.6.0")["sun_direction"])
    new = np.array(sky(assets, "sunsky", noon)["sun_direction"])
    turned = np.array(sky(assets, "sunsky", noon + '<transform name="to_world"><rotate x="1" angle="-90"/></transform>')
                      ["sun_direction"])  # fmt: skip
    assert abs(old[0]) < 0.05 and 0.85 < old[1] < 0.95 and old[2] > 0.4  # south is z
    np.testing.assert_allclose(new, [old[2], -old[0], old[1]], atol=1e-12)  # south is x, west is y
    np.testing.assert_allclose(turned, [new[0], new[2], -new[1]], atol=1e-12)


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        ('<float name="hour" value="2"/>', "its sun is below the horizon"),
        ('<float name="turbidity" value="12"/>', "turbidity outside of 1..10 is clamped"),
        ('<float name="stretch" value="0.5"/>', "stretch outside of 1..2 is clamped"),
        ('<float name="sun_radius_scale" value="300"/>', "a sun of more than 60 degrees"),
        ('<boolean name="extend" value="true"/>', "extend is left out"),
        ('<transform name="to_world"><scale x="2"/></transform>', "the scale of to_world is left out"),
    ],
)
def test_what_a_sky_cannot_have_is_a_warning(assets: Path, inner: str, words: str) -> None:
    (assets / "scene.xml").write_text(scene(f'<emitter type="sunsky">{inner}</emitter>'))
    with pytest.warns(ImportedSceneWarning, match=words):
        raw = read_mitsuba(assets / "scene.xml", "scene.xml", ImportOptions())
    assert len(raw.get("lights", {})) == (0 if "hour" in inner else 1)


@pytest.mark.parametrize(
    "inner", ['<vector name="sun_direction" value="0 0 0"/>', '<integer name="month" value="13"/>']
)
def test_wrong_skies_are_one_line(assets: Path, inner: str) -> None:
    assert "line " in error(assets, scene(f'<emitter type="sunsky">{inner}</emitter>'))
