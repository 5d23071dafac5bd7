"""Runs on disk."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from textured_quad import repeated, textured_quad

from torchpt.core.errors import OutputError
from torchpt.reports.runs import Store, name_of, prepare, write_whole
from torchpt.reports.study import study_of

FACTS = {"spp": 4, "seed": 7, "seconds": 0.5, "nonfinite_samples": 0}


def test_a_run_comes_back_to_the_bit(tmp_path: Path) -> None:
    image = torch.rand(5, 6, 3)
    Store(tmp_path / "a" / "runs").put("x", image, FACTS)
    run = Store(tmp_path / "a" / "runs").get("x")
    assert run is not None and run.seconds == 0.5 and torch.equal(run.image(), image.double())


def test_half_a_run_is_none(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.put("x", torch.rand(2, 2, 3), FACTS)
    (tmp_path / "x.json").write_text('{"seconds": 0.')
    assert store.get("x") is None and store.get("y") is None
    (tmp_path / "x.json").write_text("[]")
    assert store.get("x") is None
    store.put("x", torch.rand(2, 2, 3), FACTS)
    (tmp_path / "x.exr").unlink()
    assert store.get("x") is None


def test_names_follow_from_everything() -> None:
    names = {name_of(facts) for facts in ({"spp": 1}, {"spp": 2}, {"spp": 1, "seed": 0}, {"settings": {"clamp": None}})}
    assert len(names) == 4 and name_of({"spp": 1, "seed": 2}) == name_of({"seed": 2, "spp": 1})


def test_what_a_mesh_file_says_of_its_texture_is_part_of_a_name(tmp_path: Path) -> None:
    names = set()
    textured_quad(tmp_path)
    for times in (1, 3, 1):
        repeated(tmp_path, times)
        (measured,) = prepare(study_of({"scene": str(tmp_path / "quad.yaml"), "render.device": "cpu"}))
        names.add(name_of(measured.curves[0].job.facts))
    assert len(names) == 2


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be used for runs"):
        Store(tmp_path / "file" / "runs")
    with pytest.raises(OutputError, match="cannot be written"):
        write_whole(tmp_path / "missing" / "a.json", b"")
