"""Every pixel and every item is taken by one rank."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchpt.core.errors import RenderError
from torchpt.ranks import blocks, dealt, share
from torchpt.ranks.launch import REQUIRED_VARIABLES, LaunchedProcess


def ranks(size: int) -> list[Any]:
    return [SimpleNamespace(rank=rank, size=size) for rank in range(size)]


@given(st.integers(0, 3000), st.integers(1, 9))
def test_pixels_are_dealt_once(pixels: int, size: int) -> None:
    every = [dealt(pixels, rank, size) for rank in range(size)]
    assert torch.cat(every).sort().values.tolist() == list(range(pixels))
    assert all(bool((places[1:] > places[:-1]).all()) for places in every)
    assert max(map(len, every)) - min(map(len, every)) <= 2 * 64


@given(st.integers(0, 5000), st.integers(1, 5000), st.integers(1, 7))
def test_blocks_are_dealt_once(pixels: int, samples: int, size: int) -> None:
    found = sorted(block for group in ranks(size) for block in blocks(pixels, samples, group))
    assert [p for start, count in found for p in range(start, start + count)] == list(range(pixels))
    assert all(count > 0 for _, count in found) or pixels == 0


@given(st.lists(st.integers()), st.integers(1, 5))
def test_items_are_shared_once(items: list[int], size: int) -> None:
    shares = [share(items, group) for group in ranks(size)]
    assert sorted(pair for own in shares for pair in own) == list(enumerate(items))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_one_process_takes_all() -> None:
    assert share("ab", None) == [(0, "a"), (1, "b")] and blocks(7, 3, None) == [(0, 7)]


@pytest.mark.parametrize("size", [2, 3, 8])
def test_nobody_has_a_column_to_himself(size: int) -> None:
    """Of a picture whose rows are as wide as a round, each column is several ranks'."""
    width = 64 * size
    owner = torch.empty(width * 8 * size, dtype=torch.int64)
    for rank in range(size):
        owner[dealt(len(owner), rank, size)] = rank
    for column in range(0, width, 64):
        assert len(owner.view(-1, width)[:, column].unique()) == size


def test_what_the_launcher_left_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in REQUIRED_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(
        RenderError, match="^there is no RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT: start it by torchrun$"
    ):
        LaunchedProcess()
