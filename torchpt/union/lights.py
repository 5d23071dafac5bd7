"""Tables of lights joined, the rows of each scene after those before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from torchpt.accel.numbers import Numbers
from torchpt.lights import COLUMNS, Environment, choice, emitter
from torchpt.math.vectors import take
from torchpt.records import Lights, Quadrics

__all__ = ["joined_lights"]


def joined_lights(tables: Sequence[Lights], numbers: Numbers, quadrics: Quadrics | None) -> Lights:
    """The tables of S scenes as one.

    Args:
        tables: of one form.
        numbers: of the scenes' primitives among all.
        quadrics: of all scenes.
    """
    one = tables[0]
    sizes = [len(table.area) for table in tables]
    first = [0, *accumulate(sizes)][:-1]

    def rows(name: str, of: Callable[[int, Tensor], Tensor] = lambda scene, column: column) -> Tensor | None:
        """A column, with what ``of`` makes of each scene's; None where there is none."""
        if getattr(one, name) is None:
            return None
        return torch.cat([of(scene, getattr(table, name)) for scene, table in enumerate(tables)], -1)

    def row_of_prim() -> Tensor | None:
        if one.row_of_prim is None:
            return None
        own = [(table.row_of_prim, start) for table, start in zip(tables, first, strict=True)]
        return numbers.slots([torch.where(row < 0, row, row + start) for row, start in own if row is not None])

    # Quadrics of scenes follow each other; rows of other kinds hold 0 and are not read.
    bent = [0 if table.quadrics is None else table.quadrics.e3.shape[1] for table in tables]
    bent = [0, *accumulate(bent)][:-1]
    found: dict[str, Any] = {name: rows(name) for name in (*COLUMNS, "opacity", "kind")}
    environment = None
    if one.environment is not None:
        kind = emitter(one.kinds[-1])
        assert issubclass(kind, Environment)
        environment = kind.joined([table.environment for table in tables])
    return replace(
        one,
        **found,
        choice=choice.joined([table.choice for table in tables]),
        environment=environment,
        row_of_prim=row_of_prim(),
        quadric=rows("quadric", lambda scene, column: column + bent[scene]),
        quadrics=None if one.quadrics is None else quadrics,
        prim=rows("prim", lambda scene, column: take(numbers.own(scene), column)),
        solid=None if one.solid is None else torch.cat([t.solid for t in tables if t.solid is not None]),
        first=torch.tensor(first, device=one.area.device),
    )
