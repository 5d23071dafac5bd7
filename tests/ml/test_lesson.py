"""docs/guides/ml.md: its Python runs, and its tables name what there is."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
import torch

import torchpt

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "ml.md"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


@pytest.mark.slow
def test_the_lessons_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    names: dict[str, object] = {}
    blocks = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    assert len(blocks) == 14
    for block in blocks:
        exec(compile(block, str(PAGE), "exec"), names)
    for name in ("fov", "paint"):
        leaf = names[name]
        assert isinstance(leaf, torch.Tensor) and leaf.grad is not None and float(leaf.grad.norm()) > 0
    written = torchpt.cameras.read_transforms("transforms.json")
    assert len(written) == 3 and all(torchpt.read_image(str(path)).shape == (16, 16, 3) for path, _, _ in written)
    printed = [float(x) for x in re.findall(r"\d\.\d+", capsys.readouterr().out)]
    found = torch.tensor(printed[:3])  # of the first lesson
    right = torchpt.load("cornell_box", "cpu").params["materials.red.reflectance"]
    torch.testing.assert_close(found, right, rtol=0, atol=0.02)
    (rays,) = (block for block in blocks if "irradiance =" in block)
    irradiance = torch.zeros(3)
    for _ in range(16):  # some 300 of the 4,096 rays meet the lamp
        exec(compile(rays, str(PAGE), "exec"), names)
        once = names["irradiance"]
        assert isinstance(once, torch.Tensor)
        irradiance += once / 16
    panorama = names["panorama"]
    assert isinstance(panorama, torch.Tensor)
    rows = (torch.arange(16) + 0.5) / 32 * torch.pi  # the upper half, by its cosine
    weight = (rows.cos() * rows.sin() * torch.pi / 32 * 2 * torch.pi / 64)[:, None, None]
    torch.testing.assert_close((panorama[:16] * weight).sum((0, 1)), irradiance, rtol=0.1, atol=0.0)
    batch = names["batch"]
    assert isinstance(batch, dict) and batch["image"].shape == (2, 16, 16, 3) and batch["K"].shape == (2, 3, 3)
    tint = names["tint"]
    assert isinstance(tint, torch.Tensor) and bool((tint.detach() != 1).all())


def table(heading: str) -> dict[str, list[str]]:
    """Rows of the first table below a heading, by what stands in their first cell."""
    text = PAGE.read_text(encoding="utf-8").split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| `")]
    return {row[0].strip().strip("`"): row for row in rows}


def test_every_argument_of_render_has_a_row_with_its_default():
    rows, signature = table("Arguments of `render`"), inspect.signature(torchpt.render)
    assert {"scene", *rows} == set(signature.parameters)
    for name, parameter in signature.parameters.items():
        if name != "scene":
            default = str(parameter.default)
            assert f"`{default}`" in rows[name][-1], name


def test_every_argument_of_trace_is_named():
    named = re.findall(r"`(\w+)`", " ".join(row[0] for row in table("Rays").values()))
    assert {"scene", "o", "d", *named} == set(inspect.signature(torchpt.trace).parameters)


@pytest.mark.parametrize("loss", torchpt.losses.__all__)
def test_every_loss_has_a_row(loss):
    assert any(row.startswith(f"{loss}(") for row in table("Losses"))
