"""Scenes of the corpus beside Mitsuba, value by value: where rays hit, what BSDFs and lights are there."""

from __future__ import annotations

from pathlib import Path

import pytest
from few import few
from mitsuba_corpus import EXACT, write_assets
from mitsuba_values import agreements

pytestmark = pytest.mark.mitsuba

#: Densities that are not Mitsuba's: visible normals of GGX without those that reflect below the surface, Beckmann's with the
#: exact masking (Mitsuba approximates it), other shares of lobes.
_OWN_DENSITY = (
    *(
        "roughconductor",
        "roughconductor_beckmann",
        "bitmap_roughness",
        "blendbsdf",
        "roughplastic",
        "roughplastic_default",
    ),
    "principled",
)
#: Mitsuba's plastic takes the light that the coat keeps inside from a fit, which is off by 0.14 %.
_BY_FIT = ("plastic", "plastic_nonlinear")


def _agree(name: str, folder: Path, count: int, most_off: float) -> None:
    write_assets(folder)
    (folder / "scene.xml").write_text(EXACT[name])
    found = agreements(folder / "scene.xml", count)
    assert found["hit"].count > count // 3
    for what, row in found.items():
        if (what == "pdf" and name in _OWN_DENSITY) or (what == "value" and name in _BY_FIT):
            continue
        assert row.median < 1e-4 and row.off <= most_off, (what, row)


@pytest.mark.parametrize("name", few(EXACT, 5))
def test_values_are_mitsubas(tmp_path: Path, name: str) -> None:
    _agree(name, tmp_path, 300, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
def test_ten_thousand_values_are_mitsubas(tmp_path: Path, name: str) -> None:
    _agree(name, tmp_path, 10_000, 0.001)
