"""The checks of a first GPU run through on the simulated driver, and report what they cannot measure."""

from __future__ import annotations

import json
from pathlib import Path

import first_gpu
import pytest

from torchpt.native import device_checks

#: Checks that need a GPU.
HARDWARE = (5, 6, 7, 8, 9, 11, 12)


def test_hardware_is_not_measurable_here(tmp_path: Path, capsys):
    out = tmp_path / "report.json"
    assert first_gpu.main(["--simulated", "--out", str(out), "--only", "2", *map(str, HARDWARE)]) == 0
    report = json.loads(out.read_text())
    statuses = {check["number"]: check["status"] for check in report["checks"]}
    assert statuses == {2: "passed", **dict.fromkeys(HARDWARE, "not measurable here")}
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 1 + len(statuses) and all(check["name"] in "".join(printed) for check in report["checks"])


def test_a_wrong_quotient_fails_the_second_check(tmp_path: Path, monkeypatch):
    plain = first_gpu._run

    def off(*given):
        quotient, *others = plain(*given)
        return [quotient.nextafter(quotient + 1), *others]

    monkeypatch.setattr(first_gpu, "_run", off)
    out = tmp_path / "report.json"
    assert first_gpu.main(["--simulated", "--out", str(out), "--only", "2"]) == 1
    (check,) = json.loads(out.read_text())["checks"]
    assert check["status"] == "failed" and "quotient float32" in check["words"] and "root" not in check["words"]


def test_without_a_device_it_says_so_in_one_line(monkeypatch, tmp_path: Path, capsys):
    monkeypatch.setattr(device_checks, "why_unavailable", lambda: "there is no NVIDIA driver")
    assert first_gpu.main(["--out", str(tmp_path / "report.json")]) == 2
    said = capsys.readouterr().err
    assert said == "first_gpu: no GPU to check, as there is no NVIDIA driver; --simulated runs the checks without one\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_all_checks_run_through(tmp_path: Path):
    out = tmp_path / "report.json"
    assert first_gpu.main(["--simulated", "--out", str(out), "--pixels", "16"]) == 0
    statuses = [check["status"] for check in json.loads(out.read_text())["checks"]]
    assert statuses == ["not measurable here" if number in HARDWARE else "passed" for number in range(1, 13)]
