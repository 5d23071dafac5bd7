"""Damaged scenes of Mitsuba: an error of one line or a scene, never a traceback, never a wait, in bounded memory."""

from __future__ import annotations

import os
import random
import resource
import time
import warnings
from pathlib import Path

import pytest
from mitsuba_corpus import EXACT, NEAREST, OLD, scene, write_assets

from torchpt.core.errors import EnergyWarning, ImportedSceneWarning, TorchptError
from torchpt.scene.formats.description import read_description

#: What is put in the place of some text.
TOKENS = (
    "", "0", "-1", "1e999", "nan", "1e-320", "$x", "$", "<", ">", '"', "&amp;", "&x;", "<ref id='a'/>", "type=\"twosided\"",
    "bsdf", "shape", "texture", "sphere", "obj", "name", "\x00", "\ud7ff", "<!--", "]]>", "<scene>", "</scene>", "9" * 400,
    "0 0 0", "1,2,3", "../../../etc/passwd", "true", "to_world", "radius", "id=\"a\"", "<include filename='scene.xml'/>",
)  # fmt: skip
FLAT, PROJECTIVE, LOOK = (
    f'<transform name="to_world">{operation}</transform>'
    for operation in (
        '<scale x="-2" y="0" z="0"/>',
        '<matrix value="1 0 0 0 0 1 0 0 0 0 0 0 0 0 0.1 2"/>',
        '<lookat origin="0, 1, 0" target="1, 0, 0"/>',
    )
)
#: Poses, spots and heads of files that need mending.
PUBLISHED = (
    scene(f'<shape type="sphere"><float name="radius" value="-1"/>{FLAT}</shape>'),
    scene(f'<shape type="cube">{PROJECTIVE}</shape>'),
    scene(f'<emitter type="spot"><float name="cutoff_angle" value="270"/>{FLAT}</emitter>'),
    scene(
        '<shape type="shapegroup" id="g"><shape type="cube"/></shape><shape type="instance"><ref id="g"/>'
        f"{LOOK}</shape>"
    ),
    f' <?xml version="1.0"?><!DOCTYPE scene><scene version="0.6.0"><shape type="disk">{LOOK}</shape></scene>',
)
TEXTS = [
    *PUBLISHED,
    *EXACT.values(),
    *(text for text, *_ in NEAREST.values()),
    *(text for pair in OLD.values() for text in pair),
]
#: Longest that one scene may take, in seconds; most take a few milliseconds.
LONGEST = 20.0
#: Most bytes that the process may grow to beside what it has before.
MOST_BYTES = 2**31


def damaged(text: str, rng: random.Random) -> str:
    """Return a text with a few changes: characters, words, attributes, lines."""
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        at = rng.randrange(len(text))
        kind = rng.randrange(5)
        if kind == 0:  # a stretch lost
            text = text[:at] + text[at + rng.choice((1, 3, 20, 200)) :]
        elif kind == 1:  # something else in its place
            text = text[:at] + rng.choice(TOKENS) + text[at + rng.choice((0, 1, 5)) :]
        elif kind == 2:  # an attribute's value
            parts = text.split('"')
            if len(parts) > 2:
                parts[2 * rng.randrange(len(parts) // 2) + 1] = rng.choice(TOKENS)
            text = '"'.join(parts)
        elif kind == 3:  # a stretch of elements twice
            start, end = text.rfind("<", 0, at), text.find(">", at)
            if 0 <= start < end:
                text = text[: end + 1] + text[start : end + 1] * rng.choice((1, 3)) + text[end + 1 :]
        else:  # an element lost
            start, end = text.rfind("<", 0, at), text.find(">", at)
            if 0 <= start < end:
                text = text[:start] + text[end + 1 :]
        if not text:
            break
    return text


def check(folder: Path, count: int, seed: int, texts: list[str]) -> int:
    """Read ``count`` damaged scenes; return how many were scenes still."""
    rng, readable = random.Random(seed), 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(count):
        text = damaged(rng.choice(texts), rng)
        file = folder / "scene.xml"
        file.write_text(text, encoding="utf-8", errors="replace")
        start = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImportedSceneWarning)
            warnings.simplefilter("ignore", EnergyWarning)
            try:
                read_description(str(file), overrides={"import.missing": rng.choice(("warn", "error"))})
                readable += 1
            except TorchptError as error:
                assert "\n" not in str(error), text
            except Exception as error:
                raise AssertionError(f"{error!r} of {text}") from error
        assert time.perf_counter() - start < LONGEST, text
        assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) < MOST_BYTES, text
    return readable


def test_damaged_scenes_are_errors_or_scenes(tmp_path: Path) -> None:
    write_assets(tmp_path)
    readable = check(tmp_path, 200, 1, TEXTS)
    assert 10 < readable < 190  # else the damage says nothing


@pytest.mark.slow
def test_many_damaged_scenes_are_errors_or_scenes(tmp_path: Path) -> None:
    write_assets(tmp_path)
    assert check(tmp_path, 2000, 2, TEXTS) > 100


PUBLIC = Path(os.environ.get("TORCHPT_SCENES", Path(__file__).parents[2].parent / "shared" / "scenes"))


@pytest.mark.slow
@pytest.mark.skipif(not PUBLIC.is_dir(), reason="no public scenes ($TORCHPT_SCENES)")
def test_damaged_public_scenes_are_errors_or_scenes(tmp_path: Path) -> None:
    files = sorted(PUBLIC.glob("*/*.xml"))
    assert files
    for number, file in enumerate(files):
        for entry in file.parent.iterdir():
            if entry.is_dir() and not (tmp_path / entry.name).exists():
                (tmp_path / entry.name).symlink_to(entry)
        check(tmp_path, 2000 // len(files), number, [file.read_text(encoding="utf-8")])
