"""Sums of gradients: the order that ``torchpt/math/sums.py`` states, whatever places lanes have and whoever adds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from few import few
from gradient_rooms import several, sums_of
from mirrored import Mirrored, lights

from torchpt.compiler.graph import Unsupported
from torchpt.engines import tensors
from torchpt.engines.kernels import engine
from torchpt.engines.kernels.backward import KernelsBackward, VjpKernels
from torchpt.gradients import replay
from torchpt.math import sums
from torchpt.math.sum_kernels import COLUMNS, add_at, add_by_columns, sort_by_sample
from torchpt.paths.integrators.path import partition

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

SLOTS = 36 * COLUMNS - 5


def terms(count: int, entries: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries, numbers and slots of terms; some are of no entry."""
    random = np.random.default_rng(count)
    slots = np.sort(random.choice(SLOTS, count, False)).astype(np.int32)
    index = random.integers(-1, entries + 1, count).astype(np.int32)
    size = np.exp(8 * random.standard_normal((width, count)))
    return index, (size * random.standard_normal((width, count))).astype(np.float32), slots


def by_all_slots(total: np.ndarray, index: np.ndarray, values: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """The sum as it is stated, with a 0 from each slot that has no term, as many threads could do it."""
    rows = np.zeros((SLOTS, *total.shape))
    for k, entry in enumerate(index):
        if 0 <= entry < len(total):
            rows[slots[k], entry] = values[:, k]
    columns = np.zeros((COLUMNS, *total.shape))
    for first in range(0, SLOTS, COLUMNS):
        here = rows[first : first + COLUMNS]
        columns[: len(here)] += here
    while len(columns) > 1:
        columns = columns[: len(columns) // 2] + columns[len(columns) // 2 :]
    return total + columns[0]


@pytest.mark.parametrize(("count", "entries", "width"), [(SLOTS, 1, 3), (700, 40, 4), (60, 300, 1), (0, 2, 2)])
def test_columns_are_summed_as_is_stated(count, entries, width):
    index, values, slots = terms(count, entries, width)
    total = np.random.default_rng(1).standard_normal((entries, width))
    expected = by_all_slots(total, index, values, slots)
    add_by_columns(total, index, values, slots)
    assert np.array_equal(total, expected)


@pytest.mark.parametrize("width", [1, 2, 3, 7])
def test_terms_are_added_in_their_order(width):
    index, values, _ = terms(900, 12, width)
    total = np.zeros((12, width))
    expected = total.copy()
    for entry, column in zip(index, values.T, strict=True):
        if 0 <= entry < 12:
            expected[entry] += column
    add_at(total, index, values)
    assert np.array_equal(total, expected)


@pytest.mark.parametrize("count", [1, 50, 700, SLOTS])
def test_lists_are_sorted_by_the_slots_of_their_lanes(count):
    random = np.random.default_rng(count)
    lanes = random.permutation(SLOTS).astype(np.int32)
    places, slots = np.zeros(SLOTS + 1, np.int32), np.zeros(SLOTS + 1, np.int32)
    places[:count] = given = random.choice(SLOTS, count, False)
    taken = np.zeros(-(-SLOTS // 8) * 8, np.uint8)
    for _ in range(2):  # once more where they are in order already
        sort_by_sample(places, count, lanes, slots, np.zeros(SLOTS, np.int32), taken)
        assert np.array_equal(slots[:count], np.sort(lanes[given]))
        assert np.array_equal(lanes[places[:count]], slots[:count])
        assert not taken.any()


def test_terms_are_summed_by_entry_pairwise():
    index, values, _ = terms(900, 12, 3)
    index = np.concatenate((index, np.full(1, 40, np.int32)))
    given = torch.from_numpy(np.concatenate((values, np.ones((3, 1), np.float32)), 1)).double()
    entries, found = sums.summed_by_entry(torch.from_numpy(index).long(), given)
    assert entries.tolist() == sorted(set(index.tolist()))
    for entry, sums_of_it in zip(entries.tolist(), found.T, strict=True):
        left = list(given[:, index == entry].T)
        while len(left) > 1:
            left = [torch.stack(left[k : k + 2]).sum(0) for k in range(0, len(left), 2)]
        assert torch.equal(sums_of_it, left[0])


def test_terms_of_other_entries_may_lie_between():
    index, values, _ = terms(900, 12, 3)
    order = np.argsort(-index, kind="stable")
    one, other = (sums.summed_by_entry(torch.from_numpy(index[k]).long(), torch.from_numpy(values[:, k]))
                  for k in (np.arange(900), order))  # fmt: skip
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


# -- gradients

NAMES = ["materials.grey.reflectance", "lights.sky.radiance", "shapes.plate.to_world", "shapes.lamp.emission"]


@pytest.fixture(params=["few", "dense", "stream"])
def table(request, monkeypatch) -> None:
    """How the tables of a scene are summed, which have few numbers."""
    monkeypatch.setattr(sums, "MAX_BY_COLUMNS", sums.MAX_BY_COLUMNS if request.param == "few" else 0)
    monkeypatch.setattr(sums, "MAX_DENSE", 0 if request.param == "stream" else sums.MAX_DENSE)


def shuffled(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Lanes take other places in each arena, and lists name them in another order; returns how many were moved."""
    random, moved = np.random.default_rng(5), []
    scatter, listed = KernelsBackward.scatter, KernelsBackward.sort

    def scattered(self: Any, paths: Any, roulette: float) -> Any:
        after = scatter(self, paths, roulette)
        words = after.arena.words[:, : after.count]
        words[:] = words[:, random.permutation(after.count)]
        moved.append(after.count)
        return after

    def sort(self: Any, paths: Any) -> Any:
        counts = listed(self, paths)
        for places, count in zip(paths.lists, paths.places, strict=False):
            places.words[0, :count] = random.permutation(places.words[0, :count])
        return counts

    monkeypatch.setattr(KernelsBackward, "scatter", scattered)
    monkeypatch.setattr(KernelsBackward, "sort", sort)
    return moved


@pytest.mark.parametrize("name", few(NAMES, 2))
@pytest.mark.usefixtures("table")
def test_places_of_lanes_do_not_matter(monkeypatch, name):
    scene = several()
    first = sums_of(scene, name)
    moved = shuffled(monkeypatch)
    other = sums_of(scene, name)
    assert len(moved) >= 4 and moved[0] > 1000
    assert torch.equal(first, other)


def test_places_of_lanes_do_not_matter_to_stages_by_tensor_operations(monkeypatch):
    made = VjpKernels._get

    def get(self: Any, listed: bool, build: Any, *arguments: Any) -> Any:
        if build.__name__.endswith("_vjp"):
            raise Unsupported("an operator of the test's own")
        return made(self, listed, build, *arguments)

    monkeypatch.setattr(VjpKernels, "_get", get)
    scene = several()
    first = sums_of(scene, NAMES[0])
    shuffled(monkeypatch)
    assert torch.equal(first, sums_of(scene, NAMES[0]))


def turned(world: Any, hit: Any) -> Any:
    """Groups of lanes the other way round, so that those behind them lie elsewhere."""
    ends, groups = partition(world, hit)
    groups = [(model, index.flip(0)) for model, index in groups]
    return type(ends)(ends.emissive.flip(0), ends.missed.flip(0)), groups


@pytest.mark.parametrize("sorts", [False, True])
@pytest.mark.parametrize("name", few([*NAMES, "materials.plate.opacity"], 2))
def test_places_of_lanes_do_not_matter_by_tensor_operations(monkeypatch, name, sorts):
    """Neither to the sums of a CPU nor to those of other devices (here on a CPU)."""
    if sorts:
        monkeypatch.setattr(sums.GradientSums, "add_at", sums.GradientSums.add_sorted)
    scene = several(0.5 if name.endswith("opacity") else 1.0)
    first = sums_of(scene, name, compile="off")
    monkeypatch.setattr(tensors, "partition", turned)
    other = sums_of(scene, name, compile="off")
    assert torch.equal(first, other)


@pytest.mark.parametrize("compile", ["on", "off"])
def test_places_of_lanes_do_not_matter_to_splats(monkeypatch, compile):
    scene, wish = several(), {"compile": compile, "integrator": Mirrored(**lights())}
    first = sums_of(scene, NAMES[0], **wish)
    shuffled(monkeypatch)
    monkeypatch.setattr(tensors, "partition", turned)
    assert torch.equal(first, sums_of(scene, NAMES[0], **wish))


@pytest.mark.parametrize("name", few(NAMES, 1))
@pytest.mark.usefixtures("table")
def test_bits_do_not_depend_on_threads_nor_memory(monkeypatch, name):
    monkeypatch.setattr(replay, "LANES_OF_KERNELS", engine.LANES // 32)  # so that there are some chunks
    scene = several()
    wishes: list[dict[str, Any]] = [{"threads": 1}, {"threads": 2}, {"threads": 3}, {"max_memory": "3GB"}]
    first, *others = (sums_of(scene, name, **wish) for wish in wishes)
    assert all(torch.equal(first, other) for other in others)
