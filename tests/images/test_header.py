"""Facts in the headers of EXR files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchpt
from torchpt.core.errors import AssetError
from torchpt.images import read_header, write_image

GREY = torch.full((3, 4, 3), 0.5)


def test_facts_come_back(tmp_path: Path) -> None:
    facts: dict[str, str | int | float] = {
        **{"relmse": 0.123456789, "tiny": 1e-12, "spp": 64, "below": -(2**31), "above": 2**31, "seed": 2**63 - 1},
        **{"negative": -(2**40), "scene": "Raum 7 é", "digits": "12", "flag": True, "zero": 0, "none": 0.0},
    }
    write_image(tmp_path / "a.exr", GREY, header=facts)
    back = read_header(tmp_path / "a.exr")
    assert back.keys() == facts.keys()
    assert all(
        back[name] == (value if isinstance(value, str) else pytest.approx(float(value)))
        for name, value in facts.items()
    )
    assert type(back["seed"]) is int and back["seed"] == 2**63 - 1 and type(back["relmse"]) is float


def test_other_programs_find_them(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    write_image(tmp_path / "a.exr", GREY, {"depth": GREY[..., 0]}, header={"relmse": 0.25, "spp": 9})
    source = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    assert source is not None
    spec = source.spec()
    assert spec.get_float_attribute("torchpt:relmse") == 0.25 and spec.get_int_attribute("torchpt:spp") == 9
    assert spec.get_string_attribute("compression") == "zip"
    source.close()


@pytest.mark.parametrize("ending", [".exr", ".png", ".hdr", ".jpg", ".ppm"])
def test_no_facts(tmp_path: Path, ending: str) -> None:
    write_image(tmp_path / f"a{ending}", GREY)
    assert torchpt.read_header(tmp_path / f"a{ending}") == {}


def test_facts_of_others_are_left_out(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(4, 3, 3, "float")
    spec.attribute("other:spp", 3)
    spec.attribute("torchpt:place", oiio.TypeDesc("float[3]"), (1.0, 2.0, 3.0))  # no fact of ours is a vector
    spec.attribute("torchpt:spp", 5)
    target = oiio.ImageOutput.create("a.exr")
    assert target is not None and target.open(str(tmp_path / "a.exr"), spec)
    target.write_image(np.zeros((3, 4, 3), np.float32))
    target.close()
    assert read_header(tmp_path / "a.exr") == {"spp": 5}


@pytest.mark.parametrize(
    ("header", "says"),
    [
        ({"a:b": 1}, "letters, digits and _, got 'a:b'"),
        ({"": 1}, "letters, digits and _"),
        ({"a" * 200: 1}, "letters, digits and _"),
        ({"a": None}, "a: expected text or a number, got None"),
        ({"a": (1, 2)}, "a: expected text or a number"),
        ({"a": ""}, "a: expected printable text"),
        ({"a": "two\nlines"}, "a: expected printable text"),
    ],
)
@pytest.mark.parametrize("ending", [".exr", ".png"])
def test_what_no_header_holds(tmp_path: Path, header: Any, says: str, ending: str) -> None:
    with pytest.raises(ValueError, match=says):
        write_image(tmp_path / f"a{ending}", GREY, header=header)
    assert list(tmp_path.iterdir()) == []


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    write_image(tmp_path / "good.exr", GREY, header={"spp": 1})
    whole = (tmp_path / "good.exr").read_bytes()
    for size in (4, 20, 100, 200):
        (tmp_path / "cut.exr").write_bytes(whole[:size])
        with pytest.raises(AssetError, match="cut.exr: cannot be read"):
            read_header(tmp_path / "cut.exr")
    with pytest.raises(AssetError, match="no such file"):
        read_header(tmp_path / "none.exr")
    with pytest.raises(AssetError, match="unknown kind of image '.txt'"):
        read_header(tmp_path / "a.txt")
