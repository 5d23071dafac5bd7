"""What every kind of filter must do, of each in the table, at its defaults and at each row of ``OTHERS``."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from outside import values_outside
from trials import SIGNIFICANCE, chi_square_p, film_of

import torchpt
from torchpt.core.errors import SceneError
from torchpt.physics.film import FILTERS, Filter, filter_of
from torchpt.spec import parameters_of
from torchpt.spec.schema import read_typed

CPU = torch.device("cpu")
#: Beside the defaults: parameters that make a filter of another shape.
OTHERS: dict[str, list[dict[str, Any]]] = {
    "gaussian": [{"stddev": 1.0, "radius": 1.5}],
    "tent": [{"radius": 1.7}],
    "mitchell": [{"B": 0.0, "C": 0.5}, {"B": 1.0, "C": 0.0}, {"B": 1.0, "C": 1.0}],
}
ROWS = [(kind, keys) for kind in FILTERS for keys in ({}, *OTHERS.get(kind, []))]
ROW = pytest.mark.parametrize(("kind", "keys"), ROWS, ids=[f"{kind}-{keys}" for kind, keys in ROWS])
#: So few that chance hides what a table of 4096 cells is off by where a profile is zero: 1e-4 of all places.
N, BINS = 1 << 15, 48


def chance(seed: int) -> torch.Tensor:
    """``(2, N)`` multiples of ``2^-24``, as samplers give them."""
    whole = torch.randint(0, 1 << 24, (2, N), generator=torch.Generator().manual_seed(seed))
    return whole.float() / (1 << 24)


def grid(filter: Filter) -> tuple[np.ndarray, np.ndarray]:
    """Places over the support ``(M,)`` and the profile there, its integral one."""
    x = np.linspace(-filter.radius, filter.radius, BINS * 4096 + 1)
    middle = 0.5 * (x[1:] + x[:-1])
    profile = filter.profile(middle)
    return middle, profile / profile.sum()


def weights(filter: Filter, u: torch.Tensor) -> torch.Tensor:
    return filter.weight(u).double() if filter.signed else torch.ones(u.shape[1], dtype=torch.float64)


@pytest.mark.parametrize("kind", list(FILTERS))
def test_what_is_declared(kind):
    for key, spec in parameters_of(FILTERS[kind]).items():
        assert spec.doc, key
        for value in values_outside(spec):
            with pytest.raises(SceneError, match=rf"film\.filter\.{key}"):
                read_typed("filter", FILTERS, {"type": kind, key: value}, "film.filter", None)
    with pytest.raises(SceneError):
        filter_of(kind, CPU, no_such_key=1)


@ROW
def test_places_follow_the_profile(kind, keys):
    filter = filter_of(kind, CPU, **keys)
    _, profile = grid(filter)
    expected = np.abs(profile).reshape(BINS, -1).sum(1)
    expected *= N / expected.sum()
    for place in filter.offset(chance(1)).double().numpy():
        assert np.abs(place).max() <= filter.radius
        counts = np.histogram(place, BINS, (-filter.radius, filter.radius))[0]
        # Cells that hold next to nothing are one.
        rare = expected < 25
        cells = [(counts[~rare], expected[~rare]), (counts[rare].sum(keepdims=True), expected[rare].sum(keepdims=True))]
        found, wanted = (np.concatenate(both) for both in zip(*cells, strict=True))
        some = wanted > 5
        statistic = float((((found - wanted) ** 2)[some] / wanted[some]).sum())
        assert chi_square_p(statistic, int(some.sum()) - 1) > SIGNIFICANCE / (2 * len(ROWS))
    assert not float((filter.profile(np.array([-1.01, 1.01]) * filter.radius) != 0).any())


@ROW
def test_weights_have_a_mean_of_one_and_the_filters_sign(kind, keys):
    filter = filter_of(kind, CPU, **keys)
    x, profile = grid(filter)
    magnitude = float(np.abs(profile).sum())
    assert filter.signed == (magnitude > 1 + 1e-6)
    u = chance(2)
    weight = weights(filter, u)
    assert torch.allclose(weight.abs(), torch.full_like(weight, magnitude**2), rtol=1e-5)
    # Its expectation, exactly: of the share of numbers that are weighed negatively.
    line = (torch.arange(1 << 20) + 0.5).float() / (1 << 20)
    one = weights(filter, torch.stack((line, torch.full_like(line, 0.999)))).mean() / magnitude
    assert abs(float(one)) == pytest.approx(1, abs=1e-5)
    value = np.prod([np.interp(place, x, profile) for place in filter.offset(u).double().numpy()], axis=0)
    clear = np.abs(value) > 5e-3 * np.abs(profile).max() ** 2
    assert (np.sign(value[clear]) == np.sign(weight.numpy()[clear])).all()
    # A cosine over the support, weighed: the filter's own integral of it.
    wave = np.cos(1.3 * np.pi * x / filter.radius)
    found = weight.numpy() * np.cos(1.3 * np.pi * filter.offset(u).double().numpy() / filter.radius).prod(0)
    assert float(found.mean()) == pytest.approx(float((profile * wave).sum()) ** 2, abs=5 * found.std() / N**0.5)


@ROW
def test_both_sides_are_alike(kind, keys):
    filter = filter_of(kind, CPU, **keys)
    _, profile = grid(filter)
    np.testing.assert_allclose(profile, profile[::-1], atol=1e-12)
    place = filter.offset(((torch.arange(1 << 18) + 0.5) / (1 << 18)).float()).double() / filter.radius
    assert abs(float(place.mean())) < 1e-5
    for part in (0.0, 0.3, 0.6, 0.9):
        left, right = float((place < -part).double().mean()), float((place > part).double().mean())
        assert left == pytest.approx(right, abs=1e-5)


@pytest.mark.parametrize("kind", list(FILTERS))
def test_a_picture_is_the_same_compiled(kind):
    scene = {
        "camera": {"origin": [0, 0, 0], "target": [0, 0, -1], "fov": 90},
        "integrator": {"type": "path", "max_depth": 1},
        "shapes": {"ball": {"type": "sphere", "center": [0.3, 0.2, -3], "emission": [1, 2, 3]}},
    }
    loaded = torchpt.load(scene, "cpu")
    film = {**film_of(12, 9), "filter": kind}
    eager, compiled = (torchpt.render(loaded, spp=8, film=film, compile=mode) for mode in ("off", "on"))
    torch.testing.assert_close(eager, compiled, rtol=1e-5, atol=1e-6)
    assert float(eager.std()) > 0.1
