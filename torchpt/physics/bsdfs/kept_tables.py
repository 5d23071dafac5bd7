"""Keep tables of materials: integrals over directions that take longer than all else of a material.

Materials of a scene often share roughness and indices, and steps of an optimization change the colour of one among many.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch
from torch import Tensor

from torchpt.core.autograd import under_transforms
from torchpt.core.threads import outside_inference_mode

if TYPE_CHECKING:
    from torchpt.physics.bsdfs.base import Bsdf, Parameters

__all__ = ["keep_tables"]

#: Most results that are kept; one is a few hundred numbers.
MOST_KEPT = 512

Tabulate = TypeVar("Tabulate", bound=Callable[..., Any])


def keep_tables(tabulate: Tabulate) -> Tabulate:
    """Wrap a method ``tabulate`` of a model that reads only the parameters that it names in ``tabulated``.

    Results of numbers on the CPU are kept and shared, unless derivatives are wanted; nobody may write to them.
    """

    @lru_cache(maxsize=MOST_KEPT)
    def kept(model: Bsdf, numbers: tuple[tuple[str, torch.dtype, float], ...]) -> Any:
        with outside_inference_mode(), torch.no_grad():
            return tabulate(model, {name: torch.tensor([number], dtype=dtype) for name, dtype, number in numbers})

    @wraps(tabulate)
    def wrapped(model: Bsdf, values: Parameters) -> Parameters:
        read = {name: values[name] for name in model.tabulated if values.get(name) is not None}
        if under_transforms() or not all(map(_is_a_number, read.values())):
            return tabulate(model, values)
        return dict(kept(model, tuple((name, value.dtype, value.item()) for name, value in read.items())))

    return cast(Tabulate, wrapped)


def _is_a_number(value: Any) -> bool:
    """Return True for a tensor ``(1,)`` on the CPU, none of a tracer, that no derivatives are wanted by."""
    if type(value) is not Tensor or value.shape != (1,) or value.device.type != "cpu":
        return False
    return not (value.requires_grad and torch.is_grad_enabled())
