"""Names that the field has another word for do not come back: identifiers of the syntax tree, never prose.

docs/glossary.md has the words that took their place.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "torchpt"

RETIRED = frozenset(
    """
ASKED Assembly Before Behind Bench Bounced ByTree Chosen ChunkSums Copies Crew Editions FARTHEST FEWEST_OF_LOOP
FEWEST_OF_TAIL FOREVER Gathers Handed JointKernels Keeper Kept KnownError LED_HERE Legible Looks Lost MOST_UNFOLDED
Memo Met NARROW Need OnSurface Onward Opener Pyramids Relief RenderWishes SIGHTS Shone SinkLines Surroundings Tally
TraceWishes UNPRINTED Unfit Unlit Valued WAYS WideInstanced Wishes _DEAR _Noted _Story _UNSAID _UNSAID_EXPONENT
_Watch _Wish _as_written _assigned _blamed _bring _brought _by_pilots _certain _check_wishes _deltas _editions
_forget_look _held_up _in_sight _keeps_no_more _lit_by _look_again _never_freed _of_built _of_one_picture
_of_squares _of_sums _parted _pulls _really _slide _standing_out _unlooked _unread _vetted again_counts asked_of
asks at_once back_bounce back_eager back_emit back_escape back_kernel by_film carry_on chance_of charted charts_of
check_room check_sources corners_in corners_of_polygons declare_corners diffuse_passed drop_of_power editions
faults_of follow_shape follows_shape gathered_by gatherer glowing in_pieces in_transform key_of knowing known_error
lanes_for lasting leaning let_go load_others look_again loop_facts loop_of main_of_ranks matte mesh_shapes middle_of
misfit name_salts need_of of_tape on_tape ordered_along over_base own_scene packet_words packets_of pilots_alone
plain_png plate pruned put_back ran_out ranked rebound refuse_foreign relief retried room_of say_once
search_functions second_values shared_out sift sifted sink_lines slide slides speaking spelled splat_clear
start_team still_of suffices suits summands surroundings tabled take_rest taken_from taken_over texels_of to_look_at
too_many undisturbed unseen vet vetted vetting warn_of_touching weighed when_short widened with_texels
    """.split()
)


def identifiers(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name):
                yield name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.alias(name=name, asname=other):
                yield from (*name.split("."), other or "")
            case ast.keyword(arg=str(name)):
                yield name


def test_none_is_left() -> None:
    found, files = [], list(PACKAGE.rglob("*.py"))
    assert len(files) > 300
    for file in files:
        names = {file.stem, *identifiers(ast.parse(file.read_text(encoding="utf-8")))}
        found += [f"{file.relative_to(PACKAGE)}: {name}" for name in sorted(names & RETIRED)]
    assert not found


def test_a_retired_name_would_be_seen() -> None:
    source = "import torchpt.rendering.orders as o\nclass Wishes: pass\ndef f(asked_of): x.let_go(on_tape=1)"
    assert {"orders", "Wishes", "asked_of", "let_go", "on_tape"} <= set(identifiers(ast.parse(source)))
