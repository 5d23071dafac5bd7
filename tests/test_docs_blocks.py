"""Every block of the docs is run: Python in one namespace a page, commands whose output is shown, scene files by loading them.

A ``text`` block right behind another one is its output: equal word by word, numbers within 5 % unless they are seconds. A
YAML block that begins with ``# NAME.yaml`` is saved under that name; any other is loaded, as part of a scene. Commands without
output are run by ``tests/cli/test_advertised.py``, on small films.
"""

from __future__ import annotations

import re
import shlex
import socket
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
import yaml

import torchpt
from torchpt.cli.main import main
from torchpt.reports.study import study_of

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/**/*.md")),
]
#: Pages whose Python another test runs, and asks more of.
ELSEWHERE = {"docs/guides/ml.md": "tests/ml/test_lesson.py"}
RANKS = "tests/ranks runs ranks"
#: Lines of shell that no test runs, and why.
NOT_RUN = {
    "git clone URL torchpt && cd torchpt": "URL stands for where the checkout came from",
    "python3 -m venv .venv && . .venv/bin/activate": "installs",
    "pip install .": "installs",
    "pip install torch --index-url https://download.pytorch.org/whl/cpu": "installs, from a server",
    "pip install '.[denoise]'": "installs",
    "pip install '.[video,compare]'": "installs",
    "torchrun --nproc-per-node 2 -m torchpt render scene=cornell_box render.spp=1024 render.threads=1 out=box.exr": RANKS,
    "torchrun --nnodes 2 --nproc-per-node 1 --rdzv-backend c10d --rdzv-endpoint alpha:29500 "
    "-m torchpt render scene=cornell_box render.spp=1024 render.threads=16 out=box.exr": "needs two machines",
    "torchrun --nproc-per-node 2 --max-restarts 3 -m torchpt render scene=cornell_box render.spp=65536 "
    "render.checkpoint=box.npz render.resume=true out=box.exr": RANKS,
    "torchrun --nproc-per-node 2 scripts/examples/08_distributed.py --out examples_out": "tests/test_examples.py runs it",
}
#: Pages whose blocks take less than half a second each.
QUICK = ("docs/reference/cameras.md",)


class Block(NamedTuple):
    """A fenced block. Attributes: language, text, line where its text begins, and the line before its fence."""

    language: str
    text: str
    line: int
    before: str


def blocks(name: str) -> list[Block]:
    text = (ROOT / name).read_text(encoding="utf-8")
    found = re.finditer(r"^```(\w*)[^\n]*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [
        Block(
            match[1], match[2], text.count("\n", 0, match.start(2)), text[: match.start()].rstrip().rpartition("\n")[2]
        )
        for match in found
    ]


def lines_of_shell(text: str) -> Iterator[str]:
    """Commands of a block, without comments, continued lines joined."""
    for line in re.sub(r"\s*\\\n\s*", " ", text).splitlines():
        command = re.split(r"\s+#\s", line)[0].strip()
        if command and not command.startswith("#"):
            yield command


def shell() -> set[str]:
    return {
        line
        for name in PAGES
        for block in blocks(name)
        if block.language == "sh"
        for line in lines_of_shell(block.text)
    }


def test_every_line_of_shell_is_run_or_said_to_be_not() -> None:
    ours = re.compile(
        r"torchpt (render|orbit|info|compare|converge|convert|stress|--help|--version)\b|python scripts/|make [\w-]+$"
    )
    assert {line for line in shell() if not ours.match(line)} <= set(NOT_RUN)
    assert set(NOT_RUN) <= shell(), "a line that is not there any more"


def test_every_block_says_its_language() -> None:
    known = {"python", "sh", "yaml", "text", ""}
    for name in PAGES:
        for block in blocks(name):
            assert block.language in known, f"{name}:{block.line}"


def same(shown: str, printed: str) -> bool:
    """Return True where a page shows what was printed: word by word, numbers but for seconds within 5 %."""
    number = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")
    seconds = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)? s\b")
    shown, printed = (" ".join(seconds.sub("S", text).split()) for text in (shown, printed))
    if number.sub("N", shown) != number.sub("N", printed):
        return False
    pairs = zip(number.findall(shown), number.findall(printed), strict=True)
    return all(abs(float(a) - float(b)) <= 0.05 * abs(float(a)) + 0.011 * ("." in a) for a, b in pairs)


def test_outputs_are_compared() -> None:
    assert same("a.png: 64 samples, 1.2 s; error 3.8 %", "a.png: 64 samples, 12 s;\nerror 3.85 %")
    assert not same("error 3.8 %", "error 4.8 %") and not same("a 1", "b 1") and not same("(1, 2)", "(1, 3)")


def is_file(name: str, block: Block) -> bool:
    """Return True for files that docs/guides/extending.md puts into the package; tests/test_extending.py runs them."""
    return (
        name.endswith("extending.md")
        and re.fullmatch(r"(In )?`torchpt/[\w/]+\.py`(, among the others)?:", block.before) is not None
    )


def completed(text: str) -> dict[str, Any]:
    """A part of a scene file as a scene, with its settings small."""
    scene: dict[str, Any] = {
        "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
        "shapes": {"ball": {"type": "sphere"}},
        "lights": {"sky": {"type": "constant"}},
    }
    return scene | yaml.safe_load(text)


def shown_behind(of: list[Block], index: int, text: str) -> str | None:
    """The output that a page shows right behind a block."""
    next_hit = of[index + 1] if index + 1 < len(of) else None
    if next_hit is None or next_hit.language != "text":
        return None
    end = of[index].line + of[index].text.count("\n")
    between = text.splitlines()[end + 1 : next_hit.line - 1]
    return next_hit.text if not any(line.strip() for line in between) else None


def pages() -> Iterator[Any]:
    for name in PAGES:
        wanted = [block for block in blocks(name) if block.language in ("python", "yaml") and not is_file(name, block)]
        if wanted and name not in ELSEWHERE:
            yield pytest.param(name, id=name, marks=[] if name in QUICK else [pytest.mark.slow])


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with what a checkout has, and the variables that torchrun sets."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    for key, value in {"RANK": "0", "WORLD_SIZE": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}.items():
        monkeypatch.setenv(key, value)
    yield tmp_path
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


@pytest.mark.parametrize("name", list(pages()))
@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning", "ignore::torchpt.EnergyWarning")
def test_blocks_run(name: str, checkout: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    names: dict[str, Any] = {"torch": torch, "torchpt": torchpt} if name.startswith("docs/guides/error") else {}
    of = blocks(name)
    for index, block in enumerate(of):
        where, shown = f"{name}:{block.line}", shown_behind(of, index, text)
        capfd.readouterr()
        if block.language == "python" and not is_file(name, block):
            exec(compile("\n" * block.line + block.text, name, "exec"), names)
        elif block.language == "yaml":
            file = re.match(r"# ([\w./-]+\.yaml)\n", block.text)
            if file:
                (checkout / file[1]).parent.mkdir(exist_ok=True)
                (checkout / file[1]).write_text(block.text, encoding="utf-8")
            elif "seeds" in block.text:
                study_of(yaml.safe_load(block.text))
            elif "defaults" in block.text:
                torchpt.load(yaml.safe_load(block.text), device="cpu")
            else:
                torchpt.load(completed(textwrap.dedent(block.text)), device="cpu")
        elif block.language == "sh" and shown is not None:
            for command in lines_of_shell(block.text):
                assert main(shlex.split(command)[1:]) == 0, where
        if shown is not None:
            printed = "\n".join(line for line in capfd.readouterr().out.splitlines() if not line.startswith('{"out"'))
            assert same(shown, printed), f"{where} printed\n{printed}"
