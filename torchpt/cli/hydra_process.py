"""What Hydra takes from the process that it runs in. Hydra itself is imported by :mod:`torchpt.cli.main` alone."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["hydra_process"]


@contextmanager
def hydra_process(words: list[str]) -> Iterator[None]:
    """Hydra reads ``sys.argv``, and hands its errors over (rather than print them) only under HYDRA_FULL_ERROR.

    From Python 3.14 on an option's help text is checked when it is declared, and that of one of Hydra's options is no text
    (facebookresearch/hydra#3121, open at 1.3.8): the check rests.
    """
    argv, before = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    parser: Any = argparse.ArgumentParser
    check = getattr(parser, "_check_help", None)
    sys.argv = ["torchpt", *words]
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if check is not None:
        parser._check_help = lambda *_: None
    try:
        yield
    finally:
        sys.argv = argv
        if check is not None:
            parser._check_help = check
        if before is None:
            del os.environ["HYDRA_FULL_ERROR"]
        else:
            os.environ["HYDRA_FULL_ERROR"] = before
