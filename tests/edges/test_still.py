"""What stands still has no samples of edges, and leaving it out changes no sum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import known_gradients as known
import pytest
import torch

from torchpt.gradients.edges.gradients import Boundary, boundary_of, moving_primitives
from torchpt.gradients.edges.primary import pieces_of
from torchpt.gradients.edges.shadows import Shadows
from torchpt.math.guiding import Round
from torchpt.scene.formats.description import settings

#: The pose of a block that moves.
MOVES = "shapes.block.to_world"


def boundary(parameter: str, **shapes: Any) -> Boundary:
    """Return the edges of a room, with two blocks, other shapes and a lamp, by one parameter."""
    other = {**known.BLOCK, "transform": [{"scale": 0.3}, known.moved(-0.4, -0.6, 0.1)]}
    scene = known.opened(known.with_shapes(known.ROOM, other=other, **shapes), {}, 16, 3)
    cotangent = torch.ones(3, 16, 16)
    given = {parameter: scene.params[parameter]}
    found = boundary_of(scene, settings(scene.description, {}), given, [parameter], torch.float32, cotangent)
    assert found is not None
    return found


@pytest.mark.parametrize("parameter", [MOVES, "camera.to_world"])
def test_only_curves_that_move_on_the_film_are_drawn(parameter: str):
    given = boundary(parameter)
    poses, bounds = given.scene.merged({}), given.worth.bounds()
    moves = moving_primitives(given.scene, [MOVES])
    every = pieces_of(given.scene, given.still, poses, bounds, None, None)
    moving = pieces_of(given.scene, given.still, poses, bounds, None, moves)
    assert every is not None and moving is not None
    assert moves[moving.curves.prim].all() and not moves[every.curves.prim].all()
    assert moving.weight.sum() == every.weight[moves[every.curves.prim]].sum()
    (samples,) = given.primary(8, given.traced.radiance)
    prims = samples.held.prim  # pyright: ignore[reportAttributeAccessIssue]
    assert len(prims) and bool(moves[prims].all()) == (parameter != "camera.to_world")


def test_nothing_is_drawn_where_nothing_moves():
    given = boundary(MOVES)
    still = torch.zeros(sum(given.still.counts), dtype=torch.bool)
    assert pieces_of(given.scene, given.still, given.scene.merged({}), given.worth.bounds(), None, still) is None


def test_shadows_of_what_stands_still_on_what_stands_still_add_nothing():
    more = {"type": "cube", "material": known.WHITE, "transform": [{"scale": 0.15}, known.moved(0.6, -0.1, 0.6)]}
    given = boundary(MOVES, more=more)
    (shadows,) = (e for e in given._estimators(False) if isinstance(e, Shadows))  # pyright: ignore[reportPrivateUsage]
    assert not shadows.lights_move
    some, every = (e.samples(Round(0, 20_000), 0, 20_000) for e in (shadows, replace(shadows, lights_move=True)))
    assert some is not None and every is not None
    assert sum(len(p.lane) for p, _ in some.prefixes) < 0.9 * sum(len(p.lane) for p, _ in every.prefixes)
    (a,), (b,) = (boundary(MOVES, more=more).gradients([found], [MOVES]) for found in (some, every))
    assert a is not None and b is not None and a.abs().max() > 0
    torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-12)
