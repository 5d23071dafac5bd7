"""Several scenes as one world, whose lanes carry which of them they are in (``PathState.scene``).

    form_of(world)              what two worlds must have in common to be joined
    joined_world(worlds)        one world of several, and the numbers of their primitives in it

What a lane computes is what it computes in its own world, to the bit: the same code with the same numbers, gathered elsewhere.
So worlds of one form alone are joined: where one scene lacks smooth normals, lanes of that scene take other steps.
"""

from __future__ import annotations

from torchpt.union.form import form_of
from torchpt.union.worlds import joined_world

__all__ = ["form_of", "joined_world"]
