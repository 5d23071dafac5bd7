"""The numbers of a scene by dotted name, and what each of them is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchpt.spec import Spec, parameters_of

__all__ = ["Parameters"]


class Parameters(dict[str, np.ndarray]):
    """Arrays by dotted name, which become the tensors of ``scene.params``.

    Attributes:
        specs: what each of them is.
        stated: texels that the scene states itself, in no file.
    """

    def __init__(self) -> None:
        super().__init__()
        self.specs: dict[str, Spec] = {}
        self.stated: set[str] = set()

    def declare(self, name: str, value: Any, spec: Spec) -> None:
        """Add one; texels stay as they are, all else is kept in float64."""
        keeps = isinstance(value, np.ndarray) and value.dtype == np.float32
        self[name] = value if keeps else np.asarray(value, np.float64)
        self.specs[name] = spec

    def declare_all(self, prefix: str, kind: Any, values: Mapping[str, Any]) -> None:
        """Add those parameters of a kind that are traced and have a value; ``transform`` is called ``to_world``."""
        for key, spec in parameters_of(kind).items():
            if not spec.traced:
                continue
            if key == "transform":
                self.declare(f"{prefix}.to_world", np.eye(4) if values[key] is None else values[key], spec)
            elif isinstance(values[key], float | tuple | np.ndarray):
                self.declare(f"{prefix}.{key}", values[key], spec)
