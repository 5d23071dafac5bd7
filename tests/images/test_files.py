from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from few import few

from torchpt.core.errors import AssetError, OutputError, SceneError
from torchpt.images import check_writable, read_image, read_layers, write_image
from torchpt.images import read as read_module

ENDINGS = [".exr", ".hdr", ".png", ".jpg", ".jpeg", ".ppm"]


def picture(height: int = 5, width: int = 7, channels: int = 3) -> torch.Tensor:
    return torch.rand((height, width, channels), generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize("ending", ENDINGS)
def test_round_trip(tmp_path: Path, ending: str) -> None:
    flat = torch.full((8, 9, 3), 0.25)
    flat[:, :, 1] = 0.5
    write_image(tmp_path / f"a{ending}", flat)
    back = read_image(tmp_path / f"a{ending}")
    assert back.shape == (8, 9, 3) and back.dtype == torch.float32
    tolerance = {".exr": 0.0, ".hdr": 2e-3}.get(ending, 0.015)
    assert (back - flat).abs().max() <= tolerance
    assert os.listdir(tmp_path) == [f"a{ending}"]


def test_exr_is_exact_and_keeps_any_float(tmp_path: Path) -> None:
    image = picture() * 1e6 - 3
    image[0, 0] = torch.tensor([float("inf"), float("nan"), 1e-38])
    write_image(tmp_path / "a.exr", image, exposure=3, tonemap="aces", gamma=0.6)  # which concern the 8-bit formats
    assert torch.equal(read_image(tmp_path / "a.exr").nan_to_num(7), image.nan_to_num(7))


def test_exr_layers_have_the_usual_channels(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    image = picture()
    sizes = {"albedo": 3, "normal": 3, "depth": 1, "position": 3, "uv": 2, "object_id": 1, "variance": 3, "glossy": 3}
    layers = {name: picture(channels=c) * (i + 2) for i, (name, c) in enumerate(sizes.items())}
    layers["depth"] = layers["depth"][..., 0]
    write_image(tmp_path / "a.exr", image, layers)
    source = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    assert source is not None
    names = set(source.spec().channelnames)
    assert not source.seek_subimage(1, 0)  # one part
    source.close()
    assert names >= {"R", "G", "B", "Z", "object_id", "uv.U", "uv.V", "glossy.R"}
    assert names >= {f"{n}.{c}" for n in ("albedo", "variance") for c in "RGB"}
    assert names >= {f"{n}.{c}" for n in ("normal", "position") for c in "XYZ"}
    back = read_layers(tmp_path / "a.exr")
    assert set(back) == {"image", *sizes}
    assert torch.equal(back["image"], image) and torch.equal(read_image(tmp_path / "a.exr"), image)
    for name, layer in layers.items():
        assert torch.equal(back[name], layer if layer.ndim == 3 else layer[..., None]), name


def test_alpha_is_the_pictures_own_channel_and_a_layer(tmp_path: Path) -> None:
    image, alpha = picture(), picture(channels=1)
    write_image(tmp_path / "a.exr", image, {"depth": picture(channels=1) * 3, "alpha": alpha})
    assert torch.equal(read_image(tmp_path / "a.exr"), torch.cat((image, alpha), -1))  # as viewers take it
    back = read_layers(tmp_path / "a.exr")
    assert set(back) == {"image", "depth", "alpha"}
    assert torch.equal(back["image"], image) and torch.equal(back["alpha"], alpha)
    write_image(tmp_path / "b.exr", back.pop("image"), back)  # and round again
    assert torch.equal(read_image(tmp_path / "b.exr"), read_image(tmp_path / "a.exr"))
    write_image(tmp_path / "c.exr", torch.cat((image, alpha), -1))  # the same, said otherwise
    assert torch.equal(read_layers(tmp_path / "c.exr")["alpha"], alpha)
    with pytest.raises(ValueError, match="channel A"):
        write_image(tmp_path / "d.exr", picture(channels=4), {"alpha": alpha})
    write_image(tmp_path / "e.png", image, {"alpha": alpha})
    assert read_image(tmp_path / "e.png").shape == (5, 7, 3)
    assert not (tmp_path / "d.exr").exists()


def test_hdr_has_no_negative_values(tmp_path: Path) -> None:
    image = picture() * 100
    image[0, 0] = torch.tensor([-5.0, 1.0, float("nan")])
    write_image(tmp_path / "a.hdr", image)
    assert torch.equal(read_image(tmp_path / "a.hdr")[0, 0], torch.tensor([0.0, 1.0, 0.0]))


def test_eight_bit_means_srgb_unless_it_is_data(tmp_path: Path) -> None:
    iio.imwrite(tmp_path / "a.png", np.full((2, 3, 3), 188, np.uint8))
    assert torch.allclose(read_image(tmp_path / "a.png"), torch.tensor(0.50289), atol=1e-4)
    assert torch.allclose(read_image(tmp_path / "a.png", linear=True), torch.tensor(188 / 255))
    iio.imwrite(tmp_path / "b.png", np.full((2, 3, 4), 188, np.uint8))
    assert torch.allclose(read_image(tmp_path / "b.png")[..., 3], torch.tensor(188 / 255))  # alpha is data
    iio.imwrite(tmp_path / "c.png", np.full((2, 3), 65535, np.uint16))
    assert torch.equal(read_image(tmp_path / "c.png"), torch.ones(2, 3, 1))
    iio.imwrite(tmp_path / "d.pgm", np.full((2, 3), 255, np.uint8))
    assert torch.equal(read_image(tmp_path / "d.pgm"), torch.ones(2, 3, 1))


def test_row_0_is_the_top(tmp_path: Path) -> None:
    image = torch.zeros(4, 6, 3)
    image[0] = 1.0
    for ending in (".exr", ".hdr", ".png", ".ppm"):
        write_image(tmp_path / f"a{ending}", image)
        assert read_image(tmp_path / f"a{ending}")[:, 0, 0].tolist() == [1, 0, 0, 0], ending


def test_channels_of_the_picture(tmp_path: Path) -> None:
    for channels in (1, 3, 4):
        write_image(tmp_path / "a.exr", picture(channels=channels))
        assert torch.equal(read_image(tmp_path / "a.exr"), picture(channels=channels))
    write_image(tmp_path / "a.png", picture(channels=4))
    assert read_image(tmp_path / "a.png").shape == (5, 7, 4)
    write_image(tmp_path / "a.jpg", picture(channels=4))
    assert read_image(tmp_path / "a.jpg").shape == (5, 7, 3)
    with pytest.raises(ValueError, match="channels"):
        write_image(tmp_path / "a.exr", picture(channels=2))
    with pytest.raises(ValueError, match="layer"):
        write_image(tmp_path / "a.exr", picture(), {"albedo": picture(4, 4)})


@pytest.mark.parametrize(
    "name", ["a b (1).exr", "[x]=y,z.png", "ü→é ?a=b.exr", "#%04d.png", "a?b=c.hdr", "$HOME ~.EXR"]
)
def test_any_file_name(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "d?e=f [g]"
    folder.mkdir()
    check_writable(folder / name)
    write_image(folder / name, picture())
    assert os.listdir(folder) == [name]
    assert read_image(folder / name).shape == (5, 7, 3)


def test_replaces_what_was_there_and_follows_links(tmp_path: Path) -> None:
    (tmp_path / "real.exr").write_text("old")
    (tmp_path / "link.exr").symlink_to("real.exr")
    write_image(tmp_path / "link.exr", picture())
    assert (tmp_path / "link.exr").is_symlink() and read_image(tmp_path / "real.exr").shape == (5, 7, 3)
    assert (tmp_path / "real.exr").stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("a.bmp", "accepted: .exr .hdr .png"),
        ("a", "needs an ending"),
        ("nowhere/a.png", "there is no folder"),
        ("file/a.png", "cannot be written"),
        ("folder.png", "folder"),
        ("x" * 300 + ".exr", "File name too long"),
        ("a\0b.exr", "null"),
    ],
)
def test_unwritable(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.png").mkdir()
    before = sorted(os.listdir(tmp_path))
    for attempt in (lambda p: check_writable(p), lambda p: write_image(p, picture())):
        with pytest.raises(OutputError) as caught:
            attempt(tmp_path / name)
        assert "\n" not in str(caught.value)
        assert sorted(os.listdir(tmp_path)) == before
    with pytest.raises(OutputError, match=problem):
        check_writable(tmp_path / name)


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for ending in (".exr", ".png"):
        path = tmp_path / f"a{ending}"
        path.write_text("old")
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", full)
            with pytest.raises(OutputError, match="No space left"):
                write_image(path, picture())
        assert path.read_text() == "old"
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "a.png"]


@pytest.mark.skipif(sys.platform == "win32", reason="limits of files are of Unix")
@pytest.mark.parametrize("ending", few([".exr", ".hdr", ".png", ".ppm"], 1))
def test_the_systems_reason_is_told_where_a_file_may_not_grow(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    path.write_text("old")
    import resource

    grain = torch.rand(100, 100, 3, generator=torch.Generator().manual_seed(1))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))  # Python ignores the signal that comes of it
    try:
        with pytest.raises(OutputError) as caught:
            write_image(path, grain)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(caught.value) == f"{path}: cannot be written (File too large)"
    assert [file.name for file in tmp_path.iterdir()] == [path.name] and path.read_text() == "old"


FORKED = """
import faulthandler, os, sys, torch
from torchpt.images import read_image, write_image

first, second = sys.argv[1:]
image = torch.rand(64, 48, 3)
for _ in range(2):
    write_image(first, image)
    read_image(first)
child = os.fork()
if child == 0:
    faulthandler.dump_traceback_later(20, exit=True)
    write_image(second, image)
    os._exit(0 if torch.equal(read_image(second), image) else 2)
write_image(first, image)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing forks here")
def test_a_forked_process_writes_where_its_parent_did(tmp_path: Path) -> None:
    files = [str(tmp_path / name) for name in ("a.exr", "b.exr")]
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED, *files], capture_output=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_an_encoders_own_error_names_no_hidden_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import OpenImageIO

    class Broken:
        def open(self, name: str, spec: Any) -> bool:
            self.said = f"cannot encode {name}"
            return True

        def write_image(self, pixels: Any) -> bool:
            return False

        def close(self) -> bool:
            return True

        def geterror(self) -> str:
            return self.said

    monkeypatch.setattr(OpenImageIO.ImageOutput, "create", lambda _: Broken())
    with pytest.raises(OutputError) as caught:
        write_image(tmp_path / "a.exr", picture())
    assert str(caught.value) == f"{tmp_path}/a.exr: cannot be written (cannot encode the file)"
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [".exr", ".hdr", ".png", ".jpg", ".ppm"])
def test_damaged_files(tmp_path: Path, ending: str) -> None:
    write_image(tmp_path / f"good{ending}", picture(64, 64))
    whole = (tmp_path / f"good{ending}").read_bytes()
    bad = tmp_path / f"bad{ending}"
    for content in (b"", b"garbage" * 9, whole[: len(whole) // 2], whole[: len(whole) * 9 // 10]):
        bad.write_bytes(content)
        for reader in (read_image, read_layers):
            with pytest.raises(AssetError, match="cannot be read|has no pixels") as caught:
                reader(bad)
            assert "\n" not in str(caught.value) and str(bad) in str(caught.value)


def test_missing_and_unknown(tmp_path: Path) -> None:
    for name, problem in [
        ("a.exr", "no such file"),
        ("a.png", "no such file"),
        ("a.xyz", "known: .exr"),
        ("", "known"),
    ]:
        with pytest.raises(AssetError, match=problem):
            read_image(tmp_path / name)
    (tmp_path / "d.exr").mkdir()
    with pytest.raises(AssetError, match="not a file"):
        read_image(tmp_path / "d.exr")


def _png_claiming(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


def test_huge_headers_are_refused_before_memory_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for size in (8193, 9500, 12000, 60000):  # Pillow is silent, warns, warns, refuses
        (tmp_path / "a.png").write_bytes(_png_claiming(size, size))
        with pytest.raises(AssetError, match="64 Mpixel|exceeds limit"):
            read_image(tmp_path / "a.png")
    for width, problem in [(900000, "resolution"), (9000, "64 Mpixel")]:
        header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {width} +X {width}\n"
        (tmp_path / "a.hdr").write_bytes(header.encode() + b"\0" * 64)
        with pytest.raises(AssetError, match=problem):
            read_image(tmp_path / "a.hdr")
    write_image(tmp_path / "a.exr", picture())
    monkeypatch.setattr(read_module, "MAX_PIXELS", 34)
    with pytest.raises(AssetError, match="7 x 5 pixels"):
        read_image(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("given", "got"),
    [
        (np.zeros((2, 2, 3), np.float32), "ndarray"),
        (torch.zeros(2, 2, 3, dtype=torch.uint8), "numbers of torch.uint8"),
        (None, "NoneType"),
    ],
    ids=["an array", "8 bits", "None"],
)
def test_what_is_no_linear_picture_is_refused(tmp_path, given, got):
    with pytest.raises(ValueError, match=f"expected a tensor of linear floats .* got {got}"):
        write_image(tmp_path / "x.png", given)
    with pytest.raises(SceneError, match="^image: "):
        write_image(tmp_path / "x.png", given)
    assert not any(tmp_path.iterdir())
