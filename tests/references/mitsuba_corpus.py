"""Small scenes in Mitsuba's XML, one for each plugin and each quirk of versions; all open in Mitsuba 3.9 unless said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from small_files import serialized_bytes

__all__ = ["EXACT", "LIGHT", "NEAREST", "OLD", "scene", "write_assets"]

_HEAD = """\
<scene version="{version}">
  <integrator type="path"><integer name="max{_}epth" value="{depth}"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="40"/>
    <transform name="to{w}orld"><lookat origin="0, 3, 6" target="0, 0.6, 0" up="0, 1, 0"/></transform>
    <sampler type="independent"><integer name="sample{c}ount" value="16"/></sampler>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/><rfilter type="box"/></film>
  </sensor>
"""
_FLOOR = """\
  <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.6 0.5 0.4"/></bsdf></bsdf></shape>
"""
LIGHT = '  <emitter type="constant"><rgb name="radiance" value="1, 0.9, 0.8"/></emitter>\n'
_BALL = '  <shape type="sphere"><point name="center" x="0" y="1" z="0"/>{}</shape>\n'


def scene(body: str, version: str = "3.0.0", depth: int = 6) -> str:
    """Return a whole scene: camera, integrator and the body."""
    snake = version >= "2"
    names = {"_": "_d", "w": "_w", "c": "_c"} if snake else {"_": "D", "w": "W", "c": "C"}
    return _HEAD.format(version=version, depth=depth, **names) + body + "</scene>\n"


def ball(bsdf: str, light: str = LIGHT, depth: int = 6) -> str:
    """Return a scene of a ball on a floor."""
    return scene(_FLOOR + light + _BALL.format(bsdf), depth=depth)


def shape(xml: str) -> str:
    """Return a scene of a shape on a floor."""
    return scene(_FLOOR + LIGHT + xml)


def lamp(emitter: str) -> str:
    """Return a scene of a ball and a light."""
    return ball('<bsdf type="diffuse"/>', emitter)


_TEXTURED = '<bsdf type="diffuse">{}</bsdf>'
_RECTANGLE = """\
<shape type="rectangle"><transform name="to_world"><translate y="1" z="0.2"/></transform>{}</shape>
"""
_GGX = '<string name="distribution" value="ggx"/>'


def _attributed(name: str) -> str:
    """Return a scene of a mesh that shows one of its attributes."""
    return shape(
        '<shape type="ply"><string name="filename" value="meshes/attributes.ply"/>'
        '<boolean name="face_normals" value="true"/><transform name="to_world"><scale value="1.5"/></transform>'
        '<bsdf type="twosided"><bsdf type="diffuse">'
        f'<texture type="mesh_attribute" name="reflectance"><string name="name" value="{name}"/></texture>'
        "</bsdf></bsdf></shape>"
    )


#: Scenes whose twin is exact: the pictures of both renderers are the same but for noise.
EXACT: dict[str, str] = {
    "diffuse": ball('<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'),
    "diffuse_default": ball('<bsdf type="diffuse"/>'),
    "no_bsdf": shape('<shape type="sphere"><point name="center" x="0" y="1" z="0"/></shape>'),
    "one_sided": shape(_RECTANGLE.replace("<translate", '<rotate y="1" angle="150"/><translate').format("")),
    "dielectric": ball('<bsdf type="dielectric"><string name="int_ior" value="water"/></bsdf>', depth=12),
    "thindielectric": ball('<bsdf type="thindielectric"/>', depth=12),
    "roughdielectric": ball(f'<bsdf type="roughdielectric">{_GGX}<float name="alpha" value="0.3"/></bsdf>', depth=12),
    "roughdielectric_default": ball('<bsdf type="roughdielectric"/>', depth=12),
    "conductor": ball('<bsdf type="conductor"><string name="material" value="Au"/></bsdf>'),
    "conductor_default": ball('<bsdf type="conductor"/>'),
    "conductor_eta": ball(
        '<bsdf type="conductor"><rgb name="eta" value="0.2 0.9 1.1"/><rgb name="k" value="3.9, 2.4, 2.2"/></bsdf>'
    ),
    "roughconductor": ball(
        f'<bsdf type="roughconductor">{_GGX}<string name="material" value="Cu"/><float name="alpha_u" value="0.1"/>'
        '<float name="alpha_v" value="0.4"/></bsdf>'
    ),
    "roughconductor_beckmann": ball(
        '<bsdf type="roughconductor"><string name="distribution" value="beckmann"/><string name="material" value="Cu"/>'
        '<float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.4"/></bsdf>'
    ),
    "plastic": ball('<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0.1 0.3 0.9"/></bsdf>'),
    "plastic_nonlinear": ball(
        '<bsdf type="plastic"><rgb name="diffuse_reflectance" value="0.1 0.3 0.9"/>'
        '<boolean name="nonlinear" value="true"/></bsdf>'
    ),
    "roughplastic": ball(
        f'<bsdf type="roughplastic">{_GGX}<float name="alpha" value="0.2"/><float name="int_ior" value="1.6"/></bsdf>'
    ),
    "roughplastic_default": ball(
        '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.1 0.3 0.9"/></bsdf>'
    ),
    "principled": ball(
        '<bsdf type="principled"><rgb name="base_color" value="0.8 0.3 0.2"/><float name="roughness" value="0.4"/>'
        '<float name="metallic" value="0.3"/><float name="clearcoat" value="0.5"/><float name="specular" value="0.6"/></bsdf>'
    ),
    "twosided": shape(
        _RECTANGLE.replace("<translate", '<rotate y="1" angle="150"/><translate').format(
            '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'
        )
    ),
    "mask": ball(
        '<bsdf type="mask"><float name="opacity" value="0.3"/><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></bsdf>',
        depth=32,
    ),
    "mask_texture": shape(
        _RECTANGLE.format(
            '<bsdf type="mask"><texture type="bitmap" name="opacity"><string name="filename" value="grey.png"/></texture>'
            '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></bsdf>'
        )
    ),
    "blendbsdf": ball(
        '<bsdf type="blendbsdf"><float name="weight" value="0.3"/><bsdf type="diffuse"><rgb name="reflectance" value="1 0 0"/>'
        '</bsdf><bsdf type="roughconductor"><string name="distribution" value="ggx"/></bsdf></bsdf>'
    ),
    "blend_texture": shape(
        _RECTANGLE.format(
            '<bsdf type="blendbsdf"><texture type="bitmap" name="weight"><string name="filename" value="grey.png"/></texture>'
            '<bsdf type="diffuse"><rgb name="reflectance" value="1 0 0"/></bsdf>'
            '<bsdf type="diffuse"><rgb name="reflectance" value="0 0 1"/></bsdf></bsdf>'
        )
    ),
    "null": ball('<bsdf type="null"/>'),
    "bitmap": shape(
        _RECTANGLE.format(
            _TEXTURED.format(
                '<texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/></texture>'
            )
        )
    ),
    "bitmap_raw": shape(
        _RECTANGLE.format(
            _TEXTURED.format(
                '<texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/>'
                '<boolean name="raw" value="true"/><string name="filter_type" value="nearest"/>'
                '<string name="wrap_mode" value="mirror"/><transform name="to_uv"><scale x="2" y="3"/>'
                '<rotate z="1" angle="20"/><translate x="0.2" y="0.1"/></transform></texture>'
            )
        )
    ),
    "bitmap_sheared": shape(
        _RECTANGLE.format(
            _TEXTURED.format(
                '<texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/>'
                '<transform name="to_uv"><matrix value="1.3 0.4 0 0.2 -0.3 0.9 0 -0.6 0 0 1 0 0 0 0 1"/></transform></texture>'
            )
        )
    ),
    "bitmap_roughness": shape(
        _RECTANGLE.format(
            f'<bsdf type="roughconductor">{_GGX}<texture type="bitmap" name="alpha">'
            '<string name="filename" value="grey.png"/></texture></bsdf>'
        )
    ),
    "checkerboard": shape(
        _RECTANGLE.format(
            _TEXTURED.format(
                '<texture type="checkerboard" name="reflectance"><rgb name="color0" value="0.9 0.1 0.1"/>'
                '<transform name="to_uv"><scale x="3" y="2"/></transform></texture>'
            )
        )
    ),
    "normalmap": shape(
        _RECTANGLE.format(
            '<bsdf type="normalmap"><texture type="bitmap" name="normalmap"><boolean name="raw" value="true"/>'
            '<string name="filename" value="normals.png"/></texture><bsdf type="diffuse"/></bsdf>'
        )
    ),
    "bumpmap": shape(
        _RECTANGLE.format(
            '<bsdf type="bumpmap"><texture type="bitmap"><boolean name="raw" value="true"/>'
            '<string name="filename" value="grey.png"/></texture><float name="scale" value="0.5"/><bsdf type="diffuse"/></bsdf>'
        )
    ),
    "bumpmap_mesh": shape(
        '<shape type="obj"><string name="filename" value="meshes/roof.obj"/><boolean name="face_normals" value="true"/>'
        '<transform name="to_world"><scale value="1.5"/><translate y="0.5"/></transform><bsdf type="bumpmap">'
        '<texture type="bitmap"><string name="filename" value="grey.png"/></texture>'
        '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></bsdf></shape>'
    )
    .replace('<bsdf type="bumpmap">', '<bsdf type="twosided"><bsdf type="bumpmap">')
    .replace(
        '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></bsdf></shape>',
        '<bsdf type="diffuse"/></bsdf></bsdf></shape>',
    ),
    "spectrum": ball(
        '<bsdf type="diffuse"><spectrum name="reflectance" value="0.35"/></bsdf>',
        '<emitter type="constant"><spectrum name="radiance" value="400:0.1, 500:0.5, 600:.9, 700:.3"/></emitter>',
    ),
    "area": ball(
        '<bsdf type="diffuse"/>',
        '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/><translate y="3"/></transform>'
        '<emitter type="area"><rgb name="radiance" value="5 4 3"/></emitter></shape>',
    ),
    "area_texture": ball(
        '<bsdf type="diffuse"/>',
        '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/><translate y="3"/></transform>'
        '<emitter type="area"><texture type="bitmap" name="radiance"><string name="filename" value="a picture.png"/></texture>'
        "</emitter></shape>",
    ),
    "point": lamp(
        '<emitter type="point"><point name="position" x="1" y="4" z="2"/><rgb name="intensity" value="9"/></emitter>'
    ),
    "spot": lamp(
        '<emitter type="spot"><transform name="to_world"><lookat origin="1, 4, 2" target="0, 0, 0" up="0, 1, 0"/></transform>'
        '<float name="cutoff_angle" value="25"/><rgb name="intensity" value="40 30 20"/></emitter>'
    ),
    "directional": lamp(
        '<emitter type="directional"><vector name="direction" x="-1" y="-2" z="-1"/><rgb name="irradiance" value="2 2 1"/>'
        "</emitter>"
    ),
    "directional_to_world": lamp(
        '<emitter type="directional"><transform name="to_world"><lookat origin="2 4 2" target="0 0 0" up="0 1 0"/></transform>'
        "</emitter>"
    ),
    "envmap": lamp(
        '<emitter type="envmap"><string name="filename" value="sky.exr"/><float name="scale" value="1.5"/>'
        '<transform name="to_world"><rotate y="1" angle="70"/><rotate x="1" angle="20"/></transform></emitter>'
    ),
    "sunsky": lamp(
        '<emitter type="sunsky"><vector name="sun_direction" x="0.5" y="0.6" z="0.4"/><float name="turbidity" value="4.5"/>'
        '<rgb name="albedo" value="0.3 0.6 0.2"/><boolean name="complex_sun" value="true"/><float name="sky_scale" value="2"/>'
        '<transform name="to_world"><rotate x="1" angle="-90"/><rotate z="1" angle="10"/></transform></emitter>'
    ),
    "sky": lamp(
        '<emitter type="sunsky"><float name="sun_scale" value="0"/><float name="hour" value="9"/>'
        '<transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>'
    ),
    "obj": shape(
        '<shape type="obj"><string name="filename" value="meshes\\roof.obj"/><transform name="to_world">'
        '<scale value="1.5"/><translate y="0.5"/></transform><bsdf type="twosided"><bsdf type="diffuse">'
        '<texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/></texture></bsdf></bsdf>'
        "</shape>"
    ).replace("meshes\\", "meshes/"),
    "obj_flipped": shape(
        '<shape type="obj"><string name="filename" value="meshes/roof.obj"/><boolean name="flip_tex_coords" value="false"/>'
        '<boolean name="face_normals" value="true"/><transform name="to_world"><scale value="1.5"/><translate y="0.5"/>'
        '</transform><bsdf type="twosided"><bsdf type="diffuse">'
        '<texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/></texture></bsdf></bsdf>'
        "</shape>"
    ),
    "ply": shape(
        '<shape type="ply"><string name="filename" value="meshes/tent.ply"/><transform name="to_world"><translate y="0.2"/>'
        '</transform><bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        '<string name="filename" value="a picture.png"/></texture></bsdf></bsdf></shape>'
    ),
    "serialized": shape(
        '<shape type="serialized"><string name="filename" value="meshes/two.serialized"/>'
        '<integer name="shape_index" value="1"/><transform name="to_world"><scale value="1.5"/><translate y="0.2"/></transform>'
        '<bsdf type="twosided"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        '<string name="filename" value="a picture.png"/></texture>'
        "</bsdf></bsdf></shape>"
    ),
    "serialized_first": shape(
        '<shape type="serialized"><string name="filename" value="meshes/old.serialized"/><boolean name="face_normals" '
        'value="true"/><transform name="to_world"><scale value="1.5"/></transform><bsdf type="twosided"><bsdf type="diffuse"/>'
        "</bsdf></shape>"
    ),
    "vertex_color": _attributed("vertex_color"),
    "vertex_attribute": _attributed("vertex_gloss"),
    "face_attribute": _attributed("face_shade"),
    "sphere": shape(
        '<shape type="sphere"><float name="radius" value="0.5"/><transform name="to_world"><scale value="1.6"/>'
        '<translate y="0.8"/></transform></shape>'
    ),
    "sphere_texture": ball(
        _TEXTURED.format(
            '<texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/></texture>'
        )
    ),
    "sphere_inside": shape(
        '<shape type="sphere"><point name="center" x="0" y="1" z="0"/><boolean name="flip_normals" value="true"/></shape>'
    ),
    "cylinder": shape(
        '<shape type="cylinder"><point name="p0" x="-1" y="0.7" z="0"/><point name="p1" x="1" y="1" z="0.5"/>'
        '<float name="radius" value="0.5"/><bsdf type="twosided"><bsdf type="diffuse">'
        '<texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/></texture></bsdf></bsdf>'
        "</shape>"
    ),
    "disk": shape(
        '<shape type="disk"><transform name="to_world"><rotate y="1" angle="30"/><translate y="1"/></transform>'
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="a picture.png"/>'
        "</texture></bsdf></shape>"
    ),
    "cube": shape(
        '<shape type="cube"><transform name="to_world"><scale value="0.7"/><rotate y="1" angle="30"/><translate y="0.8"/>'
        '</transform><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        '<string name="filename" value="a picture.png"/></texture></bsdf></shape>'
    ),
    "merge": shape(
        '<shape type="merge"><shape type="cube"><transform name="to_world"><scale value="0.6"/><translate y="0.8"/></transform>'
        '<bsdf type="diffuse"><rgb name="reflectance" value="0.7 0.3 0.2"/></bsdf></shape></shape>'
    ),
    "instances": shape(
        '<shape type="shapegroup" id="g"><shape type="obj"><string name="filename" value="meshes/roof.obj"/>'
        '<transform name="to_world"><scale value="0.5"/></transform><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
        '<shape type="sphere"><float name="radius" value="0.3"/></shape></shape>'
        '<shape type="instance"><ref id="g"/><transform name="to_world"><translate x="-1" y="0.5"/></transform></shape>'
        '<shape type="instance"><ref id="g"/><transform name="to_world"><rotate y="1" angle="60"/><translate x="1" y="0.5"/>'
        "</transform></shape>"
    ),
    "references": shape(
        '<shape type="sphere"><point name="center" value="0, 1, 0"/><ref id="later"/></shape>'
        '<texture type="checkerboard" id="squares"><rgb name="color0" value="0.9 0.1 0.1"/></texture>'
        '<bsdf type="diffuse" id="later"><ref name="reflectance" id="squares"/></bsdf>'
    ),
    "thinlens": ball('<bsdf type="diffuse"/>').replace(
        '<sensor type="perspective">',
        '<sensor type="thinlens"><float name="aperture_radius" value="0.4"/><float name="focus_distance" value="5"/>',
    ),
    "orthographic": ball('<bsdf type="diffuse"/>')
    .replace('<sensor type="perspective">', '<sensor type="orthographic">')
    .replace('<float name="fov" value="40"/>', "")
    .replace('up="0, 1, 0"/>', 'up="0, 1, 0"/>')
    .replace("<lookat origin", '<scale x="3" y="3"/><lookat origin'),
    "fov_y": ball('<bsdf type="diffuse"/>').replace(
        '<float name="fov" value="40"/>', '<float name="fov" value="40"/><string name="fov_axis" value="smaller"/>'
    ),
    "focal_length": ball('<bsdf type="diffuse"/>').replace(
        '<float name="fov" value="40"/>',
        '<string name="focal_length" value="60mm"/><float name="principal_point_offset_x" value="0.1"/>',
    ),
    "crop": ball('<bsdf type="diffuse"/>').replace(
        '<rfilter type="box"/>',
        '<rfilter type="tent"/><integer name="crop_offset_x" value="8"/><integer name="crop_offset_y" value="4"/>'
        '<integer name="crop_width" value="16"/><integer name="crop_height" value="16"/>',
    ),
    "mitchell": ball('<bsdf type="diffuse"/>').replace('"box"', '"mitchell"'),
    "gaussian": ball('<bsdf type="diffuse"/>').replace('<rfilter type="box"/>', ""),
    "direct": ball('<bsdf type="diffuse"/>').replace(
        '<integrator type="path"><integer name="max_depth" value="6"/>', '<integrator type="direct">'
    ),
}

#: Scenes of older versions beside the same scene of today: pairs that are read alike. Mitsuba opens the second of each.
OLD: dict[str, tuple[str, str]] = {
    "camel_case": (
        scene(
            '<shape type="rectangle"><transform name="toWorld"><rotate x="1" angle="-90"/></transform>'
            '<bsdf type="twosided"><bsdf type="roughplastic"><string name="distribution" value="ggx"/>'
            '<float name="intIOR" value="1.5"/><float name="extIOR" value="1"/>'
            '<srgb name="diffuseReflectance" value="#808080"/>'
            '<boolean name="nonlinear" value="true"/></bsdf></bsdf></shape>',
            version="0.5.0",
        ),
        scene(
            '<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/></transform>'
            '<bsdf type="twosided"><bsdf type="roughplastic"><string name="distribution" value="ggx"/>'
            '<float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/>'
            '<rgb name="diffuse_reflectance" value="0.21586050011389926"/>'
            '<boolean name="nonlinear" value="true"/></bsdf></bsdf></shape>'
        ),
    ),
    "luminaire": (
        scene(
            '<shape type="sphere"><boolean name="inverted" value="true"/><bsdf type="lambertian"><spectrum name="reflectance"'
            ' value="0.4"/></bsdf><luminaire type="area"><rgb name="intensity" value="1,2,3"/></luminaire></shape>'
            '<luminaire type="directional"><vector name="direction" x="0" y="-1" z="1e-008"/>'
            '<rgb name="intensity" value="1"/></luminaire>',
            version="0.3.0",
        ),
        scene(
            '<shape type="sphere"><boolean name="flip_normals" value="true"/><bsdf type="diffuse"><rgb name="reflectance"'
            ' value="0.4"/></bsdf><emitter type="area"><rgb name="radiance" value="1 2 3"/></emitter></shape>'
            '<emitter type="directional"><vector name="direction" x="0" y="-1" z="1e-8"/>'
            '<rgb name="irradiance" value="1"/></emitter>'
        ),
    ),
    "roughdiffuse": (
        scene(
            '<shape type="sphere"><bsdf type="roughdiffuse"><spectrum name="diffuseReflectance" value="0.4"/>'
            '<boolean name="useFastApprox" value="true"/></bsdf></shape>',
            version="0.6.0",
        ),
        scene(
            '<shape type="sphere"><bsdf type="roughdiffuse"><rgb name="reflectance" value="0.4"/>'
            '<boolean name="use_fast_approx" value="true"/></bsdf></shape>'
        ),
    ),
    "sunsky": (
        scene(
            '<emitter type="sky"><float name="turbidity" value="4"/><vector name="sunDirection" x="1" y="2" z="3"/>'
            '<float name="scale" value="3"/><integer name="resolution" value="1024"/></emitter>',
            version="0.6.0",
        ),
        scene(
            '<emitter type="sunsky"><float name="turbidity" value="4"/><vector name="sun_direction" x="1" y="2" z="3"/>'
            '<float name="sky_scale" value="3"/><float name="sun_scale" value="0"/><rgb name="albedo" value="0.2"/>'
            '<transform name="to_world"><rotate x="1" angle="-90"/></transform></emitter>'
        ),
    ),
    "uoffset": (
        scene(
            '<shape type="rectangle"><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">'
            '<float name="uscale" value="3"/><float name="vscale" value="2"/><float name="uoffset" value="0.25"/></texture>'
            "</bsdf></shape>",
            version="0.6.0",
        ),
        scene(
            '<shape type="rectangle"><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">'
            '<transform name="to_uv"><scale x="3" y="2"/><translate x="0.25"/></transform></texture></bsdf></shape>'
        ),
    ),
}

#: Scenes with plugins that have no exact twin: what becomes of the ball, and words of the warning.
NEAREST: dict[str, tuple[str, str, str]] = {
    "coating": (
        ball('<bsdf type="coating"><bsdf type="diffuse"/></bsdf>'),
        "plastic",
        'bsdf "coating" becomes plastic',
    ),
    "roughcoating": (
        ball('<bsdf type="roughcoating"><float name="alpha" value="0.3"/><bsdf type="diffuse"/></bsdf>'),
        "roughplastic",
        'bsdf "roughcoating" becomes roughplastic',
    ),
    "ward": (
        ball('<bsdf type="ward"><rgb name="diffuse_reflectance" value="0"/><float name="alpha_u" value="0.2"/></bsdf>'),
        "roughconductor",
        'bsdf "ward" becomes roughconductor',
    ),
    "ward_diffuse": (ball('<bsdf type="ward"/>'), "blend", 'bsdf "ward" becomes roughconductor'),
    "difftrans": (
        ball('<bsdf type="difftrans"><rgb name="transmittance" value="0.5"/></bsdf>'),
        "diffuse",
        'bsdf "difftrans" becomes diffuse',
    ),
    "mine": (ball('<bsdf type="mine"><float name="glow" value="2"/></bsdf>'), "diffuse", 'bsdf "mine" becomes diffuse'),
    "phong_facets": (
        ball('<bsdf type="roughconductor"><string name="distribution" value="phong"/></bsdf>'),
        "roughconductor",
        'bsdf "roughconductor": distribution "phong" becomes beckmann',
    ),
    "timed_sunsky": (lamp('<emitter type="timed_sunsky"/>'), "diffuse", 'emitter "timed_sunsky" becomes sky'),
    "collimated": (lamp('<emitter type="collimated"/>'), "diffuse", 'emitter "collimated" is left out'),
    "sppm": (ball('<bsdf type="diffuse"/>').replace('type="path"', 'type="sppm"'), "diffuse", "becomes vcm"),
}


def write_assets(folder: Path) -> None:
    """Write the files that the scenes name."""
    from torchpt import write_image

    rng = np.random.default_rng(3)
    coarse = rng.integers(0, 255, (8, 6, 3), dtype=np.uint8)
    Image.fromarray(coarse).save(folder / "a picture.png")
    Image.fromarray(rng.integers(40, 255, (5, 7), dtype=np.uint8)).save(folder / "grey.png")
    normals = np.zeros((4, 4, 3), np.uint8) + np.array([128, 128, 255], np.uint8)
    normals[::2, ::2] = [170, 100, 230]
    Image.fromarray(normals).save(folder / "normals.png")
    sky = rng.random((8, 16, 3)).astype(np.float32)
    sky[2, 3] = 20.0
    write_image(str(folder / "sky.exr"), torch.from_numpy(sky))
    (folder / "meshes").mkdir(exist_ok=True)
    (folder / "meshes" / "roof.obj").write_text(
        "v -0.8 0 0.5\nv 0.8 0 0.5\nv 0.8 0.6 0\nv -0.8 0.6 0\nv -0.8 0 -0.5\nv 0.8 0 -0.5\n"
        "vt 0 0\nvt 1 0\nvt 1 0.6\nvt 0 0.6\nvt 0 1\nvt 1 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\nf 4/4 3/3 6/6\nf 4/4 6/6 5/5\n"
    )
    tent = {
        "vertices": [[-1, 0, 0.5], [1, 0, 0.5], [0, 0, -1], [0, 1.2, 0]],
        "faces": [[0, 1, 3], [1, 2, 3], [2, 0, 3]],
    }
    textured = {
        **tent,
        "uvs": [[0, 0], [1, 0], [0.3, 0.8], [0.5, 0.5]],
        "normals": np.add(tent["vertices"], [0, 0.3, 0.1]),
    }
    (folder / "meshes" / "two.serialized").write_bytes(serialized_bytes([tent, textured], 4, double=True))
    (folder / "meshes" / "old.serialized").write_bytes(serialized_bytes([textured, tent], 3))
    (folder / "meshes" / "attributes.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty float red\n"
        "property float green\nproperty float blue\nproperty float gloss_0\nelement face 3\n"
        "property list uchar int vertex_indices\nproperty float shade_1\nproperty float shade_2\nproperty float shade_3\n"
        "end_header\n-1 0 0.5 0.9 0 0 0.9\n1 0 0.5 0 0.8 0 0.1\n0 0 -1 0.2 0.2 0.9 0.5\n0 1.2 0 0.9 0.9 0.1 0.3\n"
        "3 0 1 3 0.8 0.1 0.2\n3 1 2 3 0.1 0.7 0.1\n3 2 0 3 0.2 0.3 0.9\n"
    )
    (folder / "meshes" / "tent.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty float u\n"
        "property float v\nelement face 3\nproperty list uchar int vertex_indices\nend_header\n"
        "-1 0 0.5 0 0\n1 0 0.5 1 0\n0 0 -1 0.3 0.8\n0 1.2 0 0.5 0.5\n3 0 1 3\n3 1 2 3\n3 2 0 3\n"
    )
