"""Textures of Mitsuba's XML at random points: what the importer makes of them beside what Mitsuba reads."""

from __future__ import annotations

import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mitsuba_corpus import scene, write_assets

import torchpt
from torchpt.core.errors import ImportedSceneWarning
from torchpt.paths.surface import surface_at
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit

pytestmark = pytest.mark.mitsuba

POINTS = 1000
_FILE = '<string name="filename" value="a picture.png"/>'
_SHEAR = '<matrix value="1.3 0.4 0 0.2 -0.3 0.9 0 -0.6 0 0 1 0 0 0 0 1"/>'
#: Contents of a texture, by what is tried.
TEXTURES = {
    "as it is": ("bitmap", _FILE),
    "raw": ("bitmap", _FILE + '<boolean name="raw" value="true"/>'),
    "moved": ("bitmap", _FILE + '<transform name="to_uv"><translate x="0.3" y="-1.2"/></transform>'),
    "turned": (
        "bitmap",
        _FILE
        + '<transform name="to_uv"><rotate z="1" angle="35"/><translate x="0.3"/><scale x="2" y="-1.5"/></transform>',
    ),
    "sheared": ("bitmap", f'{_FILE}<transform name="to_uv">{_SHEAR}</transform>'),
    "turned before it is stretched": (
        "bitmap",
        _FILE + '<transform name="to_uv"><rotate z="1" angle="35"/><scale x="3" y="0.5"/></transform>',
    ),
    "one line": (
        "bitmap",
        _FILE + '<transform name="to_uv"><scale x="0" y="1"/><rotate z="1" angle="20"/></transform>',
    ),
    "mirror": (
        "bitmap",
        f'{_FILE}<string name="wrap_mode" value="mirror"/><transform name="to_uv">{_SHEAR}<scale value="2"/></transform>',
    ),
    "clamp": (
        "bitmap",
        f'{_FILE}<string name="wrap_mode" value="clamp"/><transform name="to_uv">{_SHEAR}</transform>',
    ),
    "nearest": (
        "bitmap",
        f'{_FILE}<string name="filter_type" value="nearest"/><transform name="to_uv">{_SHEAR}</transform>',
    ),
    "checkerboard": ("checkerboard", f'<transform name="to_uv">{_SHEAR}<scale value="3"/></transform>'),
}


@cache
def mitsuba() -> Any:
    from mitsuba_scene import load_mitsuba

    return load_mitsuba("scalar_rgb")


@pytest.mark.parametrize("name", TEXTURES)
def test_reflectances_are_mitsubas(tmp_path: Path, name: str) -> None:
    write_assets(tmp_path)
    kind, inner = TEXTURES[name]
    file = tmp_path / "scene.xml"
    texture = f'<texture type="{kind}" name="reflectance">{inner}</texture>'
    file.write_text(scene(f'<shape type="rectangle"><bsdf type="diffuse">{texture}</bsdf></shape>'))
    with warnings.catch_warnings():
        warnings.simplefilter("error", ImportedSceneWarning)
        ours = torchpt.load(str(file), "cpu")
    theirs = mitsuba().load_file(str(file))

    place = 2.0 * torch.rand(2, POINTS, generator=torch.Generator().manual_seed(5)) - 1.0
    o = torch.cat((place, torch.ones(1, POINTS)))
    d = torch.tensor([[0.0], [0.0], [-1.0]]).expand(3, POINTS).contiguous()
    world, _ = ours.world(torch.float64)
    t, prim, u, v = ours.accel("auto", 1).intersect(o, d, torch.full((POINTS,), torch.inf))
    at = interact(world, o.double(), d.double(), Hit(t.double(), prim.long(), u.double(), v.double()), follow_ray=True)
    found = surface_at(world, 0, d.double(), at).parameters["reflectance"]

    expected = np.zeros((3, POINTS))
    for lane, (origin, direction) in enumerate(zip(o.T.tolist(), d.T.tolist(), strict=True)):
        si = theirs.ray_intersect(mitsuba().Ray3f(origin, direction))
        expected[:, lane] = si.bsdf().eval_diffuse_reflectance(si)
    assert expected.std() > 0.05
    off = np.abs(found.numpy() - expected).max(0) > 1e-4
    assert off.mean() <= (0.005 if name in ("nearest", "checkerboard") else 0.0), name  # beside edges, by rounding
