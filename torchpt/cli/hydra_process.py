"""Set up the process-wide state that Hydra reads: ``sys.argv``, the environment and argparse."""

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
    """Set ``sys.argv`` and HYDRA_FULL_ERROR inside the context; with HYDRA_FULL_ERROR Hydra raises its errors.

    Python 3.14 checks the help text of an option when it is declared, and one of Hydra's options has a help that is not text
    (facebookresearch/hydra#3121, open at 1.3.8): the check is off inside the context.
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
