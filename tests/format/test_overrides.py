"""Overrides of a scene's keys: what each kind of value does, and what is wrong with the others."""

from __future__ import annotations

import copy
import random
from pathlib import Path
from typing import Any

import pytest
import torch

import torchpt
from torchpt import SceneError, TorchptError
from torchpt.cli.arguments import SCENE_BLOCKS, parse
from torchpt.cli.grammar import read_word
from torchpt.physics import bsdfs, cameras, lights, shapes, textures
from torchpt.scene.fingerprint import fingerprint
from torchpt.scene.formats.compose import KEYS, PATHS
from torchpt.scene.formats.description import Description, read_description
from torchpt.scene.formats.overrides import override_words
from torchpt.scene.settings import BLOCKS
from torchpt.spec import parameters_of
from torchpt.spec.parameters import Path as PathSpec

SCENE: dict[str, Any] = {
    "camera": {"origin": [0, 1, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 24, "height": 16},
    "textures": {"squares": {"type": "checkerboard", "scale": 2}},
    "materials": {
        "white": {"type": "diffuse", "reflectance": [0.7, 0.7, 0.7]},
        "shiny": {"type": "roughconductor", "material": "Cu", "alpha": 0.2},
        "a.b": {"type": "diffuse"},
    },
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": "white",
            "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 3}],
        },
        "ball": {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "material": "shiny"},
    },
    "lights": {"sky": {"type": "constant", "radiance": 0.5}, "lamp": {"type": "point", "position": [0, 3, 0], "intensity": 4}},
}  # fmt: skip


def changes_of(*words: str) -> dict[str, Any]:
    """Return words of the command line as `torchpt.load` takes them."""
    return {key: values[0] for key, values in parse("render", ["scene=x.yaml", *words]).scene_keys}


def changed(*words: str) -> Description:
    return read_description(SCENE, overrides=changes_of(*words))


#: A word and the same by hand: where, and what stands there then.
KINDS = {
    "number": ("camera.fov=20", "camera.fov", 20),
    "colour": ("materials.white.reflectance=[0,0,1]", "materials.white.reflectance", [0, 0, 1]),
    "grey": ("materials.white.reflectance=.5", "materials.white.reflectance", 0.5),
    "component": ("materials.white.reflectance.1=.1", "materials.white.reflectance", [0.7, 0.1, 0.7]),
    "texture in place": (
        "materials.white.reflectance={type: checkerboard, color0: [1, 0, 0], scale: 8}",
        "materials.white.reflectance", {"type": "checkerboard", "color0": [1, 0, 0], "scale": 8},
    ),
    "named texture": ("materials.white.reflectance={texture: squares}", "materials.white.reflectance", {"texture": "squares"}),
    "key of a texture": ("textures.squares.scale=[4,1]", "textures.squares.scale", [4, 1]),
    "choice": ("camera.fov_axis=smaller", "camera.fov_axis", "smaller"),
    "flag": ("materials.white.two_sided=false", "materials.white.two_sided", False),
    "vector": ("shapes.ball.center=[1,2,3]", "shapes.ball.center", [1, 2, 3]),
    "transform": (
        "shapes.ball.transform=[{scale: 2},{translate: [0,1,0]}]",
        "shapes.ball.transform", [{"scale": 2}, {"translate": [0, 1, 0]}],
    ),
    "step of a transform": (
        "shapes.floor.transform.0.rotate.angle=-80", "shapes.floor.transform",
        [{"rotate": {"axis": [1, 0, 0], "angle": -80}}, {"scale": 3}],
    ),
    "one step more": (
        "+shapes.floor.transform.2={translate: [0,1,0]}", "shapes.floor.transform",
        [*SCENE["shapes"]["floor"]["transform"], {"translate": [0, 1, 0]}],
    ),
    "material by name": ("shapes.ball.material=white", "shapes.ball.material", "white"),
    "material in place": ("shapes.ball.material={type: plastic}", "shapes.ball.material", {"type": "plastic"}),
    "emission": ("+materials.shiny.emission=3", "materials.shiny.emission", 3),
    "null": ("materials.shiny.alpha=null", "materials.shiny.alpha", None),
    "name with a dot": ("materials.a.b.reflectance=.2", "materials.a\0b.reflectance", 0.2),
    "film": ("", "film.width", 24),
    "light": ("lights.lamp.position=[1,1,1]", "lights.lamp.position", [1, 1, 1]),
    "a new shape": ("+shapes.cube={type: cube, material: white}", "shapes.cube", {"type": "cube", "material": "white"}),
    "a cast": ("camera.fov=float(30)", "camera.fov", 30.0),
}  # fmt: skip


@pytest.mark.parametrize(("word", "key", "value"), KINDS.values(), ids=list(KINDS))
def test_a_value_of_each_kind_is_as_if_written_there(word: str, key: str, value: Any) -> None:
    scene: dict[str, Any] = {block: keys for block, keys in SCENE.items()}
    place = scene
    *parts, last = (part.replace("\0", ".") for part in key.split("."))
    for part in parts:
        place[part] = dict(place[part])
        place = place[part]
    place[last] = value
    by_hand, by_word = read_description(scene), changed(*([word] if word else []))
    for block in ("camera", "film", "textures", "materials", "shapes", "lights"):
        assert getattr(by_word, block) == getattr(by_hand, block)
    assert changes_of(*by_word.overrides) == changes_of(*([word] if word else []))  # what is told can be said again


def test_blocks_of_settings_are_overridden_in_python() -> None:
    scene = torchpt.load(
        SCENE,
        "cpu",
        overrides={"film.width": 12, "integrator": "direct", "sampler.type": "independent", "render.spp": 3},
    )
    full = torchpt.render(scene, full=True, compile="off")
    assert full.image.shape == (8, 12, 3) and full.spp == 3  # the height follows: 24 x 16
    assert full.settings is not None and (full.settings.integrator.name, full.settings.sampler.name) == (
        "direct",
        "independent",
    )
    assert full.header()["overrides"] == "film.width=12 integrator=direct sampler.type=independent render.spp=3"


def test_a_type_keeps_what_another_reads_too() -> None:
    found = changed("camera.type=thinlens", "camera.aperture_radius=.1", "camera.focus_distance=4")
    assert found.camera.name == "thinlens" and found.camera["fov"] == 40
    assert changed("camera={type: orthographic, width: 3}").camera["origin"] == (0, 1, 4)
    found = changed("shapes.ball.type=cube")
    assert found.shapes["ball"].name == "cube" and found.shapes["ball"]["material"] == "shiny"
    assert changed("shapes.ball.radius=2", "shapes.ball.type=cylinder").shapes["ball"]["radius"] == 2  # in any order
    found = changed("shapes.ball={type: cube}")  # a thing of another type takes its place
    assert found.shapes["ball"]["material"] is None
    assert changed("materials.white={type: conductor, material: Ag}").materials["white"].given == {"material"}


def test_a_type_of_null_is_that_material() -> None:
    for word in ("materials.white.type=null", "materials.white={type: null}", "shapes.ball.material={type: null}"):
        found = changed(word)
        assert "null" in (found.materials["white"].name, getattr(found.shapes["ball"]["material"], "name", ""))


def test_what_was_written_stays_as_it_is() -> None:
    before = copy.deepcopy(SCENE)
    changed(
        "materials.white.reflectance.0=0",
        "shapes.floor.transform.0.rotate.angle=3",
        "~lights.sky",
        "+shapes.floor.transform.2={scale: 2}",
    )
    changed(
        *(
            word
            for word, *_ in KINDS.values()
            if word.startswith(("shapes.ball.material=w", "camera.fov=2", "textures"))
        )
    )
    assert before == SCENE
    ball = {"type": "sphere", "center": [0, 0, 0]}
    read_description(SCENE, overrides={"+shapes.b": ball, "shapes.b.radius": 3, "shapes.b.center.1": 2})
    assert ball == {"type": "sphere", "center": [0, 0, 0]}
    with pytest.raises(SceneError, match="which is to be removed"):
        read_description(SCENE, overrides={"~camera.origin": torch.zeros(3)})


def test_things_come_and_go() -> None:
    found = changed("~lights.sky", "+lights.sun={type: directional, direction: [0,-1,0]}", "~shapes.ball")
    assert list(found.lights) == ["lamp", "sun"] and list(found.shapes) == ["floor"]
    assert list(changed("lights.sky=null").lights) == ["lamp"]
    found = (
        changed("+shapes.ball={type: cube}", "~shapes.ball")
        if False
        else changed("~shapes.ball", "+shapes.ball={type: cube}")
    )
    assert found.shapes["ball"].name == "cube" and found.shapes["ball"]["material"] is None
    assert changed("~camera.fov=40").camera["fov"] != 40 and list(changed("lights=null").lights) == []
    assert list(changed("lights={lamp: null}").lights) == ["sky"]


def test_paths_start_where_they_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scenes").mkdir()
    for folder, corner in (("scenes", 1), (".", 2)):
        (tmp_path / folder / "m.ply").write_text(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            f"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n{corner} 0 0\n0 {corner} 0\n3 0 1 2\n"
        )
    (tmp_path / "scenes" / "s.yaml").write_text(
        "camera: {origin: [0, 0, 4], target: [0, 0, 0]}\nshapes: {m: {type: mesh, path: m.ply}}\n"
    )
    monkeypatch.chdir(tmp_path)
    for overrides, corner in (
        ({"camera.fov": 20}, 1), ({"shapes.m.path": "m.ply"}, 2), ({"shapes.m.path": ["no.ply", "m.ply"]}, 2),
        ({"shapes.m": {"path": str(tmp_path / "m.ply")}}, 2), ({"shapes.m": {"path": "m.ply"}}, 2),
        ({"~shapes.m": None, "+shapes.m": {"type": "mesh", "path": "m.ply"}}, 2),
    ):  # fmt: skip
        scene = torchpt.load("scenes/s.yaml", "cpu", overrides=overrides)
        assert float(scene.params["shapes.m.vertices"].max()) == corner
    with pytest.raises(torchpt.AssetError, match=r"no\.ply: no such file, named by shapes\.m\.path$"):
        torchpt.load("scenes/s.yaml", "cpu", overrides={"shapes.m.path": "no.ply"})
    declared = {
        name
        for table in (bsdfs.KINDS, cameras.KINDS, lights.KINDS, shapes.KINDS, textures.KINDS)
        for kind in table.values()
        for name, spec in parameters_of(kind).items()
        if isinstance(spec, PathSpec)
    }
    assert declared == set(PATHS)


def test_tensors_among_overrides_get_gradients() -> None:
    fov = torch.tensor(40.0, requires_grad=True)
    paint = torch.tensor([0.2, 0.4, 0.6], requires_grad=True)
    scene = torchpt.load(SCENE, "cpu", overrides={"camera.fov": fov, "materials.white.reflectance": paint})
    assert scene.params["camera.fov"].requires_grad
    with pytest.warns(torchpt.EdgeWarning):
        image = torchpt.render(scene, spp=2, edges=False, film={"width": 8})
    image.mean().backward()
    assert paint.grad is not None and bool(paint.grad.gt(0).all()) and fov.grad is not None
    assert scene.description.overrides == ("camera.fov=40.0", "materials.white.reflectance=<Tensor 3>")


def test_blocks_are_the_same_where_they_are_listed_twice() -> None:
    assert set(SCENE_BLOCKS) == set(KEYS) - set(BLOCKS) - {"defaults"} | {
        "import",
        "scene_params",
    }  # of imported scenes


#: Words, and what their line says.
WRONG = {
    "an unknown key": (["materials.white.reflectnce=1"], r"materials\.white\.reflectnce: .* \(did you mean reflectance\?\)"),
    "an unknown thing": (["materials.wite.reflectance=1"], r"materials\.wite: .*mean white\?.*\+materials\.wite= adds one"),
    "a wrong type": (["camera.fov=wide"], r"camera\.fov: expected .*, got 'wide'"),
    "out of range": (["materials.white.reflectance=[0,0,7]"], r"materials\.white\.reflectance: expected .* got \[0, 0, 7\]"),
    "an unknown type": (["shapes.ball.type=sphre"], r"shapes\.ball\.type: .*did you mean sphere\?"),
    "a material that is not there": (["shapes.ball.material=whit"], r"shapes\.ball\.material: expected the name of a material"),
    "removal of what is absent": (["~lights.skye"], r"lights\.skye: expected the name of a light .*did you mean sky\?"),
    "removal of a key that is absent": (["~camera.fo"], r"camera\.fo: .*did you mean camera\.fov\?"),
    "removal of another value": (["~camera.fov=3"], r"camera\.fov: expected 3, which is to be removed, got 40"),
    "adding what is there": (["+shapes.ball={type: cube}"], r"shapes\.ball: expected a key that is not there yet"),
    "adding a key that is there": (["+camera.fov=3"], r"camera\.fov: expected a key that is not there yet"),
    "a target": (["+shapes.x={type: sphere, _target_: os.system}"], "_target_"),
    "a target as key": (["shapes.ball._target_=os.system"], "_target_"),
    "bad grammar": (["camera.fov=[1,2"], r"camera\.fov=\[1,2: expected key=value"),
    "an index out of a list": (["shapes.floor.transform.7.scale=2"], r"transform\.7\.scale: expected an index 0\.\.1 of "),
    "a key of a list": (["materials.white.reflectance.r=1"], r"reflectance\.r: expected an index 0\.\.2"),
    "a key of a number": (["camera.fov.x=1"], r"camera\.fov\.x: expected camera\.fov to be a mapping"),
    "given twice": (["camera.fov=1", "camera.fov=2"], r"camera\.fov: given twice"),
    "given twice, otherwise": (["camera.fov=1", "++camera.fov=2"], r"camera\.fov: expected to be given once"),
    "no value": (["camera.fov"], "expected key=value"),
    "a sweep": (["camera.fov=1,2"], r"camera\.fov=1,2: expected one value"),
    "an interval": (["camera.fov=interval(1,2)"], r"camera\.fov: expected values a,b"),
    "a glob": (["camera.fov=glob(*)"], r"camera\.fov: expected values a,b"),
    "interpolation": (["camera.fov=${film.width}"], "scenes know no interpolation"),
    "keys that are no text": (["materials.white={1: 2}"], "expected text as keys"),
    "an empty part": (["camera..fov=1"], r"camera\.\.fov: expected a dotted key"),
    "the version": (["version=2"], "version: expected 1, got 2"),
    "no camera": (["~camera"], "camera: expected a camera"),
    "no mapping": (["shapes=3"], "shapes: expected a mapping from names to shapes, got 3"),
}  # fmt: skip


@pytest.mark.parametrize(("words", "line"), WRONG.values(), ids=list(WRONG))
def test_what_is_wrong_takes_one_line(words: list[str], line: str) -> None:
    with pytest.raises(TorchptError, match=line) as caught:
        changed(*words)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        ([("camera.fov", 1)], "overrides: expected a mapping"),
        ({3: 1}, "overrides: expected dotted keys"),
        ({"": 1}, "expected a dotted key"),
        ({"defaults": ["cornell_box"]}, "defaults: expected a key of a scene"),
        ({"material.white": 1}, r"did you mean materials\.white\?"),
        ({"camera.fov": object()}, r"camera\.fov: expected"),
        ({"render.checkpoint": "x"}, r"render\.checkpoint: expected null"),
        ({"x." * 200 + "x": 1}, "expected a dotted key"),
    ],
)
def test_what_is_wrong_in_python(overrides: Any, line: str) -> None:
    with pytest.raises(SceneError, match=line):
        read_description(SCENE, overrides=overrides)


def test_errors_of_a_file_and_of_overrides_are_told_apart(tmp_path: Path) -> None:
    file = tmp_path / "s.yaml"
    file.write_text(
        "camera: {origin: [0, 0, 4], target: [0, 0, 0], fov: 400}\nmaterials: {m: {type: diffuse, reflectance: 0.5}}\n"
    )
    with pytest.raises(SceneError, match=r"s\.yaml: camera\.fov: expected"):
        read_description(file, overrides={"materials.m.reflectance": 0.2})
    with pytest.raises(SceneError, match=r"^materials\.m\.reflectance: expected"):
        read_description(file, overrides={"materials.m.reflectance": 2, "camera.fov": 40})


def test_a_scene_is_as_if_it_had_been_written(tmp_path: Path) -> None:
    ball = {"type": "sphere", "center": [300, 400, 300], "radius": 50}
    one = torchpt.load(
        "cornell_box", "cpu", overrides={"camera.fov": 20, "+shapes.ball": ball, "~shapes.tall_box": None}
    )
    text = (Path(__file__).parents[2] / "configs" / "scene" / "cornell_box.yaml").read_text()
    text = text.replace("fov: 39.3077", "fov: 20")
    text = text[: text.index("  tall_box:")] + "  ball: {type: sphere, center: [300, 400, 300], radius: 50}\n"
    other = torchpt.load(text, "cpu")
    assert fingerprint(one) == fingerprint(other)
    wishes: dict[str, Any] = {"spp": 2, "film": {"width": 16}, "compile": "off"}
    assert torch.equal(torchpt.render(one, **wishes), torchpt.render(other, **wishes))


#: What keys and values are made of, between bars.
PIECES = (
    "camera|fov|materials|white|shiny|reflectance|shapes|ball|floor|transform|0|1|-1|rotate|angle|radius|type|lights|sky|lamp"
    "|textures|squares|scale|material|version|emission|path|a.b|| |_target_|\u00e9|to_world|displacement|texture|film|null"
    f"|{'x' * 300}"
).split("|")
VALUES = (
    "1|-1|0|1e400|nan|inf|null|true|[]|{}|[1,2,3]|[[1,2],[3]]|{type: sphere}|{type: diffuse}|white|shiny|'a b'|[{scale: 2}]"
    "|[{scale: [1,2]}]|{texture: squares}|{texture: none}|1,2|range(1,3)|float(x)|${x}||'|[1|a=b|{a: {b: {c: 1}}}|{type: blend}"
    "|{type: image, path: x}|sphere|cube|mesh|9999999999999999999|glob(*)|\\|\u2028|{_target_: os.system}|[null]|~|{1: 2}|1_0"
).split("|")


def drawn(dice: random.Random) -> str:
    """Return a word: one that is right, or one of which a piece is another, or any pieces."""
    sign, parts = dice.choice(("", "", "", "+", "++", "~")), [dice.choice(SCENE_BLOCKS)]
    parts += [dice.choice(PIECES) for _ in range(dice.randrange(4))]
    value = dice.choice(VALUES)
    if dice.random() < 0.75:
        right = dice.choice([word for word, *_ in KINDS.values() if word])
        key, _, text = right.partition("=")
        kind = dice.randrange(6)
        if kind > 1:
            return right
        sign, parts, value = "", key.split("."), value if kind == 1 else text
        if kind == 0:
            parts[dice.randrange(len(parts))] = dice.choice(PIECES)
    return f"{sign}{'.'.join(parts)}{dice.choice(('=', '=', '=', '=', ''))}{value}"


@pytest.mark.parametrize("count", [2000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_any_overrides_are_taken_or_refused_in_a_line(count: int) -> None:
    dice = random.Random(count)
    taken = 0
    for _ in range(count):
        words = [drawn(dice) for _ in range(dice.choice((1, 1, 1, 2, 3)))]
        try:
            changed(*words)
            taken += 1
        except TorchptError as error:
            assert len(str(error).splitlines()) == 1, words
    assert 0.2 * count < taken < 0.8 * count


def test_words_are_told_as_they_can_be_said() -> None:
    values: dict[str, Any] = {
        "camera.a": "it's, [so]", "camera.b": 1e-7, "camera.c": [True, None, "x y"],
        "camera.d": {"e": [1, {"f": "null"}]}, "camera.g": "",
        "camera.h": "back\\slash", "camera.m": "at the end\\", "camera.n": "both\\'s", "camera.i": "1",
        "camera.j": "$TORCHPT_ASSETS/a-b.ply", "camera.k": "é", "~camera.l": None,
    }  # fmt: skip
    assert {key: values for word in override_words(values) for key, (values,), _ in [read_word(word)]} == values
