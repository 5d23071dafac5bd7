from __future__ import annotations

import subprocess
import sys
import time

import pytest

HEAVY = ("hydra", "omegaconf", "trimesh", "kornia", "matplotlib", "numba", "OpenImageIO", "imageio", "mitsuba")
PROBE = f"import sys; print([name for name in {HEAVY!r} if name in sys.modules])"


def loaded(code: str) -> tuple[str, float]:
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", f"{code}\n{PROBE}"], capture_output=True, text=True, check=True)
    return done.stdout.strip(), time.perf_counter() - start


def test_import_is_quick_and_light() -> None:
    found, seconds = loaded("import torchpt")
    assert found == "[]" and seconds < 2.0


def test_the_public_names_load_on_use() -> None:
    found, _ = loaded("import torchpt, torchpt.cli\nfor name in torchpt.__all__: getattr(torchpt, name)")
    assert found == "[]"


def test_render_stays_the_function_when_its_module_is_imported() -> None:
    code = "from torchpt.render import render_scene; import torchpt, torchpt.render; assert callable(torchpt.render)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_unknown_names() -> None:
    import torchpt

    assert set(torchpt.__all__) <= set(dir(torchpt))
    with pytest.raises(AttributeError, match="nonsense"):
        _ = torchpt.nonsense
