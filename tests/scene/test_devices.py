"""`device=auto` takes CUDA only where a check has passed; what is missing is one line."""

from __future__ import annotations

import pytest
import torch

import torchpt
from torchpt.core import errors
from torchpt.native import cache, device_checks
from torchpt.native.device_checks import CheckResult, record, recorded
from torchpt.scene.devices import device_of

CARD, DRIVER = "NVIDIA Example 1", "550.54.15"


@pytest.fixture(autouse=True)
def _folder(monkeypatch, tmp_path):
    monkeypatch.setattr(cache, "_folder", lambda: tmp_path)
    errors.warn_once.cache_clear()
    yield
    errors.warn_once.cache_clear()


@pytest.fixture
def card(monkeypatch):
    """A machine with two CUDA devices."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device=None: CARD)
    monkeypatch.setattr(device_checks, "driver_version", lambda: DRIVER)


@pytest.fixture
def without(monkeypatch):
    """A function that takes away the device: torch's version of CUDA and the driver's."""

    def remove(of_torch: str | None, of_driver: tuple[int, int] | None) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        monkeypatch.setattr(torch.version, "cuda", of_torch)
        monkeypatch.setattr(device_checks, "cuda_of_driver", lambda: of_driver)

    return remove


def test_results_are_kept_by_card_and_driver():
    assert recorded(CARD, DRIVER) is None
    record(CheckResult(CARD, DRIVER, False, "emit differs"))
    record(CheckResult(CARD, "551.0", True))
    assert recorded(CARD, DRIVER) == CheckResult(CARD, DRIVER, False, "emit differs", torchpt.__version__)
    record(CheckResult(CARD, DRIVER, True))
    assert recorded(CARD, DRIVER) == CheckResult(CARD, DRIVER, True) and recorded("another card", DRIVER) is None


def test_a_damaged_result_counts_as_none(tmp_path):
    record(CheckResult(CARD, DRIVER, True))
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-3])
    assert recorded(CARD, DRIVER) is None


@pytest.mark.usefixtures("card")
def test_auto_takes_a_card_that_was_checked(capfd):
    record(CheckResult(CARD, DRIVER, True))
    assert device_of("auto") == torch.device("cuda:1")
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("card")
def test_auto_says_once_why_it_takes_the_cpu(capfd):
    assert device_of("auto") == device_of("auto") == torch.device("cpu")
    assert capfd.readouterr().err == (
        f"torchpt: device=auto takes the CPU, as {CARD} with driver {DRIVER} was never checked: "
        "scripts/first_gpu.py does that; device=cuda takes it\n"
    )
    record(CheckResult(CARD, DRIVER, False, "emit differs"))
    assert device_of("auto") == torch.device("cpu")
    assert "failed its check by scripts/first_gpu.py (emit differs)" in capfd.readouterr().err
    # a new driver is a new question
    record(CheckResult(CARD, "551.0", True))
    assert device_of("auto") == torch.device("cpu")


@pytest.mark.usefixtures("card")
def test_cuda_is_taken_by_name_without_a_check():
    assert device_of("cuda") == torch.device("cuda:1") and device_of("cuda:0") == torch.device("cuda:0")
    with pytest.raises(torchpt.RenderError) as caught:
        device_of("cuda:2")
    assert str(caught.value) == "render.device: cuda:2 is not available; this machine has 2 CUDA devices, from cuda:0"


MISSING = [
    (None, None, f"torch {torch.__version__} was built without CUDA"),
    ("12.8", None, "there is no NVIDIA driver"),
    ("12.8", (12, 4), "no CUDA device was found"),
    ("13.0", (12, 4), "the NVIDIA driver is too old: it has CUDA 12.4, and torch was built for CUDA 13.0"),
]


@pytest.mark.parametrize(("of_torch", "of_driver", "reason"), MISSING, ids=["torch", "driver", "device", "old"])
def test_a_missing_device_is_one_line(without, capfd, of_torch, of_driver, reason):
    without(of_torch, of_driver)
    with pytest.raises(torchpt.RenderError) as caught:
        torchpt.load("cornell_box", device="cuda")
    assert str(caught.value) == f"render.device: cuda is not available, as {reason}; cpu and auto are"
    assert device_of("auto") == torch.device("cpu")
    said = capfd.readouterr().err
    assert said == (f"torchpt: device=auto takes the CPU, as {reason}\n" if "too old" in reason else "")
