from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.slow
def test_the_wheel_carries_configs_and_scenes(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="hatchling (extra `dev`) builds the wheel")
    tree = tmp_path / "tree"
    ignored = shutil.ignore_patterns(".*", "tests", "docs", "__pycache__")
    shutil.copytree(ROOT, tree, ignore=ignored)
    build = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-q",
        "-w",
        str(tmp_path),
        str(tree),
    ]
    subprocess.run(build, check=True)
    (wheel,) = tmp_path.glob("torchpt_renderer-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for folder in ("configs", "scenes"):
        for path in (ROOT / folder).rglob("*"):
            if path.is_file():
                assert f"torchpt/share/{path.relative_to(ROOT)}" in names
    kernels = {path.name for path in (ROOT / "torchpt" / "native" / "ir").iterdir()}
    assert kernels and {f"torchpt/native/ir/{name}" for name in kernels} <= names
    assert "torchpt/physics/lights/hosek_wilkie.npz" in names
    assert sum("hosek_wilkie.LICENSE" in name for name in names) == 2  # beside the numbers, and among the licences
    assert any(name.endswith("entry_points.txt") for name in names)
    assert not any(name.startswith(("configs", "tests")) for name in names)
