"""Every command that help, the docs and the first line of each config file advertise is run, on a film of a few pixels."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from few import few
from mitsuba_corpus import LIGHT
from mitsuba_corpus import scene as mitsuba_scene

from torchpt.cli import main as cli
from torchpt.cli.main import main
from torchpt.core.files import configs
from torchpt.images import write_image

from .conftest import Renderer

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Settings by which a render takes no time, in place of what a command says.
SMALL = {"film.width": "8", "film.height": "6", "render.spp": "2", "render.compile": "off"}
#: The same for `torchpt converge`; what a command says itself stays where it is smaller.
SMALL_STUDY = {
    "film.width": "12", "film.height": "12", "spp": "[1,2]", "seeds": "2", "reference.spp": "4", "reference.seeds": "2",
    "metrics": "[relmse,mse]", "render.compile": "off",
}  # fmt: skip
#: Scenes that load and render in no time; of the others the commands are slow.
QUICK = ("my/scene.yaml", "room.yaml", "glass.yaml", "cornell_box", "cornell_spheres", "games101", "env_teapot")
SCENE = """\
camera: {origin: [0, 0, -4], target: [0, 0, 0]}
shapes: {ball: {type: sphere, emission: 1}}
"""


def texts() -> Iterator[tuple[str, str]]:
    """Return where a command may stand, and the text."""
    yield "cli.HELP", "\n".join(f"torchpt {command.name} {command.example}" for command in cli.COMMANDS)
    for command in cli.COMMANDS:
        yield f"cli.{command.name}.HELP", command.help
    for page in PAGES:
        yield str(page.relative_to(ROOT)), page.read_text(encoding="utf-8")
    for path in sorted(configs().rglob("*.yaml")):
        yield f"configs/{path.relative_to(configs())}", path.read_text(encoding="utf-8").splitlines()[0]


def spans(where: str, text: str) -> Iterator[str]:
    """Return what a text shows as commands: lines of blocks, and what stands between backticks, perhaps over two lines."""
    if where.endswith(".md"):
        blocks = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
        yield from (line for block in blocks for line in block.splitlines())
        yield from (" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text))
        return
    quoted = re.findall(r"`([^`]+)`", text)
    for line in quoted if where.endswith(".yaml") and quoted else text.splitlines():
        yield re.split(r" {3,}(?=\S+ )(?!scene)", line.strip().removeprefix("# "))[0]


def commands(program: str) -> list[tuple[str, str]]:
    """Commands of a program by where they stand; usage with capital letters for what is to be filled in is none."""
    found: dict[str, str] = {}
    for where, text in texts():
        for span in spans(where, text):
            whole = program != "torchpt" or "=" in span or "--" in span  # else it is named, not shown
            if (
                span.startswith(f"{program} ")
                and whole
                and not re.search(r"\b(NAME|COMMAND|FILE|FOLDER|PATTERN|SCENE)\b", span)
            ):
                command = span.partition(" #")[0].strip().replace("{{", "{").replace("}}", "}")  # of a format string
                found.setdefault(command, where)
    return [(where, command) for command, where in found.items()]


def shrunk(words: list[str]) -> list[str]:
    """The words of a command for a film of a few pixels; sweeps keep how many values they have."""
    if words[0] == "stress":
        return words
    left, made = dict(SMALL_STUDY if words[0] == "converge" else SMALL), []
    if words[0] == "converge":
        words = [word for word in words if word.partition("=")[0] not in left]
    if words[0] == "orbit":
        left["frames"] = "2"
    for word in words:
        key, equals, value = word.partition("=")
        if equals and key in left:
            small = left.pop(key)
            word = f"{key}={','.join([small] * len(value.split(',')))}"
        made.append(word)
    return made + [f"{key}={value}" for key, value in left.items()]


def quick(command: str) -> bool:
    if command.startswith("torchpt compare"):
        return True
    return "--cfg" in command or any(f"scene={name}" in command.split() for name in QUICK)


def marks(command: str) -> list[pytest.MarkDecorator]:
    """Return what a command needs: time, or a package that may not be there."""
    long = any(word in command for word in ("converge", "stress", "--multirun")) or not quick(command)
    needs = pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed (extra `denoise`)")
    return [pytest.mark.slow] * long + [needs] * ("denoise=true" in command)


TORCHPT = commands("torchpt")


def test_there_are_commands_from_everywhere() -> None:
    where = {place for place, _ in TORCHPT}
    assert {"cli.HELP", "README.md", "docs/explanations/ibl.md", "configs/config.yaml"} <= where
    assert "configs/integrator/direct.yaml" in where
    assert len(TORCHPT) > 40 and {command.split()[1] for _, command in TORCHPT} - {"--help", "--version"} == {
        "render",
        "orbit",
        "info",
        "compare",
        "convert",
        "converge",
        "stress",
    }


def test_every_file_in_configs_opens_with_its_command() -> None:
    for path in configs().rglob("*.yaml"):
        (command, *_) = spans(path.name, path.read_text(encoding="utf-8").splitlines()[0])
        if path.parent.name == "study":
            assert command == f"torchpt converge study={path.stem}"
            continue
        assert command.startswith("torchpt render scene="), path
        if path.parent.name == "scene":
            assert f"scene={path.stem} " in command
        elif path.stem not in ("default", "config"):
            assert f" {path.parent.name}={path.stem}" in command


def renders(words: list[str]) -> bool:
    one_path = any(word.startswith("debug.") for word in words)  # which is printed
    return words[0] in ("render", "orbit", "converge") and "--cfg" not in words and not one_path


def written(where: str) -> bool:
    """Return True for where only the words of commands are in doubt, not that what they ask for can be rendered."""
    return where == "README.md" or where.startswith("configs/")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with all files that commands name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my").mkdir()
    for name in ("my/scene.yaml", "room.yaml", "glass.yaml"):
        (tmp_path / name).write_text(SCENE)
    for name in ("scene.xml", "staircase2/scene.xml", "room/scene.xml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        defaults = '<default name="spp" value="4"/><default name="resx" value="32"/>'
        text = mitsuba_scene(f'<shape type="sphere"/>{LIGHT}').replace('"16"', '"$spp"').replace('"32"', '"$resx"')
        (tmp_path / name).write_text(text.replace(">\n", f">\n{defaults}", 1))
    for name in ("test.exr", "reference.exr"):  # what is compared
        write_image(tmp_path / name, torch.full((12, 12, 3), 0.5), {"albedo": torch.full((12, 12, 3), 0.3)})
    return tmp_path


def check(where: str, command: str, place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(command)[1:]
    assert main(shrunk(words) if renders(words) else words) == 0, where
    assert capfd.readouterr().out
    if renders(words):
        files = [path for path in place.rglob("*") if path.is_file() and path.suffix not in (".yaml", ".xml")]
        assert files and all(path.stat().st_size for path in files)


@pytest.mark.parametrize(
    ("where", "command"),
    few([item for item in TORCHPT if written(item[0]) and renders(item[1].split()[1:]) and not marks(item[1])], 10),
    ids=lambda value: value,
)
def test_advertised_commands_are_understood(
    where: str, command: str, place: Path, renderer: Renderer, capfd: pytest.CaptureFixture[str]
) -> None:
    check(where, command, place, capfd)
    assert renderer.settings


@pytest.mark.parametrize(
    ("where", "command"),
    [
        pytest.param(
            *item, marks=marks(item[1]) or [pytest.mark.slow] * (written(item[0]) and renders(item[1].split()[1:]))
        )
        for item in TORCHPT
    ],
    ids=lambda value: value,
)
def test_advertised_commands_run(where: str, command: str, place: Path, capfd: pytest.CaptureFixture[str]) -> None:
    check(where, command, place, capfd)


SCRIPTS = commands("python")


@pytest.mark.slow
@pytest.mark.parametrize(("where", "command"), SCRIPTS, ids=lambda value: value)
def test_advertised_scripts_take_their_arguments(where: str, command: str) -> None:
    """They take minutes: what is run is their help, with the arguments as advertised."""
    words = shlex.split(command)[1:]
    assert (ROOT / words[0]).is_file(), where
    done = subprocess.run([sys.executable, *words, "--help"], cwd=ROOT, capture_output=True, text=True, timeout=120)
    if "No module named" in done.stderr:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0 and "usage" in done.stdout, done.stderr


def test_advertised_targets_of_make_are_there() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = {command.split()[1] for _, command in commands("make")}
    assert {"render", "test"} <= named <= targets
