"""The arguments of `render` are declared once: signatures, checks, keys of the command line and docs follow from that."""

from __future__ import annotations

import inspect
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, TypedDict, Unpack

import pytest
import torch

import torchpt
from torchpt.cli.arguments import GROUPS, path_keys
from torchpt.core.errors import SceneError
from torchpt.scene.settings import (
    BLOCKS,
    UNTYPED_BLOCKS,
    BatchOptions,
    CommonOptions,
    Render,
    RendererOptions,
    RenderOptions,
    TraceOptions,
)
from torchpt.spec import Role, parameters_of
from torchpt.spec.arguments import arguments_of, expand_signature

ROOT = Path(__file__).parents[2]
BALL: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
    "film": {"width": 4, "height": 4},
    "shapes": {"ball": {"type": "sphere", "material": {"type": "diffuse"}}},
    "lights": {"sky": {"type": "constant", "radiance": 1.0}},
}


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load(BALL, "cpu")


@pytest.mark.parametrize(
    ("function", "own", "form"),
    [
        (torchpt.render, ("scene", "full"), CommonOptions),
        (torchpt.trace, ("scene", "o", "d", "spp", "seed", "params"), TraceOptions),
        (torchpt.render_batch, ("scenes", "cameras", "params", "spp", "seed", "on_progress", "full"), BatchOptions),
        (torchpt.nn.Renderer, ("scene", "names", "seed", "rigid", "parametrizations", "full"), RendererOptions),
        (torchpt.nn.Renderer.forward, ("self", "params", "seed", "full"), RendererOptions),
    ],
)
def test_signatures_spell_every_argument_out(function: Any, own: tuple[str, ...], form: Any) -> None:
    signature = inspect.signature(function)
    assert tuple(signature.parameters) == (*own, *arguments_of(form))
    for name, argument in arguments_of(form).items():
        shown = signature.parameters[name]
        assert (shown.kind, shown.default, shown.annotation) == (shown.KEYWORD_ONLY, argument.default, argument.type)


def test_signatures_are_as_they_were_written_by_hand() -> None:
    shown = inspect.signature(torchpt.render).parameters
    assert str(shown["edge_spp"]) == "edge_spp: int | None = None" and str(shown["edges"]) == "edges: bool = True"
    assert shown["dtype"].default is torch.float32 and shown["adjoint"].default is None and len(shown) == 26


def test_help_says_what_each_argument_is() -> None:
    lines = [line.strip() for line in (inspect.getdoc(torchpt.render) or "").splitlines()]
    for name, argument in arguments_of(CommonOptions).items():
        assert sum(line.startswith(f"{name}: {argument.spec.doc}") for line in lines) == 1
    assert (
        "spp: samples a pixel; a limit of time or error may end sooner (a whole number 1..2147483647; None: 64)"
        in lines
    )


def test_the_block_of_scene_files_has_the_settings_among_them() -> None:
    own = {"params", "full", "dtype", "adjoint", "seed_grad", "spp_grad", "edges", "edge_spp", "ranks", "edge_guide"}
    assert {*arguments_of(RenderOptions)} - own == {*parameters_of(Render), *BLOCKS} - {"preview", "render"}


def test_the_command_line_knows_blocks_and_files() -> None:
    assert GROUPS == BLOCKS
    files = {
        f"{b}.{name}"
        for b, r in UNTYPED_BLOCKS.items()
        for name, s in parameters_of(r).items()
        if "file path" in s.words
    }
    assert {*path_keys()} == files == {"render.checkpoint", "render.preview"}


def test_an_argument_without_a_spec_is_no_declaration() -> None:
    class Form(TypedDict, total=False):
        plain: int

    Form.__annotations__["plain"] = int
    with pytest.raises(TypeError, match=r"Form.plain has no spec"):
        arguments_of(Form)


def test_what_a_function_says_itself_comes_first() -> None:
    @expand_signature
    def f(scene: int, *, seed: int = 0, **wishes: Unpack[RendererOptions]) -> None:
        """Do it."""

    assert tuple(inspect.signature(f).parameters)[:3] == ("scene", "seed", "spp")
    assert (f.__doc__ or "").startswith("Do it.\n\nWishes:\n    spp: samples a pixel")


UNKNOWN = [({"sp": 1}, "'sp'. Did you mean 'spp'?"), ({"preview": "a.png"}, "'preview'"), ({"ful": 1}, "mean 'full'?")]


@pytest.mark.parametrize(("wishes", "says"), UNKNOWN)
def test_unknown_arguments_are_errors_in_pythons_words(scene: torchpt.Scene, wishes: Any, says: str) -> None:
    with pytest.raises(TypeError) as error:
        torchpt.render(scene, **wishes)
    assert str(error.value).startswith("render() got an unexpected keyword argument") and says in str(error.value)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"full": 1}, "full: expected True or False, got 1"),
    ({"full": None}, "full: expected True or False, got None"),
    ({"edges": None}, "edges: expected True or False, got None"),
    ({"edges": "no"}, "edges: expected True or False, got 'no'"),
    ({"dtype": None}, "dtype: expected torch.float32 or torch.float64, got None"),
    ({"dtype": torch.float16}, "dtype: expected torch.float32 or torch.float64, got torch.float16"),
    ({"adjoint": "radiative"}, "adjoint: expected replay or autograd, got 'radiative'"),
    ({"seed_grad": -1}, "seed_grad: expected a whole number >= 0, got -1"),
    ({"spp_grad": 0}, "spp_grad: expected a whole number >= 1, got 0"),
    ({"spp_grad": 2.0}, "spp_grad: expected a whole number >= 1, got 2.0"),
    ({"edge_spp": True}, "edge_spp: expected a whole number >= 1, got True"),
    ({"ranks": 2}, "ranks: expected a torchpt.ranks.Group, got 2"),
    (
        {"params": []},
        "params: expected a mapping from names of scene.params to tensors, or numbers and lists as in scene files, got []",
    ),
    ({"params": {3: 0}}, "params: expected names of scene.params such as "),
    ({"device": "meta"}, "device: expected the scene's own device cpu; load the scene on the other, got 'meta'"),
    ({"spp": 0}, "render.spp: expected a whole number 1..2147483647, got 0"),
    ({"time_limit": 0}, "render.time_limit: expected null or seconds > 0, got 0"),
    ({"resume": True}, "render.resume: expected false without render.checkpoint, the file to go on from, got True"),
    ({"film": 3}, "film: expected (width, height), or a mapping of settings, got 3"),
    ({"film": (8, 0)}, "film.height: expected a whole number 1..65536, got 0"),
    ({"film": (8, 8, 3)}, "film: expected (width, height), or a mapping of settings, got"),
]


@pytest.mark.parametrize(("wishes", "says"), WRONG, ids=str)
def test_wrong_values_are_errors_of_a_line(scene: torchpt.Scene, wishes: Any, says: str) -> None:
    with pytest.raises(SceneError) as error:
        torchpt.render(scene, **wishes)
    assert str(error.value).startswith(says) and "\n" not in str(error.value)


def test_none_is_what_nobody_said(scene: torchpt.Scene) -> None:
    unsaid = {name: argument.default for name, argument in arguments_of(CommonOptions).items()}
    wishes: Any = {**unsaid, "spp": 1, "compile": "off"}
    assert torch.equal(torchpt.render(scene, **wishes), torchpt.render(scene, spp=1, compile="off"))


def test_a_role_is_left_out() -> None:
    render = Render(time_limit=1.0, target_error=0.1, threads=2, checkpoint="a.npz", resume=True, preview="b.png")
    assert render.stops == {"time_limit": 1.0, "target_error": 0.1}
    assert render.without(Role.ENDS | Role.FILES) == Render(threads=2)


#: A stop rule that the renderer has not: file, what stands there, what is put before it.
TOY = {
    "scene/settings.py": (
        "    checkpoint: Annotated[",
        '    enough: Annotated[int | None, Integer(None, low=1, doc="samples that are enough", role=Role.ENDS)]\n',
    ),
    "rendering/stopping.py": (
        "        self.progress = min(",
        '        if self.render.enough is not None:\n            done["enough"] = taken / self.render.enough\n',
    ),
}
#: What the tree with the toy in it is asked.
QUESTIONS = """
import inspect, json, sys
sys.argv, ball = sys.argv[:1], json.loads(sys.argv[1])
import make_configs, make_tables, torchpt
from torchpt.cli.main import main
from torchpt.core.errors import SceneError
from torchpt.reports.study import variants_of

def refused(work):
    try:
        work()
    except (SceneError, TypeError) as error:
        return str(error)

assert make_configs.main() == make_tables.main() == 0
scene = torchpt.load(ball, "cpu")
wishes = {"spp": 64, "compile": "off", "threads": 1}
ended = torchpt.render(scene, enough=4, full=True, **wishes)
batch = torchpt.render_batch([scene], enough=4, full=True, **wishes)
module = torchpt.nn.Renderer(scene, enough=4, full=True, **wishes)()
answers = {
    "file": torchpt.__file__,
    "signatures": [str(inspect.signature(f).parameters["enough"])
                   for f in (torchpt.render, torchpt.render_batch, torchpt.nn.Renderer)],
    "help": inspect.getdoc(torchpt.render),
    "ended": [[each.stopped_by, each.spp] for each in (ended, batch[0, 0], module)],
    "wrong": refused(lambda: torchpt.render(scene, enough=0)),
    "near": refused(lambda: torchpt.render(scene, enugh=4)),
    "counted": refused(lambda: torchpt.render(scene, enough=4, sampler="hammersley")),
    "study": refused(lambda: variants_of({"render.enough": [4, 8]}, None)),
    "code": [main(["render", "scene=ball.yaml", "render.enough=4", "render.compile=off", "out=a.png"]),
             main(["render", "scene=ball.yaml", "render.enough=0", "out=b.png"]),
             main(["render", "--help"])],
}
print(json.dumps(answers))
"""


def test_a_new_stop_rule_is_one_declaration_and_its_use(tmp_path: Path) -> None:
    """In a copy of the tree: two files are edited, two scripts write what is made of them."""
    tree = tmp_path / "tree"
    for folder in ("torchpt", "configs", "scripts", "scenes"):
        shutil.copytree(ROOT / folder, tree / folder, ignore=shutil.ignore_patterns("__pycache__", "*.png"))
    shutil.copytree(ROOT / "docs", tree / "docs", ignore=shutil.ignore_patterns("images"))
    for name, (place, line) in TOY.items():
        file = tree / "torchpt" / name
        text = file.read_text(encoding="utf-8")
        assert text.count(place) == 1
        file.write_text(text.replace(place, line + place), encoding="utf-8")
    (tree / "ball.yaml").write_text(json.dumps(BALL), encoding="utf-8")
    path = os.pathsep.join([str(tree), str(tree / "scripts")])
    command = [sys.executable, "-c", QUESTIONS, json.dumps(BALL)]
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    *said, last = done.stdout.splitlines()
    assert said[:2] == ["written: render/default.yaml", "written: guides/ml.md, reference/cli.md, reference/scenes.md"]
    row = "a whole number 1..2147483647"
    assert (
        f"\n| `enough` | samples that are enough | {row} | `None` |\n"
        in (tree / "docs" / "guides" / "ml.md").read_text()
    )
    assert (
        f"\n| `enough` |  | {row} | samples that are enough |\n"
        in (tree / "docs" / "reference" / "scenes.md").read_text()
    )

    answers = json.loads(last)
    assert answers["file"] == str(tree / "torchpt" / "__init__.py")
    assert answers["signatures"] == ["enough: int | None = None"] * 3
    assert f"    enough: samples that are enough ({row})" in answers["help"].splitlines()
    assert answers["ended"] == [["enough", 4]] * 3
    assert answers["wrong"] == f"render.enough: expected {row}, got 0"
    assert answers["near"].endswith("'enugh'. Did you mean 'enough'?")
    assert answers["counted"].startswith("render.enough: expected null where sampler is hammersley")
    assert answers["study"] == "render.enough: expected nothing: every run takes the samples that spp= says, got [4, 8]"
    assert answers["code"] == [0, 2, 0] and any("enough" in line.split() for line in said)
    assert any('"stopped_by": "enough"' in line for line in said)


CALLS = """
import torch
import torchpt

scene = torchpt.load("cornell_box", "cpu")
image: torch.Tensor = torchpt.render(scene, spp=4, film={"width": 8}, edges=False)
full: torchpt.Rendering = torchpt.render(scene, seed=3, full=True)
images: torch.Tensor = torchpt.render_batch([scene], spp=4, seed=[1])
module = torchpt.nn.Renderer(scene, spp=4, target_error=0.1)
torchpt.render(scene, spp="many")  # wrong
torchpt.render(scene, sp=4)  # wrong
torchpt.render(scene, edges=None)  # wrong
torchpt.render_batch([scene], resume="yes")  # wrong
torchpt.nn.Renderer(scene, threads=1.5)  # wrong
module(dtype="float32")
"""


@pytest.mark.slow
def test_type_checkers_see_every_argument(tmp_path: Path) -> None:
    pytest.importorskip("pyright", reason="pyright (extra `dev`)")
    file = tmp_path / "calls.py"
    file.write_text(CALLS, encoding="utf-8")
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    found = json.loads(done.stdout)["generalDiagnostics"]
    wrong = {number for number, line in enumerate(CALLS.splitlines()) if line.endswith("# wrong")}
    assert {each["range"]["start"]["line"] for each in found} == wrong, found


def test_a_film_may_be_its_width_and_height(scene: torchpt.Scene) -> None:
    whole = {"width": 6, "height": 3}
    assert torch.equal(torchpt.render(scene, spp=2, film=(6, 3)), torchpt.render(scene, spp=2, film=whole))
    assert torchpt.render(scene, spp=1, film=[6, 3], full=True).image.shape == (3, 6, 3)
    assert torchpt.render_batch(scene, spp=1, film=(6, 3)).shape == (1, 1, 3, 6, 3)
    assert torchpt.nn.Renderer(scene, spp=1, film=(6, 3))().shape == (3, 6, 3)
    assert scene.film_size((6, 3)) == (6, 3) and torch.equal(scene.pinhole(film=(6, 3)).K, scene.pinhole(film=whole).K)
    camera = {"to_world": torch.eye(4), "K": [[4.0, 0.0, 3.0], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]]}
    assert scene.seen_by(camera, (6, 3)).params["camera.fov"] == scene.seen_by(camera, whole).params["camera.fov"]
    made = torchpt.data.RenderDataset(lambda _: (scene, {"film": (6, 3)}), 1, spp=1, film=(2, 2))
    assert made[0]["image"].shape == (3, 6, 3)


def test_a_seed_may_be_a_tensor_or_drawn_anew(scene: torchpt.Scene) -> None:
    def seed_of(**wishes: Any) -> int:
        made = torchpt.render(scene, spp=1, full=True, **wishes)
        assert made.settings is not None
        return made.settings.render.seed

    assert seed_of() == 0 and seed_of(seed=torch.tensor(7)) == seed_of(seed=torch.tensor([7], dtype=torch.uint8)) == 7
    torch.manual_seed(5)
    drawn = [seed_of(seed=None) for _ in range(3)]
    torch.manual_seed(5)
    assert [seed_of(seed=None) for _ in range(3)] == drawn and len({*drawn}) == 3


def test_a_render_with_a_seed_draws_nothing_even_where_it_compiles(
    scene: torchpt.Scene, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setenv("TORCHPT_CACHE", str(tmp_path))  # so that kernels are traced
    before = torch.get_rng_state()
    torchpt.render(torchpt.load({**BALL, "film": {"width": 3, "height": 3, "filter": "tent"}}, "cpu"), spp=1, seed=3)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_drawn_seed_in_every_entry(scene: torchpt.Scene) -> None:
    name = "shapes.ball.material.reflectance"

    def twice(make: Any) -> tuple[torch.Tensor, torch.Tensor]:
        torch.manual_seed(2)
        first = make(), make()
        torch.manual_seed(2)
        again = make(), make()
        assert all(map(torch.equal, first, again)) and not torch.equal(*first)
        return first

    alone = twice(lambda: torchpt.render(scene, spp=1, seed=None))
    o, d = torch.tensor([0.0, 0.0, 4.0]), torch.tensor([[0.1, 0.0, -1.0]]).expand(9, 3)
    twice(lambda: torchpt.trace(scene, o, d, seed=None))
    torch.manual_seed(2)
    batch = torchpt.render_batch([scene, scene], spp=1, seed=None)[:, 0]
    assert torch.equal(batch[0], alone[0]) and torch.equal(batch[1], alone[1])
    module = torchpt.nn.Renderer(scene, name, seed=None, spp=1)
    with torch.no_grad():
        twice(module)
        twice(module.eval())
    assert torch.equal(
        torchpt.render_batch(scene, spp=1, seed=torch.tensor(3)), torchpt.render_batch(scene, spp=1, seed=3)
    )


def test_the_backward_pass_of_a_drawn_seed_is_of_that_seed(scene: torchpt.Scene) -> None:
    name, grads = "shapes.ball.material.reflectance", []
    for seed in (None, None):
        torch.manual_seed(4)
        leaf = torch.full((3,), 0.5, requires_grad=True)
        torchpt.render(scene, spp=2, seed=seed, params={name: leaf}).square().sum().backward()
        grads.append(leaf.grad)
    assert torch.equal(*grads)


@pytest.mark.parametrize("seed", [torch.tensor(1.0), torch.tensor([1, 2]), torch.tensor(True)])
def test_seeds_that_are_refused(scene: torchpt.Scene, seed: torch.Tensor) -> None:
    for call in (torchpt.render, torchpt.nn.Renderer):
        with pytest.raises(SceneError, match="^seed: expected a whole number, also as a tensor with one element"):
            call(scene, spp=1, seed=seed)
    with pytest.raises(SceneError, match="seed: expected a whole number 0"):
        torchpt.render(scene, spp=1, seed=torch.tensor(-1))


def test_whole_numbers_may_be_tensors(scene: torchpt.Scene) -> None:
    grey = torch.tensor([0.5], requires_grad=True)  # one number for a colour, and for an angle
    given = {"shapes.ball.material.reflectance": grey, "camera.fov": torch.tensor([40.0])}
    numbers: Any = {"spp": torch.tensor(3), "seed_grad": torch.tensor([5]), "spp_grad": torch.tensor(2)}
    torchpt.render(scene, params=given, **numbers).mean().backward()
    leaf = torch.tensor(0.5, requires_grad=True)
    plain = {"shapes.ball.material.reflectance": leaf, "camera.fov": 40.0}
    torchpt.render(scene, params=plain, spp=3, seed_grad=5, spp_grad=2).mean().backward()
    assert grey.grad is not None and leaf.grad is not None and torch.equal(grey.grad[0], leaf.grad)
    for name, value in (("spp", torch.tensor(2.0)), ("seed_grad", torch.tensor([1, 2]))):
        options: Any = {name: value}
        with pytest.raises(
            SceneError, match=f"^{name}: expected a whole number, also as a tensor with one element, got"
        ):
            torchpt.render(scene, **options)


def test_numbers_that_are_not_finite_are_named_by_their_place(scene: torchpt.Scene) -> None:
    pose = scene.params["camera.to_world"].clone()
    pose[1, 2] = torch.inf
    colour = torch.tensor([0.5, torch.nan, 0.5])
    for name, value, place in (
        ("camera.to_world", pose, r"inf at \[1, 2\]"),
        ("shapes.ball.material.reflectance", colour, r"nan at \[1\]"),
        ("camera.fov", torch.tensor(torch.nan), "nan'"),
    ):
        with pytest.raises(SceneError, match=rf"^params.{name}: expected numbers finite in float32, got '{place}"):
            torchpt.render(scene, params={name: value}, spp=1)


def test_what_print_says_of_a_scene(scene: torchpt.Scene) -> None:
    said = f"Scene(of a mapping: 4 x 4, 1 shapes, 1 primitives, {len(scene.params)} parameters, cpu)"
    assert repr(scene) == said


@pytest.mark.parametrize("kind", [torch.float64, torch.bfloat16])
def test_another_default_dtype_of_torch_is_refused(scene: torchpt.Scene, kind: torch.dtype) -> None:
    """Random numbers would have it: pictures were wrong, without a word."""
    value = scene.params["shapes.ball.material.reflectance"].clone().requires_grad_()
    picture = torchpt.render(scene, params={"shapes.ball.material.reflectance": value}, spp=1)
    torch.set_default_dtype(kind)
    try:
        for call in (lambda: torchpt.render(scene, spp=1), lambda: picture.mean().backward()):
            with pytest.raises(SceneError, match=rf"^torch.get_default_dtype: expected torch.float32; .* got {kind}"):
                call()
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(torchpt.render(scene, spp=1), picture)
