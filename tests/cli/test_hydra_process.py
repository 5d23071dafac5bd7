"""What Hydra takes from the process is there while it runs, and no longer."""

from __future__ import annotations

import argparse
import os
import sys

import pytest

from torchpt.cli.hydra_process import hydra_process
from torchpt.cli.main import main


@pytest.mark.parametrize("set_before", [None, "0"])
def test_the_process_is_left_as_it_was(set_before, monkeypatch):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    if set_before is not None:
        monkeypatch.setenv("HYDRA_FULL_ERROR", set_before)
    before = list(sys.argv)
    with pytest.raises(ZeroDivisionError), hydra_process(["a=1"]):
        assert sys.argv == ["torchpt", "a=1"] and os.environ["HYDRA_FULL_ERROR"] == "1"
        raise ZeroDivisionError
    assert sys.argv == before and os.environ.get("HYDRA_FULL_ERROR") == set_before


def test_help_that_is_no_text_does_not_end_hydra(monkeypatch, capsys):
    """As Python 3.14 checks it, whichever Python runs this."""
    declare = argparse._ActionsContainer.add_argument

    def checked(self, *args, **options):
        action = declare(self, *args, **options)
        getattr(self, "_check_help", lambda _: None)(action)
        return action

    def check(self, action):
        if not isinstance(action.help, str | None):
            raise ValueError("badly formed help string")

    monkeypatch.setattr(argparse._ActionsContainer, "add_argument", checked)
    monkeypatch.setattr(argparse.ArgumentParser, "_check_help", check, raising=False)
    assert main(["render", "--cfg", "job"]) == 0
    assert "film:" in capsys.readouterr().out
    with pytest.raises(ValueError, match="badly formed"):
        argparse.ArgumentParser().add_argument("--x", help=object())  # type: ignore[arg-type]
