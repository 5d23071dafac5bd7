"""Pictures of the corpus and of public scenes beside Mitsuba's own, within their errors."""

from __future__ import annotations

import os
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mitsuba_corpus import EXACT, write_assets

import torchpt
from torchpt.core.errors import ImportedSceneWarning

SEEDS, SPP = 6, 64
#: A few pictures of different kinds are fast; all are slow.
QUICK = ("roughplastic", "bitmap_raw", "bumpmap_mesh", "cylinder", "instances", "orthographic", "spot")
PUBLIC = Path(os.environ.get("TORCHPT_SCENES", Path(__file__).parents[2].parent / "shared" / "scenes"))


@cache
def mitsuba() -> Any:
    from mitsuba_scene import load_mitsuba

    return load_mitsuba("scalar_rgb")


def means(render: Any) -> np.ndarray:
    """Return the mean colours ``(SEEDS, 3)`` of pictures of different seeds."""
    return np.array([np.asarray(render(seed), np.float64).mean((0, 1)) for seed in range(SEEDS)])


@pytest.mark.mitsuba
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.slow]) for name in EXACT]
)
def test_pictures_are_mitsubas(tmp_path: Path, name: str) -> None:
    write_assets(tmp_path)
    file = tmp_path / "scene.xml"
    file.write_text(EXACT[name])
    peer, scene = mitsuba().load_file(str(file)), torchpt.load(str(file))
    theirs = means(lambda seed: np.array(mitsuba().render(peer, spp=SPP, seed=1000 + seed))[..., :3])
    ours = means(lambda seed: torchpt.render(scene, spp=SPP, seed=seed, compile="off").numpy())
    error = np.sqrt((ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / SEEDS)
    # Deviates of Student's t with some 10 degrees of freedom, over 3 channels of 55 scenes: 6 happens once in 1,000 runs.
    assert (np.abs(ours.mean(0) - theirs.mean(0)) < 6.0 * error + 1e-3 * theirs.mean(0)).all(), (
        ours.mean(0),
        theirs.mean(0),
    )
    assert error.max() < 0.02 * theirs.mean()  # else the comparison says nothing
    assert (np.abs(_coarse(scene) - _coarse_of(peer)) < 0.25).all()


def _coarse(scene: Any) -> np.ndarray:
    """Return a picture's four quarters, whose pattern a flipped or turned picture has not."""
    return _quarters(torchpt.render(scene, spp=SPP, seed=0, compile="off").numpy())


def _coarse_of(peer: Any) -> np.ndarray:
    return _quarters(np.array(mitsuba().render(peer, spp=SPP, seed=0))[..., :3])


def _quarters(image: np.ndarray) -> np.ndarray:
    height, width = (side // 2 for side in image.shape[:2])
    found = image[: 2 * height, : 2 * width].reshape(2, height, 2, width, 3).mean((1, 3))
    return found / found.mean()


@pytest.mark.slow
@pytest.mark.skipif(not PUBLIC.is_dir(), reason="no public scenes ($TORCHPT_SCENES)")
def test_public_scenes_open_as_published(tmp_path: Path) -> None:
    from torchpt.cli.main import main

    files = sorted(PUBLIC.glob("*/*.xml"))
    assert len(files) >= 8
    film = {"width": 16, "height": 9}
    for file in files:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImportedSceneWarning)
            scene = torchpt.load(str(file))
        image = torchpt.render(scene, spp=1, film=film, compile="off")
        assert bool(image.isfinite().all()) and float(image.mean()) > 0.01, file
        target = tmp_path / f"{file.parent.name}_{file.stem}.yaml"
        assert main(["convert", str(file), str(target)]) == 0
        assert bool((torchpt.render(torchpt.load(str(target)), spp=1, film=film, compile="off") == image).all()), file
