"""The names of the files of a report's plots."""

from __future__ import annotations

from torchpt.reports.report import plot_stems


def test_scenes_of_one_stem_have_plots_of_their_own() -> None:
    assert plot_stems(["cornell_box", "a/my room.yaml", "b/my room.yml", "my_room_2", "a/my-room.yaml"]) == [
        "cornell_box",
        "my_room",
        "my_room_2",
        "my_room_2_2",
        "my_room_3",
    ]
