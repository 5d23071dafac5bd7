"""Scenes of Mitsuba whose picture would differ without a word: what they become, and what the import says of them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
from mitsuba_corpus import scene

from torchpt.core.errors import ImportedSceneWarning, SceneError
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
