"""What users import stays importable: public modules, and all that kinds of their own need from one place."""

from __future__ import annotations

from importlib import import_module

import pytest

import torchpt

MODULES = ("cameras", "data", "extend", "ibl", "losses", "metrics", "nn", "ranks")


@pytest.mark.parametrize("name", MODULES)
def test_a_public_module_has_what_it_names(name: str) -> None:
    module = import_module(f"torchpt.{name}")
    assert getattr(torchpt, name) is module
    assert name in torchpt.__all__
    for own in module.__all__:
        assert getattr(module, own) is not None


def test_a_kind_of_ones_own_needs_nothing_else() -> None:
    extend = torchpt.extend
    for name in (
        "Bsdf",
        "Light",
        "Shape",
        "Camera",
        "Points",
        "Filter",
        "Computed",
        "Path",
        "SurfaceLayer",
        "FilmLayer",
    ):
        assert isinstance(getattr(extend, name), type)
    for name in ("Splat", "Field", "StageContext", "VertexInput", "VertexOutput", "Transmission", "Emission", "Draws"):
        assert name in extend.__all__
