"""What every test needs: reasons for skipping, and quiet libraries."""

from __future__ import annotations

import gc
import importlib.util
import os

import pytest
from hypothesis import settings

# Examples are the same in each run; `make test-all` draws more of them, others each time (--hypothesis-profile=random).
settings.register_profile("fixed", max_examples=30, derandomize=True, database=None, deadline=None)
settings.register_profile("random", max_examples=300, deadline=None, print_blob=True)
settings.load_profile("fixed")

# Workers share the cores: threads of their own would only wait for each other. (Before torch is imported.)
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.fixture(scope="module", autouse=True)
def _little_to_collect() -> None:
    """What modules before have left is not looked through at each collection: bounded memory asks for many."""
    gc.collect()
    gc.freeze()


def pytest_sessionfinish() -> None:
    """What ends with the process is to be collected then."""
    gc.unfreeze()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what this machine cannot run, and say why."""
    no_mitsuba = pytest.mark.skip(reason="mitsuba is not installed (extra `bench`)")
    no_gpu = pytest.mark.skip(reason="no CUDA device")
    has_mitsuba = importlib.util.find_spec("mitsuba") is not None
    for item in items:
        if "mitsuba" in item.keywords and not has_mitsuba:
            item.add_marker(no_mitsuba)
        if "gpu" in item.keywords and not _has_cuda():
            item.add_marker(no_gpu)


def _has_cuda() -> bool:
    import torch

    return torch.cuda.is_available()
