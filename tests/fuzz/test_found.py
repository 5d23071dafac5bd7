"""What damaged input once ended in: a case for each kind of failure that was found and mended."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_files import float_picture

import torchpt
from torchpt.core.errors import AssetError
from torchpt.images import read_header, read_image
from torchpt.images.layers import group_channels
from torchpt.scene.meshes import load_mesh

BALL: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
    "film": {"width": 4, "height": 4},
    "lights": {"s": {"type": "constant", "radiance": 1}},
    "shapes": {"b": {"type": "sphere"}},
}


def line(error: pytest.ExceptionInfo[AssetError], file: Path) -> str:
    said = str(error.value)
    assert said.startswith(f"{file}: ") and said.isprintable()
    return said


@pytest.mark.parametrize("read", [read_header, read_image])
def test_a_decoder_that_complains_in_the_files_own_bytes(tmp_path: Path, read: Any) -> None:
    """OpenImageIO's binding made text of bytes that are no UTF-8."""
    data = float_picture(tmp_path, "exr", "zip")
    file = tmp_path / "a.exr"
    file.write_bytes(data.replace(b"channels\0chlist\0", b"channels\0\xffhlist\0", 1))
    with pytest.raises(AssetError) as caught:
        read(file)
    line(caught, file)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The members of a sound checkpoint."""
    file = tmp_path_factory.mktemp("found") / "a.ckpt"
    torchpt.render(torchpt.load(BALL), spp=2, checkpoint=str(file), compile="off")
    with zipfile.ZipFile(file) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def resumed(folder: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> str:
    """What is said of a checkpoint with other members."""
    file = folder / "a.ckpt"
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(AssetError) as caught:
        torchpt.render(torchpt.load(BALL), spp=2, checkpoint=str(file), resume=True, compile="off")
    return line(caught, file)


def array(values: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, values, allow_pickle=True)
    return file.getvalue()


def changed(members: dict[str, bytes], **facts: Any) -> dict[str, bytes]:
    start = members["facts.npy"].index(b"{", 100)
    own = json.loads(members["facts.npy"][start:])
    return {**members, "facts.npy": array(np.frombuffer(json.dumps({**own, **facts}).encode(), np.uint8))}


def test_a_checkpoint_is_of_its_render_or_refused(tmp_path: Path, saved: dict[str, bytes]) -> None:
    """NumPy's reader ran a tokenizer over damaged headers and trusted sizes; what was missing was met much later."""
    first = "picture.first.npy"
    header = saved[first][:128]
    cases: list[tuple[dict[str, bytes], str]] = [
        ({**saved, first: header.replace(b"}", b" ")[:128] + saved[first][128:]}, "is no array of numbers"),
        (
            {**saved, first: header.replace(b"(3, 16)", b"(3, 9999999999999)") + saved[first][128:]},
            "is no array of numbers",
        ),
        ({**saved, first: array(np.array([open, "x"], dtype=object))}, "is no array of numbers"),
        ({**saved, first: b""}, "is no array of numbers"),
        ({**saved, first: array(np.zeros((3, 15)))}, "picture.first are missing, or others"),
        ({name: data for name, data in saved.items() if name != "light.npy"}, "light are missing, or others"),
        ({**saved, "facts": saved["facts.npy"]}, "'facts' is no array"),
        (changed(saved, rays="many"), "rays is many"),
        (changed(saved, taken=-1), "taken is -1"),
        (changed(saved, seconds=float("nan")), "seconds is nan"),
        (changed(saved, format=99), "another format"),
    ]
    for members, part in cases:
        assert part in resumed(tmp_path, members)
    assert "is compressed or encrypted" in resumed(tmp_path, saved, zipfile.ZIP_DEFLATED)


def test_an_index_out_of_range_beside_face_colours(tmp_path: Path) -> None:
    """Corners were looked up before they were checked."""
    file = tmp_path / "a.off"
    file.write_text("COFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 99999999999999 255 0 0 255\n")
    with pytest.raises(AssetError) as caught:
        load_mesh(file)
    line(caught, file)


def test_a_digit_that_is_no_number(tmp_path: Path) -> None:
    """Superscripts are digits to Python, and no numbers."""
    file = tmp_path / "a.ply"
    file.write_bytes("ply\nformat ascii 1.0\nelement vertex \u00b2\nproperty float x\nend_header\n".encode("latin-1"))
    with pytest.raises(AssetError, match="element vertex .* is not understood") as caught:
        load_mesh(file)
    line(caught, file)
    assert group_channels(("Y", "x.\u00b2", "x.1")) == {"image": [0], "x": [2, 1]}
