"""Scenes of Mitsuba whose picture would differ without a word: what they become, and what the import says of them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mitsuba_corpus import scene, write_assets
from PIL import Image

import torchpt
from torchpt.core.errors import AssetError, ImportedSceneWarning, SceneError
from torchpt.images.write import write_image
from torchpt.scene.formats.mitsuba import ImportOptions, read_mitsuba


def opened(folder: Path, text: str) -> tuple[dict[str, Any], list[str]]:
    """Return a scene, and the warnings of its import without the file's name."""
    file = folder / "scene.xml"
    file.write_text(text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_mitsuba(file, "scene.xml", ImportOptions())
    assert all(issubclass(each.category, ImportedSceneWarning) for each in caught)
    return found, [str(each.message).removeprefix("scene.xml:") for each in caught]


def refused(folder: Path, text: str) -> str:
    """Return the error of a scene."""
    with pytest.raises(SceneError) as caught:
        opened(folder, text)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def sphere(inner: str) -> str:
    """Return a scene of one sphere."""
    return scene(f'<shape type="sphere">{inner}</shape>')


@pytest.mark.parametrize(("first", "second"), [("m", " m"), ("x" * 220 + "1", "x" * 220 + "2")])
def test_ids_that_make_one_key_name_materials_and_textures_of_their_own(
    tmp_path: Path, first: str, second: str
) -> None:
    bsdf = '<bsdf type="diffuse" id="{}"><rgb name="reflectance" value="{}"/></bsdf>'
    shapes = "".join(f'<shape type="sphere"><ref id="{name}"/></shape>' for name in (first, second, first))
    found, said = opened(tmp_path, scene(bsdf.format(first, ".9") + bsdf.format(second, ".1") + shapes))
    used = [found["materials"][shape["material"]]["reflectance"][0] for shape in found["shapes"].values()]
    assert used == [0.9, 0.1, 0.9] and not said
    texture = '<texture type="checkerboard" id="{}"><rgb name="color0" value="{}"/></texture>'
    shapes = "".join(
        f'<shape type="sphere"><bsdf type="diffuse"><ref name="reflectance" id="{name}"/></bsdf></shape>'
        for name in (first, second, first)
    )
    found, said = opened(tmp_path, scene(texture.format(first, ".9") + texture.format(second, ".1") + shapes))
    names = [shape["material"]["reflectance"]["texture"] for shape in found["shapes"].values()]
    assert [found["textures"][name]["color0"][0] for name in names] == [0.9, 0.1, 0.9] and not said


MASK = '<bsdf type="mask">{}<bsdf type="diffuse"/></bsdf>'
BLEND = '<bsdf type="blendbsdf"><float name="weight" value=".4"/><bsdf type="{}"/><bsdf type="diffuse"/></bsdf>'
CHECKER = '<texture type="checkerboard" name="opacity"/>'


@pytest.mark.parametrize(
    ("bsdf", "radiance", "words"),
    [
        (MASK.format('<float name="opacity" value=".25"/>'), 8.0, ""),
        (BLEND.format("null"), 5.0, ""),
        (BLEND.format("plastic"), 2.0, ""),
        (MASK.format(CHECKER), 2.0, 'emitter "area": emission is multiplied by the opacity'),
        (MASK.format('<float name="opacity" value="0"/>'), 2.0, 'emitter "area": it is left out'),
        ('<bsdf type="null"/>', 2.0, 'emitter "area": it is left out'),
    ],
)
def test_emission_does_not_depend_on_opacity(tmp_path: Path, bsdf: str, radiance: float, words: str) -> None:
    found, said = opened(tmp_path, sphere(f'{bsdf}<emitter type="area"><rgb name="radiance" value="2"/></emitter>'))
    assert found["shapes"]["sphere_1"]["emission"] == pytest.approx([radiance] * 3)
    assert len(said) == bool(words) and words in "".join(said)


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        ('<transform name="to_world"><scale x="2" v="3"/></transform>', "scale: the attribute v is unknown"),
        (
            '<transform name="to_world"><lookat origin="0,0,0" target="1,0,0" upp="0,1,0"/></transform>',
            "lookat: the attribute upp",
        ),
        ('<transform name="to_world" foo="1"/>', "transform to_world: the attribute foo is unknown"),
        ('<float name="radius" value="2" vaule="3"/>', "float radius: the attribute vaule is unknown"),
        (
            '<float name="radius" value="2"><float name="a" value="1"/></float>',
            "float radius: the float inside is left out",
        ),
        ('<bsdf type="diffuse" foo="1"/>', 'bsdf "diffuse": the attribute foo is unknown'),
        ('<ref id="grey" foo="1"/>', "ref: the attribute foo is unknown"),
        ('<spectrum name="wish" value="1" intent="x" unit="1"/>', "spectrum wish: the attribute unit is unknown"),
    ],
)
def test_attributes_that_nobody_reads_are_named(tmp_path: Path, inner: str, words: str) -> None:
    found, said = opened(tmp_path, scene(f'<bsdf type="diffuse" id="grey"/>\n<shape type="sphere">\n{inner}\n</shape>'))
    assert len(found["shapes"]) == 1
    line = scene("").count("\n") + 2
    assert any(text.startswith(f"{line}: {words}") for text in said), said


@pytest.mark.parametrize(
    ("operation", "words"),
    [
        ('<rotate x="1"/>', "expected an attribute angle, got '<rotate>'"),
        ('<rotate x="1" angel="30"/>', "expected an attribute angle, got '<rotate>'"),
        ('<scale v=".2"/>', "expected x, y, z or value, got '<scale>'"),
        ('<translate foo="1"/>', "expected x, y, z or value, got '<translate>'"),
    ],
)
def test_operations_that_say_nothing_are_refused(tmp_path: Path, operation: str, words: str) -> None:
    assert words in refused(tmp_path, sphere(f'<transform name="to_world">{operation}</transform>'))


@pytest.mark.parametrize(
    ("pairs", "light", "reflectance"),
    [
        ("580:1, 590:1", [0.175672, 0.054318, 0.0], [0.163534, 0.0508251, 0.0]),
        ("589:1, 590:1", [0.018754, 0.00392519, 0.0], None),
        ("580:30, 581:30", [0.437132, 0.193018, 0.0], None),
        ("580.2:1, 580.7:1", [0.00734447, 0.00318359, 0.0], None),
        ("580:1, 590:1, 600:2", [0.517664, 0.0933608, 0.0], None),
        ("560:.9, 570:.9", None, [0.0579107, 0.0966161, 0.0]),
    ],
)
def test_spectra_that_end_where_they_are_seen_are_summed_up_as_in_mitsuba(
    tmp_path: Path, pairs: str, light: list[float] | None, reflectance: list[float] | None
) -> None:
    """The numbers are those of Mitsuba 3.9.1, ``scalar_rgb``, whose D65 makes a flat reflectance 0.99889."""
    value = f'<spectrum name="{{}}" value="{pairs}"/>'
    if light:
        found, _ = opened(tmp_path, scene(f'<emitter type="constant">{value.format("radiance")}</emitter>'))
        assert found["lights"]["constant_1"]["radiance"] == pytest.approx(light, rel=1e-5)
    if reflectance:
        found, _ = opened(tmp_path, sphere(f'<bsdf type="diffuse">{value.format("reflectance")}</bsdf>'))
        mine = found["shapes"]["sphere_1"]["material"]["reflectance"]
        assert [0.99889 * part for part in mine] == pytest.approx(reflectance, rel=1e-4)


def test_a_colour_in_place_of_a_number_is_its_mean(tmp_path: Path) -> None:
    inner = '<rgb name="{}" value=".9 .3 .06"/>'
    found, said = opened(tmp_path, sphere(f'<bsdf type="roughconductor">{inner.format("alpha")}</bsdf>'))
    assert found["shapes"]["sphere_1"]["material"]["alpha"] == pytest.approx(0.42) and not said
    found, said = opened(tmp_path, sphere(f'<bsdf type="mask"><bsdf type="diffuse"/>{inner.format("opacity")}</bsdf>'))
    assert found["shapes"]["sphere_1"]["material"]["opacity"] == pytest.approx(0.42) and not said


def test_environments_of_16_bits_are_decoded(tmp_path: Path) -> None:
    Image.fromarray(np.full((2, 4), 32768, np.uint16)).save(tmp_path / "deep.png")
    emitter = '<emitter type="envmap"><string name="filename" value="deep.png"/></emitter>'
    (tmp_path / "scene.xml").write_text(scene(emitter))
    opened = torchpt.load(str(tmp_path / "scene.xml"), "cpu")
    assert float(opened.params["lights.envmap_1.texels"].max()) == pytest.approx(0.21404, abs=1e-4)


@pytest.mark.parametrize("scale", ['value="2"', 'x="2"'])
@pytest.mark.parametrize("type", ["envmap", "spot", "sunsky"])
def test_a_scale_of_a_direction_is_said(tmp_path: Path, type: str, scale: str) -> None:
    Image.fromarray(np.full((2, 4), 128, np.uint8)).save(tmp_path / "sky.png")
    file = '<string name="filename" value="sky.png"/>' if type == "envmap" else ""
    turn = '<rotate z="1" angle="10"/>'
    text = f'<emitter type="{type}">{file}<transform name="to_world">{{}}{turn}</transform></emitter>'
    found, said = opened(tmp_path, scene(text.format(f"<scale {scale}/>")))
    assert len(said) == 1 and f'emitter "{type}": the scale of to_world is left out' in said[0]
    with pytest.warns(ImportedSceneWarning):
        torchpt.load(str(tmp_path / "scene.xml"), "cpu")
    plain, nothing = opened(tmp_path, scene(text.format("")))
    (light,), (expected,) = found["lights"].values(), plain["lights"].values()
    assert not nothing
    if type != "spot":
        assert np.array(light["transform"][0]["matrix"]) == pytest.approx(np.array(expected["transform"][0]["matrix"]))


MAPPED = (
    '<bsdf type="{}map"><texture type="checkerboard"/><bsdf type="{}map"><texture type="checkerboard"/>'
    '<bsdf type="diffuse"/></bsdf></bsdf>'
)


@pytest.mark.parametrize(("outer", "inner"), [("normal", "bump"), ("bump", "normal"), ("bump", "bump")])
def test_of_maps_inside_each_other_the_outer_one_is_taken(tmp_path: Path, outer: str, inner: str) -> None:
    found, said = opened(tmp_path, sphere(MAPPED.format(outer, inner)))
    keys = set(found["shapes"]["sphere_1"]["material"]) & {"normal_map", "bump_map"}
    assert keys == {f"{outer}_map"}
    assert len(said) == 1 and f'bsdf "{outer}map": the {inner}_map of the bsdf inside is left out' in said[0]


def test_a_material_of_two_maps_is_refused_in_words() -> None:
    texture = {"type": "checkerboard"}
    material = {"type": "diffuse", "normal_map": texture, "bump_map": texture}
    camera = {"origin": [0, 0, 3], "target": [0, 0, 0]}
    with pytest.raises(SceneError) as caught:
        torchpt.load({"version": 1, "camera": camera, "shapes": {"a": {"type": "sphere", "material": material}}}, "cpu")
    assert "not both" in str(caught.value) and " object at " not in str(caught.value)
    assert "Texture" not in str(caught.value)


@pytest.mark.parametrize(
    ("slot", "name"),
    [
        ('<bsdf type="diffuse"><texture name="reflectance"', "reflectance"),
        ('<bsdf type="roughconductor"><texture name="alpha"', "alpha"),
        ('<bsdf type="mask"><bsdf type="diffuse"/><texture name="opacity"', "opacity"),
        ('<bsdf type="blendbsdf"><bsdf type="diffuse"/><bsdf type="plastic"/><texture', "weight"),
        ('<bsdf type="normalmap"><bsdf type="diffuse"/><texture', "normal_map"),
    ],
)
@pytest.mark.parametrize("shared", [False, True])
def test_textures_of_more_than_1_are_clamped(tmp_path: Path, slot: str, name: str, shared: bool) -> None:
    write_image(tmp_path / "bright.exr", torch.tensor([[[0.25, 0.25, 0.25], [3.0, 3.0, 3.0]]]))
    own = ' id="bright"' if shared else ""
    text = sphere(f'{slot} type="bitmap"{own}><string name="filename" value="bright.exr"/></texture></bsdf>')
    found, said = opened(tmp_path, text)
    texture = found["shapes"]["sphere_1"]["material"][name]
    assert texture["clamp"] is True and texture["path"] == "bright.exr"
    assert (
        len(said) == 1
        and f"values of the texture of {name.replace('_map', 's')} outside of 0..1 are clamped" in said[0]
    )
    with pytest.warns(ImportedSceneWarning):
        loaded = torchpt.load(str(tmp_path / "scene.xml"), "cpu")
    (texels,) = [texels for texels in loaded.params.values() if texels.shape[:2] == (1, 2)]
    assert texels[0, :, 0].tolist() == [0.25, 1.0]


def test_textures_within_1_are_left_alone(tmp_path: Path) -> None:
    write_image(tmp_path / "grey.exr", torch.full((1, 2, 3), 0.5))
    bitmap = '<texture name="{}" type="bitmap"><string name="filename" value="grey.exr"/></texture>'
    found, said = opened(tmp_path, sphere(f'<bsdf type="diffuse">{bitmap.format("reflectance")}</bsdf>'))
    assert "clamp" not in found["shapes"]["sphere_1"]["material"]["reflectance"] and not said


def test_an_area_emitter_that_shapes_refer_to_is_on_them(tmp_path: Path) -> None:
    lamp = '<emitter type="area" id="lamp"><rgb name="radiance" value="2"/></emitter>'
    found, said = opened(tmp_path, scene(lamp + '<shape type="sphere"><ref id="lamp"/></shape>'))
    assert found["shapes"]["sphere_1"]["emission"] == [2.0] * 3 and not said
    _, said = opened(tmp_path, scene(lamp + '<shape type="sphere"/>'))
    assert 'emitter "area" is left out: it is on no shape' in said[0]


HEAD = '<scene version="3.0.0">'


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<sensor type="perspective"><film type="hdrfilm"/><film type="hdrfilm"/><float name="fov" value="40"/></sensor>',
         'sensor "perspective": only the last film of several is taken'),
        ('<sensor type="perspective"><sampler type="sobol"/><sampler type="sobol"/><float name="fov" value="40"/></sensor>',
         'sensor "perspective": only the last sampler of several is taken'),
        ('<sensor type="orthographic"><float name="principal_point_offset_x" value=".1"/></sensor>',
         'sensor "orthographic": principal_point_offset_x is left out'),
        ('<integrator type="path"/><integrator type="direct"/>', "all integrators but the last are left out"),
        ('<integrator type="volpath"><integer name="max_dept" value="3"/></integrator>',
         'integrator "volpath": the property max_dept is unknown here'),
        ('<shape type="sphere"><bsdf type="roughconductor"><float name="alpha_u" value=".2"/></bsdf></shape>',
         'bsdf "roughconductor": alpha_u without alpha_v, which becomes 0.1'),
    ],
)  # fmt: skip
def test_what_stands_twice_or_alone_is_said(tmp_path: Path, body: str, words: str) -> None:
    sensor = "" if "sensor" in body else '<sensor type="perspective"><float name="fov" value="40"/></sensor>'
    _, said = opened(tmp_path, f'{HEAD}{body}{sensor}<shape type="sphere"/></scene>')
    assert any(words in text for text in said), said


@pytest.mark.parametrize(
    ("value", "expected", "count"), [(".8 .3 .2", [0.8, 0.3, 0.2], 0), ("2 .5 .5", [1.0, 0.5, 0.5], 1)]
)
def test_a_texture_of_one_colour_is_that_colour(tmp_path: Path, value: str, expected: list[float], count: int) -> None:
    texture = f'<texture type="srgb" name="reflectance"><rgb name="color" value="{value}"/></texture>'
    found, said = opened(tmp_path, sphere(f'<bsdf type="diffuse">{texture}</bsdf>'))
    assert found["shapes"]["sphere_1"]["material"]["reflectance"] == expected and len(said) == count


@pytest.mark.parametrize(
    ("plugin", "file"), [("ply", "tent.ply"), ("obj", "roof.obj"), ("serialized", "two.serialized")]
)
@pytest.mark.parametrize("ending", ["", ".dat", ".stl"])
def test_meshes_are_read_by_their_plugin_whatever_their_ending(
    tmp_path: Path, plugin: str, file: str, ending: str
) -> None:
    write_assets(tmp_path)
    copy = f"copy{ending}"
    (tmp_path / copy).write_bytes((tmp_path / "meshes" / file).read_bytes())
    text = f'<shape type="{plugin}"><string name="filename" value="{{}}"/></shape>'
    pictures = []
    for name in (copy, f"meshes/{file}"):
        (tmp_path / "scene.xml").write_text(scene(text.format(name) + '<emitter type="constant"/>'))
        opened = torchpt.load(str(tmp_path / "scene.xml"), "cpu", overrides={"film.width": 8, "film.height": 8})
        pictures.append(torchpt.render(opened, spp=2, seed=0, compile="off"))
    assert torch.equal(*pictures)


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_images_are_known_by_their_content(tmp_path: Path, kind: str) -> None:
    write_image(tmp_path / f"grey.{kind}", torch.full((1, 2, 3), 0.5))
    (tmp_path / "grey").write_bytes((tmp_path / f"grey.{kind}").read_bytes())
    bitmap = '<texture name="reflectance" type="bitmap"><string name="filename" value="grey"/></texture>'
    (tmp_path / "scene.xml").write_text(sphere(f'<bsdf type="diffuse">{bitmap}</bsdf>'))
    loaded = torchpt.load(str(tmp_path / "scene.xml"), "cpu")
    (texels,) = [texels for texels in loaded.params.values() if texels.shape[:2] == (1, 2)]
    assert texels.max().item() == pytest.approx(0.5, abs=0.01)
    (tmp_path / "grey").write_text("words")
    with pytest.raises(AssetError, match="unknown kind of image ''"):
        torchpt.load(str(tmp_path / "scene.xml"), "cpu")


BAD_CAMERA = '<sensor type="thinlens">\n<float name="{}" value="{}"/>\n<float name="{}" value="1"/>\n</sensor>\n'
FILM = '<sensor type="perspective">\n<float name="fov" value="40"/>\n<film type="hdrfilm">\n{}\n</film>\n</sensor>\n'
WIDTH = '<integer name="width" value="8"/><integer name="height" value="8"/>'


@pytest.mark.parametrize(
    ("body", "where"),
    [
        (BAD_CAMERA.format("fov", 0, "aperture_radius"), 'line 3, sensor "thinlens" fov: '),
        (BAD_CAMERA.format("fov", 180, "aperture_radius"), 'line 3, sensor "thinlens" fov: '),
        (BAD_CAMERA.format("aperture_radius", -1, "fov"), 'line 3, sensor "thinlens" aperture_radius: '),
        (BAD_CAMERA.format("focus_distance", 0, "fov"), 'line 3, sensor "thinlens" focus_distance: '),
        (FILM.format('<integer name="width" value="0"/>'), 'line 5, film "hdrfilm" width: '),
        (FILM.format(WIDTH + '<integer name="crop_width" value="9"/>'), 'line 4, film "hdrfilm": '),
        (FILM.format('<rfilter type="tent"><float name="radius" value="0"/></rfilter>'), 'line 5, rfilter "tent" radius: '),
        ('<integrator type="path">\n<integer name="max_depth" value="99999999999"/></integrator>',
         'line 3, integrator "path" max_depth: '),
        ('<shape type="sphere">\n<float name="radius" value="1 2"/></shape>',
         "line 3, float radius: expected 1 number, got '1 2'"),
        ('<shape type="sphere"><bsdf type="diffuse">\n<rgb name="reflectance" value=".1 .2"/></bsdf></shape>',
         "line 3, rgb reflectance: expected 1 or 3 numbers, got '.1 .2'"),
        ('<shape type="obj">\n<string name="filename" value="no.obj"/></shape>', "line 3, string filename: "),
        ('<shape type="obj"><string name="filename" value="scene.xml"/>\n</shape>', "no face"),
        ('<emitter type="envmap">\n<float name="scale" value="-1"/><string name="filename" value="sky.png"/></emitter>',
         'line 3, emitter "envmap" scale: '),
    ],
)  # fmt: skip
def test_errors_of_values_name_line_and_element(tmp_path: Path, body: str, where: str) -> None:
    Image.fromarray(np.full((2, 4), 128, np.uint8)).save(tmp_path / "sky.png")
    sensor = "" if "sensor" in body else '<sensor type="perspective"><float name="fov" value="40"/></sensor>'
    file = tmp_path / "scene.xml"
    file.write_text(f"{HEAD}\n{body}{sensor}</scene>")
    with pytest.raises((SceneError, AssetError)) as caught:
        torchpt.load(str(file), "cpu")
    said = str(caught.value)
    assert "\n" not in said and (said.startswith(f"{file}: {where}") or "no face" in where in said), said


def test_an_override_is_at_fault_itself(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(scene('<shape type="sphere" id="ball"/>'))
    with pytest.raises(SceneError, match=r"^camera\.fov: expected"):
        torchpt.load(str(file), "cpu", overrides={"camera.fov": 300})
    with pytest.raises(SceneError, match=r"^film\.width: expected"):
        torchpt.load(str(file), "cpu", overrides={"film.width": 0})


@pytest.mark.parametrize(("version", "green"), [("0.6.0", 0x80 / 255), ("3.0.0", 0.2158605)])
def test_hexadecimal_colours_are_linear_before_version_2(tmp_path: Path, version: str, green: float) -> None:
    bsdf = '<shape type="sphere"><bsdf type="diffuse"><{0} name="reflectance" value="#ff8000"/></bsdf></shape>'
    for tag, expected in (("rgb", green), ("srgb", 0.2158605)):
        found, _ = opened(tmp_path, scene(bsdf.format(tag), version))
        assert found["shapes"]["sphere_1"]["material"]["reflectance"] == pytest.approx([1.0, expected, 0.0])


def test_samples_beyond_the_border_need_no_warning(tmp_path: Path) -> None:
    film = '<film type="hdrfilm"><boolean name="sample_border" value="true"/></film>'
    _, said = opened(
        tmp_path, f'{HEAD}<sensor type="perspective">{film}<float name="fov" value="40"/></sensor></scene>'
    )
    assert not said
